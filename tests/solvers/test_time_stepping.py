# SPDX-License-Identifier: LGPL-3.0-or-later
import io
import math
import sys
from itertools import pairwise
from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import create_unit_square

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.solvers import LinearSolverError, NewtonResult, restore_values, save_values
from tests.models import Elastic, stack

NONE = 1e9


class Fake:
    """Counts up time in x; ``fails`` returns what a step to t of length dt raises, or None."""

    def __init__(self, fails=lambda t, dt: None, checks=lambda t, dt: None, iterations=3):
        self.comm, self.iterations = MPI.COMM_SELF, iterations
        self.dt, self.time = (
            SimpleNamespace(value=np.array(9.0)),
            SimpleNamespace(value=np.array(7)),
        )
        self.load = SimpleNamespace(value=np.array(5.0))
        self.histories = [(self.load, lambda t: 2.0 * t)]
        self.fails, self.checks = fails, checks
        self.x, self.x_n = np.array([0.1]), np.array([0.1])
        self.tried, self.seen = [], []

    def solve(self):
        t, dt = float(self.time.value), float(self.dt.value)
        self.tried.append(dt)
        self.seen.append((self.x[0], self.x_n[0]))
        assert self.load.value == 2.0 * t
        self.x += dt / 3.0
        error = self.fails(t, dt)
        if error is not None:
            raise error
        return NewtonResult(self.iterations, contacts=[{"a/b": {"open": 1, "closed": 2}}])

    def check(self):
        error = self.checks(float(self.time.value), float(self.dt.value))
        if error is not None:
            raise error

    def accept(self):
        self.x_n[:] = self.x

    def save(self):
        return self.x.copy()

    def restore(self, state):
        self.x[:] = state


def too_long(limit, history=lambda dt: [dt, 1.0]):
    """No convergence of steps beyond a limit."""
    return lambda t, dt: hm.ConvergenceError("no root", history(dt)) if dt > limit else None


def lengths(steps):
    return [step.dt for step in steps]


# --- where steps end ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("times", "dt", "expected"),
    [
        (1.0, 0.25, [0.25] * 4),
        (1.0, 0.1, [0.1] * 10),
        (1.0, 0.3, [1 / 3] * 3),
        (1.0, 0.35, [1 / 3] * 3),
        (1.2, 1.0, [1.2]),
        (1.3, 1.0, [0.65] * 2),
        (1.0, 5.0, [1.0]),
        ([0.1, 0.25, 1.0], 0.1, [0.1] + [0.075] * 2 + [0.09375] * 8),
        ([0.1, 0.25, 1.0], 0.3, [0.1, 0.15] + [0.25] * 3),
    ],
)
def test_steps_are_even_and_end_at_the_asked_times(times, dt, expected):
    stepping = hm.TimeStepping(Fake())
    steps = list(stepping.run(times, dt))
    assert lengths(steps) == pytest.approx(expected, rel=1e-12)
    assert [s.t for s in steps if s.asked] == list(np.atleast_1d(times))
    assert stepping.t == np.atleast_1d(times)[-1]
    assert [s.t for s in steps] == pytest.approx(np.cumsum(expected), rel=1e-12)


def test_no_slivers_whatever_the_times():
    rng = np.random.default_rng(3)
    for _ in range(200):
        dt = 10.0 ** rng.uniform(-3, 3)
        times = np.cumsum(dt * rng.uniform(0.01, 7.0, 5))
        steps = list(hm.TimeStepping(Fake()).run(times, dt))
        assert [s.t for s in steps if s.asked] == list(times)
        for before, end in zip([0.0, *times[:-1]], times, strict=True):
            taken = [s.dt for s in steps if before < s.t <= end]
            assert sum(taken) == pytest.approx(end - before, rel=1e-9)
            assert max(taken) == pytest.approx(min(taken), rel=1e-5)
            assert max(taken) <= 1.25 * dt * (1 + 1e-5)
            assert len(taken) == 1 or min(taken) >= 0.6 * dt


