# SPDX-License-Identifier: LGPL-3.0-or-later
"""The conventional interface element: its matrices, its solution and how it becomes singular."""

import numpy as np
import pytest
from scipy.sparse.linalg import spsolve

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.contact import gather_surface
from fenicsx_hmcontact.gap_flow.conventional import ConventionalInterface
from fenicsx_hmcontact.solvers.condition import normalised_condition
from tests.models import GAMMA, K, Porous, largest, stack

pytestmark = pytest.mark.mpi

FLOW = hm.GapFlow(K)
DT = 100.0
G = 1e-5
ROLLERS = {(f"{side}_{k}", 0): 0.0 for side in ("left", "right") for k in (0, 1)}
ROLLERS |= {("bottom_0", 1): 0.0}


def blocks(comm, across=(6, 6), *, pairs=(), fixed=(), E=1e8, k=K, slope=0.0, width=0.5, shift=0.0):
    """Two loaded blocks of 0.5 m height, drained on top."""
    return Porous(
        stack(comm, across, width=width, rows=4, slope=slope, shift=shift),
        fixed=ROLLERS | dict.fromkeys(fixed, 0.0),
        drained={"top_1": 0.0},
        tractions={"top_1": (0.0, -1e4)},
        pairs=pairs,
        material=hm.LinearElastic(E, 0.3),
        permeability=k,
        smoothing="triangles",
        dt=DT,
    )


def interface(model, flow=FLOW, names=("bottom_1", "top_0")):
    domain = model.domain
    faces = (gather_surface(domain.mesh, domain.facet_tags, domain.surface(n), n) for n in names)
    return ConventionalInterface(*faces, flow, model.problem.layout)


def conditions(model, apertures, closed=True, flow=FLOW):
    elements = interface(model, flow)
    bulk, prescribed = model.problem.bulk_tangent()
    systems = (elements.system(bulk, prescribed, g, DT, closed)[0] for g in apertures)
    return np.array([normalised_condition(matrix) for matrix in systems])


# --- the element -----------------------------------------------------------------------------


@pytest.mark.parametrize("names", [("bottom_1", "top_0"), ("top_0", "bottom_1")])
def test_leak_off_of_one_element_is_that_of_the_paper(comm, names):
    length, across = 0.5, hm.GapFlow(K, aperture_cap=1e-12)
    A = interface(blocks(comm, (1, 1)), across, names).conductance(G).toarray()
    c = K / (GAMMA * G)
    # The order of Eq. 100, but for p-: here each node stands opposite its own.
    expected = np.array([[2, 1, -2, -1], [1, 2, -1, -2], [-2, -1, 2, 1], [-1, -2, 1, 2]])
    np.testing.assert_allclose(A, c * length / 6 * expected, rtol=1e-12)
    assert np.linalg.matrix_rank(A) == 2


@pytest.mark.parametrize("slope", [0.0, 0.3])
def test_linear_pressures_flow_and_leak_exactly(comm, slope):
    elements = interface(blocks(comm, (7, 7), slope=slope))
    x = elements._middle.points[:, 0]
    length, g = 0.5 * np.hypot(1.0, slope), 1e-3
    A = elements.conductance(g)
    assert largest((A - A.T).toarray(), comm) < 1e-15 * largest(A.toarray(), comm)
    assert largest(A @ np.ones(2 * x.size), comm) < 1e-15 * largest(A.toarray(), comm)
    p = np.tile(3 + 7 * x, 2)
    along = 7 / np.hypot(1.0, slope)
    assert p @ A @ p == pytest.approx(g**3 / 12e-3 * along**2 * length, rel=1e-9)
    drop = np.concatenate((np.full(x.size, 5.0), np.full(x.size, 2.0)))
    leak = K / (GAMMA * g) * 3.0 * length
    assert (A @ drop)[: x.size].sum() == pytest.approx(leak, rel=1e-12)
    assert (A @ drop)[x.size :].sum() == pytest.approx(-leak, rel=1e-12)


