# SPDX-License-Identifier: LGPL-3.0-or-later
"""Averages over the triangles of node cells, and F-bar made of them."""

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem

import fenicsx_hmcontact as hm
from fenicsx_hmcontact._kernels import assembly as kernels
from fenicsx_hmcontact._kernels import node_cells as node_kernels
from fenicsx_hmcontact.smoothing import (
    PointFunction,
    create_node_cells,
    evaluate_at_points,
    point_forms,
)
from tests.smoothing.helpers import (
    add_up,
    assemble,
    input_nodes,
    make_mesh,
    set_cell_values,
    set_values,
    smoothed_terms,
    square,
)
from tests.smoothing.test_tangents import assert_tangent, first_piola
from tests.smoothing.twin import make_twin, triangle_gradients

pytestmark = pytest.mark.mpi

POINTS, TRIANGLES = square("unstructured", 4)
VALUES = np.random.default_rng(1).normal(scale=0.02, size=2 * len(POINTS))
FULL = hm.node_cells_measure("full")


def displacement(comm=MPI.COMM_WORLD):
    V = fem.functionspace(make_mesh(POINTS, TRIANGLES, comm), ("P", 1, (2,)))
    u = fem.Function(V)
    set_values(u, VALUES)
    return u


def gradient(u):
    return ufl.Identity(2) + ufl.grad(u)


def f_bar(u):
    F = gradient(u)
    return ufl.sqrt(ufl.cell_avg(ufl.det(F)) / ufl.det(F)) * F


def energy(F, mu=1.3, lame=2.1):
    J = ufl.det(F)
    return 0.5 * mu * (ufl.tr(F.T * F) - 2.0) - mu * ufl.ln(J) + 0.5 * lame * ufl.ln(J) ** 2


def triangle_jacobians(values):
    _, (gx, gy) = triangle_gradients(POINTS, TRIANGLES)
    H = np.array([[g @ values[a::2] for g in (gx, gy)] for a in range(2)])
    return (1.0 + H[0, 0]) * (1.0 + H[1, 1]) - H[0, 1] * H[1, 0]


def test_mean_of_the_jacobian_gives_the_new_area_of_the_cell():
    u = displacement()
    cells = create_node_cells(u.function_space.mesh)
    value = evaluate_at_points(ufl.cell_avg(ufl.det(gradient(u))), cells)
    assert value.shape == (len(cells), 4)
    of_cell = input_nodes(fem.functionspace(cells.mesh, ("P", 1)))[
        cells.block_dofs(fem.functionspace(cells.mesh, ("P", 1)))[: len(cells)]
    ]
    expected = make_twin(POINTS, TRIANGLES).weights @ triangle_jacobians(VALUES)
    assert np.allclose(value, expected[of_cell, None], rtol=0, atol=1e-14)
    moved = make_twin(POINTS + VALUES.reshape(-1, 2), TRIANGLES)
    assert np.allclose(value[:, 0] * cells.areas, moved.areas[of_cell], rtol=1e-13)


def test_averages_of_data_and_constants():
    """A weight constant on triangles stands inside the mean, the mean of grad p at no point."""
    mesh = make_mesh(POINTS, TRIANGLES)
    Q = fem.functionspace(mesh, ("P", 1))
    p, k = fem.Function(Q), fem.Function(fem.functionspace(mesh, ("DG", 0)))
    rng = np.random.default_rng(3)
    p_values, k_values = rng.normal(size=len(POINTS)), rng.uniform(1.0, 2.0, len(TRIANGLES))
    set_values(p, p_values)
    set_cell_values(k, k_values)
    c = fem.Constant(mesh, 3.0)
    vector = assemble(ufl.cell_avg(c * k * ufl.grad(p)[0] ** 2) * ufl.TestFunction(Q) * hm.dc)
    twin = make_twin(POINTS, TRIANGLES)
    along_x = triangle_gradients(POINTS, TRIANGLES)[1][0] @ p_values
    expected = twin.areas * (twin.weights @ (3.0 * k_values * along_x**2))
    assert np.allclose(vector, expected, rtol=0, atol=1e-13 * abs(expected).max())


