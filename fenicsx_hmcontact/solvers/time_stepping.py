# SPDX-License-Identifier: LGPL-3.0-or-later
"""Steps in time that end where they are asked to; what fails is undone and tried with less."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from types import MappingProxyType
from typing import Any, Protocol

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from ..domain import NodalState, function_state, set_function
from .linear import LinearSolverError, SingularSystemError
from .newton import ConvergenceError, NewtonResult, contact_counts

LONGEST = 1.25
"""Longest step, relative to the asked one, that spares a short one at an asked time."""

SAME = 1e-6
"""Difference of times, relative to the step, that is round-off of the times."""

ALIKE = 1e-2
"""Relative difference of first residuals that do not shrink with the step."""

_log = logging.getLogger(__name__)


class StepRejected(RuntimeError):
    """A converged step that is not to be had: a check refuses it, and says why."""


class TimeSteppingError(RuntimeError):
    """No step goes on from here; model and time are those of the last accepted step.

    Attributes:
        t: Time reached [s].
        dt: Length of the last step tried [s].
    """

    def __init__(self, message: str, t: float, dt: float) -> None:
        super().__init__(message)
        self.t, self.dt = t, dt


FAILURES = (
    ConvergenceError,
    LinearSolverError,
    SingularSystemError,
    StepRejected,
    FloatingPointError,
)
"""What a shorter step may cure; any other exception passes."""


@dataclass(frozen=True)
class StepOptions:
    """How the length of steps follows failure and success.

    Attributes:
        cut: Next step, relative to one that failed [-]. Lower it where steps fail several times.
        growth: Growth after easy steps, up to the asked step [-]; 1 never grows.
        easy_steps: Easy steps in a row before one that is longer [-]. Raise it where steps fail
            again as soon as they grow.
        easy_iterations: Most iterations of an easy step [-]; any number where None.
        smallest: Smallest step, relative to the asked one or to the time between asked times where
            that is shorter [-].
        max_cuts: Most cuts of one step [-]; 0 tries every step once.
        alike: Failures of one step in a row, all the same, after which shorter ones are not tried
            [-]. Raise it where you know better.
    """

    cut: float = 0.5
    growth: float = 1.5
    easy_steps: int = 2
    easy_iterations: int | None = None
    smallest: float = 1e-3
    max_cuts: int = 10
    alike: int = 3

    def __post_init__(self) -> None:
        """Refuse values that make no sense."""
        for name in ("cut", "smallest"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must lie between 0 and 1")
        if not 1.0 <= self.growth < math.inf:
            raise ValueError(f"growth is {self.growth}; it must be at least 1 and finite")
        least = {"easy_steps": 1, "max_cuts": 0, "alike": 2}
        if self.easy_iterations is not None:
            least["easy_iterations"] = 1
        for name, number in least.items():
            if not getattr(self, name) >= number:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least {number}")


# --- the model ----------------------------------------------------------------------------------

type Stored = fem.Function | fem.Constant
"""What holds values of a model."""

type History = tuple[Stored, Callable[[float], Any]]
"""What is prescribed, and its value at a time [s]: a number or array, or a function of x."""


class Steppable(Protocol):
    """What `TimeStepping` needs of a model; every method is called on all ranks.

    Attributes:
        comm: Communicator.
        dt: Length of the step [s].
        time: Time at the end of the step [s], None where nothing depends on it.
        histories: What is prescribed in time.
    """

    comm: MPI.Comm
    dt: fem.Constant
    time: fem.Constant | None
    histories: Sequence[History]

    def solve(self) -> NewtonResult:
        """Solve the step of length `dt`; raise one of `FAILURES` where that fails."""

    def check(self) -> None:
        """Look at the converged step; raise `StepRejected` where it is not to be had."""

    def accept(self) -> None:
        """Make the end of the step the start of the next, before that one."""

    def save(self) -> Any:
        """Copy all that `solve` and `check` change."""

    def restore(self, state: Any) -> None:
        """Go back to what `save` returned, bit for bit."""


class Problem(Protocol):
    """What `TransientModel` needs of a problem, such as `ContactProblem`."""

    comm: MPI.Comm

    def solve(self) -> NewtonResult:
        """Solve the step."""

    def save(self) -> Any:
        """Copy all that `solve` changes."""

    def restore(self, state: Any) -> None:
        """Go back to what `save` returned."""

    def nodal_state(self) -> dict[str, NodalState]:
        """What the problem holds between two steps, by nodes; for a `Simulation`."""

    def set_nodal_state(self, states: Mapping[str, NodalState]) -> None:
        """Start from what `nodal_state` returned; likewise."""

    def integrals(self) -> dict[str, tuple[float, float]]:
        """Integrals of histories, and what the steps booked of them; likewise."""

    def gap_volumes(self) -> dict[str, float]:
        """Volumes of gaps by pair; likewise."""


class TransientModel:
    """A problem in time whose state is that of functions, to be stepped.

    Args:
        problem: The problem.
        dt: Length of the step [s], the constant in the residual.
        previous: Functions at the start of the step, each with the one at its end: ``(u_n, u)``.
        time: Time at the end of the step [s], a constant in the residual or in its data.
        histories: Loads, prescribed displacements and others, with their values in time.
        saved: Functions and constants by name, besides the unknowns, that a step or its check
            changes.
        check: Raises `StepRejected` where a converged step is not to be had.
        follow: Lets what else there is follow an accepted step; at finite strain the mesh, as
            ``lambda: problem.move_mesh(u, u_n)``.
    """

    def __init__(
        self,
        problem: Problem,
        dt: fem.Constant,
        previous: Sequence[tuple[fem.Function, fem.Function]],
        *,
        time: fem.Constant | None = None,
        histories: Sequence[History] = (),
        saved: Mapping[str, Stored] = MappingProxyType({}),
        check: Callable[[], None] | None = None,
        follow: Callable[[], None] | None = None,
    ) -> None:
        self.comm, self.dt, self.time, self.histories = problem.comm, dt, time, histories
        self.problem, self.previous, self.saved = problem, previous, saved
        self._check, self.follow = check, follow

    def solve(self) -> NewtonResult:
        """Solve the step. Collective."""
        return self.problem.solve()

    def check(self) -> None:
        """Ask the check of the user."""
        if self._check is not None:
            self._check()

    def accept(self) -> None:
        """Let the mesh follow, and copy the end of the step to the start of the next."""
        if self.follow is not None:
            self.follow()
        for start, end in self.previous:
            start.x.array[:] = end.x.array

    def nodal_state(self) -> dict[str, NodalState]:
        """What the model holds between two steps, by the nodes of its mesh. Collective.

        Raises:
            ValueError: If something in it cannot be carried to another mesh.
        """
        states = self.problem.nodal_state()
        for name, item in self.saved.items():
            if name in states:
                raise ValueError(f"'{name}' in saved has the name of a state of the problem")
            if isinstance(item, fem.Function):
                states[name] = function_state(item)
            else:
                values = {"value": np.asarray(item.value).tolist()}
                states[name] = NodalState(np.zeros(0, np.int64), {}, values)
        return states

    def set_nodal_state(self, states: Mapping[str, NodalState]) -> None:
        """Start from what `nodal_state` returned, on this mesh or another. Collective."""
        for name, item in self.saved.items():
            state = states[name]
            if isinstance(item, fem.Function):
                set_function(item, state)
            else:
                item.value = state.values["value"]
        self.problem.set_nodal_state(states)
        for start, end in self.previous:
            start.x.array[:] = end.x.array

    def save(self) -> Any:
        """Copy the state."""
        return self.problem.save(), save_values(self.saved.values())

    def restore(self, state: Any) -> None:
        """Go back to a saved state, bit for bit. Collective."""
        problem, values = state
        self.problem.restore(problem)
        restore_values(self.saved.values(), values)


def save_values(items: Iterable[Stored]) -> list[npt.NDArray[np.float64]]:
    """Copy the values of functions, ghosts included, and of constants."""
    return [np.array(f.x.array if isinstance(f, fem.Function) else f.value) for f in items]


def restore_values(items: Iterable[Stored], values: Iterable[npt.NDArray[np.float64]]) -> None:
    """Give functions and constants the values that `save_values` returned."""
    for f, array in zip(items, values, strict=True):
        if isinstance(f, fem.Function):
            f.x.array[:] = array
        else:
            f.value = array


def _set_value(target: Stored, value: Any) -> None:
    if not isinstance(target, fem.Function):
        target.value = value
    elif callable(value):
        target.interpolate(value)
        target.x.scatter_forward()
    else:
        target.x.array.reshape(-1, target.function_space.dofmap.index_map_bs)[:] = value


# --- the steps ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Step:
    """An accepted step.

    Attributes:
        t: Time at its end [s].
        dt: Its length [s].
        result: What Newton's method took.
        cuts: How often it was cut.
        asked: Whether it ends at an asked time.
    """

    t: float
    dt: float
    result: NewtonResult = field(repr=False)
    cuts: int
    asked: bool

    @property
    def iterations(self) -> int:
        """Number of linear solves."""
        return self.result.iterations

    def __str__(self) -> str:
        """One line for the log."""
        line = f"t = {self.t:g} s: step {self.dt:g} s, iterations {self.iterations}"
        line += f", cuts {self.cuts}" if self.cuts else ""
        counts = contact_counts(self.result.contacts[-1]) if self.result.contacts else ""
        return f"{line}; {counts}".rstrip("; ")


class TimeStepping:
    """Steps of a model, in one run or in several after each other.

    Args:
        model: The model.
        options: How the length of steps follows failure and success.
        start: Time at the start [s].

    Attributes:
        model: The model.
        t: Time at the end of the last accepted step [s].
    """

    def __init__(
        self, model: Steppable, options: StepOptions = StepOptions(), *, start: float = 0.0
    ) -> None:
        self.model, self.t = model, float(start)
        self._options = options
        self._to_accept = False
        self._lengths: _Lengths | None = None
        self._resumed: _Lengths | None = None

    def run(self, times: float | Sequence[float], dt: float, *, bar: str = "") -> Iterator[Step]:
        """Go on to the asked times, and yield every accepted step. Collective.

        The steps between two asked times are even. The loop's body sees the end of a step beside
        its start, which moves on (`Steppable.accept`) when the next step is asked for.

        Args:
            times: The end, or all times at which a step must end, ascending [s].
            dt: Length of a step [s]; at most a quarter more where that spares a short one.
            bar: What runs: shows a progress bar with the time left, on a terminal.

        Raises:
            TimeSteppingError: If a step fails and no shorter one helps, while iterating.
            ValueError: If ``times`` or ``dt`` make no sense.
        """
        ends = [float(t) for t in np.atleast_1d(np.asarray(times, float))]
        if not ends or not all(a < b for a, b in pairwise((self.t, *ends, math.inf))):
            raise ValueError(f"times must ascend from the present one, {self.t:g} s, and be finite")
        if not 0.0 < dt < math.inf:
            raise ValueError(f"dt is {dt}; it must be positive and finite")
        steps, start = self._steps(ends, float(dt)), self.t
        if not bar:
            return steps
        from ..output.report import progress

        return progress(
            steps, self.model.comm, bar, total=ends[-1] - start, position=lambda s: s.t - start
        )

    def _steps(self, ends: list[float], dt: float) -> Iterator[Step]:
        lengths = self._lengths = self._resumed or _Lengths(self._options, dt)
        self._resumed = None
        for end in ends:
            if lengths.end != end:
                lengths.head_for(self.t, end)
            while self.t < end:
                self.accept()
                step = self._advance(lengths)
                self.t, self._to_accept = step.t, True
                lengths.succeed(step)
                self._log(step)
                yield step
        self.accept()

    def accept(self) -> None:
        """Make the end of the last step the start of the next. Collective.

        It comes by itself, once, when the next step is asked for. Call it before that where the
        start of the next step is to be seen or changed.
        """
        if self._to_accept:
            self._to_accept = False
            self.model.accept()

    def prescribe(self, t: float, dt: float) -> None:
        """Set the length of the step, and what is prescribed at its end. Collective.

        Every step does so by itself. Call it where a model is to be seen at a time without one.

        Args:
            t: Time at the end of the step [s].
            dt: Its length [s].
        """
        model = self.model
        model.dt.value = dt
        if model.time is not None:
            model.time.value = t
        for target, value in model.histories:
            _set_value(target, value(t))

    def save(self) -> dict[str, Any]:
        """Time and lengths of the steps, to go on with in another run by `restore`."""
        return {"t": self.t, "lengths": self._lengths and self._lengths.save()}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on where `save` was called: the next `run` keeps the lengths found there."""
        self.t, self._to_accept = state["t"], False
        if state["lengths"] is not None:
            self._resumed = _Lengths(self._options, 0.0)
            self._resumed.restore(state["lengths"])

    def _advance(self, lengths: _Lengths) -> Step:
        """Take the next step, with as many cuts as it needs."""
        model = self.model
        prescribed: list[Stored] = [model.dt, *(target for target, _ in model.histories)]
        if model.time is not None:
            prescribed.append(model.time)
        state, values = model.save(), save_values(prescribed)
        failures: list[_Failure] = []
        while True:
            t, dt = lengths.next()
            self.prescribe(t, dt)
            result, failure, error = self._agreed(model.solve)
            if failure is None:
                _, failure, error = self._agreed(model.check)
            if failure is None:
                return Step(t, dt, result, len(failures), t == lengths.end)
            model.restore(state)
            restore_values(prescribed, values)
            failures.append(failure)
            reason = self._hopeless(failures, dt)
            if not reason and not lengths.cut(self.t, dt):
                reason = f"a step of {dt:g} s fails, and shorter ones are not allowed"
            if reason:
                message = f"no step goes on from t = {self.t:g} s: {reason}; {failure.message}"
                raise TimeSteppingError(message, self.t, dt) from error
            words = f"step {dt:g} s fails, next {lengths.next()[1]:g} s; {failure.message}"
            self._log(f"t = {self.t:g} s: {words}")

    def _hopeless(self, failures: list[_Failure], dt: float) -> str:
        """Say why no shorter step is to be tried after some of one step; empty if one is."""
        options = self._options
        last = failures[-options.alike :]
        if len(last) == options.alike and all(a.like(b) for a, b in pairwise(last)):
            return f"{len(last)} steps down to {dt:g} s fail alike"
        if len(failures) > options.max_cuts:
            return f"a step fails after {options.max_cuts} cuts, at {dt:g} s"
        return ""

    def _log(self, line: object) -> None:
        if self.model.comm.rank == 0:
            _log.info("%s", line)

    def _agreed(self, action: Callable[[], Any]) -> tuple[Any, _Failure | None, Exception | None]:
        """Do what may fail; what fails on one rank fails on all, in the words of the first."""
        result, error = None, None
        try:
            result = action()
        except FAILURES as raised:
            error = raised
        failures = self.model.comm.allgather(None if error is None else _Failure.of(error))
        return result, next((f for f in failures if f is not None), None), error


