# SPDX-License-Identifier: LGPL-3.0-or-later
"""Functions whose values live at smoothing points."""

from __future__ import annotations

import math
from typing import Any

import basix.ufl
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx.mesh import Mesh

from .measure import Enhancement


class PointFunction(ufl.Coefficient):
    """A coefficient of smoothed terms with a value of its own at each smoothing point.

    In a form it stands for its value at the point that the term is evaluated at. It has no
    gradient, and a derivative with respect to another field does not see how its values came about.

    Args:
        mesh: Mesh of the node cells.
        shape: UFL shape.
        enhancement: Enhancement of the measure of its terms.
        values: Values at the points of each cell; shape (n_cells, n_points, components).
        name: Name in messages.

    Attributes:
        cells: Cells that have values, in ascending order; all where None.
        operator: What gives the values at any state, None for plain data.
    """

    def __init__(
        self,
        mesh: Mesh,
        shape: tuple[int, ...],
        enhancement: Enhancement,
        values: npt.NDArray[np.float64],
        name: str = "point function",
    ) -> None:
        element = basix.ufl.element("DG", "triangle", 0, shape=shape)
        super().__init__(ufl.FunctionSpace(mesh.ufl_domain(), element))
        if values.shape[2] != math.prod(shape):
            raise ValueError(f"{name} of shape {shape} was given {values.shape[2]} values a point")
        self.mesh = mesh
        self.enhancement = enhancement
        self.values = values
        self.name = name
        self.cells: npt.NDArray[np.int32] | None = None
        self.operator: Any = None
