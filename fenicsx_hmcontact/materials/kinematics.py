# SPDX-License-Identifier: LGPL-3.0-or-later
"""Strain increments of a step at small and finite strain (Section 3.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import ufl
from ufl.core.expr import Expr

from ..smoothing import METADATA_KEY

Kinematics = Literal["small", "finite"]


def check_kinematics(kinematics: str, measure: ufl.Measure) -> None:
    """Refuse a kinematics that does not exist, or not on a measure.

    Raises:
        ValueError: If there is none of that name, or finite strain is asked for on node cells with
            the deviatoric enhancement, which replaces only the linear trace of the gradient.
    """
    if kinematics not in get_args(Kinematics):
        known = ", ".join(get_args(Kinematics))
        raise ValueError(f"kinematics is {kinematics!r}; it must be one of {known}")
    if kinematics == "finite" and _enhancement(measure) == "deviatoric":
        raise ValueError(
            "finite kinematics does not go with the deviatoric enhancement, whose trace is that of "
            "small strain: take node_cells_measure('full'), where F-bar does the same"
        )


@dataclass(frozen=True)
class StepDeformation:
    """Deformation of a step, on a mesh that stands at the start of the step.

    Attributes:
        F: Deformation gradient; UFL, shape (2, 2).
        J: Its determinant.
        J_b: Jacobian of the node cell's area, for F-bar; None without.
    """

    F: Expr
    J: Expr
    J_b: Expr | None

    @property
    def F_bar(self) -> Expr:
        """F, or scaled to the Jacobian of the cell: F-bar (de Souza Neto et al. 1996)."""
        return self.F if self.J_b is None else ufl.sqrt(self.J_b / self.J) * self.F


def step_deformation(u: Expr, u_n: Expr, measure: ufl.Measure) -> StepDeformation:
    """Deformation of a step as terms on a measure see it.

    With the fully enhanced gradient the Jacobian is that of the node cell's area: it does not lock,
    and the cell keeps exactly its volume.

    Args:
        u: Displacement at the end of the step [m].
        u_n: Displacement at its start, where the mesh stands [m].
        measure: Measure of the stress.
    """
    # By components: UFL then recognises the same mean in all derivatives.
    H, H_n, one = ufl.grad(u), ufl.grad(u_n), np.eye(2)
    F = ufl.as_matrix([[one[i, j] + H[i, j] - H_n[i, j] for j in range(2)] for i in range(2)])
    J = ufl.det(F)
    return StepDeformation(F, J, ufl.cell_avg(J) if _enhancement(measure) == "full" else None)


def strain_increment(u: Expr, u_n: Expr) -> list[Expr]:
    """Strain increment xx, yy, 2 xy of a step at small strain [-]."""
    strain = ufl.sym(ufl.grad(u - u_n))
    return [strain[0, 0], strain[1, 1], 2.0 * strain[0, 1]]


def midpoint_increment(F: Expr) -> list[Expr]:
    """Increments of a step at finite strain, about its middle (Hughes and Winget 1980).

    Args:
        F: Deformation gradient of the step.

    Returns:
        Strain increment xx, yy, 2 xy and spin increment (H_xy - H_yx)/2 [-].
    """
    middle = 0.5 * (F + ufl.Identity(2))
    H = ufl.dot(F - ufl.Identity(2), ufl.inv(middle))
    return [H[0, 0], H[1, 1], H[0, 1] + H[1, 0], 0.5 * (H[0, 1] - H[1, 0])]


def _enhancement(measure: ufl.Measure) -> str | None:
    """Enhancement of a measure over node cells."""
    return measure.metadata().get(METADATA_KEY)