@pytest.mark.parametrize("enhancement", ["deviatoric", "full", "none"])
def test_variations(enhancement):
    """First and second variations of averages alone, in products, and within other functions."""
    u = displacement()
    V = u.function_space
    J = ufl.det(gradient(u))
    J_b, mean = ufl.cell_avg(J), ufl.cell_avg(ufl.inner(gradient(u), gradient(u)) ** 2)
    functional = (ufl.sin(J_b * mean) + J_b**2 / J + u[0] * mean) * hm.node_cells_measure(
        enhancement
    )
    v = ufl.TestFunction(V)
    assert_tangent([ufl.derivative(functional, u, v)], [(u, VALUES)])
    # An energy: the vector is its own difference, the matrix is symmetric.
    du = ufl.TrialFunction(V)
    matrix = assemble(ufl.derivative(ufl.derivative(functional, u, v), u, du))
    assert abs(matrix - matrix.T).max() < 1e-13 * abs(matrix).max()


def test_averages_of_two_fields():
    """Second variations by different fields: rectangular blocks."""
    u = displacement()
    mesh = u.function_space.mesh
    Q = fem.functionspace(mesh, ("P", 1))
    p, q = fem.Function(Q), ufl.TestFunction(Q)
    p_values = np.random.default_rng(5).normal(size=len(POINTS))
    set_values(p, p_values)
    J = ufl.det(gradient(u))
    flux = ufl.cell_avg(J * ufl.dot(ufl.grad(p), ufl.grad(p))) * ufl.cell_avg(
        ufl.dot(ufl.inv(gradient(u)) * ufl.grad(p), ufl.grad(q))
    )
    v = ufl.TestFunction(u.function_space)
    work = ufl.cell_avg(ufl.div(v) * J * ufl.grad(p)[1]) * p
    assert_tangent([flux * FULL, work * FULL], [(u, VALUES), (p, p_values)])


def test_f_bar_has_the_exact_tangent_and_one_jacobian_a_cell():
    u = displacement()
    v = ufl.TestFunction(u.function_space)
    F = f_bar(u)
    work = ufl.derivative(energy(F) * FULL, u, v)
    assert_tangent([work], [(u, VALUES)])
    cells = create_node_cells(u.function_space.mesh)
    jacobian = evaluate_at_points(ufl.det(F), cells, FULL)
    assert np.allclose(jacobian, jacobian[:, :1], rtol=1e-14, atol=0)


def test_f_bar_is_the_deviatoric_enhancement_at_no_displacement():
    u = displacement()
    u.x.array[:] = 0.0
    V = u.function_space
    v, du = ufl.TestFunction(V), ufl.TrialFunction(V)
    by_jacobian = assemble(ufl.derivative(ufl.derivative(energy(f_bar(u)) * FULL, u, v), u, du))
    deviatoric = ufl.inner(first_piola(u, 1.3, 2.1), ufl.grad(v)) * hm.dc
    expected = assemble(ufl.derivative(deviatoric, u, du))
    assert np.allclose(by_jacobian, expected, rtol=0, atol=5e-16 * abs(expected).max())


def test_forces_turn_with_the_body():
    """F-bar is objective, other than the deviatoric enhancement of grad u."""
    u = displacement()
    terms = smoothed_terms(
        ufl.derivative(energy(f_bar(u)) * FULL, u, ufl.TestFunction(u.function_space))
    )
    force = add_up(*terms).reshape(-1, 2)
    rotation = np.array([[np.cos(1.1), -np.sin(1.1)], [np.sin(1.1), np.cos(1.1)]])
    set_values(u, ((POINTS + VALUES.reshape(-1, 2)) @ rotation.T - POINTS).ravel())
    expected = force @ rotation.T
    assert np.allclose(add_up(*terms).reshape(-1, 2), expected, atol=1e-13 * abs(expected).max())


