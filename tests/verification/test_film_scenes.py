# SPDX-License-Identifier: LGPL-3.0-or-later
"""The film in larger scenes: carried along, around a corner, beside friction, and not there."""

import numpy as np
import pytest
from dolfinx import fem

import fenicsx_hmcontact as hm
from tests.models import LOAD, Porous, notch, stack, total

pytestmark = pytest.mark.mpi


def film_pair(domain, secondary, primary, law=None, **flow):
    """A pair with water between two surfaces."""
    return hm.ContactPair(
        domain.facet_tags,
        domain.surface(secondary),
        domain.surface(primary),
        law or hm.Frictionless(),
        flow=hm.GapFlow(1e-7, **flow),
    )


def with_pairs(model, *pairs):
    """The problem of a model with these pairs."""
    model.problem = hm.ContactProblem(
        model.F, [model.u, model.p], bcs=model.bcs, pairs=pairs, time_step=model.dt
    )
    return model


@pytest.mark.parametrize("secondary", ["block", "base"])
@pytest.mark.parametrize("across", [(13, 7), (7, 13)])
def test_a_sliding_wedge_carries_half_of_its_gap_along(comm, secondary, across):
    """Between plates that slide the mean velocity is half the slip (Couette flow)."""
    gap, slope, slide = 1e-4, 1e-4, 0.02
    domain = stack(comm, across, rows=2)
    push = fem.Constant(domain.mesh, 0.0)
    model = Porous(
        domain,
        fixed={("bottom_0", 0): 0.0, ("bottom_0", 1): 0.0, ("top_1", 0): push},
        drained={"bottom_0": 0.0, "top_1": 0.0},
        material=hm.LinearElastic(1e14, 0.2),
        permeability=1e-2,
        dt=1e4,
    )
    wedge = fem.Function(model.V)
    upper = domain.cell_tags.find(domain.bodies["block_1"])
    wedge.interpolate(lambda x: (0.0 * x[0], gap + slope * x[0]), upper)
    wedge.x.scatter_forward()
    model.u.x.array[:] = wedge.x.array
    collapsed, to_V = model.V.sub(1).collapse()
    height = fem.Function(collapsed)
    height.x.array[:] = wedge.x.array[to_V]
    facets = domain.facet_tags.find(domain.surface("top_1"))
    top = fem.locate_dofs_topological((model.V.sub(1), collapsed), 1, facets)
    model.bcs.append(fem.dirichletbc(height, top, model.V.sub(1)))
    names = ("bottom_1", "top_0") if secondary == "block" else ("top_0", "bottom_1")
    pair = film_pair(domain, *names)
    with_pairs(model, pair)
    model.step()
    before = model.problem.interface(pair)
    push.value = slide
    model.step()
    state = model.problem.interface(pair)
    assert state.taken_up == pytest.approx(-0.5 * slope * slide * (1.0 - slide / 2), rel=0.05)
    assert state.volume - before.volume == pytest.approx(state.taken_up + state.swept, abs=1e-18)


@pytest.mark.parametrize("across", [(5, 7), (7, 4)])
def test_water_flows_around_a_corner_where_two_gaps_meet(comm, across):
    gap, drop, mu, dt = 1e-3, 1e3, 1e-3, 1e6
    domain = notch(comm, *across)
    model = Porous(
        domain,
        fixed={
            ("block left", 0): -gap,
            ("block top", 1): gap,
            ("base bottom", 0): 0.0,
            ("base bottom", 1): 0.0,
        },
        drained={"block left": drop, "base left": drop, "block top": 0.0, "base top": 0.0},
        material=hm.LinearElastic(1e14, 0.2),
        permeability=1e-12,
        dt=dt,
    )
    block = domain.cell_tags.find(domain.bodies["block"])
    nodes = np.unique(model.V.dofmap.list[block])
    model.u.x.array[2 * nodes], model.u.x.array[2 * nodes + 1] = -gap, gap
    with_pairs(
        model,
        film_pair(domain, "block bottom", "base floor"),
        film_pair(domain, "block right", "base wall"),
    )
    model.step()
    reactions = model.problem.reactions(model.p)
    flow = gap**3 * drop / (12.0 * mu * 2.0)
    for sign, names in ((1, ("block left", "base left")), (-1, ("block top", "base top"))):
        through = sum(total(reactions, domain, name)[0] for name in names) / dt
        # The gap is longer by its own width at the corner and at its ends.
        assert sign * through == pytest.approx(flow, rel=3.0 * gap)