class _Lengths:
    """Lengths of the steps on the way to the asked times.

    Args:
        options: How they follow failure and success.
        dt: The asked length [s].

    Attributes:
        end: The asked time to come [s].
    """

    def __init__(self, options: StepOptions, dt: float) -> None:
        self._options, self._dt, self._length = options, dt, dt
        self._shortened, self._easy, self.end = False, 0, -math.inf

    def save(self) -> dict[str, float]:
        """Everything but the options, as numbers."""
        return {name: value for name, value in vars(self).items() if name != "_options"}

    def restore(self, state: dict[str, float]) -> None:
        """Go on where `save` was called."""
        vars(self).update(state)

    def head_for(self, t: float, end: float) -> None:
        """Divide the way to the next asked time."""
        self.end = end
        self._smallest = self._options.smallest * min(self._dt, end - t)
        self._divide(t)

    def next(self) -> tuple[float, float]:
        """Time at the end of the next step, and its length [s]."""
        # Counted from the end, which is met exactly
        return self.end - (self._left - 1) * self._step, self._step

    def succeed(self, step: Step) -> None:
        """Count a step; after easy ones those that failed before may be longer again."""
        options = self._options
        self._left -= 1
        if not self._shortened:
            return
        limit = options.easy_iterations
        self._easy = self._easy + 1 if limit is None or step.iterations <= limit else 0
        if self._easy >= options.easy_steps:
            self._easy = 0
            self._length = min(options.growth * self._length, self._dt)
            self._shortened = self._length < self._dt
            self._divide(step.t)

    def cut(self, t: float, failed: float) -> bool:
        """Shorten the steps after one that failed; False where that is not allowed any more."""
        self._length = min(self._options.cut * failed, self._dt)
        self._shortened, self._easy = True, 0
        if self._length < self._smallest:
            return False
        self._divide(t)
        return True

    def _divide(self, t: float) -> None:
        """Divide what is left into even steps close to the present length."""
        way, length = self.end - t, self._length
        longest = length if self._shortened else LONGEST * length
        self._left = max(1, math.floor(way / length + 0.5))
        if way > self._left * longest + SAME * length:
            self._left += 1
        self._step = way / self._left
        # A step of the very same length needs no new tangent.
        if abs(way - self._left * length) <= SAME * length:
            self._step = length


@dataclass(frozen=True)
class _Failure:
    """Why a step failed, the same on all ranks.

    Attributes:
        message: What was raised.
        kind: What is known not to depend on the step where it comes back, None if nothing.
        size: First residual of Newton's method, relative to the increment [-].
    """

    message: str
    kind: str | None = None
    size: float = 0.0

    @classmethod
    def of(cls, error: Exception) -> _Failure:
        """Failure of an exception.

        With the step the first linear solve comes ever closer to the solution, unless something
        jumps. Without any solve, and where a system is singular, words tell.
        """
        message = str(error) or type(error).__name__
        if isinstance(error, ConvergenceError) and error.history:
            return cls(message, "residual", error.history[0])
        if isinstance(error, ConvergenceError | SingularSystemError):
            return cls(message, message)
        return cls(message)

    def like(self, other: _Failure) -> bool:
        """Whether the other is the same, at another step."""
        same = self.kind is not None and self.kind == other.kind
        return same and abs(self.size - other.size) <= ALIKE * self.size
