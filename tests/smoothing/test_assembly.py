# SPDX-License-Identifier: LGPL-3.0-or-later
"""Vectors and matrices of linear terms against the NumPy twin and against DOLFINx."""

from mpi4py import MPI

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
import ufl
from dolfinx import fem

import fenicsx_hmcontact as hm
from tests.smoothing.helpers import (
    COMM,
    ENHANCEMENTS,
    KINDS,
    add_up,
    assemble,
    assemble_triangles,
    hooke,
    make_mesh,
    set_cell_values,
    set_values,
    smoothed_terms,
    square,
    tag_cells,
)
from tests.smoothing.twin import make_twin

pytestmark = pytest.mark.mpi

JITTERED = square("unstructured", 5)
G, LAME = 1.3, 2.1


def spaces(points, triangles, comm=COMM):
    mesh = make_mesh(points, triangles, comm)
    return fem.functionspace(mesh, ("P", 1, (2,))), fem.functionspace(mesh, ("P", 1))


def trial_and_test(space):
    return ufl.TrialFunction(space), ufl.TestFunction(space)


def stiffness(points, triangles, smoothing, shear_modulus=G, lame=LAME):
    V, _ = spaces(points, triangles)
    u, v = trial_and_test(V)
    form = ufl.inner(hooke(u, shear_modulus, lame), ufl.grad(v))
    return assemble(form * hm.node_cells_measure(smoothing))


def triangle_stiffness(points, triangles, shear_modulus=G, lame=LAME):
    V, _ = spaces(points, triangles, MPI.COMM_SELF)
    u, v = trial_and_test(V)
    return assemble_triangles(ufl.inner(hooke(u, shear_modulus, lame), ufl.grad(v)) * ufl.dx)


def assert_equal(ours, expected, rtol=1e-14):
    assert ours.shape == expected.shape
    assert abs(ours - expected).max() <= rtol * abs(expected).max()


# --- against the twin ----------------------------------------------------------------------------


@pytest.mark.parametrize("enhancement", ENHANCEMENTS)
@pytest.mark.parametrize("kind", KINDS)
def test_elasticity_is_that_of_the_twin(kind, enhancement):
    points, triangles = square(kind, 5)
    twin = make_twin(points, triangles).elasticity(enhancement, G, LAME)
    assert_equal(stiffness(points, triangles, enhancement), twin)


@pytest.mark.parametrize("enhancement", ENHANCEMENTS)
def test_elastic_forces_are_those_of_the_twin(enhancement):
    V, _ = spaces(*JITTERED)
    u, v = fem.Function(V), ufl.TestFunction(V)
    values = np.random.default_rng(0).normal(size=2 * len(JITTERED[0]))
    set_values(u, values)
    measure = hm.node_cells_measure(enhancement)
    force = assemble(ufl.inner(hooke(u, G, LAME), ufl.grad(v)) * measure)
    assert_equal(force, make_twin(*JITTERED).elasticity(enhancement, G, LAME) @ values)


@pytest.mark.parametrize("enhancement", ENHANCEMENTS)
def test_poisson_is_that_of_the_twin(enhancement):
    _, Q = spaces(*JITTERED)
    p, q = trial_and_test(Q)
    measure = hm.node_cells_measure(enhancement)
    matrix = assemble(ufl.inner(ufl.grad(p), ufl.grad(q)) * measure)
    assert_equal(matrix, make_twin(*JITTERED).poisson(enhancement))


def test_values_are_taken_at_the_node():
    """A product of values gives the lumped mass; tests and trials couple at the node alone."""
    V, Q = spaces(*JITTERED)
    areas = make_twin(*JITTERED).areas
    p, q = trial_and_test(Q)
    assert_equal(assemble(p * q * hm.dc), np.diag(areas))
    u, v = trial_and_test(V)
    assert_equal(assemble(ufl.inner(u, v) * hm.dc), np.diag(np.repeat(areas, 2)))


def test_test_function_with_value_and_gradient_in_one_term():
    _, Q = spaces(*JITTERED)
    p, q = trial_and_test(Q)
    twin = make_twin(*JITTERED)
    wind = ufl.as_vector([2.0, -3.0])
    gx, gy = (g.toarray() for g in twin.mean)
    at_node = np.diag(twin.areas)
    # The value does not vary over the points, so the second gradient cancels.
    along = 2.0 * gx - 3.0 * gy
    assert_equal(assemble(ufl.dot(wind, ufl.grad(p)) * q * hm.dc), at_node @ along)
    assert_equal(assemble(p * ufl.dot(wind, ufl.grad(q)) * hm.dc), along.T @ at_node)


