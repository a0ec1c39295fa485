# SPDX-License-Identifier: LGPL-3.0-or-later
"""What acts between two surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float64]


class NodeState(IntEnum):
    """State of a node of the secondary surface."""

    UNPAIRED = -1
    """It faces no primary facet, or it is prescribed."""
    OPEN = 0
    STICKING = 1
    SLIPPING = 2
    """Closed and free to slide, by friction at its bound or without friction."""


@dataclass(frozen=True)
class InterfaceState:
    """What acts between the surfaces of a pair, at the nodes of the secondary surface.

    Attributes:
        points: Coordinates of the nodes [m]; shape (n, 2).
        normals: Unit normals, from primary to secondary; shape (n, 2).
        pressure: Effective contact pressure [Pa], compression positive; nan at unpaired nodes;
            (n,).
        shear: Shear traction on the secondary surface along the tangent (n_y, -n_x) [Pa]; (n,).
        pore_pressure: Mean pore pressure of both faces [Pa], zero without water; (n,).
        jump: Pore pressure of the secondary less that of the primary face [Pa]; (n,).
        gap: Distance of the surfaces [m], positive where open: the weighted gap (Eq. 70) less what
            dropped neighbours add to it; nan at unpaired nodes; (n,).
        slip: Relative displacement along the tangent in the last step [m]; (n,).
        state: `NodeState` of each node; (n,).
        length: Part of the secondary surface that a node stands for [m]; (n,).
        forces: Forces of the primary surface, solid and water, on the nodes [N/m]; shape (n, 2).
        volume: Volume of the gap [m^3/m].
        primary_points: Coordinates of the nodes of the primary surface [m]; shape (k, 2).
        primary_forces: Forces of the secondary surface on them [N/m]; shape (k, 2).
        water_forces: What the water does of the forces on the secondary nodes [N/m]; shape (n, 2).
        taken_up: Water that the gap took from the bodies in the last step [m^3/m].
        swept: Water that came into the gap at its ends, with surfaces that move, in the last step
            [m^3/m]; the change of the volume is what is taken up and swept in.
    """

    points: Float
    normals: Float
    pressure: Float
    shear: Float
    pore_pressure: Float
    jump: Float
    gap: Float
    slip: Float
    state: npt.NDArray[np.int8]
    length: Float
    forces: Float
    volume: float
    primary_points: Float
    primary_forces: Float
    water_forces: Float
    taken_up: float = 0.0
    swept: float = 0.0

    @property
    def force(self) -> Float:
        """Resultant of the forces on the secondary surface [N/m]; shape (2,)."""
        total: Float = self.forces.sum(axis=0)
        return total

    def moment(self, about: tuple[float, float] = (0.0, 0.0)) -> float:
        """Moment of the forces on the secondary surface, anticlockwise [N m/m].

        Args:
            about: Point [m].
        """
        arm = self.points - np.asarray(about)
        return float(np.sum(arm[:, 0] * self.forces[:, 1] - arm[:, 1] * self.forces[:, 0]))

    @property
    def closed(self) -> npt.NDArray[np.bool_]:
        """Which nodes touch; shape (n,)."""
        return self.state >= NodeState.STICKING
