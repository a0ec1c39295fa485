# SPDX-License-Identifier: LGPL-3.0-or-later
import numpy as np
import pytest

from fenicsx_hmcontact.solvers import (
    ConvergenceError,
    NewtonOptions,
    NewtonResult,
    relax,
    solve_newton,
)


class Scalar:
    """One unknown in two equal fields: F(x) = f, slope g; sets change in the first residuals."""

    def __init__(self, comm, f, g, x, changes=0):
        self.field_names = ["first", "second"]
        self.comm, self.f, self.g, self.x = comm, f, g, x
        self.r, self.start = np.nan, x
        self.changes = changes

    @property
    def settled(self):
        return self.changes < 0

    @property
    def sets(self):
        return str(self.changes).encode()

    def residual(self, damped=False):
        self.changes -= 1
        self.r = self.f(self.x)
        if not np.isfinite(self.r):
            raise FloatingPointError("the residual of first is not a number")

    def increment(self, damping=0.0):
        self.step = -self.r / (self.g(self.x) + damping * abs(self.r))
        self.x += self.step

    def move(self, part):
        self.x += part * self.step

    @property
    def farthest(self):
        return abs(self.step)

    def violation(self, held=True):
        return abs(self.r)

    def contacts(self):
        return {"a/b": {"open": 1, "closed": 2}}

    def scaled_residuals(self):
        return [abs(self.r), 0.5 * abs(self.r)]

    reach = 1.0

    def scaled_norms(self):
        return abs(self.x - self.start), abs(self.x)

    def hold(self):
        pass

    def release(self):
        pass


def test_finds_the_root_quadratically(comm):
    system = Scalar(comm, lambda x: x**2 - 2, lambda x: 2 * x, 1.0)
    result = solve_newton(system, NewtonOptions())
    assert system.x == pytest.approx(np.sqrt(2), rel=1e-10)
    assert isinstance(result, NewtonResult) and result.iterations == len(result.history) == 4
    errors = [h[0] for h in result.history]
    assert errors[2] < errors[1] ** 2 and errors[3] < errors[2] ** 2
    assert all(h[1] == pytest.approx(h[0] / 2) for h in result.history)


def test_linear_equations_take_one_iteration(comm):
    system = Scalar(comm, lambda x: 3 * x - 6, lambda x: 3, 0.0)
    assert solve_newton(system, NewtonOptions()).iterations == 1


def test_goes_on_until_the_sets_are_settled(comm):
    system = Scalar(comm, lambda x: 3 * x - 6, lambda x: 3, 0.0, changes=4)
    # The fifth residual is the first that leaves the sets as they were; one is before the steps.
    assert solve_newton(system, NewtonOptions()).iterations == 4


def test_tolerance_decides_when_to_stop(comm):
    counts = []
    for tolerance in (1e-2, 1e-6, 1e-10):
        system = Scalar(comm, lambda x: np.exp(x) - 5, lambda x: 5.0, 1.4)
        counts.append(solve_newton(system, NewtonOptions(tolerance, 100)).iterations)
        # The largest increment is the first.
        largest = (5 - np.exp(1.4)) / 5
        assert abs(np.exp(system.x) - 5) <= tolerance * largest
    assert counts[0] < counts[1] < counts[2]


def test_round_off_of_the_state_counts_as_zero(comm):
    # At rest but for the noise of the residual: nothing relative to the increment is small.
    noise = iter(1e-14 * np.resize([1.0, -1.0], 99))
    system = Scalar(comm, lambda x: next(noise), lambda x: 1.0, 1.0)
    assert solve_newton(system, NewtonOptions()).iterations == 1


def test_no_root_is_reported_with_the_history(comm):
    system = Scalar(comm, lambda x: x**2 + 1, lambda x: 2 * x, 0.7)
    with pytest.raises(ConvergenceError, match="no convergence in 7 iterations") as error:
        solve_newton(system, NewtonOptions(max_iterations=7))
    assert "residual of first" in str(error.value)
    assert len(error.value.history) == 7 and min(error.value.history) > 1e-10


@pytest.mark.parametrize(("start", "iterations"), [(-1.0, 0), (1.0, 1)])
def test_not_a_number_is_reported_before_and_after_a_step(comm, start, iterations):
    def alone(x):
        return 1.0 if x == 1.0 else np.nan

    system = Scalar(comm, alone, lambda x: 1.0, start)
    with pytest.raises(ConvergenceError, match="residual of first is not a number") as error:
        solve_newton(system, NewtonOptions())
    assert len(error.value.history) == iterations