def test_an_asked_step_that_fits_is_taken_to_the_last_bit():
    steps = list(hm.TimeStepping(Fake()).run(np.arange(1, 400) * 0.3, 0.1))
    assert set(lengths(steps)) == {0.1} and len(steps) == 1197
    steps = list(hm.TimeStepping(Fake(), start=1e6).run([1e6 + 1.0, 1e6 + 2.0], 0.01))
    assert set(lengths(steps)) == {0.01} and len(steps) == 200


# --- failure and success -------------------------------------------------------------------------


def test_a_step_that_fails_is_cut_and_grows_again():
    model = Fake(lambda t, dt: too_long(0.3)(t, dt) if t <= 4.0 else None)
    steps = list(hm.TimeStepping(model).run([4.0, 8.0], 1.0))
    # Two steps, then half as long again; what does not fit is divided anew.
    first, second = [s for s in steps if s.t <= 4.0], [s for s in steps if s.t > 4.0]
    assert model.tried[:5] == pytest.approx([1.0, 0.5, 0.25, 0.25, 3.5 / 10])
    assert [s.cuts for s in first[:3]] == [2, 0, 1] and max(lengths(first)) <= 0.3
    assert first[2].dt == pytest.approx(0.175)
    assert all(b <= 1.5 * a * (1 + 1e-9) for a, b in pairwise(lengths(second)))
    assert max(lengths(second)) <= 1.0 and second[-1].dt > 0.6 and not any(s.cuts for s in second)
    assert (first[-1].t, second[-1].t) == (4.0, 8.0)


def test_the_asked_step_comes_back():
    model = Fake(lambda t, dt: too_long(0.5)(t, dt) if t < 1.5 else None)
    steps = list(hm.TimeStepping(model, hm.StepOptions(growth=2.0)).run(8.0, 1.0))
    assert model.tried == [1.0, 0.5, 0.5] + [1.0] * 7
    assert [s.cuts for s in steps] == [1] + [0] * 8


def test_hard_steps_do_not_grow_and_growth_can_be_left_out():
    fails = lambda t, dt: too_long(0.5)(t, dt) if t < 1.5 else None  # noqa: E731
    for options in (hm.StepOptions(easy_iterations=2), hm.StepOptions(growth=1.0)):
        assert lengths(hm.TimeStepping(Fake(fails), options).run(4.0, 1.0)) == [0.5] * 8
    options = hm.StepOptions(easy_iterations=3, growth=2.0, easy_steps=4)
    assert lengths(hm.TimeStepping(Fake(fails), options).run(4.0, 1.0)) == [0.5] * 4 + [1.0] * 2


def test_a_cut_step_is_never_stretched_to_the_one_that_failed():
    model = Fake(too_long(0.99))
    steps = list(hm.TimeStepping(model, hm.StepOptions(cut=0.9)).run(1.24, 1.0))
    assert model.tried == [1.24, 0.62, 0.62] and len(steps) == 2


def test_failed_steps_leave_no_bit_behind():
    errors = [too_long(0.2), lambda t, dt: FloatingPointError("nan") if dt > 0.2 else None]
    errors.append(lambda t, dt: hm.SingularSystemError(f"body {dt}") if dt > 0.2 else None)
    errors.append(lambda t, dt: LinearSolverError("reason -9") if dt > 0.2 else None)
    for fails in errors:
        model, straight = Fake(fails), Fake()
        options = hm.StepOptions(growth=1.0)
        steps = list(hm.TimeStepping(model, options).run(1.0, 1.0))
        list(hm.TimeStepping(straight).run(1.0, 0.125))
        assert lengths(steps) == [0.125] * 8 and model.tried[:4] == [1.0, 0.5, 0.25, 0.125]
        assert model.x.tobytes() == straight.x.tobytes() == model.x_n.tobytes()
        assert len(set(model.seen[:4])) == 1 and model.seen[3:] == straight.seen


def test_a_check_may_reject_a_converged_step():
    rejects = lambda t, dt: hm.StepRejected("cells turned over") if dt > 0.3 else None  # noqa: E731
    model, straight = Fake(checks=rejects), Fake()
    steps = list(hm.TimeStepping(model, hm.StepOptions(growth=1.0)).run(1.0, 1.0))
    list(hm.TimeStepping(straight).run(1.0, 0.25))
    assert [s.cuts for s in steps] == [2, 0, 0, 0] and model.x.tobytes() == straight.x.tobytes()


