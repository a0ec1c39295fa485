# SPDX-License-Identifier: LGPL-3.0-or-later
"""Water between a porous and a dry body, which has no pore pressure at all."""

import numpy as np
import pytest
import ufl
from dolfinx import fem

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.contact import ContactStatus
from tests.models import GAMMA, LOAD, dense, fix, integral, largest, loads, stack, total

pytestmark = pytest.mark.mpi

POROUS = {"primary": "block_1", "secondary": "block_0"}
"""The porous block where the dry one carries this surface; the secondary one lies on block 1."""


class PorousOnDry:
    """Two blocks, one of them dry, under a load with water of a given pressure behind them."""

    def __init__(self, domain, dry, *, flow=None, material=None, k=1e-9, dt=1e5, motion="finite"):
        self.domain, mesh = domain, domain.mesh
        mesh.topology.create_connectivity(1, 2)
        material = material or hm.LinearElastic(1e8, 0.0)
        self.porous = POROUS[dry]
        self.part, entity_map = domain.submesh(self.porous)
        V, Q = fem.functionspace(mesh, ("P", 1, (2,))), fem.functionspace(self.part.mesh, ("P", 1))
        self.u, self.p = fem.Function(V, name="displacement"), fem.Function(Q, name="pore pressure")
        self.u_n, self.p_n = fem.Function(V), fem.Function(Q)
        v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))
        self.dt = fem.Constant(mesh, dt)
        tag = domain.body(self.porous)
        wet = hm.node_cells_measure(domain=mesh, subdomain_data=domain.cell_tags)(tag)
        dx = self.wet_dx = ufl.Measure("dx", mesh, subdomain_data=domain.cell_tags)(tag)
        F = hm.equilibrium(material.stress(self.u), self.p, v, triangles=dx)
        F += hm.water_balance(
            *(self.u, self.u_n, self.p, q, self.dt),
            permeability=k,
            unit_weight=GAMMA,
            smoothed=wet,
            triangles=dx,
        )
        F += hm.pressure_projection(self.p, self.p_n, q, material.shear_modulus, triangles=dx)
        self.F = F + loads(domain, v, {"top_1": (0.0, -LOAD)})
        self.bcs = [fix(domain, V.sub(i), "bottom_0") for i in (0, 1)]
        self.bcs += [
            fix(domain, V.sub(0), f"{side}_{k}") for side in ("left", "right") for k in (0, 1)
        ]
        self.drained = "top_1" if dry == "primary" else "bottom_0"
        surfaces = domain.surface("bottom_1"), domain.surface("top_0")
        flow = flow or hm.GapFlow(1e-9)
        self.pair = hm.ContactPair(
            domain.facet_tags, *surfaces, hm.CoulombFriction(0.3), flow=flow, motion=motion
        )
        self.maps = [entity_map]

    def make(self, pressure=None):
        """Build the problem, with a pressure behind the porous body or a sealed one."""
        if pressure is not None:
            self.bcs.append(fix(self.part, self.p.function_space, self.drained, pressure))
        self.problem = hm.ContactProblem(
            self.F,
            [self.u, self.p],
            bcs=self.bcs,
            pairs=[self.pair],
            time_step=self.dt,
            entity_maps=self.maps,
        )
        return self

    def step(self):
        """Solve one step; water that leaves the porous body's volume, and the interface."""
        self.u_n.x.array[:], self.p_n.x.array[:] = self.u.x.array, self.p.x.array
        self.problem.solve()
        change = fem.form(ufl.div(self.u - self.u_n) * self.wet_dx, entity_maps=self.maps)
        return integral(change, self.domain.mesh.comm), self.problem.interface(self.pair)


@pytest.mark.parametrize("dry", ["primary", "secondary"])
@pytest.mark.parametrize("across", [(5, 13), (13, 5), (6, 6)])
def test_uniform_pressure_and_load_pass(comm, dry, across):
    pressure = 0.4 * LOAD
    model = PorousOnDry(stack(comm, across), dry).make(pressure)
    for _ in range(6):
        model.dt.value *= 10.0
        _, state = model.step()
    paired = state.state >= hm.NodeState.OPEN
    np.testing.assert_allclose(state.pressure[paired], LOAD - pressure, rtol=1e-9)
    np.testing.assert_allclose(state.pore_pressure, pressure, rtol=1e-9)
    assert np.all(state.jump == 0.0) and np.all(state.closed[paired])
    assert largest(model.p.x.array - pressure, comm) < 1e-9 * pressure
    assert model.problem.n_unknowns["pore pressure"] == 4 * (across[dry == "primary"] + 1)
    assert model.problem.condition_number() < 1e4


