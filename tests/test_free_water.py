# SPDX-License-Identifier: LGPL-3.0-or-later
"""Free water on faces that have left each other, and at the ends of gaps."""

import numpy as np
import pytest
from dolfinx import fem

import fenicsx_hmcontact as hm
from tests.models import GAMMA, Porous, integral, largest, stack, total

pytestmark = pytest.mark.mpi

SHIFT = 0.32
GAP = 1e-3


def shifted(domain, outside, *, lift=GAP, gravity=None, **options):
    """Two blocks, the upper one shifted and lifted, water around them or none."""
    fixed = {(name, i): 0.0 for name in ("bottom_0", "top_1") for i in (0, 1)}
    model = Porous(domain, fixed=fixed | {("top_1", 1): lift}, drained={}, **options)
    upper = domain.cell_tags.find(domain.bodies["block_1"])
    model.u.x.array[2 * np.unique(model.V.dofmap.list[upper]) + 1] = GAP
    surfaces = domain.surface("bottom_1"), domain.surface("top_0")
    flow = hm.GapFlow(1e-9, outside=outside, aperture_cap=1e-4, gravity=gravity)
    model.pair = hm.ContactPair(domain.facet_tags, *surfaces, hm.Frictionless(), flow=flow)
    model.problem = hm.ContactProblem(
        model.F, [model.u, model.p], bcs=model.bcs, pairs=[model.pair], time_step=model.dt
    )
    return model


def overlapping(comm, across=(11, 7)):
    """Blocks of which each is left uncovered at one end."""
    return stack(comm, across, shift=SHIFT)


def on_surface(model, name, values):
    """Coordinates of a surface's nodes and values there, of all ranks."""
    facets = model.domain.facet_tags.find(model.domain.surface(name))
    dofs = fem.locate_dofs_topological(model.Q, 1, facets)
    x = model.Q.tabulate_dof_coordinates()[dofs]
    comm = model.domain.mesh.comm
    return np.concatenate(comm.allgather(x)), np.concatenate(comm.allgather(values[dofs]))


@pytest.mark.parametrize("outside", [2e3, lambda x: GAMMA * (3.0 - x[:, 1]) + 0.0 * x[:, 0]])
def test_free_water_wets_what_nothing_faces(comm, outside):
    model = shifted(overlapping(comm), outside, weight=GAMMA if callable(outside) else None)
    model.step()
    wetted = model.problem._free_water.wetted
    for name, uncovered in (("top_0", lambda x: x < SHIFT - 0.1), ("bottom_1", lambda x: x > 1.1)):
        x, p = on_surface(model, name, model.p.x.array)
        x[:, 1] += GAP * (name == "bottom_1")
        expected = outside(x[:, :2]) if callable(outside) else np.full(len(x), outside)
        free = uncovered(x[:, 0])
        assert free.any() and not free.all()
        np.testing.assert_allclose(p[free], expected[free], rtol=1e-5)
    assert 0 < wetted.sum() < len(wetted)


def test_without_it_faces_and_ends_are_sealed(comm):
    model = shifted(overlapping(comm), None)
    model.step()
    assert model.problem._free_water.numbers.size == 0
    assert largest(model.outflow(), comm) == 0.0


@pytest.mark.parametrize("across", [(11, 7), (6, 13)])
def test_water_at_rest_stays_at_rest_around_a_gap(comm, across):
    model = shifted(
        overlapping(comm, across),
        lambda x: GAMMA * (3.0 - x[:, 1]),
        gravity=(0.0, -1.0),
        material=hm.LinearElastic(1e16, 0.2),
        weight=GAMMA,
        dt=1e7,
    )
    model.p.interpolate(lambda x: GAMMA * (3.0 - x[1]))
    rest = model.p.x.array.copy()
    for _ in range(2):
        model.step()
    # The upper block stands higher by the gap than the coordinates say.
    assert largest(model.p.x.array - rest, comm) < 1.01 * GAMMA * GAP


@pytest.mark.parametrize("across", [(11, 7), (6, 13)])
def test_a_gap_that_opens_fills_from_its_ends(comm, across):
    domain, opening = overlapping(comm, across), 2e-4
    lift = fem.Constant(domain.mesh, GAP)
    model = shifted(
        domain,
        0.0,
        lift=lift,
        permeability=1e-16,
        material=hm.LinearElastic(1e12, 0.2),
        tau=0.0,
        dt=1e4,
    )
    model.step()
    before = model.problem.interface(model.pair)
    lift.value = GAP + opening
    model.step()
    state = model.problem.interface(model.pair)
    bodies = integral(model.volume_change, comm)
    came_in = total(model.problem.reactions(model.p), domain)[0]
    width = 1.0 - SHIFT
    assert state.volume - before.volume == pytest.approx(opening * width, rel=1e-6)
    assert state.taken_up == pytest.approx(opening * width, rel=1e-6)
    assert came_in == pytest.approx(bodies + state.taken_up, rel=1e-9)
    # Suction between parallel plates that part, open at both ends to the nearest node
    suction = 12e-3 / 1e-4**3 * (opening / 1e4) * width**2 / 8.0
    assert -state.pore_pressure.min() == pytest.approx(suction, rel=0.25)
    assert state.pore_pressure.max() == 0.0