# --- what no shorter step cures ------------------------------------------------------------------


def stopped(fails, options=hm.StepOptions(), checks=lambda t, dt: None):
    """Fail from t = 1 s on; return the model and the error."""
    later = lambda f: lambda t, dt: f(t, dt) if t > 1.0 else None  # noqa: E731
    model = Fake(later(fails), later(checks))
    stepping = hm.TimeStepping(model, options)
    before = Fake()
    list(hm.TimeStepping(before).run(1.0, 0.5))
    with pytest.raises(hm.TimeSteppingError) as error:
        for _ in stepping.run(3.0, 0.5):
            pass
    # The last good state, in the model and in the error.
    assert model.x.tobytes() == model.x_n.tobytes() == before.x.tobytes()
    assert stepping.t == error.value.t == 1.0 == model.time.value and model.load.value == 2.0
    assert error.value.dt == model.tried[-1] and model.dt.value == 0.5
    return model, error.value


def test_a_system_that_stays_singular_is_given_up_at_a_quarter_of_the_step():
    model, error = stopped(lambda t, dt: hm.SingularSystemError("body 'block' has no support"))
    assert model.tried[2:] == [0.5, 0.5 / 2, 0.5 / 4]
    assert str(error) == (
        "no step goes on from t = 1 s: 3 steps down to 0.125 s fail alike; "
        "body 'block' has no support"
    )
    assert isinstance(error.__cause__, hm.SingularSystemError)


def test_a_residual_that_is_no_number_before_any_iteration_is_given_up():
    fails = lambda t, dt: hm.ConvergenceError("the residual of u is not a number", [])  # noqa: E731
    model, error = stopped(fails)
    assert len(model.tried) == 2 + 3 and "residual of u is not a number" in str(error)
    assert isinstance(error.__cause__, hm.ConvergenceError)
    assert len(stopped(fails, hm.StepOptions(alike=2))[0].tried) == 2 + 2
    assert len(stopped(fails, hm.StepOptions(alike=5))[0].tried) == 2 + 5


def test_a_residual_that_does_not_shrink_is_given_up():
    # A jump, and a part that shrinks with the step: 0.9 % from the fifth to the sixth step.
    fails = too_long(0.0, lambda dt: [1.0 + 0.3 * dt / 0.5, 1e-3])
    model, error = stopped(fails)
    assert len(model.tried) == 2 + 7 and "no root" in str(error)
    # One that shrinks is tried to the end.
    model, error = stopped(too_long(0.0))
    assert len(model.tried) == 2 + 10 and "shorter ones are not allowed; no root" in str(error)


def test_other_words_or_no_number_are_no_sign():
    body = lambda t, dt: hm.SingularSystemError(f"body {dt}") if dt > 1e-2 else None  # noqa: E731
    steps = list(hm.TimeStepping(Fake(body)).run(1.0, 1.0))
    assert steps[0].cuts == 7
    nan = too_long(1e-2, lambda dt: [math.nan])
    assert next(iter(hm.TimeStepping(Fake(nan)).run(1.0, 1.0))).cuts == 7
    rejects = lambda t, dt: hm.StepRejected("no") if dt > 1e-2 else None  # noqa: E731
    assert next(iter(hm.TimeStepping(Fake(checks=rejects)).run(1.0, 1.0))).cuts == 7


def test_cuts_end_at_the_most_and_at_the_smallest_step():
    model, error = stopped(too_long(0.0), hm.StepOptions(max_cuts=2))
    assert len(model.tried) == 2 + 3
    assert "a step fails after 2 cuts, at 0.125 s; no root" in str(error)
    model, error = stopped(too_long(0.0), hm.StepOptions(smallest=0.2))
    assert model.tried[2:] == [0.5, 0.25, 0.125] and "a step of 0.125 s fails" in str(error)
    model, error = stopped(too_long(0.0), hm.StepOptions(max_cuts=0))
    assert model.tried[2:] == [0.5]
    # A short way between asked times has its own smallest step.
    model = Fake(too_long(1e-6))
    steps = list(hm.TimeStepping(model).run([3e-6, 1e-5], 1.0))
    assert steps[0].cuts == 2 and steps[-1].t == 1e-5


