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

from .friction import FrictionLaw, HeldBound

Float = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]

BOUND_TOLERANCE = 1e-6
"""What sticks slides when its shear traction exceeds this part of the bound: it may be on it."""

ROUND_OFF = 1e-10
"""What slides goes on where it has slid back by no more than this, relative to the bound."""


@dataclass
class ContactStatus:
    """State of the secondary nodes of a pair.

    Attributes:
        closed: Whether a node touches; shape (n_s,).
        slipping: Whether a node slides against friction; shape (n_s,).
        direction: +1 or -1, the direction of slip along the tangent; shape (n_s,).
        rubbing: Whether friction acts on a node: on closed ones where None; shape (n_s,).
    """

    closed: Bool
    slipping: Bool
    direction: Float = field(repr=False)
    rubbing: Bool | None = field(default=None, repr=False)

    @classmethod
    def open(cls, n: int) -> ContactStatus:
        """All nodes open."""
        return cls(np.zeros(n, bool), np.zeros(n, bool), np.ones(n))

    @property
    def sticking(self) -> Bool:
        """Whether a node on which friction acts does not slide; shape (n_s,)."""
        return (self.closed if self.rubbing is None else self.rubbing) & ~self.slipping

    def same(self, other: ContactStatus) -> bool:
        """Whether sets and directions are those of another state."""
        return (
            np.array_equal(self.closed, other.closed)
            and np.array_equal(self.sticking, other.sticking)
            and np.array_equal(self.slipping, other.slipping)
            and np.array_equal(self.direction[self.slipping], other.direction[other.slipping])
        )

    @property
    def signature(self) -> bytes:
        """Sets and directions in short, to recognise them."""
        sign = np.where(self.slipping, self.direction, 0.0)
        return (sign + 3.0 * self.closed + 6.0 * self.sticking).astype(np.int8).tobytes()

    def restricted(self, kept: Bool, law: FrictionLaw | None) -> ContactStatus:
        """Return the same sets without nodes that carry no multiplier any more.

        Args:
            kept: Nodes that carry one; shape (n_s,).
            law: Friction law; None without friction.
        """
        slipping = self.slipping & kept & (law is not None)
        return ContactStatus(self.closed & kept, slipping, self.direction)

    def updated(
        self,
        kept: Bool,
        pressure: Float,
        shear: Float,
        gap: Float,
        slip: Float,
        stiffness: tuple[Float, Float],
        law: FrictionLaw | None,
        damped: bool = False,
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
            damped: Whether open nodes count with the tractions that a damped step leaves on them,
                so that the sets depend on the state alone.
        """
        p = pressure if damped else np.where(self.closed, pressure, 0.0)
        t = shear if damped else np.where(self.closed, shear, 0.0)
        trial = p - stiffness[0] * gap
        closed = kept & (trial > 0.0)
        if law is None:
            return ContactStatus(closed, np.zeros_like(closed), self.direction)
        bound, _ = law.bound(np.maximum(trial, 0.0))
        trial_shear = t - stiffness[1] * slip
        # What slides goes on until it slides back; what sticks needs more than round-off to slide.
        slack = np.where(self.slipping, -ROUND_OFF, BOUND_TOLERANCE)
        rubbing = kept & (bound > 0.0) if isinstance(law, HeldBound) else closed
        slipping = rubbing & (np.abs(trial_shear) > bound * (1.0 + slack))
        direction = np.where(slipping, -np.sign(trial_shear), self.direction)
        return ContactStatus(closed, slipping, direction, rubbing)


def complementarity(
    pressure: Float,
    shear: Float,
    gap: Float,
    slip: Float,
    stiffness: tuple[Float, Float],
    law: FrictionLaw | None,
) -> tuple[Float, Float]:
    """Functions of the state that vanish where contact and friction hold, continuous over all sets.

    p - max(p - c_n g, 0) and t less t - c_t v cut to the bound (Gitterle et al. 2010).

    Args:
        pressure: Contact pressure [Pa]; shape (n_s,).
        shear: Shear traction along the tangent [Pa]; shape (n_s,).
        gap: Weighted gap [m]; shape (n_s,).
        slip: Slip since the start of the step [m]; shape (n_s,).
        stiffness: c_n and c_t [Pa/m]; shapes (n_s,).
        law: Friction law; None without friction.

    Returns:
        Both functions [Pa]; shapes (n_s,).
    """
    trial = np.maximum(pressure - stiffness[0] * gap, 0.0)
    bound = np.zeros_like(trial) if law is None else law.bound(trial)[0]
    return pressure - trial, shear - np.clip(shear - stiffness[1] * slip, -bound, bound)