def test_conductance_follows_an_aperture_that_varies(comm):
    """Against the integral of c_T over a gap of linear aperture."""
    elements = interface(blocks(comm, (40, 40)))
    x = elements._middle.points[:, 0]
    drop = np.repeat((1.0, 0.0), x.size)
    leak = drop @ elements.conductance(1e-3 * (1 + x)) @ drop
    assert leak == pytest.approx(K / (GAMMA * 1e-3) * np.log(1.5), rel=1e-9)


@pytest.mark.parametrize("slope", [0.0, 0.3])
def test_gap_takes_up_the_volume_it_opens_by(comm, slope):
    elements = interface(blocks(comm, slope=slope))
    n = len(elements._middle.nodes)
    lift = np.array([3e-3, 1e-3])
    still = np.zeros(2 * n)
    opened = elements.storage @ np.concatenate((np.tile(lift, n), still))
    # Of the upper body by its projections: width across, the fall of the interface along.
    volume = 0.5 * lift[1] - 0.5 * slope * lift[0]
    assert opened.sum() == pytest.approx(volume, rel=1e-12)
    assert opened[:n].sum() == pytest.approx(volume / 2, rel=1e-12)
    assert largest(elements.storage @ np.tile(lift, 2 * n), comm) < 1e-16
    force = elements.storage.T @ np.full(2 * n, 2.0)
    total = force[: 2 * n].reshape(-1, 2).sum(axis=0)
    np.testing.assert_allclose(total, [-slope, 1.0], atol=1e-14)


@pytest.mark.parametrize("closed", [True, False])
def test_system_is_symmetric_but_for_the_sign_of_its_volumes(comm, closed):
    model = blocks(comm, fixed=[("top_1", 1)])
    bulk, prescribed = model.problem.bulk_tangent()
    matrix, T = interface(model).system(bulk, prescribed, G, DT, closed)
    numbers = np.concatenate(comm.allgather(model.problem.layout.field_of_owned()))
    field = T.T @ numbers > 0.5
    signed = np.where(field, -1.0, 1.0)[:, None] * matrix.toarray()
    d = 1 / np.sqrt(np.abs(signed.diagonal()))
    signed = d[:, None] * signed * d
    np.testing.assert_allclose(signed, signed.T, rtol=0, atol=1e-13)
    assert np.all(signed.diagonal()[field] < 0.0)


# --- its solution ----------------------------------------------------------------------------


@pytest.mark.parametrize("slope", [0.0, 0.2])
@pytest.mark.parametrize("g", [1e-3, 1e-7])
def test_solution_is_that_of_the_film_between_matching_meshes(comm, slope, g):
    film = hm.GapFlow(K, aperture=g)
    proposed = blocks(comm, slope=slope, pairs=[("bottom_1", "top_0", film)])
    proposed.step()
    model = blocks(comm, slope=slope)
    bulk, prescribed = model.problem.bulk_tangent()
    matrix, T = interface(model).system(bulk, prescribed, g, DT, closed=True)
    model.problem.residual()
    layout = model.problem.layout
    load = -np.concatenate(comm.allgather(model.problem._raw[layout.owned]))
    x = T @ spsolve(matrix.tocsc(), T.T @ load)
    found = layout.views(x[layout.global_index])
    for unknown, values in zip((proposed.u, proposed.p), found, strict=True):
        # 1e-16 times the condition number, 6e6
        size = largest(unknown.x.array, comm)
        np.testing.assert_allclose(values, unknown.x.array, rtol=0, atol=1e-8 * size)


# --- its condition ---------------------------------------------------------------------------

APERTURES = [1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-8, 1e-10, 1e-12, 1e-14, 1e-16]
PROTOTYPE = [6.0e9, 6.0e6, 6.0e3, 5.1e3, 5.6e4, 5.6e6, 5.6e8, 5.6e10, 5.6e12, 5.6e14]
"""Condition numbers of an independent prototype of the same scene."""