def test_a_rejection_is_named_when_it_stays():
    checks = lambda t, dt: hm.StepRejected(f"the mesh is folded at ({dt}, 0)")  # noqa: E731
    _, error = stopped(lambda t, dt: None, checks=checks)
    assert "the mesh is folded at (" in str(error) and isinstance(error.__cause__, hm.StepRejected)


def test_other_exceptions_pass():
    model = Fake(lambda t, dt: KeyError("typo"))
    with pytest.raises(KeyError, match="typo"):
        list(hm.TimeStepping(model).run(1.0, 1.0))
    assert len(model.tried) == 1


# --- runs ----------------------------------------------------------------------------------------


def test_the_loop_sees_the_step_and_its_start():
    model = Fake()
    stepping = hm.TimeStepping(model)
    for step in stepping.run(1.0, 0.25):
        assert model.x[0] - model.x_n[0] == pytest.approx(step.dt / 3.0)
    assert model.x == model.x_n


def test_runs_follow_each_other():
    model = Fake()
    stepping = hm.TimeStepping(model, start=-1.0)
    for step in stepping.run([0.0, 1.0], 0.5):
        if step.t == 0.5:
            break
    assert stepping.t == 0.5 and model.x != model.x_n
    steps = list(stepping.run(1.5, 1.0))
    assert [(s.t, s.dt) for s in steps] == [(1.5, 1.0)] and model.seen[-1][0] == model.seen[-1][1]
    with pytest.raises(ValueError, match=r"ascend from the present one, 1[.]5 s"):
        stepping.run(1.5, 1.0)


def test_one_line_a_step(caplog):
    caplog.set_level("INFO", logger="fenicsx_hmcontact")
    options = hm.StepOptions(growth=1.0)
    list(hm.TimeStepping(Fake(too_long(0.6)), options).run([1.0, 1.5], 1.0))
    assert [record.getMessage() for record in caplog.records] == [
        "t = 0 s: step 1 s fails, next 0.5 s; no root",
        "t = 0.5 s: step 0.5 s, iterations 3, cuts 1; a/b: 1 open, 2 closed",
        "t = 1 s: step 0.5 s, iterations 3; a/b: 1 open, 2 closed",
        "t = 1.5 s: step 0.5 s, iterations 3; a/b: 1 open, 2 closed",
    ]


def test_a_bar_on_a_terminal_only(monkeypatch):
    for terminal in (False, True):
        out = io.StringIO()
        out.isatty = lambda terminal=terminal: terminal
        monkeypatch.setattr(sys, "stdout", out)
        stepping = hm.TimeStepping(Fake(), start=1.0)
        assert len(list(stepping.run([2.0, 3.0], 0.5, bar="loading"))) == 4
        monkeypatch.undo()
        assert ("loading" in out.getvalue()) == terminal


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("cut", 1.0),
        ("cut", 0.0),
        ("cut", math.nan),
        ("growth", 0.9),
        ("growth", math.inf),
        ("easy_steps", 0),
        ("easy_iterations", 0),
        ("smallest", 0.0),
        ("smallest", 1.0),
        ("max_cuts", -1),
        ("alike", 1),
    ],
)
def test_refuses_options_by_name(name, value):
    with pytest.raises(ValueError, match=f"{name} is {value}; it must"):
        hm.StepOptions(**{name: value})


@pytest.mark.parametrize("times", [[], [1.0, 1.0], [2.0, 1.0], 0.0, math.nan, [1.0, math.inf]])
def test_refuses_times(times):
    with pytest.raises(ValueError, match="times must ascend"):
        hm.TimeStepping(Fake()).run(times, 0.1)


@pytest.mark.parametrize("dt", [0.0, -1.0, math.nan, math.inf])
def test_refuses_steps(dt):
    with pytest.raises(ValueError, match="dt is"):
        hm.TimeStepping(Fake()).run(1.0, dt)


# --- on meshes -----------------------------------------------------------------------------------


