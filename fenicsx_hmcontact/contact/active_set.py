# SPDX-License-Identifier: LGPL-3.0-or-later
"""Which secondary nodes are closed, and which of them slide (Section 4.1).

Newton's method on the complementarity conditions: the trial values p - c_n g and t - c_t v decide,
also for nodes that close just now (Gitterle et al. 2010), so that a step needs few iterations and
does not depend on the constants.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from .friction import FrictionLaw

Float = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]

BOUND_TOLERANCE = 1e-6
"""A shear traction on the bound within this part of it sticks: what slid before is on it."""


@dataclass
class ContactStatus:
    """State of the secondary nodes of a pair.

    Attributes:
        closed: Whether a node touches; shape (n_s,).
        slipping: Whether a closed node slides; shape (n_s,).
        direction: +1 or -1, the direction of slip along the tangent; shape (n_s,).
    """

    closed: Bool
    slipping: Bool
    direction: Float = field(repr=False)

    @classmethod
    def open(cls, n: int) -> ContactStatus:
        """All nodes open."""
        return cls(np.zeros(n, bool), np.zeros(n, bool), np.ones(n))

    @property
    def sticking(self) -> Bool:
        """Whether a closed node does not slide; shape (n_s,)."""
        return self.closed & ~self.slipping

    def same(self, other: ContactStatus) -> bool:
        """Whether sets and directions are those of another state."""
        return (
            np.array_equal(self.closed, other.closed)
            and np.array_equal(self.slipping, other.slipping)
            and np.array_equal(self.direction[self.slipping], other.direction[other.slipping])
        )

    def updated(
        self,
        kept: Bool,
        pressure: Float,
        shear: Float,
        gap: Float,
        slip: Float,
        stiffness: tuple[Float, Float],
        law: FrictionLaw | None,
    ) -> ContactStatus:
        """Return the sets that the trial values ask for.

        Args:
            kept: Nodes that carry a multiplier; others are open; shape (n_s,).
            pressure: Contact pressure [Pa]; shape (n_s,).
            shear: Shear traction along the tangent [Pa]; shape (n_s,).
            gap: Weighted gap [m]; shape (n_s,).
            slip: Slip since the start of the step [m]; shape (n_s,).
            stiffness: c_n and c_t [Pa/m]; shapes (n_s,).
            law: Friction law; None without friction.
        """
        p = np.where(self.closed, pressure, 0.0)
        t = np.where(self.closed, shear, 0.0)
        trial = p - stiffness[0] * gap
        closed = kept & (trial > 0.0)
        if law is None:
            return ContactStatus(closed, np.zeros_like(closed), self.direction)
        bound, _ = law.bound(np.maximum(trial, 0.0))
        trial_shear = t - stiffness[1] * slip
        slipping = closed & (np.abs(trial_shear) > bound * (1.0 + BOUND_TOLERANCE))
        direction = np.where(slipping, -np.sign(trial_shear), self.direction)
        return ContactStatus(closed, slipping, direction)