def test_position_is_that_of_the_node():
    """A weight linear in x is integrated exactly, as axisymmetry needs."""
    points, _ = JITTERED
    _, Q = spaces(*JITTERED)
    q = ufl.TestFunction(Q)
    x = ufl.SpatialCoordinate(Q.mesh)
    twin = make_twin(*JITTERED)
    moment = assemble(x[0] * q * hm.dc)
    assert_equal(moment, twin.areas * points[:, 0])
    assert moment.sum() == pytest.approx(0.5, rel=1e-14)
    # The gradient of the position is the identity.
    V, _ = spaces(*JITTERED)
    v = ufl.TestFunction(V)
    x = ufl.SpatialCoordinate(V.mesh)
    assert_equal(
        assemble(ufl.inner(ufl.grad(x), ufl.grad(v)) * hm.dc), assemble(ufl.div(v) * hm.dc)
    )


# --- against triangles ---------------------------------------------------------------------------


@pytest.mark.parametrize("enhancement", ENHANCEMENTS)
@pytest.mark.parametrize("kind", KINDS)
def test_pressure_at_the_node_couples_as_on_triangles(kind, enhancement):
    points, triangles = square(kind, 5)
    V, Q = spaces(points, triangles)
    measure = hm.node_cells_measure(enhancement)
    p, v = ufl.TrialFunction(Q), ufl.TestFunction(V)
    ours = assemble(p * ufl.div(v) * measure)
    V1, Q1 = spaces(points, triangles, MPI.COMM_SELF)
    on_triangles = assemble_triangles(
        ufl.TrialFunction(Q1) * ufl.div(ufl.TestFunction(V1)) * ufl.dx
    )
    assert abs(ours - on_triangles).max() <= 1e-15 * max(1.0, abs(on_triangles).max())
    u, q = ufl.TrialFunction(V), ufl.TestFunction(Q)
    assert abs(assemble(q * ufl.div(u) * measure) - ours.T).max() <= 1e-15


@pytest.mark.parametrize("enhancement", ENHANCEMENTS)
@pytest.mark.parametrize("kind", KINDS)
def test_rigid_motions_are_the_only_zero_modes(kind, enhancement):
    points, triangles = square(kind, 6)
    matrix = stiffness(points, triangles, enhancement)
    x, y = points.T
    one, zero = np.ones_like(x), np.zeros_like(x)
    for motion in ((one, zero), (zero, one), (-y, x)):
        assert abs(matrix @ np.column_stack(motion).ravel()).max() < 1e-14 * abs(matrix).max()
    eigenvalues = np.linalg.eigvalsh(matrix)
    assert abs(eigenvalues[:3]).max() < 1e-13 * eigenvalues[-1]
    assert eigenvalues[3] > 1e-3 * eigenvalues[-1]


@pytest.mark.parametrize("kind", KINDS)
def test_smoothing_never_stiffens(kind):
    """Its least stiffness is that of the mean gradient, its most that of triangles (nu = 0)."""
    points, triangles = square(kind, 6)
    reference = triangle_stiffness(points, triangles, 0.5, 0.0)
    # Both kernels are the rigid motions; three supports span a complement.
    free = np.setdiff1d(np.arange(2 * len(points)), [0, 1, 3])
    least = {}
    for enhancement in ENHANCEMENTS:
        matrix = stiffness(points, triangles, enhancement, 0.5, 0.0)
        ratios = scipy.linalg.eigh(
            matrix[np.ix_(free, free)], reference[np.ix_(free, free)], eigvals_only=True
        )
        assert ratios[-1] <= 1.0 + 1e-10
        least[enhancement] = ratios[0]
    assert 0.0 < least["none"] < 0.05 < least["deviatoric"] < least["full"] < 0.4


@pytest.mark.parametrize("enhancement", ENHANCEMENTS)
def test_elasticity_does_not_depend_on_the_axes(enhancement):
    points, triangles = JITTERED
    c, s = np.cos(0.7), np.sin(0.7)
    rotation = np.array([[c, -s], [s, c]])
    turned = stiffness(points @ rotation.T, triangles, enhancement)
    q = sp.kron(sp.eye(len(points)), rotation).toarray()
    assert_equal(turned, q @ stiffness(points, triangles, enhancement) @ q.T, 2e-14)


def test_measure_triangles_is_plain_dx():
    measure = hm.node_cells_measure("triangles")
    V, _ = spaces(*JITTERED, MPI.COMM_SELF)
    u, v = trial_and_test(V)
    form = ufl.inner(hooke(u, G, LAME), ufl.grad(v)) * measure
    assert smoothed_terms(form)[0] == []
    assert form.signature() == (ufl.inner(hooke(u, G, LAME), ufl.grad(v)) * ufl.dx).signature()


# --- what may stand in a term --------------------------------------------------------------------