class Growth:
    """u' = div grad u + u^2, which backward Euler has a solution of up to dt = 1 / (4 u)."""

    def __init__(self, comm, check=None, histories=lambda s: []):
        mesh = create_unit_square(comm, 4, 4)
        Q = fem.functionspace(mesh, ("P", 1))
        self.u, self.u_n, v = fem.Function(Q, name="u"), fem.Function(Q), ufl.TestFunction(Q)
        self.u.x.array[:] = self.u_n.x.array[:] = 1.0
        self.dt, self.load = fem.Constant(mesh, 1.0), fem.Constant(mesh, 0.0)
        self.time = fem.Constant(mesh, 0.0)
        self.field = fem.Function(Q)
        F = (self.u - self.u_n - self.dt * (self.u**2 + self.load)) * v * ufl.dx
        F += self.dt * ufl.inner(ufl.grad(self.u), ufl.grad(v)) * ufl.dx
        self.problem = hm.ContactProblem(F, self.u, newton=hm.NewtonOptions(max_iterations=12))
        self.model = hm.TransientModel(
            self.problem,
            self.dt,
            [(self.u_n, self.u)],
            time=self.time,
            histories=histories(self),
            saved={"field": self.field},
            check=check,
        )


@pytest.mark.mpi
def test_a_step_without_solution_is_cut(comm):
    s = Growth(comm)
    steps = list(hm.TimeStepping(s.model).run([0.25, 0.5], 0.5))
    assert [step.t for step in steps if step.asked] == [0.25, 0.5]
    assert sum(step.cuts for step in steps) > 0
    # What backward Euler does with these steps.
    x = 1.0
    for step in steps:
        x = (1.0 - math.sqrt(1.0 - 4.0 * step.dt * x)) / (2.0 * step.dt)
    np.testing.assert_allclose(s.u.x.array, x, rtol=1e-7)
    np.testing.assert_array_equal(s.u.x.array, s.u_n.x.array)
    assert comm.allgather([(step.t, step.cuts) for step in steps]) == comm.size * [
        [(step.t, step.cuts) for step in steps]
    ]


@pytest.mark.mpi
def test_growth_beyond_all_bounds_ends_at_the_last_good_state(comm):
    s = Growth(comm)
    stepping, last = hm.TimeStepping(s.model, hm.StepOptions(smallest=0.1)), None
    with pytest.raises(hm.TimeSteppingError, match="the residual of u") as error:
        for step in stepping.run(2.0, 0.25):
            last = step, s.u.x.array.copy()
    assert last[0].t == stepping.t == error.value.t > 0.5
    np.testing.assert_array_equal(s.u.x.array, last[1])
    np.testing.assert_array_equal(s.u_n.x.array, last[1])


@pytest.mark.mpi
def test_a_load_that_is_no_number_is_given_up_at_once(comm):
    s = Growth(comm, histories=lambda s: [(s.load, lambda t: 0.0 if t <= 0.1 else math.nan)])
    stepping = hm.TimeStepping(s.model)
    with pytest.raises(hm.TimeSteppingError, match=r"3 steps .* alike; the residual of u is not"):
        list(stepping.run([0.1, 1.0], 0.05))
    assert stepping.t == 0.1 and s.load.value == 0.0 and s.dt.value == 0.05


@pytest.mark.mpi
def test_histories_are_those_of_the_end_of_the_step(comm):
    def histories(s):
        return [
            (s.load, lambda t: 3.0 * t),
            (s.field, lambda t: lambda x: t + x[0]),
            (s.u_n, lambda t: 1.0 + t),
        ]

    s = Growth(comm, histories=histories)
    x = s.u.function_space.tabulate_dof_coordinates()[:, 0]
    for step in hm.TimeStepping(s.model).run(0.1, 0.05):
        assert s.load.value == 3.0 * step.t and s.time.value == step.t
        np.testing.assert_allclose(s.field.x.array, step.t + x, atol=1e-14)
        np.testing.assert_array_equal(s.u_n.x.array, 1.0 + step.t)


