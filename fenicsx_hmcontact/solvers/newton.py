# SPDX-License-Identifier: LGPL-3.0-or-later
"""Newton's method on the scaled, condensed equations."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Protocol

from mpi4py import MPI

import numpy as np

from .linear import SingularSystemError


@dataclass(frozen=True)
class NewtonOptions:
    """When Newton's method stops.

    Attributes:
        tolerance: Largest scaled residual of each balance, relative to the scaled increment of the
            step [-]. Lower it for figures to round-off, raise it for quick looks.
        max_iterations: Most iterations of one step [-]. Most steps take 1 to 8; contact sets that
            cycle take more. Lower it where steps are cut anyway.
        relaxation: Where the method fails, the solid creeps to equilibrium against dashpots, with
            moves of about this length [m]; 0: never. Set it to a tenth of the shortest edges where
            soil snaps from one equilibrium to another: no step is short enough for that.
    """

    tolerance: float = 1e-10
    max_iterations: int = 50
    relaxation: float = 0.0

    def __post_init__(self) -> None:
        """Refuse values that make no sense."""
        if not 0.0 < self.tolerance < 1.0:
            raise ValueError(f"tolerance is {self.tolerance}; it must lie between 0 and 1")
        if self.max_iterations < 1:
            raise ValueError(f"max_iterations is {self.max_iterations}; it must be at least 1")
        if not 0.0 <= self.relaxation < np.inf:
            raise ValueError(f"relaxation is {self.relaxation}; it must be 0 or a length")


class ConvergenceError(RuntimeError):
    """Newton's method did not converge.

    Attributes:
        history: Largest scaled residual relative to the increment, after each iteration; nan where
            that is not a number. Empty if the step fails before its first iteration.
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
        contacts: Number of nodes in each state, by pair, after each solve.
        lengths: Part of the increment that was taken in each iteration [-].
    """

    iterations: int = 0
    history: list[list[float]] = field(default_factory=list)
    contacts: list[dict[str, dict[str, int]]] = field(default_factory=list)
    lengths: list[float] = field(default_factory=list)


class System(Protocol):
    """What `solve_newton` needs of the equations; arrays hold the owned unknowns."""

    field_names: list[str]
    comm: MPI.Comm

    @property
    def sets(self) -> bytes:
        """The contact sets that the last residual belongs to; the same on all ranks."""

    @property
    def settled(self) -> bool:
        """Whether the last residual was that of the same contact sets as the one before."""

    def residual(self, damped: bool = False) -> None:
        """Assemble the residual at the current state; it may hold anything but must be finite.

        Args:
            damped: Whether the last increment was not taken as a whole.

        Raises:
            FloatingPointError: If it is not, naming the field; on all ranks alike.
        """

    def increment(self, damping: float = 0.0) -> None:
        """Assemble the tangent where it has changed, solve, and add the increment.

        Args:
            damping: Resistance of dashpots at the nodes of the solid, relative to the scaled
                residual of its equilibrium [1/m].
        """

    @property
    def farthest(self) -> float:
        """Longest move of a node along an axis in the last increment [m]."""

    @property
    def reach(self) -> float:
        """Part of the last increment that moves contact surfaces by no more than a facet."""

    def move(self, part: float) -> None:
        """Add a part of the last increment once more; a negative one takes it back."""

    def violation(self, held: bool = True) -> float:
        """Norm of the scaled residual as a continuous function of the state, over all sets.

        Args:
            held: Whether held bounds of friction count, or those of the pressures.
        """

    def scaled_residuals(self) -> list[float]:
        """Norm of the scaled residual of each field, free unknowns only."""

    def scaled_norms(self) -> tuple[float, float]:
        """Norms of the scaled change in the step, and of the scaled unknowns and reactions."""

    def hold(self) -> None:
        """Hold the bounds of friction, after a move towards those of the present pressures."""

    def release(self) -> None:
        """Let the bounds of friction follow the pressures again."""

    def contacts(self) -> dict[str, dict[str, int]]:
        """Number of nodes in each state, by pair."""


ROUND_OFF = 1e2 * float(np.finfo(np.float64).eps)
"""Residual that is round-off, relative to the scaled unknowns themselves."""

PATIENCE = 8
"""Iterations without convergence after which a step is guarded as if its sets cycled."""

CONVERGING = 0.1
"""Decrease of the residual in an iteration with which whole steps are left alone."""

HELD = 1e-6
"""Tolerance at which held bounds move on."""

GUARDED = 30
"""Most guarded iterations in the first round; so many more in each next one."""

SHORTEST = 2.0**-6
"""Shortest part of an increment that is tried."""

DECREASE = 1e-4
"""Part of the decrease at the start of an increment that a damped step must reach."""

MOST_CREEPING = 150
"""Most iterations of creeping."""

FAR = 4.0
"""Longest move in an iteration of creeping, relative to the asked one; longer ones are undone."""

STIFFER, SOFTER = 4.0, 0.5
"""Factors of the dashpots after moves that are undone, and after short ones."""

STUCK = 1e6
"""Factor of the dashpots with which nothing moves any more."""

_log = logging.getLogger(__name__)


def solve_newton(system: System, options: NewtonOptions) -> NewtonResult:
    """Iterate until the residual of every field is small.

    The symmetric scaling that gives the matrix a unit diagonal makes increments and residuals of
    all fields comparable, whatever the units: residuals are measured against the scaled change in
    the step. A residual that is round-off of the state itself is accepted as zero.

    Whole increments are taken until contact sets come back that have been there before: the sets
    cycle. From then on an increment is cut until the violation of equilibrium and contact
    conditions decreases.

    Args:
        system: The equations.
        options: When to stop.

    Returns:
        The number of iterations and the residuals on the way.

    Raises:
        ConvergenceError: If the residual does not become small, or is not a number.
    """
    result = NewtonResult()
    worst: list[float] = []
    _residual(system, worst)
    seen, since, rounds, guarded, calm, ready, last = {system.sets}, 0, 0, 0, 0, True, b""
    while result.iterations < options.max_iterations:
        converging = system.settled and len(worst) > 1 and worst[-1] < CONVERGING * worst[-2]
        if since >= PATIENCE and not guarded and not converging:
            rounds += 1
            guarded, calm, ready = GUARDED * rounds, 0, True
        if guarded and ready:
            system.hold()
            _residual(system, worst, damped=True)
        before = system.violation() if guarded else np.inf
        _increment(system, result, worst)
        result.iterations += 1
        try:
            part = _take(system, before, system.reach if guarded else 1.0)
        except FloatingPointError as error:
            raise ConvergenceError(str(error), [*worst, np.nan]) from error
        size, limit, residuals = _note(system, options, result, worst, part)
        small = all(r <= limit for r in residuals) and system.settled
        if small and part == 1.0 and (not guarded or system.violation(held=False) <= limit):
            return result
        since += 1
        if guarded:
            guarded -= 1
            ready = system.settled and part == 1.0 and all(r <= HELD * size for r in residuals)
            if ready:
                calm = calm + 1 if system.sets == last else 0
                last = system.sets
            if not guarded or calm > 2**rounds:
                guarded = since = 0
                system.release()
                _residual(system, worst, damped=True)
                seen = set()
        elif not system.settled and system.sets in seen:
            since = PATIENCE
        seen.add(system.sets)
    name = system.field_names[int(np.argmax(result.history[-1]))]
    raise ConvergenceError(
        f"no convergence in {options.max_iterations} iterations: the residual of {name} is still "
        f"{worst[-1]:.1e} of the increment",
        worst,
    )


def relax(system: System, options: NewtonOptions) -> NewtonResult:
    """Let the solid creep to equilibrium, against dashpots that fade as it comes to rest.

    Implicit steps of pseudo-time, with the exact tangent and no line search (pseudo-transient
    continuation, Kelley and Keyes 1998). Beyond a limit point, where the residual has a minimum but
    no root nearby, this finds the equilibrium that the solid snaps to; it is one of the same
    equations, to the same tolerance.

    Args:
        system: The equations.
        options: When to stop, and by how much the solid moves in an iteration.

    Returns:
        The number of iterations and the residuals on the way.

    Raises:
        ConvergenceError: If the solid does not come to rest.
    """
    result, worst = NewtonResult(), list[float]()
    resistance = 1.0
    _residual(system, worst)
    for iteration in range(MOST_CREEPING):
        system.increment(resistance / options.relaxation)
        result.iterations += 1
        # What is prescribed moves the solid in the first iteration, by any length.
        fits = iteration == 0 or system.farthest <= FAR * options.relaxation
        if fits:
            try:
                system.residual()
            except FloatingPointError:
                fits = False
        if not fits:
            resistance *= STIFFER
            if iteration == 0 or resistance > STUCK:
                break
            system.move(-1.0)
            _residual(system, worst, damped=True)
            continue
        _, limit, residuals = _note(system, options, result, worst, 1.0)
        if system.settled and all(r <= limit for r in residuals):
            return result
        if system.farthest < options.relaxation:
            resistance *= SOFTER
    raise ConvergenceError("the solid does not come to rest, however it creeps", worst)


def _note(
    system: System,
    options: NewtonOptions,
    result: NewtonResult,
    history: list[float],
    part: float,
) -> tuple[float, float, list[float]]:
    """Take an iteration down; return the size of the step, the limit of residuals, and them."""
    size, state = system.scaled_norms()
    residuals = system.scaled_residuals()
    result.history.append([r / size if size > 0.0 else r for r in residuals])
    result.contacts.append(system.contacts())
    result.lengths.append(part)
    history.append(max(result.history[-1]))
    if system.comm.rank == 0:
        _log.info("%s", _Line(system.field_names, result))
    return size, max(options.tolerance * size, ROUND_OFF * state), residuals


def _increment(system: System, result: NewtonResult, history: list[float]) -> None:
    """Add the next increment; where nothing holds a body, go back part of the last one first."""
    while True:
        try:
            system.increment()
            return
        except SingularSystemError:
            part = 0.5 * result.lengths[-1] if result.lengths else 0.0
            if part < SHORTEST:
                raise
        system.move(-part)
        result.lengths[-1] = part
        _residual(system, history, damped=True)


def _residual(system: System, history: list[float], damped: bool = False) -> None:
    try:
        system.residual(damped)
    except FloatingPointError as error:
        raise ConvergenceError(str(error), history) from error


def _take(system: System, before: float, part: float) -> float:
    """Take the largest part of the increment that decreases the violation, or the best one.

    Args:
        system: The equations, after a whole increment.
        before: Violation before it; infinite to take all that has a residual.
        part: Largest part to try.

    Returns:
        The part taken.
    """
    tried: dict[float, float] = {}
    shortest = SHORTEST * part
    if part < 1.0:
        system.move(part - 1.0)
    while True:
        try:
            system.residual(damped=np.isfinite(before) or part < 1.0)
            if np.isinf(before):
                return part
            tried[part] = system.violation()
            if tried[part] <= (1.0 - DECREASE * part) * before:
                return part
        except FloatingPointError:
            if part <= shortest:
                raise
        if part <= shortest:
            break
        system.move(-0.5 * part)
        part *= 0.5
    best = min(tried, key=lambda p: tried[p])
    if best != part:
        system.move(best - part)
        system.residual(damped=True)
    return best


def contact_counts(contacts: dict[str, dict[str, int]]) -> str:
    """Words for the number of nodes in each state, by pair."""
    return "; ".join(
        f"{pair}: " + ", ".join(f"{n} {state}" for state, n in states.items())
        for pair, states in contacts.items()
    )


class _Line:
    """One line about an iteration, written only where somebody reads it."""

    def __init__(self, names: list[str], result: NewtonResult) -> None:
        self._names, self._result = names, result

    def __str__(self) -> str:
        result = self._result
        residuals = ", ".join(
            f"{n} {r:.1e}" for n, r in zip(self._names, result.history[-1], strict=True)
        )
        counts = contact_counts(result.contacts[-1])
        damped = f", {result.lengths[-1]:.3g} of the increment" if result.lengths[-1] < 1.0 else ""
        return f"iteration {result.iterations}: {residuals}{damped}; {counts}".rstrip("; ")
