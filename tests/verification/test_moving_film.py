# SPDX-License-Identifier: LGPL-3.0-or-later
"""Water in the gap that bodies leave: it leaks, flows along, is squeezed out, and closes."""

import numpy as np
import pytest
import ufl
from dolfinx import fem

import fenicsx_hmcontact as hm
from tests.models import GAMMA, Porous, largest, stack, total

pytestmark = pytest.mark.mpi

HELD = {(f"{side}_{k}", i): 0.0 for side, k in (("bottom", 0),) for i in (0, 1)}


class Gap(Porous):
    """Two blocks, the upper one lifted by a gap at the start."""

    def __init__(
        self, comm, across, gap, flow, *, rows=4, width=1.0, law=None, motion="small", **k
    ):
        domain = stack(comm, across, rows=rows, width=width)
        super().__init__(domain, **k)
        upper = domain.cell_tags.find(domain.bodies["block_1"])
        self.u.x.array[2 * np.unique(self.V.dofmap.list[upper]) + 1] = gap
        surfaces = domain.surface("bottom_1"), domain.surface("top_0")
        self.pair = hm.ContactPair(
            domain.facet_tags, *surfaces, law or hm.Frictionless(), flow=flow, motion=motion
        )
        self.problem = hm.ContactProblem(
            self.F, [self.u, self.p], bcs=self.bcs, pairs=[self.pair], time_step=self.dt
        )

    @property
    def state(self):
        return self.problem.interface(self.pair)

    def water_taken_up(self, action):
        """Water that bodies and gap take up in a step, beside what flows out."""
        before = self.state.volume
        u = self.u.x.array.copy()
        action()
        moved = fem.Function(self.V)
        moved.x.array[:] = self.u.x.array - u
        bodies = fem.assemble_scalar(fem.form(ufl.div(moved) * ufl.dx))
        return self.u.function_space.mesh.comm.allreduce(bodies), self.state.volume - before


@pytest.mark.parametrize("across", [(6, 6), (5, 7), (11, 3)])
def test_channel(comm, across):
    g, mu, width, drop, dt = 1e-3, 1e-3, 0.5, 1e3, 1e6
    ends = {f"{side}_{k}": p for side, p in (("left", drop), ("right", 0.0)) for k in (0, 1)}
    held = {(f"{side}_{k}", i): 0.0 for side, k in (("bottom", 0),) for i in (0, 1)}
    held |= {("top_1", 0): 0.0, ("top_1", 1): g}
    model = Gap(
        comm,
        across,
        g,
        hm.GapFlow(1e-7, mu),
        width=width,
        fixed=held,
        drained=ends,
        material=hm.LinearElastic(1e16, 0.2),
        permeability=1e-14,
        dt=dt,
    )
    model.step()
    flow = g**3 * drop / (12 * mu * width)
    for side, sign in (("left", 1), ("right", -1)):
        reactions = model.problem.reactions(model.p)
        through = sum(total(reactions, model.domain, f"{side}_{k}")[0] for k in (0, 1))
        assert sign * through / dt == pytest.approx(flow, rel=1e-6)


@pytest.mark.parametrize(
    ("g", "k_t"), [(1e-2, 1e-8), (1e-3, 1e-10), (1e-6, 1e-7), (1e-10, 1e-7), (1e-14, 1e-7)]
)
def test_leak_off_is_a_resistance_in_series(comm, g, k_t):
    k, drop, dt = 1e-6, 1e4, 1e6
    model = Gap(
        comm,
        (5, 7),
        g,
        hm.GapFlow(k_t),
        fixed=HELD | {("top_1", 0): 0.0, ("top_1", 1): g},
        drained={"bottom_0": drop, "top_1": 0.0},
        material=hm.LinearElastic(1e20, 0.0),
        permeability=k,
        tau=0.0,
        dt=dt,
    )
    model.step()
    q = drop / GAMMA / (0.5 / k + g / k_t + 0.5 / k)
    for surface, sign in (("bottom_0", -1), ("top_1", 1)):
        assert sign * model.outflow(surface) / dt == pytest.approx(q, rel=1e-6)


def closing_gap(t, g, q, k, E, H):
    """Gap under a load whose water leaves through the block above (Carslaw and Jaeger 1959) [m]."""
    n, cv = np.arange(1, 2000), k * E / GAMMA
    decay = (1.0 - np.exp(-((n * np.pi / H) ** 2) * cv * t)) * (H / (n * np.pi)) ** 2 / cv
    return g - k * q / (GAMMA * H) * (t + 2.0 * np.sum((-1.0) ** n * decay))


