# SPDX-License-Identifier: LGPL-3.0-or-later
"""Values that live at smoothing points, and expressions evaluated there."""

import numpy as np
import pytest
import ufl
from dolfinx import fem

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.smoothing import (
    PointExpression,
    PointFunction,
    check_smoothable,
    create_node_cells,
    evaluate_at_points,
)
from tests.smoothing.helpers import (
    ENHANCEMENTS,
    assemble,
    input_nodes,
    make_mesh,
    set_cell_values,
    set_values,
    smoothed_terms,
    square,
    tag_cells,
)
from tests.smoothing.twin import POINTS as PER_CELL
from tests.smoothing.twin import make_twin

pytestmark = pytest.mark.mpi

POINTS, TRIANGLES = square("unstructured", 4)


@pytest.fixture
def cells():
    return create_node_cells(make_mesh(POINTS, TRIANGLES))


def of_cells(cells):
    """Number in the input of the node of each cell."""
    Q = fem.functionspace(cells.mesh, ("P", 1))
    return input_nodes(Q)[cells.block_dofs(Q)[: len(cells)]]


def global_values(seed, components, enhancement):
    shape = (len(POINTS), PER_CELL[enhancement], components)
    return np.random.default_rng(seed).normal(size=shape)


@pytest.mark.parametrize("enhancement", ENHANCEMENTS)
def test_values_stand_in_terms(cells, enhancement):
    """Two functions of several components, next to nodal fields and data on triangles."""
    mesh = cells.mesh
    V, Q = fem.functionspace(mesh, ("P", 1, (2,))), fem.functionspace(mesh, ("P", 1))
    a_values, b_values = (global_values(k, n, enhancement) for k, n in ((1, 4), (2, 1)))
    mine = of_cells(cells)
    a = PointFunction(mesh, (2, 2), enhancement, a_values[mine])
    b = PointFunction(mesh, (), enhancement, b_values[mine])
    p, p_values = fem.Function(Q), np.random.default_rng(3).normal(size=len(POINTS))
    set_values(p, p_values)
    k = fem.Function(fem.functionspace(mesh, ("DG", 0)))
    k_values = np.random.default_rng(4).uniform(1.0, 2.0, len(TRIANGLES))
    set_cell_values(k, k_values)
    v = ufl.TestFunction(V)
    measure = hm.node_cells_measure(enhancement)
    vector = assemble((k + p) * b * ufl.inner(a, ufl.grad(v)) * measure, cells)

    twin = make_twin(POINTS, TRIANGLES)
    n = PER_CELL[enhancement]
    factor = np.repeat(twin.weights @ k_values + p_values, n) * b_values.ravel()
    weight = factor * twin.point_weights(enhancement)
    parts = zip(twin.displacement_gradient(enhancement), a_values.reshape(-1, 4).T, strict=True)
    expected = sum(g.T @ (weight * values) for g, values in parts)
    assert np.allclose(vector, expected, rtol=0, atol=1e-13 * abs(expected).max())


@pytest.mark.parametrize("enhancement", ENHANCEMENTS)
def test_expressions_at_the_points(cells, enhancement):
    mesh = cells.mesh
    V = fem.functionspace(mesh, ("P", 1, (2,)))
    u = fem.Function(V)
    set_values(u, np.random.default_rng(5).normal(size=2 * len(POINTS)))
    measure = hm.node_cells_measure(enhancement)
    gradient = evaluate_at_points(ufl.grad(u), cells, measure)
    expected = cells.gradient(u, enhancement)
    assert gradient.shape == expected.shape == (len(cells), PER_CELL[enhancement], 2, 2)
    assert np.allclose(gradient, expected, rtol=0, atol=1e-13)
    a = PointFunction(mesh, (2,), enhancement, expected[..., 0].copy())
    c = fem.Constant(mesh, 3.0)
    x = ufl.SpatialCoordinate(mesh)
    scalar = evaluate_at_points(c * a[1] + u[0] + x[1], cells, measure)
    at_node = cells.nodal_values(u)[: len(cells), 0] + cells.points[: len(cells), 1]
    assert np.allclose(scalar, 3.0 * expected[:, :, 1, 0] + at_node[:, None], rtol=0, atol=1e-13)


def test_expressions_of_a_part(cells):
    """Only points of the tagged body, and again after values have changed."""
    tags = tag_cells(cells.mesh, np.ones(len(TRIANGLES)))
    p = fem.Function(fem.functionspace(cells.mesh, ("P", 1)))
    measure = hm.node_cells_measure("full", domain=cells.mesh, subdomain_data=tags)
    expression = PointExpression([p**2, ufl.grad(p)[0]], cells, measure(1))
    assert np.array_equal(expression.cells, np.arange(len(cells)))
    for value in (2.0, 3.0):
        p.x.array[:] = value
        values = expression.evaluate()
        assert np.allclose(values[..., 0], value**2, rtol=1e-14)
        assert np.allclose(values[..., 1], 0.0, atol=1e-12)


def test_derivatives_see_values_as_data(cells):
    p = fem.Function(fem.functionspace(cells.mesh, ("P", 1)))
    q, dp = ufl.TestFunction(p.function_space), ufl.TrialFunction(p.function_space)
    a = PointFunction(cells.mesh, (), "full", np.ones((len(cells), 4, 1)))
    full = hm.node_cells_measure("full")
    form = (p + a) ** 2 * q * full
    p.x.array[:] = 0.5
    by_p = assemble(ufl.derivative(form, p, dp), cells)
    by_a = assemble(ufl.derivative(form, a, 2.0 * dp), cells)
    assert np.allclose(by_p, 3.0 * assemble(q * dp * full), rtol=1e-14)
    assert np.allclose(by_a, 2.0 * by_p, rtol=1e-14)


def test_refusals(cells):
    mesh = cells.mesh
    Q = fem.functionspace(mesh, ("P", 1))
    p, q = fem.Function(Q), ufl.TestFunction(Q)
    a = PointFunction(mesh, (), "full", np.zeros((len(cells), 4, 1)), "hardening")
    for measure in (ufl.dx, ufl.ds):
        with pytest.raises(ValueError, match="hardening lives at smoothing points: its term must"):
            check_smoothable(a * q * measure)
        with pytest.raises(ValueError, match="hardening lives at smoothing points: its term must"):
            hm.ContactProblem(a * p * q * measure, p)
    with pytest.raises(ValueError, match=r"hardening lives at the points of .*'full'.* on .*'dev"):
        check_smoothable(a * q * hm.dc)
    with pytest.raises(ValueError, match=r"of shape \(2,\) was given 3 values"):
        PointFunction(mesh, (2,), "full", np.zeros((len(cells), 4, 3)))
    with pytest.raises(ValueError, match="not hardening"):
        smoothed_terms(ufl.cell_avg(a) * q * hm.node_cells_measure("full"), cells)
    a.cells = np.arange(1 if len(cells) else 0, len(cells), dtype=np.int32)
    with pytest.raises(ValueError, match="hardening has no values in some of the cells"):
        smoothed_terms(a * q * hm.node_cells_measure("full"), cells)
    w = fem.Function(fem.functionspace(mesh, ("P", 2)), name="w")
    with pytest.raises(ValueError, match="w lives on"):
        evaluate_at_points(w, cells)