@pytest.mark.mpi
def test_what_one_rank_rejects_all_ranks_cut(comm):
    def check():
        s.field.x.array[:] += 1.0
        if comm.rank == comm.size - 1 and float(s.dt.value) > 0.06:
            raise hm.StepRejected("rank alone")

    s = Growth(comm, check)
    steps = list(hm.TimeStepping(s.model, hm.StepOptions(growth=1.0)).run(0.1, 0.1))
    assert [step.cuts for step in steps] == [1, 0]
    assert np.all(s.field.x.array == 2.0)


@pytest.mark.mpi
def test_values_come_back_to_the_last_bit(comm):
    s = Growth(comm)
    s.field.interpolate(lambda x: np.sin(1e3 * x[0]))
    before, values = s.field.x.array.copy(), save_values([s.field, s.load])
    s.field.x.array[:] = s.load.value = 8.0
    restore_values([s.field, s.load], values)
    assert s.field.x.array.tobytes() == before.tobytes() and s.load.value == 0.0


@pytest.mark.mpi
def test_saved_values_are_carried_by_name(comm):
    one, other = Growth(comm), Growth(comm)
    one.field.interpolate(lambda x: np.sin(x[0]))
    states = one.model.nodal_state()
    other.model.set_nodal_state(states)
    assert "field" in states and other.field.x.array.tobytes() == one.field.x.array.tobytes()
    one.model.saved = {"field u": one.field}
    with pytest.raises(ValueError, match="'field u' in saved has the name of a state"):
        one.model.nodal_state()


def flat(state):
    """Leaves of nested lists and tuples."""
    if not isinstance(state, list | tuple):
        return [state]
    return [leaf for part in state for leaf in flat(part)]


def pushed(comm):
    """A block on another that is pressed and pushed along; rejects some converged steps."""
    domain = stack(comm, (3, 4))
    mesh = domain.mesh
    top = fem.Constant(mesh, np.zeros(2))
    m = Elastic(
        domain,
        fixed={("bottom_0", None): np.zeros(2), ("top_1", None): top},
        pairs=[("bottom_1", "top_0", None, hm.CoulombFriction(0.3))],
    )
    dt, rejected = fem.Constant(mesh, 1.0), []

    def check():
        if float(dt.value) > limit[0]:
            rejected.append(float(dt.value))
            raise hm.StepRejected("too long")

    limit = [NONE]
    history = (top, lambda t: np.array([4e-3 * max(t - 1.0, 0.0), -1e-3 * min(t, 1.0)]))
    model = hm.TransientModel(m.problem, dt, [], histories=[history], check=check)
    return m, hm.TimeStepping(model, hm.StepOptions(growth=1.0)), limit, rejected


@pytest.mark.mpi
def test_contact_forgets_a_rejected_step(comm):
    m, stepping, limit, rejected = pushed(comm)
    straight, other, *_ = pushed(comm)
    list(stepping.run(1.0, 1.0))
    list(other.run(1.0, 1.0))
    pair = m.pairs[0]
    before, counts = vars(m.problem.interface(pair)), m.problem.contacts()
    saved, start, u = m.problem.save(), flat(m.problem._sliding[0].save()), m.u.x.array.tobytes()
    list(stepping.run(1.5, 0.5))
    assert m.problem.interface(pair).slip.any() and m.problem.contacts() != counts
    m.problem.restore(saved)
    for name, value in vars(m.problem.interface(pair)).items():
        np.testing.assert_array_equal(value, before[name], err_msg=name)
    assert m.problem.contacts() == counts
    assert m.u.x.array.tobytes() == u
    now = flat(m.problem._sliding[0].save())
    assert len(now) > 3 and all(a is b for a, b in zip(now, start, strict=True))

    # Slip of the rejected step does not count, nor do its sets.
    stepping.t, limit[0] = 1.0, 0.3
    list(stepping.run(1.5, 0.5))
    list(other.run(1.5, 0.25))
    assert rejected == [0.5]
    np.testing.assert_allclose(m.u.x.array, straight.u.x.array, rtol=1e-10, atol=1e-16)
    mine, theirs = m.problem.interface(pair), straight.problem.interface(straight.pairs[0])
    np.testing.assert_allclose(mine.slip, theirs.slip, rtol=1e-8, atol=1e-14)
    np.testing.assert_array_equal(mine.state, theirs.state)