def test_constants_are_read_at_every_assembly():
    V, _ = spaces(*JITTERED)
    u, v = trial_and_test(V)
    g, la = fem.Constant(V.mesh, 1.0), fem.Constant(V.mesh, 0.0)
    skew = fem.Constant(V.mesh, np.array([[1.0, 0.0], [0.0, 1.0]]))
    stress = ufl.dot(skew, hooke(u, g, la))
    terms, both = smoothed_terms(ufl.inner(stress, ufl.grad(v)) * hm.dc)
    assert set(terms[0].constants) == {g, la, skew}
    twin = make_twin(*JITTERED)
    assert_equal(add_up(terms, both), twin.elasticity("deviatoric", 1.0, 0.0))
    g.value, la.value = G, LAME
    skew.value[:] = 3.0 * np.eye(2)
    assert_equal(add_up(terms, both), 3.0 * twin.elasticity("deviatoric", G, LAME))
    # Entries of a tensor arrive in their places.
    skew.value[:] = [[1.0, 0.5], [-0.25, 2.0]]
    xx, xy, yx, yy = twin.displacement_gradient("deviatoric")
    e = [[xx, 0.5 * (xy + yx)], [0.5 * (xy + yx), yy]]
    volume = xx + yy
    sigma = [
        [2 * G * e[i][j] + (LAME * volume if i == j else 0 * xx) for j in (0, 1)] for i in (0, 1)
    ]
    turned = [[sum(skew.value[i, k] * sigma[k][j] for k in (0, 1)) for j in (0, 1)] for i in (0, 1)]
    w = sp.diags(twin.point_weights("deviatoric"))
    gradient = [[xx, xy], [yx, yy]]
    expected = sum(gradient[i][j].T @ w @ turned[i][j] for i in (0, 1) for j in (0, 1))
    assert_equal(add_up(terms, both), expected.toarray())


@pytest.mark.parametrize("enhancement", ENHANCEMENTS)
def test_values_constant_on_triangles_enter_with_the_cell_mean(enhancement):
    V, _ = spaces(*JITTERED)
    u, v = trial_and_test(V)
    modulus = fem.Function(fem.functionspace(V.mesh, ("DG", 0)))
    values = np.random.default_rng(5).uniform(1.0, 9.0, len(JITTERED[1]))
    set_cell_values(modulus, values)
    measure = hm.node_cells_measure(enhancement)
    ours = assemble(ufl.inner(hooke(u, modulus, 0.5 * modulus), ufl.grad(v)) * measure)
    twin = make_twin(*JITTERED)
    means = twin.weights @ values
    assert_equal(ours, twin.elasticity(enhancement, means, 0.5 * means))