def test_condition_of_a_closing_gap_is_that_of_a_prototype(comm):
    np.testing.assert_allclose(conditions(blocks(comm), APERTURES), PROTOTYPE, rtol=0.15)


def test_condition_of_free_faces_is_that_of_a_prototype(comm):
    model = blocks(comm, fixed=[("top_1", 1)])
    found = conditions(model, [1e-2, 1e-5, 1e-6, 1e-14, 1e-16], closed=False)
    np.testing.assert_allclose(found, [1.2e10, 1e4, 1e5, 1e13, 1e15], rtol=0.15)


def test_condition_grows_with_one_over_the_aperture(comm):
    g = np.array([1e-7, 1e-9, 1e-11, 1e-13])
    found = conditions(blocks(comm), g) * g
    np.testing.assert_allclose(found, found[0], rtol=1e-2)


def test_soft_blocks_are_singular_to_working_precision(comm):
    found = conditions(blocks(comm, E=1e6, k=1e-5), [1e-4, 1e-16], flow=hm.GapFlow(1e-5))
    assert found[0] == pytest.approx(7e3, rel=0.15)
    assert found[1] > 4e15


def test_film_stays_well_conditioned_where_the_element_does_not(comm):
    found = []
    for g in (1e-5, 1e-10, 1e-16, 0.0):
        model = blocks(comm, pairs=[("bottom_1", "top_0", hm.GapFlow(K, aperture=g))])
        model.step()
        found.append(model.problem.condition_number())
    np.testing.assert_allclose(found, found[0], rtol=1e-3)
    assert found[0] < 100


def test_partly_closed_gap(comm):
    model = blocks(comm)
    elements = interface(model)
    closed = elements._middle.points[:, 0] < 0.25
    bulk, prescribed = model.problem.bulk_tangent()
    parts = [
        elements.system(bulk, prescribed, np.where(closed, 1e-14, 1e-4), DT, part)
        for part in (False, closed, True)
    ]
    sizes = [matrix.shape[0] for matrix, _ in parts]
    # The left end moves up and down only.
    assert sizes[0] - sizes[1] == 2 * closed.sum() - 1
    assert sizes[0] - sizes[2] == 2 * closed.size - 2
    assert normalised_condition(parts[1][0]) > 1e11


# --- refusals --------------------------------------------------------------------------------


@pytest.mark.parametrize("g", [0.0, -1e-9, [1e-3] * 6 + [0.0]])
def test_refuses_an_aperture_that_is_not_positive(comm, g):
    with pytest.raises(ValueError, match="a conventional element needs a positive one"):
        interface(blocks(comm)).conductance(g)


def test_refuses_meshes_that_do_not_match(comm):
    with pytest.raises(ValueError, match="'bottom_1' and 'top_0' are not two chains of as many"):
        interface(blocks(comm, (5, 7)))
    with pytest.raises(ValueError, match="the nodes of surfaces 'bottom_1' and 'top_0' do not lie"):
        interface(blocks(comm, shift=0.02))


def test_elements_stay_on_the_nodes_that_lay_opposite_each_other(comm):
    model = blocks(comm, shift=0.02)
    names = "bottom_1", "top_0"
    faces = [
        gather_surface(model.domain.mesh, model.domain.facet_tags, model.domain.surface(n), n)
        for n in names
    ]
    order = [np.argsort(face.points[:, 0]) for face in faces]
    moved = [np.zeros_like(face.points) for face in faces]
    moved[0][order[0]] = faces[0].points[order[0]] - faces[1].points[order[1]]
    elements = ConventionalInterface(*faces, FLOW, model.problem.layout, tuple(moved))
    n = len(faces[0].nodes)
    pressures = np.zeros(2 * n)
    pressures[:n] = 1.0
    leak = elements.conductance(G) @ pressures
    assert leak[:n].sum() == pytest.approx(0.5 * K / GAMMA / G, rel=0.1)
    with pytest.raises(ValueError, match="do not lie opposite"):
        ConventionalInterface(*faces, FLOW, model.problem.layout)
