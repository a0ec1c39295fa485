# SPDX-License-Identifier: LGPL-3.0-or-later
"""Numbering, local and global matrix, linear solver, Newton's method and time steps."""

from .layout import FieldLayout
from .linear import DEFAULT_OPTIONS, LinearSolver, LinearSolverError, SingularSystemError
from .matrix import LocalMatrix
from .newton import ConvergenceError, NewtonOptions, NewtonResult, relax, solve_newton
from .time_stepping import (
    Step,
    StepOptions,
    Steppable,
    StepRejected,
    TimeStepping,
    TimeSteppingError,
    TransientModel,
    restore_values,
    save_values,
)

__all__ = [
    "DEFAULT_OPTIONS",
    "ConvergenceError",
    "FieldLayout",
    "LinearSolver",
    "LinearSolverError",
    "LocalMatrix",
    "NewtonOptions",
    "NewtonResult",
    "SingularSystemError",
    "Step",
    "StepOptions",
    "StepRejected",
    "Steppable",
    "TimeStepping",
    "TimeSteppingError",
    "TransientModel",
    "relax",
    "restore_values",
    "save_values",
    "solve_newton",
]
