# SPDX-License-Identifier: LGPL-3.0-or-later
"""Condition numbers against those of dense matrices, exact and estimated."""

import numpy as np
import pytest
from dolfinx import fem
from scipy import sparse

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.solvers import LinearSolver, SingularSystemError, condition
from fenicsx_hmcontact.solvers.condition import (
    condition_number,
    estimated_condition,
    exact_condition,
    normalised_condition,
)
from tests.models import Elastic, Porous, dense, stack

pytestmark = pytest.mark.mpi

BOTH = [exact_condition, estimated_condition]
BASE = {("bottom_0", 0): 0.0, ("bottom_0", 1): 0.0}
FACES = ("bottom_1", "top_0")
SUPERLU = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "superlu_dist"}


def dry(comm, *law):
    return Elastic(
        stack(comm, (4, 5)),
        fixed=BASE | {("top_1", 0): 1e-6, ("top_1", 1): -1e-4},
        pairs=[(*FACES, None, *law)],
    )


def wet(comm, aperture, *law, width=1.0, rows=3):
    return Porous(
        stack(comm, (4, 5), width=width, rows=rows),
        fixed=BASE | {("top_1", 0): 0.0},
        drained={"top_1": 0.0},
        tractions={"top_1": (0.0, -1e4)},
        pairs=[(*FACES, hm.GapFlow(1e-9, aperture=aperture), *law)],
    )


def reservoir(comm):
    """A block under water of a pressure that can be changed."""
    domain = stack(comm, (4,))
    pressure = fem.Constant(domain.mesh, 1e3)
    model = Porous(domain, fixed=BASE, drained={"top_0": pressure})
    model.pressure = pressure
    return model


MODELS = {
    "tied": lambda comm: dry(comm),
    "rubbing": lambda comm: dry(comm, hm.CoulombFriction(0.1)),
    "water, no gap": lambda comm: wet(comm, 0.0),
    "water, thin gap": lambda comm: wet(comm, 1e-10),
    "water, wide gap": lambda comm: wet(comm, 1e-3),
    "water, rubbing": lambda comm: wet(comm, None, hm.CoulombFriction(0.3)),
}


def system(comm, matrix, options=None):
    """A dense matrix as a linear system, its rows spread over the ranks."""
    n = len(matrix)
    owned = n // comm.size + (comm.rank < n % comm.size)
    first = comm.exscan(owned) or 0
    rows, columns = (k.ravel().astype(np.int32) for k in np.indices((n, n))[:, first:][:, :owned])
    solver = LinearSolver(comm, owned, rows, columns, options)
    solver.set_values(np.asarray(matrix, float)[first : first + owned].ravel())
    return solver, slice(first, first + owned)


# --- of problems -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", MODELS)
def test_condition_is_that_of_the_free_unknowns(comm, name):
    model = MODELS[name](comm)
    model.step() if isinstance(model, Porous) else model.problem.solve()
    problem = model.problem
    free = np.concatenate(comm.allgather(problem._free))
    matrix = dense(problem._linear.matrix, comm)
    assert not free.all()
    assert not matrix[np.ix_(free, ~free)].any() and not matrix[np.ix_(~free, free)].any()
    matrix = matrix[np.ix_(free, free)]
    np.testing.assert_allclose(np.abs(np.diag(matrix)), 1.0, rtol=1e-12)
    expected = np.linalg.cond(matrix)
    assert expected > 10
    before = problem.n_factorisations
    assert problem.condition_number() == pytest.approx(expected, rel=1e-7)
    assert estimated_condition(problem._linear, problem._free) == pytest.approx(expected, rel=1e-2)
    assert problem.n_factorisations == before


def test_asking_changes_nothing(comm):
    asked, quiet = wet(comm, 1e-6), wet(comm, 1e-6)
    for _ in range(2):
        asked.step()
        estimated_condition(asked.problem._linear, asked.problem._free)
        asked.problem.bulk_tangent()
        quiet.step()
        assert np.array_equal(asked.u.x.array, quiet.u.x.array)
        assert np.array_equal(asked.p.x.array, quiet.p.x.array)


def test_tangent_of_another_state_is_forgotten(comm):
    """Prescribed motions, too, are multiplied with the tangent of the step."""
    asked, quiet = reservoir(comm), reservoir(comm)
    for model in (asked, quiet):
        model.step()
    asked.dt.value = 250.0
    asked.problem.bulk_tangent()
    asked.dt.value = 100.0
    for model in (asked, quiet):
        model.pressure.value = 2e3
        model.step()
    np.testing.assert_array_equal(asked.p.x.array, quiet.p.x.array)


def test_many_unknowns_are_estimated(comm, monkeypatch):
    model = wet(comm, 1e-4)
    model.step()
    exact = model.problem.condition_number()
    monkeypatch.setattr(condition, "EXACT_SIZE", 10)
    monkeypatch.setattr(condition, "exact_condition", None)
    assert model.problem.condition_number() == pytest.approx(exact, rel=1e-2)


def test_tall_column_of_many_unknowns(comm):
    """The estimate where small singular values lie close together."""
    model = wet(comm, 1e-6, rows=40, width=0.2)
    model.step()
    arguments = model.problem._linear, model.problem._free
    assert estimated_condition(*arguments) == pytest.approx(exact_condition(*arguments), rel=1e-2)


