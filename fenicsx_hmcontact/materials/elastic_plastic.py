# SPDX-License-Identifier: LGPL-3.0-or-later
"""Laws with linear elasticity: what is left to write is the return of a trial stress."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from .elasticity import IsotropicElasticity
from .interface import Bool, Float, MaterialUpdate


class ReturnMapping(NamedTuple):
    """Result of a return mapping of n points.

    Attributes:
        stress: Stress xx, yy, zz, xy at the end [Pa]; shape (n, 4).
        history: Histories at the end; shape (n, m).
        tangent: Derivative of the stress by the trial stress [-]; shape (n, 4, 4).
        flagged: Points without a solution, None where there always is one; shape (n,).
        reason: Why points are flagged.
    """

    stress: Float
    history: Float
    tangent: Float
    flagged: Bool | None = None
    reason: str = ""


@dataclass(frozen=True)
class ElasticPlastic(IsotropicElasticity, ABC):
    """Base of laws whose elasticity is linear and isotropic; it remembers the plastic strain.

    A law of one's own overrides `return_mapping`, and `history_names` where it remembers more.

    Attributes:
        E: Young's modulus [Pa].
        nu: Poisson's ratio [-].
    """

    history_names: ClassVar[tuple[str, ...]] = ("kappa",)

    @abstractmethod
    def return_mapping(self, trial: Float, history: Float) -> ReturnMapping:
        """Return trial stresses to the elastic range.

        Args:
            trial: Stress xx, yy, zz, xy if the step were elastic [Pa]; shape (n, 4).
            history: Histories at the start of the step; shape (n, m).
        """

    def initial_history(self, n: int) -> Float:
        """Zeros; shape (n, m)."""
        return np.zeros((n, len(self.history_names)))

    def update(self, stress: Float, strain: Float, history: Float) -> MaterialUpdate:
        """Return the elastic trial stress of the step, see `Material`."""
        result = self.return_mapping(stress + strain @ self.stiffness.T, history)
        # One product of two matrices: NumPy's product of stacks is slower.
        by_strain = (result.tangent.reshape(-1, 4) @ self.stiffness).reshape(-1, 4, 3)
        return MaterialUpdate(
            result.stress, result.history, by_strain, result.tangent, result.flagged, result.reason
        )