def test_any_number_of_ranks_gives_the_same():
    def assembled(comm):
        u = displacement(comm)
        V = u.function_space
        work = ufl.derivative(energy(f_bar(u)) * FULL, u, ufl.TestFunction(V))
        results = [add_up(*smoothed_terms(work))]
        tangent = ufl.derivative(work, u, ufl.TrialFunction(V))
        return [*results, add_up(*smoothed_terms(tangent))]

    for ours, alone in zip(assembled(MPI.COMM_WORLD), assembled(MPI.COMM_SELF), strict=True):
        assert np.allclose(ours, alone, rtol=0, atol=1e-14 * abs(alone).max())


def test_kernels_agree_with_their_python_source(monkeypatch):
    """Where numba read past an array, the interpreter would raise."""
    u = displacement(MPI.COMM_SELF)
    V = u.function_space
    cells = create_node_cells(V.mesh)
    a = PointFunction(V.mesh, (), "full", np.ones((len(cells), 4, 1)))
    work = ufl.derivative((1.0 + a) * energy(f_bar(u)) * FULL, u, ufl.TestFunction(V))
    tangent = ufl.derivative(work, u, ufl.TrialFunction(V))
    compiled = [add_up(*smoothed_terms(form, cells)) for form in (work, tangent)]
    helpers = ("_gradients_at", "_means", "_pack")
    mains = ("assemble_vector", "assemble_matrix", "evaluate", "patch_vectors")
    for name in (*helpers, *mains, "add_second_variations"):
        monkeypatch.setattr(kernels, name, getattr(kernels, name).py_func)
    for form, expected in zip((work, tangent), compiled, strict=True):
        assert np.allclose(
            add_up(*smoothed_terms(form, cells)), expected, rtol=0, atol=1e-14 * abs(expected).max()
        )


def test_geometry_of_triangles_and_turned_axes():
    cells = create_node_cells(make_mesh(POINTS, TRIANGLES))
    gradients = node_kernels.triangle_gradients.py_func(cells.vertices, cells.points)
    corners = cells.points[cells.vertices]
    for k in range(2):  # gradients of the shape functions reproduce x and y
        slope = np.einsum("tk,tki->ti", corners[:, :, k], gradients)
        assert np.allclose(slope, np.eye(2)[k], rtol=0, atol=1e-13)
    assert np.allclose(cells.on_triangles.gradients[:, 0].reshape(gradients.shape), gradients)
    nodes = cells.nodes[cells.corners]
    assert np.array_equal(nodes, cells.vertices[cells.triangles])
    # Axes turned by a quarter: the points along the second axis lie where those of x lay.
    p = fem.Function(fem.functionspace(cells.mesh, ("P", 1)))
    set_values(p, VALUES[::2])
    before = cells.gradient(p, "full")
    cells.angles[:] = 0.5 * np.pi
    cells.follow()
    after = cells.gradient(p, "full")
    assert np.allclose(after[:, :2], before[:, 2:], rtol=0, atol=1e-13)
    assert np.allclose(after[:, 2:], before[:, [1, 0]], rtol=0, atol=1e-13)


def test_what_has_no_mean_over_triangles_is_refused():
    u = displacement()
    mesh = u.function_space.mesh
    p = fem.Function(fem.functionspace(mesh, ("P", 1)), name="pressure")
    q = ufl.TestFunction(p.function_space)
    x = ufl.SpatialCoordinate(mesh)
    refused = {
        "not pressure": ufl.cell_avg(p),
        "not x": ufl.cell_avg(x[0] * ufl.grad(p)[0]),
        "by components": ufl.cell_avg(ufl.grad(p))[0],
        "another cell_avg": ufl.cell_avg(ufl.grad(p)[0] * ufl.cell_avg(ufl.grad(p)[0])),
    }
    for message, expression in refused.items():
        with pytest.raises(ValueError, match=message):
            point_forms(expression * q * hm.dc)
    with pytest.raises(ValueError, match="cell_avg takes gradients"):
        point_forms(ufl.cell_avg(q) * hm.dc)
