# SPDX-License-Identifier: LGPL-3.0-or-later
"""The film between surfaces that move: its tangent, its laws, and water carried along."""

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.contact import ContactStatus
from fenicsx_hmcontact.gap_flow import unseen_exchange
from tests.models import dense, fix, largest, notch, stack

CUBIC = {}
DOWN = {"gravity": (0.6, -0.8)}
ROUGH = {"aperture": hm.ResidualAperture(0.03)}
CONSTANT = {"aperture": 0.05}
LAGGED = {"lagged": True}
SEALING = {"sealing": True}


def soft_blocks(comm, flow, *, held=False, motion="finite"):
    """Two soft porous blocks with an inclined gap, and the problem of both."""
    domain = stack(comm, (3, 4), rows=1, slope=0.2, shift=0.07)
    mesh = domain.mesh
    mesh.topology.create_connectivity(1, 2)
    V, Q = fem.functionspace(mesh, ("P", 1, (2,))), fem.functionspace(mesh, ("P", 1))
    u, p = fem.Function(V, name="u"), fem.Function(Q, name="p")
    v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))
    dt = fem.Constant(mesh, 1.0)
    F = hm.equilibrium(hm.LinearElastic(100.0, 0.2).stress(u), p, v)
    F += hm.water_balance(u, fem.Function(V), p, q, dt, permeability=0.3, unit_weight=1.0)
    bcs = [fix(domain, V.sub(i), "bottom_0") for i in (0, 1)]
    if held:
        bcs += [fix(domain, V.sub(0), "left_1"), fix(domain, Q, "right_1")]
    surfaces = domain.surface("bottom_1"), domain.surface("top_0")
    law = hm.CoulombFriction(0.4, 0.3)
    pair = hm.ContactPair(domain.facet_tags, *surfaces, law, flow=flow, motion=motion)
    return hm.ContactProblem(F, [u, p], bcs=bcs, pairs=[pair], time_step=dt)


@pytest.mark.parametrize("sets", ["open", "stick", "slip", "mixed"])
@pytest.mark.parametrize("options", [CUBIC, DOWN, ROUGH, CONSTANT, LAGGED, SEALING])
@pytest.mark.parametrize(
    ("held", "motion"), [((), "finite"), (("u", "p"), "finite"), ((), "small")]
)
def test_the_tangent_follows_the_film(sets, options, held, motion):
    comm = MPI.COMM_SELF
    flow = hm.GapFlow(1e-3, viscosity=1e-3, unit_weight=50.0, **options)
    problem = soft_blocks(comm, flow, held=held, motion=motion)
    u, p = problem.unknowns
    rng = np.random.default_rng(1)
    u.x.array[:] = rng.normal(size=u.x.array.size) * 0.004
    p.x.array[:] = rng.normal(size=p.x.array.size) * 3.0
    coupling = problem._sliding[0]
    n = len(coupling.status.closed)
    closed, slipping = np.full(n, sets != "open"), np.full(n, sets in ("slip", "mixed"))
    if sets == "mixed":
        closed[::3] = slipping[1::3] = False
    coupling.status = ContactStatus(closed, slipping & closed, rng.choice([-1.0, 1.0], n))
    coupling.kinematics.aperture = lambda: np.resize([0.0, 0.02, 0.03], n)
    coupling.water.begin(np.resize([True, False, False], n))
    del coupling.kinematics.aperture
    check_tangent(problem)


def check_tangent(problem):
    """Compare the condensed tangent at the present state with differences of the residual."""
    comm, (u, p), rng = problem.comm, problem.unknowns, np.random.default_rng(2)
    for coupling in problem._sliding:
        # As after the first increment, but with the sets as they are.
        follow = coupling.follow_water
        coupling.follow_water = lambda *states, follow=follow: follow(*states[:2], True)
    problem.residual()
    problem._update_tangent()
    scale, A = problem._linear.scale, dense(problem._linear.matrix, comm)
    start, free = [f.x.array.copy() for f in (u, p)], problem._free
    for _ in range(6):
        direction = np.where(free, rng.normal(size=len(free)), 0.0)
        move = direction * scale
        problem.condensation.expand(move)
        difference, h = np.zeros(len(free)), 1e-7
        for sign in (1.0, -1.0):
            for f, x, along in zip((u, p), start, problem.layout.views(move), strict=True):
                f.x.array[:] = x + sign * h * along
            problem.residual()
            difference += sign * problem._condensed * scale / (2.0 * h)
        error = (difference - A @ direction)[free]
        assert largest(error, comm) < 1e-6 * largest((A @ direction)[free], comm)


@pytest.mark.parametrize("sealing", [False, True])
def test_what_no_node_sees_of_pressures_passes_no_closed_node_that_seals(sealing):
    flow = hm.GapFlow(1e-12, viscosity=1e-3, unit_weight=50.0, sealing=sealing)
    problem = soft_blocks(MPI.COMM_SELF, flow)
    problem.residual()
    kinematics = problem._sliding[0].kinematics
    n = len(kinematics.secondary.nodes)
    exchanges = []
    for gaps in ([0.01, 0.01], [0.01, 0.0]):
        kinematics.aperture = lambda gaps=gaps: np.resize(gaps, n)
        exchanges.append(unseen_exchange(flow, kinematics).toarray())
        size = np.abs(exchanges[-1]).max()
        assert np.abs(exchanges[-1].sum(axis=1)).max() < 1e-12 * size
        assert exchanges[-1] == pytest.approx(exchanges[-1].T, abs=1e-15 * size)
        assert np.linalg.eigvalsh(exchanges[-1]).min() > -1e-12 * size
    of_all, of_half = (np.abs(exchange).max() for exchange in exchanges)
    assert (of_half < 1e-6 * of_all) if sealing else (of_half > 0.1 * of_all)