@pytest.mark.parametrize("tolerance", [0.0, -1e-3, 1.0, np.nan, np.inf])
def test_refuses_tolerances(tolerance):
    with pytest.raises(ValueError, match="tolerance"):
        NewtonOptions(tolerance=tolerance)


@pytest.mark.parametrize("number", [0, -3])
def test_refuses_numbers_of_iterations(number):
    with pytest.raises(ValueError, match="max_iterations"):
        NewtonOptions(max_iterations=number)


class Cycling(Scalar):
    """Two sets, x < 0 and x > 0, whose whole steps lead from one to the other for ever."""

    def __init__(self, comm, x):
        super().__init__(comm, lambda x: np.arctan(x), lambda x: 1 / (1 + x**2), x)
        self.positive = x > 0
        self.same = True
        self.damped = []

    @property
    def settled(self):
        return self.same

    @property
    def sets(self):
        return b"+" if self.positive else b"-"

    def residual(self, damped=False):
        super().residual()
        # Where the equations hold to round-off, no set is better than the other.
        positive = self.positive if abs(self.x) < 1e-12 else self.x > 0
        self.same, self.positive = positive == self.positive, positive
        self.damped.append(damped)


def test_cycling_sets_are_noticed_and_the_step_is_cut(comm):
    system = Cycling(comm, 1.3917452)  # from here whole steps go to and fro
    result = solve_newton(system, NewtonOptions(max_iterations=40))
    assert abs(system.x) < 1e-9
    # Two whole steps, then one that is cut; the last one is whole.
    assert result.lengths[:2] == [1.0, 1.0] and min(result.lengths) < 1.0
    assert result.lengths[-1] == 1.0
    assert not any(system.damped[:3]) and all(system.damped[3:])


def test_a_step_without_residual_is_cut(comm):
    system = Scalar(comm, lambda x: np.log(x) - 3 if x > 0 else np.nan, lambda x: 1 / x, 60.0)
    result = solve_newton(system, NewtonOptions(max_iterations=40))
    assert system.x == pytest.approx(np.exp(3.0), rel=1e-9) and result.lengths[0] == 0.5


def test_iterations_tell_what_the_contacts_do(comm, caplog):
    caplog.set_level("INFO", logger="fenicsx_hmcontact")
    result = solve_newton(Scalar(comm, lambda x: 3 * x - 6, lambda x: 3, 0.0), NewtonOptions())
    assert result.contacts == [{"a/b": {"open": 1, "closed": 2}}]
    lines = [record.getMessage() for record in caplog.records]
    assert lines == (
        ["iteration 1: first 0.0e+00, second 0.0e+00; a/b: 1 open, 2 closed"]
        if comm.rank == 0
        else []
    )


@pytest.mark.parametrize("move", [0.02, 0.05, 0.1])
def test_creeps_over_a_limit_point_to_the_root_behind_it(comm, move):
    # The left branch of x^3 - 3 x ends at x = -1 with 2; a little more load snaps through.
    system = Scalar(comm, lambda x: x**3 - 3 * x - 2.01, lambda x: 3 * x**2 - 3, -1.3)
    with pytest.raises(ConvergenceError):
        solve_newton(system, NewtonOptions(max_iterations=6))
    system.x = -1.3
    result = relax(system, NewtonOptions(relaxation=move))
    assert system.x == pytest.approx(2.0011, abs=1e-3)
    assert abs(system.x**3 - 3 * system.x - 2.01) < 1e-9
    # At its end it is Newton's method.
    assert result.history[-1][0] < 0.1 * result.history[-2][0] < result.history[-3][0]


def test_creep_goes_back_from_where_there_is_no_residual(comm):
    system = Scalar(comm, np.log, lambda x: 1 / x, 30.0)
    with np.errstate(invalid="ignore"):
        result = relax(system, NewtonOptions(relaxation=10.0))
    assert system.x == pytest.approx(1.0, rel=1e-9)
    # Dashpots that have faded let an increment end at a negative number.
    assert result.iterations > len(result.history)


def test_solid_that_does_not_come_to_rest_is_reported(comm):
    system = Scalar(comm, lambda x: np.exp(-x), lambda x: -np.exp(-x), 0.0)
    with pytest.raises(ConvergenceError, match="does not come to rest") as error:
        relax(system, NewtonOptions(relaxation=0.1))
    assert len(error.value.history) > 0


@pytest.mark.parametrize("relaxation", [-1e-3, np.nan, np.inf])
def test_refuses_relaxations(relaxation):
    with pytest.raises(ValueError, match="relaxation"):
        NewtonOptions(relaxation=relaxation)
