# SPDX-License-Identifier: LGPL-3.0-or-later
"""Numbering, local and global matrix, linear solver and Newton's method."""

from .layout import FieldLayout
from .linear import DEFAULT_OPTIONS, LinearSolver, SingularSystemError
from .matrix import LocalMatrix
from .newton import ConvergenceError, NewtonOptions, NewtonResult, solve_newton

__all__ = [
    "DEFAULT_OPTIONS",
    "ConvergenceError",
    "FieldLayout",
    "LinearSolver",
    "LocalMatrix",
    "NewtonOptions",
    "NewtonResult",
    "SingularSystemError",
    "solve_newton",
]
