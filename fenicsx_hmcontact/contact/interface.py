# SPDX-License-Identifier: LGPL-3.0-or-later
"""What acts between two surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class InterfaceState:
    """What acts between the surfaces of a pair, at the nodes of the secondary surface.

    Attributes:
        points: Coordinates of the nodes [m]; shape (n, 2).
        normals: Unit normals, from primary to secondary; shape (n, 2).
        pressure: Effective contact pressure [Pa], compression positive; nan at dropped nodes; (n,).
        shear: Shear traction on the secondary surface along the tangent (n_y, -n_x) [Pa]; (n,).
        pore_pressure: Mean pore pressure of both faces [Pa], zero without water; (n,).
        jump: Pore pressure of the secondary less that of the primary face [Pa]; (n,).
    """

    points: npt.NDArray[np.float64]
    normals: npt.NDArray[np.float64]
    pressure: npt.NDArray[np.float64]
    shear: npt.NDArray[np.float64]
    pore_pressure: npt.NDArray[np.float64]
    jump: npt.NDArray[np.float64]