def test_tensor_constant_on_triangles():
    _, Q = spaces(*JITTERED)
    q = ufl.TestFunction(Q)
    k = fem.Function(fem.functionspace(Q.mesh, ("DG", 0, (2, 2))))
    values = np.random.default_rng(6).normal(size=(len(JITTERED[1]), 4))
    dofs = k.function_space.dofmap.list[:, 0]
    k.x.array.reshape(-1, 4)[dofs] = values[Q.mesh.topology.original_cell_index]
    twin = make_twin(*JITTERED)
    for a in range(4):
        ours = assemble(k[a // 2, a % 2] * q * hm.dc)
        assert_equal(ours, twin.areas * (twin.weights @ values[:, a]))


@pytest.mark.parametrize("enhancement", ["deviatoric", "full"])
def test_coefficients_of_any_rank(enhancement):
    """Values and gradients of scalar, vector and tensor fields at once, each in its own slot."""
    points, _ = JITTERED
    n = len(points)
    V, Q = spaces(*JITTERED)
    mesh = V.mesh
    q = ufl.TestFunction(Q)
    s, u = fem.Function(Q), fem.Function(V)
    t = fem.Function(fem.functionspace(mesh, ("P", 1, (2, 2))))
    rng = np.random.default_rng(7)
    values = {f: rng.normal(size=n * f.function_space.dofmap.bs) for f in (s, u, t)}
    for f, array in values.items():
        set_values(f, array)
    twin = make_twin(*JITTERED)
    gx, gy = twin.gradient(enhancement)
    _, xy, _, yy = (g @ values[u] for g in twin.displacement_gradient(enhancement))
    tensor = values[t].reshape(n, 2, 2)
    node = np.repeat(np.arange(n), 4)
    measure = hm.node_cells_measure(enhancement)
    form = s * u[1] * ufl.grad(t)[1, 0, 1] * ufl.grad(u)[0, 1] + t[0, 1] * s.dx(0) * u[1].dx(1)
    expected = values[s][node] * values[u][1::2][node] * (gy @ tensor[:, 1, 0]) * xy
    expected += tensor[node, 0, 1] * (gx @ values[s]) * yy
    weighted = twin.point_weights(enhancement) * expected
    ours = assemble(form * q * measure)
    assert_equal(ours, weighted.reshape(n, 4).sum(axis=1), 1e-13)


def test_several_measures_in_one_form():
    V, _ = spaces(*JITTERED)
    u, v = trial_and_test(V)
    full, mean = hm.node_cells_measure("full"), hm.node_cells_measure("none")
    work = ufl.inner(hooke(u, G, LAME), ufl.grad(v))
    twin = make_twin(*JITTERED)
    ours = assemble(work * full + 2.0 * work * mean - 0.5 * work * hm.dc)
    expected = twin.elasticity("full", G, LAME) + 2.0 * twin.elasticity("none", G, LAME)
    assert_equal(ours, expected - 0.5 * twin.elasticity("deviatoric", G, LAME))
    # The same integrand on two measures is compiled twice without clash.
    assert_equal(
        assemble(work * full + work * mean),
        twin.elasticity("full", G, LAME) + twin.elasticity("none", G, LAME),
    )


def two_squares():
    points, triangles = square("unstructured", 4)
    far = points + np.array([1.5, 0.25])
    return np.vstack((points, far)), np.vstack((triangles, triangles + len(points)))


def test_terms_on_one_of_two_bodies():
    points, triangles = two_squares()
    body = np.repeat([3, 8], len(triangles) // 2)
    V, _ = spaces(points, triangles)
    dc = hm.node_cells_measure("full", domain=V.mesh, subdomain_data=tag_cells(V.mesh, body))
    u, v = trial_and_test(V)
    work = ufl.inner(hooke(u, G, LAME), ufl.grad(v))
    twin = make_twin(points, triangles)
    half = np.arange(len(points)) < len(points) // 2
    first = twin.elasticity("full", half * G, half * LAME)
    second = twin.elasticity("full", ~half * G, ~half * LAME)
    assert_equal(assemble(work * dc(3)), first)
    assert_equal(assemble(work * dc(8)), second)
    assert_equal(assemble(2.0 * work * dc(3) + work * dc(8)), 2.0 * first + second)
    assert_equal(assemble(work * dc((3, 8))), first + second)
    # A term on everything and one on a body add up.
    assert_equal(assemble(work * dc + work * dc(8)), first + 2.0 * second)


def test_ids_of_different_tags_are_kept_apart():
    points, triangles = two_squares()
    mesh = make_mesh(points, triangles)
    body = np.repeat([1, 2], len(triangles) // 2)
    swapped = 3 - body
    q = ufl.TestFunction(fem.functionspace(mesh, ("P", 1)))
    measures = [
        hm.node_cells_measure("full", domain=mesh, subdomain_data=tag_cells(mesh, values))
        for values in (body, swapped)
    ]
    ours = assemble(q * measures[0](1) + q * measures[1](1))
    assert_equal(ours, make_twin(points, triangles).areas)


def test_positions_are_needed_before_a_matrix():
    _, Q = spaces(*JITTERED)
    p, q = trial_and_test(Q)
    (term,), _ = smoothed_terms(p * q * hm.dc)
    with pytest.raises(RuntimeError, match="set_positions must be called before add_to_matrix"):
        term.add_to_matrix(np.zeros(1))


# --- locking -------------------------------------------------------------------------------------


def cooks_membrane(n):
    points, triangles = square("unstructured", n)
    x, t = points.T
    low, high = 44.0 * x, 44.0 + 16.0 * x
    return np.column_stack((48.0 * x, low + t * (high - low))), triangles


def test_only_the_volumetric_enhancement_locks():
    """Cook's membrane, nu = 0.4999: uy at (48, 60) is 19.304 (P2, 64 cells a side)."""
    points, triangles = cooks_membrane(8)
    clamped = np.flatnonzero(np.repeat(np.isclose(points[:, 0], 0.0), 2))
    free = np.setdiff1d(np.arange(2 * len(points)), clamped)
    tip = np.argmin(np.hypot(points[:, 0] - 48.0, points[:, 1] - 60.0))
    # A load of 1 in all, constant along the loaded edge.
    edge = np.flatnonzero(np.isclose(points[:, 0], 48.0))
    load = np.zeros(2 * len(points))
    load[2 * edge + 1] = 1.0 / (len(edge) - 1)
    ends = edge[np.argsort(points[edge, 1])[[0, -1]]]
    load[2 * ends + 1] *= 0.5
    material = hm.LinearElastic(E=1.0, nu=0.4999)
    moduli = (material.shear_modulus, material.lame)
    error = {}
    for smoothing in ENHANCEMENTS:
        matrix = stiffness(points, triangles, smoothing, *moduli)
        u = np.linalg.solve(matrix[np.ix_(free, free)], load[free])
        error[smoothing] = u[np.searchsorted(free, 2 * tip + 1)] / 19.304 - 1.0
    assert abs(error["none"]) < 0.05
    assert abs(error["deviatoric"]) < 0.12
    assert error["full"] < -0.35
