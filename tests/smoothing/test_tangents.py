# SPDX-License-Identifier: LGPL-3.0-or-later
"""Tangents of nonlinear terms: finite differences at random states, and how Newton converges."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import exterior_facet_indices

import fenicsx_hmcontact as hm
from tests.smoothing.helpers import (
    COMM,
    ENHANCEMENTS,
    add_up,
    make_mesh,
    set_cell_values,
    set_values,
    smoothed_terms,
    square,
)

pytestmark = pytest.mark.mpi

POINTS, TRIANGLES = square("unstructured", 4)
N = len(POINTS)


def first_piola(u, mu, lame):
    """P of the neo-Hookean energy mu/2 (tr C - 2) - mu ln J + lambda/2 ln^2 J."""
    F = ufl.variable(ufl.Identity(2) + ufl.grad(u))
    J = ufl.det(F)
    energy = 0.5 * mu * (ufl.tr(F.T * F) - 2.0) - mu * ufl.ln(J) + 0.5 * lame * ufl.ln(J) ** 2
    return ufl.diff(energy, F)


def random_state(space, seed, size=0.02):
    f = fem.Function(space)
    values = np.random.default_rng(seed).normal(scale=size, size=N * space.dofmap.bs)
    set_values(f, values)
    return f, values


def assert_tangent(residuals, fields, tolerance=2e-8, step=1e-6):
    """Compare every block of the tangent with central differences along random directions.

    Args:
        residuals: Form of each test function.
        fields: Functions with the flat arrays of their values.
        tolerance: Of the differences, relative to the largest entry.
        step: Of the differences; its square and round-off over it are both far below 1e-8.
    """
    rng = np.random.default_rng(11)
    for residual in residuals:
        vector = smoothed_terms(residual)
        for f, values in fields:
            trial = ufl.TrialFunction(f.function_space)
            matrix = add_up(*smoothed_terms(ufl.derivative(residual, f, trial)))
            for _ in range(2):
                direction = rng.normal(size=values.size)
                ends = []
                for sign in (1.0, -1.0):
                    set_values(f, values + sign * step * direction)
                    ends.append(add_up(*vector))
                set_values(f, values)
                difference = (ends[0] - ends[1]) / (2.0 * step)
                assert abs(difference).max() > 0.0
                error = abs(matrix @ direction - difference).max()
                assert error < tolerance * abs(difference).max()


@pytest.mark.parametrize("enhancement", ENHANCEMENTS)
def test_neo_hookean(enhancement):
    V = fem.functionspace(make_mesh(POINTS, TRIANGLES), ("P", 1, (2,)))
    state = random_state(V, 1)
    measure = hm.node_cells_measure(enhancement)
    v = ufl.TestFunction(V)
    assert_tangent([ufl.inner(first_piola(state[0], 1.3, 2.1), ufl.grad(v)) * measure], [state])


def test_tangent_of_an_energy_is_symmetric():
    """Residual and tangent by two Gateaux derivatives of one functional."""
    V = fem.functionspace(make_mesh(POINTS, TRIANGLES), ("P", 1, (2,)))
    u, _ = random_state(V, 1)
    F = ufl.Identity(2) + ufl.grad(u)
    J = ufl.det(F)
    energy = (0.65 * (ufl.tr(F.T * F) - 2.0) - 1.3 * ufl.ln(J) + 1.05 * ufl.ln(J) ** 2) * hm.dc
    v, du = ufl.TestFunction(V), ufl.TrialFunction(V)
    residual = ufl.derivative(energy, u, v)
    by_stress = ufl.inner(first_piola(u, 1.3, 2.1), ufl.grad(v)) * hm.dc
    ours, expected = (add_up(*smoothed_terms(form)) for form in (residual, by_stress))
    assert np.allclose(ours, expected, rtol=0, atol=1e-13 * abs(expected).max())
    matrix = add_up(*smoothed_terms(ufl.derivative(residual, u, du)))
    assert abs(matrix - matrix.T).max() < 1e-13 * abs(matrix).max()


@pytest.mark.parametrize("enhancement", ENHANCEMENTS)
def test_coupled_fields(enhancement):
    """Displacement and pressure in each other's terms, with values, gradients, data and x."""
    mesh = make_mesh(POINTS, TRIANGLES)
    V, Q = fem.functionspace(mesh, ("P", 1, (2,))), fem.functionspace(mesh, ("P", 1))
    (u, u_values), (p, p_values) = random_state(V, 2), random_state(Q, 3, 0.5)
    u_n, p_n = random_state(V, 4)[0], random_state(Q, 5)[0]
    k = fem.Function(fem.functionspace(mesh, ("DG", 0)))
    set_cell_values(k, np.random.default_rng(6).uniform(1.0, 2.0, len(TRIANGLES)))
    b = fem.Constant(mesh, np.array([0.3, -0.7]))
    x = ufl.SpatialCoordinate(mesh)
    v, q = ufl.TestFunction(V), ufl.TestFunction(Q)
    measure = hm.node_cells_measure(enhancement)
    F = ufl.Identity(2) + ufl.grad(u)
    J = ufl.det(F)
    stress = first_piola(u, 1.3 + x[0], 2.1 * k) - p**2 * J * ufl.inv(F).T
    balance = ufl.inner(stress, ufl.grad(v)) + J * ufl.dot(b + u * p, v) * x[1]
    flux = k * ufl.exp(J - 1.0) * ufl.inv(F) * ufl.inv(F).T * (ufl.grad(p) + (1.0 + p) * b)
    water = (J - 1.0 + ufl.div(u_n) * (p - p_n) * u[0]) * q * x[0] + ufl.dot(flux, ufl.grad(q))
    assert_tangent([balance * measure, water * measure], [(u, u_values), (p, p_values)])


