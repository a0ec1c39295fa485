# SPDX-License-Identifier: LGPL-3.0-or-later
"""Newton's method on the scaled, condensed equations."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

from mpi4py import MPI

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class NewtonOptions:
    """When Newton's method stops.

    Attributes:
        tolerance: Largest scaled residual of each balance, relative to the scaled increment of the
            step [-]. Lower it for figures to round-off, raise it for quick looks.
        max_iterations: Most iterations of one step [-]. Raise it for hard steps.
    """

    tolerance: float = 1e-10
    max_iterations: int = 25

    def __post_init__(self) -> None:
        """Refuse values that make no sense."""
        if not 0.0 < self.tolerance < 1.0:
            raise ValueError(f"tolerance is {self.tolerance}; it must lie between 0 and 1")
        if self.max_iterations < 1:
            raise ValueError(f"max_iterations is {self.max_iterations}; it must be at least 1")


class ConvergenceError(RuntimeError):
    """Newton's method did not converge.

    Attributes:
        history: Largest scaled residual relative to the increment, after each iteration.
    """

    def __init__(self, message: str, history: list[float]) -> None:
        super().__init__(message)
        self.history = history


@dataclass
class NewtonResult:
    """What a converged step took.

    Attributes:
        iterations: Number of linear solves.
        history: Residual of each field after each solve, scaled and relative to the increment.
    """

    iterations: int = 0
    history: list[list[float]] = field(default_factory=list)


class System(Protocol):
    """What `solve_newton` needs of the equations; arrays hold the owned unknowns."""

    field_names: list[str]
    comm: MPI.Comm

    @property
    def settled(self) -> bool:
        """Whether the last residual was that of the same contact sets as the one before."""

    def residual(self) -> None:
        """Assemble the residual at the current state; it may hold anything but must be finite.

        Raises:
            FloatingPointError: If it is not, naming the field; on all ranks alike.
        """

    def increment(self) -> npt.NDArray[np.float64]:
        """Assemble the tangent where it has changed, solve, and add the increment."""

    def scaled_residuals(self) -> list[float]:
        """Norm of the scaled residual of each field, free unknowns only."""

    def scaled_norms(self, increment: npt.NDArray[np.float64]) -> tuple[float, float]:
        """Norms of a scaled increment, and of the scaled unknowns and forces of supports."""


ROUND_OFF = 1e3 * float(np.finfo(np.float64).eps)
"""Residual that is round-off, relative to the scaled unknowns themselves."""


def solve_newton(system: System, options: NewtonOptions) -> NewtonResult:
    """Iterate until the residual of every field is small.

    The symmetric scaling that gives the matrix a unit diagonal makes increments and residuals of
    all fields comparable, whatever the units: residuals are measured against the scaled change in
    the step. A residual that is round-off of the state itself is accepted as zero.

    Args:
        system: The equations.
        options: When to stop.

    Returns:
        The number of iterations and the residuals on the way.

    Raises:
        ConvergenceError: If the residual does not become small, or is not a number.
    """
    result = NewtonResult()
    change: npt.NDArray[np.float64] | None = None
    worst: list[float] = []
    _residual(system, worst)
    while result.iterations < options.max_iterations:
        increment = system.increment()
        result.iterations += 1
        _residual(system, worst)
        # Of the whole step: one wild increment must not loosen the test.
        change = increment if change is None else change + increment
        size, state = system.scaled_norms(change)
        residuals = system.scaled_residuals()
        floor = ROUND_OFF * state
        relative = [r / size if size > 0.0 else r for r in residuals]
        result.history.append(relative)
        worst.append(max(relative))
        if system.settled and all(r <= max(options.tolerance * size, floor) for r in residuals):
            return result
    name = system.field_names[int(np.argmax(result.history[-1]))]
    raise ConvergenceError(
        f"no convergence in {options.max_iterations} iterations: the residual of {name} is still "
        f"{worst[-1]:.1e} of the increment",
        worst,
    )


def _residual(system: System, history: list[float]) -> None:
    try:
        system.residual()
    except FloatingPointError as error:
        raise ConvergenceError(str(error), history) from error