@pytest.mark.parametrize("mu", [0.3, 0.6])
def test_water_costs_friction_at_most_two_iterations(comm, mu):
    counts = {}
    for wet in (False, True):
        domain = stack(comm, (11, 7), rows=3)
        push = fem.Constant(domain.mesh, 0.0)
        model = Porous(
            domain,
            fixed={("bottom_0", 0): 0.0, ("bottom_0", 1): 0.0, ("top_1", 0): push},
            drained={"top_1": 0.0, "bottom_0": 0.0},
            tractions={"top_1": (0.0, -LOAD)},
            material=hm.LinearElastic(1e7, 0.2),
            permeability=1e-7,
            dt=10.0,
        )
        law = hm.CoulombFriction(mu)
        pair = film_pair(domain, "bottom_1", "top_0", law)
        if not wet:
            pair = hm.ContactPair(
                domain.facet_tags, domain.surface("bottom_1"), domain.surface("top_0"), law
            )
        with_pairs(model, pair)
        counts[wet] = []
        for push.value in np.linspace(0.01, 0.3, 8):
            counts[wet].append(model.step().iterations)
    assert max(counts[True]) <= max(counts[False]) + 2
    assert np.mean(counts[True]) <= np.mean(counts[False]) + 2


@pytest.mark.parametrize(
    ("law", "smoothing", "tolerance"),
    [
        (hm.Tied(), "triangles", 1e-10),
        (hm.Tied(), "deviatoric", 1e-3),
        (hm.CoulombFriction(0.5), "triangles", 1e-3),
    ],
)
def test_a_closed_column_is_one_without_interface(comm, law, smoothing, tolerance):
    """Node cells end at surfaces and nodes on rollers carry no contact: both make a difference."""

    def column(levels, across, rows, pairs):
        domain = stack(comm, across, width=0.25, levels=levels, rows=rows)
        sides = {(f"{side}_{k}", 0): 0.0 for side in ("left", "right") for k in range(len(across))}
        top = f"top_{len(across) - 1}"
        model = Porous(
            domain,
            fixed=sides | {("bottom_0", 1): 0.0},
            drained={top: 0.0},
            tractions={top: (0.0, -LOAD)},
            smoothing=smoothing,
        )
        return with_pairs(model, *(pair(domain) for pair in pairs))

    single = column([0.0, 1.0], (4,), 16, [])
    double = column(
        [0.0, 0.5, 1.0],
        (4, 4),
        8,
        [
            lambda domain: hm.ContactPair(
                domain.facet_tags,
                domain.surface("bottom_1"),
                domain.surface("top_0"),
                law,
                flow=hm.GapFlow(1e-9),
            )
        ],
    )
    for dt in [20.0] * 5 + [100.0] * 9 + [1000.0] * 9:
        profiles = []
        for model in (single, double):
            model.step(dt)
            x = model.Q.tabulate_dof_coordinates()
            n = model.Q.dofmap.index_map.size_local
            data = np.concatenate(comm.allgather(np.column_stack((x[:n, :2], model.p.x.array[:n]))))
            heights = np.unique(np.round(data[:, 1], 9))
            profiles.append([data[np.isclose(data[:, 1], y), 2].mean() for y in heights])
        assert np.abs(np.subtract(*profiles)).max() < tolerance * LOAD