@pytest.mark.parametrize("estimate", BOTH)
def test_body_that_nothing_holds_is_singular(comm, estimate):
    model = Elastic(stack(comm, (3, 4)), fixed=BASE, tractions={"top_1": (0.0, -1e4)})
    with pytest.raises(SingularSystemError):
        model.problem.solve()
    assert estimate(model.problem._linear, model.problem._free) == np.inf
    assert model.problem.condition_number() == np.inf


def test_before_the_first_solution_there_is_no_matrix(comm):
    with pytest.raises(RuntimeError, match="condition number is that of a system, and none has"):
        dry(comm).problem.condition_number()


def test_bulk_tangent_is_the_derivative_of_the_residual(comm):
    model = Porous(stack(comm, (3, 4)), fixed=BASE, drained={"top_1": 0.0})
    problem = model.problem
    matrix, prescribed = problem.bulk_tangent()
    layout = problem.layout
    assert matrix.shape == (layout.n_global, layout.n_global)
    residuals = []
    # Linear, so that one difference is exact.
    x = np.random.default_rng(1).standard_normal(layout.n_global)
    for factor in (0.0, 1.0):
        views = layout.views(factor * x[layout.global_index])
        for unknown, values in zip(problem.unknowns, views, strict=True):
            unknown.x.array[:] = values
        problem.residual()
        residuals.append(np.concatenate(comm.allgather(problem._raw[layout.owned])))
    change, expected = residuals[1] - residuals[0], matrix @ x
    np.testing.assert_allclose(change, expected, rtol=0, atol=1e-13 * np.abs(expected).max())
    n_bottom, n_top = 4 * 2, 5
    assert prescribed.sum() == n_bottom + n_top


# --- of matrices -----------------------------------------------------------------------------


def test_prescribed_unknowns_would_do_harm(comm):
    solver, part = system(comm, [[1, 10, 0], [-10, 1, 0], [0, 0, 1]])
    free = np.array([True, True, False])
    for estimate in BOTH:
        assert estimate(solver, free[part]) == pytest.approx(1.0, rel=1e-12)
        assert estimate(solver, np.ones(3, bool)[part]) == pytest.approx(101**0.5, rel=1e-12)


def test_nothing_free(comm):
    solver, part = system(comm, np.eye(5))
    assert condition_number(solver, np.zeros(5, bool)[part]) == 1.0


@pytest.mark.parametrize("estimate", BOTH)
@pytest.mark.parametrize("options", [None, SUPERLU])
def test_singular_matrix_has_none(comm, estimate, options):
    matrix = 2 * np.eye(6)
    matrix[:2, :2] = 1.0
    solver, part = system(comm, matrix, options)
    assert estimate(solver, np.ones(6, bool)[part]) == np.inf


def test_what_is_no_number_has_none(comm):
    matrix = np.eye(4)
    matrix[2, 3] = np.nan
    solver, part = system(comm, matrix)
    with pytest.raises(RuntimeError, match="has entries that are not numbers"):
        condition_number(solver, np.ones(4, bool)[part])


def test_solver_that_does_not_converge_estimates_nothing(comm):
    rng = np.random.default_rng(3)
    options = {"ksp_type": "gmres", "pc_type": "none", "ksp_max_it": 2, "ksp_rtol": 1e-12}
    solver, part = system(comm, rng.standard_normal((20, 20)) + 5 * np.eye(20), options)
    with pytest.raises(RuntimeError, match="could not be solved"):
        estimated_condition(solver, np.ones(20, bool)[part])


def test_estimate_by_an_iterative_solver(comm):
    rng = np.random.default_rng(3)
    options = {"ksp_type": "gmres", "pc_type": "jacobi", "ksp_rtol": 1e-10}
    solver, part = system(comm, rng.standard_normal((20, 20)) + 5 * np.eye(20), options)
    free = np.ones(20, bool)[part]
    assert estimated_condition(solver, free) == pytest.approx(exact_condition(solver, free), 1e-2)


@pytest.mark.parametrize("decades", [2, 6, 11])
def test_estimate_of_unsymmetric_matrices(comm, decades):
    rng = np.random.default_rng(decades)
    U, V = (np.linalg.qr(rng.standard_normal((60, 60)))[0] for _ in range(2))
    A = U @ np.diag(10.0 ** -np.linspace(0, decades, 60)) @ V
    solver, part = system(comm, A)
    scale = 1 / np.sqrt(np.abs(np.diag(A)))
    expected = np.linalg.cond(scale[:, None] * A * scale)
    free = np.ones(60, bool)[part]
    assert exact_condition(solver, free) == pytest.approx(expected, rel=1e-3)
    assert estimated_condition(solver, free) == pytest.approx(expected, rel=1e-2)


def test_units_do_not_matter(comm):
    rng = np.random.default_rng(2)
    A = rng.standard_normal((30, 30)) + 5 * np.eye(30)
    units = 10.0 ** rng.integers(-8, 9, 30)
    d = 1 / np.sqrt(np.abs(np.diag(A)))
    expected = np.linalg.cond(d[:, None] * A * d)
    scaled = sparse.csr_array(units[:, None] * A * units)
    assert normalised_condition(scaled) == pytest.approx(expected, rel=1e-9)