def axisymmetric_strain(u, r):
    # At the axis the weight r makes any finite hoop strain vanish from the term, but not 0/0.
    hoop = u[0] / ufl.conditional(ufl.lt(r, 1e-12), 1.0, r)
    e = ufl.sym(ufl.grad(u))
    return ufl.as_tensor([[e[0, 0], e[0, 1], 0], [e[1, 0], e[1, 1], 0], [0, 0, hoop]])


@pytest.mark.parametrize("enhancement", ENHANCEMENTS)
def test_axisymmetric(enhancement):
    """The square touches the axis x = 0."""
    mesh = make_mesh(POINTS, TRIANGLES)
    V = fem.functionspace(mesh, ("P", 1, (2,)))
    u, values = random_state(V, 7)
    v = ufl.TestFunction(V)
    r = ufl.SpatialCoordinate(mesh)[0]
    strain = axisymmetric_strain(u, r)
    stress = (1.0 + ufl.tr(strain) ** 2) * strain + 2.0 * ufl.tr(strain) * ufl.Identity(3)
    work = ufl.inner(stress, axisymmetric_strain(v, r)) * r
    assert_tangent([work * hm.node_cells_measure(enhancement)], [(u, values)])


@pytest.mark.parametrize("enhancement", ["full", "none"])
def test_forces_turn_with_the_body(enhancement):
    """Objectivity: a rigid rotation on top of any state turns the nodal forces.

    It cannot hold for the deviatoric enhancement of grad u, which mixes the trace of points.
    """
    V = fem.functionspace(make_mesh(POINTS, TRIANGLES), ("P", 1, (2,)))
    u, values = random_state(V, 8)
    v = ufl.TestFunction(V)
    measure = hm.node_cells_measure(enhancement)
    terms = smoothed_terms(ufl.inner(first_piola(u, 1.3, 2.1), ufl.grad(v)) * measure)
    force = add_up(*terms).reshape(-1, 2)
    c, s = np.cos(1.1), np.sin(1.1)
    rotation = np.array([[c, -s], [s, c]])
    turned = (POINTS + values.reshape(-1, 2)) @ rotation.T - POINTS
    set_values(u, turned.ravel())
    expected = force @ rotation.T
    assert np.allclose(add_up(*terms).reshape(-1, 2), expected, atol=1e-13 * abs(expected).max())
    set_values(u, (POINTS @ rotation.T - POINTS).ravel())
    assert abs(add_up(*terms)).max() < 1e-14


# --- Newton --------------------------------------------------------------------------------------

TIGHT = hm.NewtonOptions(tolerance=1e-13)


def boundary_dofs(V):
    tdim = V.mesh.topology.dim
    V.mesh.topology.create_connectivity(tdim - 1, tdim)
    return fem.locate_dofs_topological(V, tdim - 1, exterior_facet_indices(V.mesh.topology))


@pytest.mark.parametrize("smoothing", [*ENHANCEMENTS, "triangles"])
def test_patch_of_finite_strain(smoothing):
    """A linear field on the boundary gives it inside, from a disturbed start."""
    slope = np.array([[0.2, 0.15], [-0.1, -0.25]])
    V = fem.functionspace(make_mesh(POINTS, TRIANGLES), ("P", 1, (2,)))
    u, v = random_state(V, 9)[0], ufl.TestFunction(V)
    exact = fem.Function(V)
    exact.interpolate(lambda x: slope @ x[:2])
    form = ufl.inner(first_piola(u, 1.3, 2.1), ufl.grad(v)) * hm.node_cells_measure(smoothing)
    bc = fem.dirichletbc(exact, boundary_dofs(V))
    problem = hm.ContactProblem(form, u, bcs=[bc], newton=TIGHT)
    assert (problem.node_cells is None) == (smoothing == "triangles")
    problem.solve()
    assert np.allclose(u.x.array, exact.x.array, rtol=0, atol=1e-13)


@pytest.mark.parametrize("enhancement", ENHANCEMENTS)
def test_newton_converges_quadratically(enhancement):
    """A block between rough plates, squeezed by 20 %."""
    V = fem.functionspace(make_mesh(POINTS, TRIANGLES), ("P", 1, (2,)))
    u, v = fem.Function(V), ufl.TestFunction(V)
    plates = fem.locate_dofs_geometrical(V, lambda x: np.isclose(abs(x[1] - 0.5), 0.5))
    moved = fem.Function(V)
    moved.interpolate(lambda x: np.vstack((0.0 * x[0], -0.2 * x[1])))
    form = ufl.inner(first_piola(u, 1.0, 1.5), ufl.grad(v)) * hm.node_cells_measure(enhancement)
    problem = hm.ContactProblem(form, u, bcs=[fem.dirichletbc(moved, plates)], newton=TIGHT)
    result = problem.solve()
    residuals = np.array([r for (r,) in result.history])
    assert result.iterations <= 6
    assert residuals[0] > 1e-3
    assert np.all(residuals[1:] < 10.0 * residuals[:-1] ** 2 + 1e-14)
    # The support forces of both plates balance.
    reactions = problem.reactions(u).x.array[: V.dofmap.index_map.size_local * 2].reshape(-1, 2)
    total = COMM.allreduce(reactions.sum(axis=0))
    size = COMM.allreduce(abs(reactions).sum())
    assert size > 0.1 and abs(total).max() < 1e-12 * size