@pytest.mark.parametrize("dry", ["primary", "secondary"])
@pytest.mark.parametrize("across", [(5, 8), (8, 5)])
def test_water_is_squeezed_into_the_porous_body(comm, dry, across):
    gap = 1e-5
    model = PorousOnDry(stack(comm, across, rows=6), dry, dt=400.0)
    upper = model.domain.cell_tags.find(model.domain.body("block_1"))
    V = model.u.function_space
    model.u.x.array[2 * np.unique(V.dofmap.list[upper]) + 1] = gap
    model.make(0.0)
    volume, left, closed = gap, 0.0, []
    for _ in range(25):
        bodies, state = model.step()
        out = -total(model.problem.reactions(model.p), model.part)[0]
        left += abs(out)
        assert abs(bodies + state.taken_up + out) < 1e-10 * left
        assert abs(state.volume - volume - state.taken_up - state.swept) < 1e-14 * gap
        volume = state.volume
        paired = state.state >= hm.NodeState.OPEN
        closed.append(bool(state.closed[paired].all()))
        # Solid and water together carry the load.
        carried = (state.pressure + state.pore_pressure)[paired]
        np.testing.assert_allclose(carried, LOAD, rtol=0.05)
        assert np.dot(state.force, (0.0, 1.0)) == pytest.approx(LOAD, rel=1e-9)
    assert not closed[0] and closed[-1] and volume < 1e-12


@pytest.mark.parametrize("dry", ["primary", "secondary"])
@pytest.mark.parametrize("sets", ["open", "slip"])
def test_the_tangent_follows_the_film_of_one_face(comm, dry, sets):
    domain = stack(comm, (3, 4), rows=1, slope=0.2, shift=0.07)
    flow = hm.GapFlow(1e-3, 1e-3, 50.0, aperture=hm.ResidualAperture(0.03), gravity=(0.6, -0.8))
    soft = hm.LinearElastic(100.0, 0.2)
    model = PorousOnDry(domain, dry, flow=flow, material=soft, k=0.3 * GAMMA, dt=1.0)
    # The default load and supports are too stiff a frame for random states; only one end is held.
    model.bcs = model.bcs[:2]
    problem = model.make().problem
    rng = np.random.default_rng(3)
    for f, size in ((model.u, 0.004), (model.p, 3.0)):
        f.x.array[:] = rng.normal(size=f.x.array.size) * size
        f.x.scatter_forward()
    coupling = problem._sliding[0]
    n = len(coupling.status.closed)
    shut = np.full(n, sets == "slip")
    coupling.status = ContactStatus(
        shut, shut.copy(), np.random.default_rng(2).choice([-1.0, 1.0], n)
    )
    problem.residual()
    problem._update_tangent()
    layout, scale = problem.layout, problem._linear.scale
    A = dense(problem._linear.matrix, comm)
    start = [f.x.array.copy() for f in (model.u, model.p)]
    rows = slice(layout.first, layout.first + layout.owned.size)
    for k in range(4):
        direction = np.random.default_rng(k).normal(size=layout.n_global)
        free = np.concatenate(comm.allgather(problem._free))
        direction[~free] = 0.0
        move = np.zeros(layout.n_local)
        move[layout.owned] = direction[rows] * scale
        layout.update_ghosts(move)
        problem.condensation.expand(move)
        difference, h = np.zeros(layout.owned.size), 1e-7
        for sign in (1.0, -1.0):
            for f, x, along in zip((model.u, model.p), start, layout.views(move), strict=True):
                f.x.array[:] = x + sign * h * along
            problem.residual()
            difference += sign * problem._condensed[layout.owned] * scale / (2.0 * h)
        error = (difference - (A @ direction)[rows])[problem._free]
        assert largest(error, comm) < 1e-6 * np.abs((A @ direction)[free]).max()


def test_water_needs_a_porous_body_on_one_side(comm):
    domain = stack(comm, (3, 4, 3))
    part, entity_map = domain.submesh("block_2")
    V, Q = fem.functionspace(domain.mesh, ("P", 1, (2,))), fem.functionspace(part.mesh, ("P", 1))
    u, p = fem.Function(V, name="displacement"), fem.Function(Q, name="pore pressure")
    v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))
    dx = ufl.Measure("dx", domain.mesh, subdomain_data=domain.cell_tags)
    F = ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx + p * q * dx(domain.body("block_2"))
    surfaces = domain.surface("bottom_1"), domain.surface("top_0")
    pair = hm.ContactPair(domain.facet_tags, *surfaces, hm.Frictionless(), flow=hm.GapFlow(1e-9))
    with pytest.raises(ValueError, match="needs a porous body on one side at least"):
        hm.ContactProblem(
            F,
            [u, p],
            pairs=[pair],
            time_step=fem.Constant(domain.mesh, 1.0),
            entity_maps=[entity_map],
        )