@pytest.mark.parametrize("motion", ["finite", "small"])
def test_a_gap_of_round_off_leaves_the_matrix_as_it_is(motion):
    """Pressures of the iterations differ across it, and leakage grows without bound."""
    problem = soft_blocks(MPI.COMM_SELF, hm.GapFlow(1e-3, unit_weight=50.0), motion=motion)
    coupling, p = problem._sliding[0], problem.unknowns[1]
    p.x.array[:] = np.random.default_rng(1).normal(size=p.x.array.size) * 3.0
    n = len(coupling.status.closed)
    coupling.status = ContactStatus.open(n)
    # Nothing of this is a gap.
    coupling.kinematics.aperture = lambda: np.resize([1e-20, -1e-19, 1e-17, 3e-18], n)
    problem.residual()
    problem._update_tangent()
    assert np.abs(dense(problem._linear.matrix, problem.comm)).max() < 1e2


def test_the_tangent_follows_films_that_meet():
    """A node in the corner has the water of both, and passes it on to what it faces."""
    comm = MPI.COMM_SELF
    domain = notch(comm, 3, 4)
    mesh = domain.mesh
    V, Q = fem.functionspace(mesh, ("P", 1, (2,))), fem.functionspace(mesh, ("P", 1))
    u, p = fem.Function(V, name="u"), fem.Function(Q, name="p")
    v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))
    dt = fem.Constant(mesh, 1.0)
    F = hm.equilibrium(hm.LinearElastic(100.0, 0.2).stress(u), p, v)
    F += hm.water_balance(u, fem.Function(V), p, q, dt, permeability=0.3, unit_weight=1.0)
    bcs = [fix(domain, V.sub(i), "base bottom") for i in (0, 1)]
    flow = hm.GapFlow(1e-3, viscosity=1e-3, unit_weight=50.0)
    pairs = [
        hm.ContactPair(domain.facet_tags, *map(domain.surface, names), hm.Frictionless(), flow=flow)
        for names in (("block bottom", "base floor"), ("block right", "base wall"))
    ]
    problem = hm.ContactProblem(F, [u, p], bcs=bcs, pairs=pairs, time_step=dt)
    rng = np.random.default_rng(1)
    u.x.array[:] = rng.normal(size=u.x.array.size) * 0.004
    block = np.unique(V.dofmap.list[domain.cell_tags.find(domain.bodies["block"])])
    u.x.array[2 * block] -= 0.03
    u.x.array[2 * block + 1] += 0.03
    p.x.array[:] = rng.normal(size=p.x.array.size) * 3.0
    for coupling in problem._sliding:
        coupling.status = ContactStatus.open(len(coupling.status.closed))
    check_tangent(problem)


def film_between(flow, gap, before, closed):
    """Film of a given width, now and at the start of the step, and the problem it belongs to."""
    problem = soft_blocks(MPI.COMM_SELF, flow)
    coupling = problem._sliding[0]
    n = len(coupling.status.closed)
    closed = np.isin(np.argsort(np.argsort(coupling.kinematics.points[0][:, 0])), closed)
    coupling.kinematics.aperture = lambda: np.where(closed, 0.0, before)
    coupling.water.begin(closed)
    coupling.kinematics.aperture = lambda: np.where(closed, 0.0, gap)
    coupling.status = ContactStatus(closed, np.zeros(n, bool), np.ones(n))
    problem.residual()
    return problem, coupling.water.film


def test_one_closed_node_seals():
    flow = hm.GapFlow(1e-3, unit_weight=50.0, sealing=True)
    _, film = film_between(flow, 0.02, 0.02, closed=[1])
    _, open_film = film_between(flow, 0.02, 0.02, closed=[])
    along = [f._along.toarray() for f in (film, open_film)]
    order = np.argsort(film._kinematics.points[0][:, 0])
    assert not along[0][order[1]].any()
    assert along[1][order[1]].any()
    # Beyond the neighbour the water flows as it did.
    assert along[0][order[2], order[3]] == along[1][order[2], order[3]] != 0.0


def test_lagged_water_flows_through_the_gap_before_and_fills_that_of_now():
    options = {"transverse_permeability": 1e-3, "unit_weight": 50.0}
    _, lagged = film_between(hm.GapFlow(lagged=True, **options), 0.03, 0.02, closed=[])
    _, narrow = film_between(hm.GapFlow(**options), 0.02, 0.02, closed=[])
    _, wide = film_between(hm.GapFlow(**options), 0.03, 0.02, closed=[])
    for name in ("of_pressures", "of_drops"):
        flows, before, now = (getattr(film, name).toarray() for film in (lagged, narrow, wide))
        assert np.array_equal(flows, before)
        assert np.abs(now - before).max() > 0.1 * np.abs(now).max()
    # Without pressures nothing flows; what the surfaces parted by in the step is filled.
    assert not lagged.volumes.any()
    problem, _ = film_between(hm.GapFlow(lagged=True, **options), 0.03, 0.02, closed=[])
    coupling, u = problem._sliding[0], problem.unknowns[0]
    u.x.array[coupling._dofs[0][1::2]] += 0.01
    problem.residual()
    # The upper block overhangs the lower one by .07 m.
    assert coupling.water.film.volumes.sum() == pytest.approx(0.01 * 0.93, rel=1e-2)