def test_a_squeezed_gap_closes_in_time_and_keeps_its_water(comm):
    g, q, k, E, dt = 2e-5, 1e4, 1e-9, 1e8, 400.0
    sides = {(f"{side}_{k}", 0): 0.0 for side in ("left", "right") for k in (0, 1)}
    model = Gap(
        comm,
        (8, 5),
        g,
        hm.GapFlow(1e-9),
        rows=10,
        fixed=HELD | sides,
        drained={"top_1": 0.0},
        tractions={"top_1": (0.0, -q)},
        material=hm.LinearElastic(E, 0.0),
        permeability=k,
        dt=dt,
    )
    moved, error, closes, expected = 0.0, 0.0, None, None
    for i in range(1, 45):
        bodies, gap = model.water_taken_up(model.step)
        moved += abs(model.outflow())
        assert abs(bodies + gap + model.outflow()) < 1e-10 * moved
        state, exact = model.state, closing_gap(i * dt, g, q, k, E, 0.5)
        paired = state.state >= hm.NodeState.OPEN
        # Solid and water together carry the load.
        np.testing.assert_allclose((state.pressure + state.pore_pressure)[paired], q, rtol=0.02)
        if exact > 0.0:
            error = max(error, largest(state.gap[paired] - exact, comm))
        elif expected is None:
            expected = i
        if closes is None and state.closed[paired].all():
            closes = i
            np.testing.assert_allclose(state.jump[paired], 0.0, atol=1e-9 * q)
    assert error < 0.03 * g and closes is not None and abs(closes - expected) <= 1


@pytest.mark.parametrize("across", [(13, 7), (7, 13)])
def test_water_is_kept_while_a_gap_opens_slides_and_closes(comm, across):
    domain = stack(comm, across, rows=3)
    lift, push = (fem.Constant(domain.mesh, 0.0) for _ in range(2))
    model = Porous(
        domain,
        fixed=HELD | {("top_1", 0): push, ("top_1", 1): lift},
        drained={"top_1": 0.0, "bottom_0": 0.0},
        material=hm.LinearElastic(1e8, 0.2),
        permeability=1e-5,
        dt=200.0,
    )
    surfaces = domain.surface("bottom_1"), domain.surface("top_0")
    friction = hm.CoulombFriction(0.3)
    pair = hm.ContactPair(domain.facet_tags, *surfaces, friction, flow=hm.GapFlow(1e-9))
    problem = model.problem = hm.ContactProblem(
        model.F, [model.u, model.p], bcs=model.bcs, pairs=[pair], time_step=model.dt
    )
    path = [(0, -1e-5), (0, 4e-5), (0.05, 4e-5), (0.15, 2e-5), (0.2, -1e-5), (0.2, -2e-5)]
    states = []
    for push.value, lift.value in path:
        u = model.u.x.array.copy()
        assert model.step().iterations <= 12
        moved = fem.Function(model.V)
        moved.x.array[:] = model.u.x.array - u
        bodies = comm.allreduce(fem.assemble_scalar(fem.form(ufl.div(moved) * ufl.dx)))
        state = problem.interface(pair)
        moved = max(abs(bodies), abs(state.taken_up), 1e-6)
        assert abs(bodies + state.taken_up + model.outflow()) < 1e-10 * moved
        states.append(state)
    closed = [state.closed.any() for state in states]
    assert closed == [True, False, False, False, True, True]
    assert states[1].volume > 2e-5 and abs(states[0].volume) < 1e-12


def test_water_in_a_gap_needs_the_step(comm):
    domain = stack(comm, (4, 5))
    model = Porous(domain, fixed=HELD, drained={"top_1": 0.0})
    surfaces = domain.surface("bottom_1"), domain.surface("top_0")
    pair = hm.ContactPair(domain.facet_tags, *surfaces, hm.Frictionless(), flow=hm.GapFlow(1e-9))
    with pytest.raises(ValueError, match="water in its gap: the problem needs time_step"):
        hm.ContactProblem(model.F, [model.u, model.p], bcs=model.bcs, pairs=[pair])


def test_units_do_not_matter(comm):
    answers = []
    for m, N, s in ((1.0, 1.0, 1.0), (1e3, 1e-3, 1 / 86400)):
        Pa = N / m**2
        domain = stack(comm, (7, 5), rows=4, width=m, levels=np.array([0.0, 0.5, 1.0]) * m)
        model = Porous(
            domain,
            fixed=HELD | {("top_1", 0): 0.0},
            drained={"top_1": 0.0, "right_1": 0.0},
            tractions={"top_1": (0.0, -1e4 * Pa)},
            material=hm.LinearElastic(1e8 * Pa, 0.2),
            permeability=1e-9 * m / s,
            unit_weight=GAMMA * N / m**3,
            dt=400.0 * s,
        )
        upper = domain.cell_tags.find(domain.bodies["block_1"])
        model.u.x.array[2 * np.unique(model.V.dofmap.list[upper]) + 1] = 5e-6 * m
        flow = hm.GapFlow(1e-9 * m / s, 1e-3 * Pa * s, GAMMA * N / m**3, gravity=(0.0, -1.0))
        surfaces = domain.surface("bottom_1"), domain.surface("top_0")
        pair = hm.ContactPair(domain.facet_tags, *surfaces, hm.CoulombFriction(0.3), flow=flow)
        model.problem = hm.ContactProblem(
            model.F, [model.u, model.p], bcs=model.bcs, pairs=[pair], time_step=model.dt
        )
        iterations = [model.step().iterations for _ in range(8)]
        state = model.problem.interface(pair)
        assert 0 < state.closed.sum() or state.volume > 0.0
        answers.append(
            [
                iterations,
                state.gap / m * 1e6,
                state.pressure / (1e4 * Pa),
                state.pore_pressure / (1e4 * Pa),
                state.taken_up / m**2 * 1e6,
                model.outflow() / m**2 * 1e6,
            ]
        )
    for si, other in zip(*answers, strict=True):
        np.testing.assert_allclose(si, other, rtol=0, atol=1e-9)
