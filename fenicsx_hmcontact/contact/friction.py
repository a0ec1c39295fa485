# SPDX-License-Identifier: LGPL-3.0-or-later
"""Laws between the solids of two surfaces.

A law of one's own is any object with `bound`: the largest shear traction at a contact pressure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float64]

COHESION_RAMP = 0.1
"""Cohesion is full from this contact pressure on, relative to the cohesion."""


@runtime_checkable
class FrictionLaw(Protocol):
    """What the active set needs of a law."""

    def bound(self, pressure: Float) -> tuple[Float, Float]:
        """Largest shear traction and its slope.

        Args:
            pressure: Effective contact pressure [Pa], zero or positive; shape (n,).

        Returns:
            Bound [Pa] and its derivative with respect to the pressure [-]; shapes (n,).
        """


@dataclass(frozen=True)
class Tied:
    """The surfaces move together: neither parting nor sliding."""


@dataclass(frozen=True)
class Frictionless:
    """The surfaces press on each other and slide freely. Nothing tangential is computed."""


@dataclass(frozen=True)
class CoulombFriction:
    """Mohr-Coulomb friction: the shear traction is at most mu p + c (Eqs. 14 and 15).

    Attributes:
        mu: Coefficient of friction [-].
        cohesion: c [Pa]. It acts in full from a contact pressure of ``ramp`` on, and in proportion
            below: a jump at p = 0 would let nodes open and close in turns.
        ramp: That pressure [Pa]; a tenth of the cohesion where None.
        lagged: Whether the pressures of the step's start bound the shear traction all through it.
            Contact is then the minimum of an energy, as far as surfaces move little in a step, but
            the bound errs in first order of the step, and the first step is free of friction. Set
            it where steps fail because nodes stick and slip in turns.

    Raises:
        ValueError: If a value is negative.
    """

    mu: float
    cohesion: float = 0.0
    ramp: float | None = None
    lagged: bool = False

    def __post_init__(self) -> None:
        """Refuse values that make no sense."""
        for name in ("mu", "cohesion"):
            value = getattr(self, name)
            if not (value >= 0.0 and math.isfinite(value)):
                raise ValueError(f"{name} is {value}; it must be zero or positive")
        if self.ramp is not None and not (self.ramp > 0.0 and math.isfinite(self.ramp)):
            raise ValueError(f"ramp is {self.ramp}; it must be positive")

    def bound(self, pressure: Float) -> tuple[Float, Float]:
        """Largest shear traction [Pa] and its slope [-]; shapes (n,).

        Args:
            pressure: Effective contact pressure [Pa]; shape (n,).
        """
        slope = np.full(pressure.shape, self.mu)
        if self.cohesion == 0.0:
            return self.mu * pressure, slope
        ramp = COHESION_RAMP * self.cohesion if self.ramp is None else self.ramp
        slope[pressure < ramp] += self.cohesion / ramp
        return self.mu * pressure + self.cohesion * np.minimum(pressure / ramp, 1.0), slope


@dataclass(frozen=True)
class HeldBound:
    """Bounds that do not follow the pressure, and act on open nodes too.

    With them contact is the minimum of an energy, which is why Newton's method finds it.

    Attributes:
        values: Largest shear traction of each node [Pa]; shape (n,).
    """

    values: Float

    def bound(self, pressure: Float) -> tuple[Float, Float]:
        """Largest shear traction [Pa] and its slope [-]; shapes (n,).

        Args:
            pressure: Effective contact pressure [Pa]; shape (n,).
        """
        return self.values, np.zeros_like(pressure)


def tangential_law(law: object) -> FrictionLaw | None:
    """Return the law of the shear traction, None where there is no friction.

    Raises:
        ValueError: If the object is no law.
    """
    if isinstance(law, Frictionless):
        return None
    if isinstance(law, CoulombFriction) and law.mu == 0.0 and law.cohesion == 0.0:
        return None
    if isinstance(law, type) or not isinstance(law, FrictionLaw):
        raise ValueError(f"{law!r} is no friction law: it has no method bound(pressure)")
    return law
