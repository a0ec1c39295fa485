# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a material is to the rest of the package: a map of many points at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class MaterialUpdate:
    """What becomes of n points in a step, and its derivatives.

    Attributes:
        stress: Effective stress xx, yy, zz, xy at the end [Pa]; shape (n, 4).
        history: Histories at the end; shape (n, m).
        by_strain: Derivative of the stress by the strain increment xx, yy, 2 xy [Pa]; shape
            (n, 4, 3).
        by_stress: Derivative of the stress by the stress at the start, xy and yx changing together
            [-]; shape (n, 4, 4).
        flagged: Points where the law has no solution and gave a substitute; shape (n,). None for a
            law that always has one. A step that ends with flagged points must not be accepted.
        reason: Why points are flagged, for messages.
    """

    stress: Float
    history: Float
    by_strain: Float
    by_stress: Float
    flagged: Bool | None = None
    reason: str = ""


@runtime_checkable
class Material(Protocol):
    """A law of the effective stress in plane strain; stress is positive in tension.

    Any object with these names is a material. A law whose elasticity is linear is shorter as an
    `ElasticPlastic`.
    """

    @property
    def history_names(self) -> tuple[str, ...]:
        """Names of the m scalars that the law remembers at each point."""

    def initial_history(self, n: int) -> Float:
        """Histories of n points at the start of a computation; shape (n, m)."""

    def update(self, stress: Float, strain: Float, history: Float) -> MaterialUpdate:
        """Follow the material through one step, always from the state at the start of the step.

        Called several times a step, it must leave its arguments as they are.

        Args:
            stress: Effective stress xx, yy, zz, xy at the start of the step, turned with the
                material [Pa]; shape (n, 4).
            strain: Strain increment xx, yy, 2 xy [-]; shape (n, 3).
            history: Histories at the start of the step; shape (n, m).
        """
