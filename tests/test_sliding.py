# SPDX-License-Identifier: LGPL-3.0-or-later
"""Surfaces that touch, stick, slide and part: tangent, patches, pushed and parted blocks."""

from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.contact import ContactStatus
from tests.models import dense, fix, gathered, largest, loads, stack, total

MATERIAL = hm.LinearElastic(100.0, 0.3)
"""Moderate against tractions of about 1, so that surfaces bend and turn."""


class Saturating:
    """Shear that a contact pressure cannot raise beyond a limit; curved, unlike Coulomb's."""

    def __init__(self, mu, limit):
        self.mu, self.limit = mu, limit

    def bound(self, pressure):
        decay = np.exp(-self.mu * pressure / self.limit)
        return self.limit * (1.0 - decay), self.mu * decay


class Blocks:
    """Dry blocks; ``fixed`` maps (surface, component or None for both) to values."""

    def __init__(
        self,
        domain,
        law,
        *,
        fixed=None,
        bcs=(),
        tractions=None,
        spring=None,
        swap=False,
        material=MATERIAL,
        newton=hm.NewtonOptions(),
        **pair,
    ):
        mesh = domain.mesh
        mesh.topology.create_connectivity(1, 2)
        self.domain, self.comm = domain, mesh.comm
        self.V = V = fem.functionspace(mesh, ("P", 1, (2,)))
        self.u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
        F = ufl.inner(material.stress(self.u), ufl.grad(v)) * hm.dc + loads(
            domain, v, tractions or {}
        )
        if spring is not None:
            ds = ufl.Measure("ds", domain=mesh, subdomain_data=domain.facet_tags)
            surface, stiffness = spring
            F += fem.Constant(mesh, stiffness) * ufl.dot(self.u, v) * ds(domain.surface(surface))
        conditions = [
            fix(domain, V if i is None else V.sub(i), name, value)
            for (name, i), value in (fixed or {}).items()
        ]
        conditions += [bc(V) for bc in bcs]
        surfaces = [domain.surface(name) for name in ("bottom_1", "top_0")]
        secondary, primary = surfaces[::-1] if swap else surfaces
        self.pair = hm.ContactPair(domain.facet_tags, secondary, primary, friction=law, **pair)
        self.problem = hm.ContactProblem(
            F, self.u, bcs=conditions, pairs=[self.pair], newton=newton
        )
        self.coupling = self.problem._sliding[0]

    def solve(self):
        """Iterations of a step, and what acts between the blocks."""
        result = self.problem.solve()
        return result.iterations, self.problem.interface(self.pair)

    @property
    def operator(self):
        return self.coupling.kinematics.operator

    @property
    def area(self):
        """Length that the traction of each node acts on, that of dropped neighbours too."""
        operator = self.operator
        return np.where(operator.kept, operator.D * (1.0 + operator.C.sum(axis=1)), 0.0)

    @property
    def status(self):
        return self.coupling.status


def held_at(x, y, component, value=0.0):
    """Condition on one component at the node at (x, y)."""

    def condition(V):
        sub = V.sub(component)
        at = fem.locate_dofs_geometrical(
            (sub, sub.collapse()[0]), lambda p: np.isclose(p[0], x) & np.isclose(p[1], y)
        )
        prescribed = fem.Function(sub.collapse()[0])
        prescribed.x.array[:] = value
        return fem.dirichletbc(prescribed, at, sub)

    return condition


# --- tangent ----------------------------------------------------------------------------------


def condensed_tangent(problem):
    """Matrix that Newton's method solves with, without its scaling."""
    linear = problem._linear
    return dense(linear.matrix, problem.comm) / np.multiply.outer(linear.scale, linear.scale)


def tangent_error(model, kind, seed=1):
    """Tangent at a random state and fixed sets against central differences, of free unknowns."""
    rng = np.random.default_rng(seed)
    problem, u, n = model.problem, model.u, len(model.status.closed)
    u.x.array[:] = rng.normal(size=u.x.array.size) * 0.004
    slipping = np.full(n, kind in ("slip", "mixed"))
    closed = np.full(n, kind != "open")
    if kind == "mixed":
        closed[::3] = slipping[1::3] = False
    model.coupling.status = before = ContactStatus(
        closed, slipping & closed, rng.choice([-1.0, 1.0], n)
    )
    problem.residual()
    problem._update_tangent()
    tangent = condensed_tangent(problem)
    kept = model.operator.kept.copy()

    state = u.x.array.copy()
    moves = np.eye(state.size)
    for move in moves:
        problem.condensation.expand(move)
    difference, h = np.zeros_like(tangent), 1e-7
    for i, move in enumerate(moves):
        for sign in (1.0, -1.0):
            u.x.array[:] = state + sign * h * move
            problem.residual()
            difference[:, i] += sign * problem._condensed / (2 * h)
    assert problem.settled and np.array_equal(model.operator.kept, kept)
    assert np.array_equal(model.status.closed & kept, before.closed & kept)
    free = np.flatnonzero(problem._free)
    error = (difference - tangent)[np.ix_(free, free)]
    return SimpleNamespace(
        error=np.abs(error).max() / np.abs(tangent).max(), tangent=tangent, kept=kept
    )


STATES = [
    pytest.param(hm.Frictionless(), "closed", id="frictionless"),
    pytest.param(hm.Frictionless(), "open", id="open"),
    pytest.param(hm.CoulombFriction(0.4), "stick", id="stick"),
    pytest.param(hm.CoulombFriction(0.4, 0.1), "slip", id="slip"),
    pytest.param(hm.CoulombFriction(0.4, 0.1), "mixed", id="mixed"),
    pytest.param(Saturating(0.4, 0.2), "slip", id="own-law"),
]


@pytest.mark.parametrize("slope", [0.0, 0.3])
@pytest.mark.parametrize(("law", "kind"), STATES)
def test_tangent(slope, law, kind):
    model = Blocks(stack(MPI.COMM_SELF, (5, 3), rows=1, slope=slope), law)
    assert tangent_error(model, kind).error < 1e-7


@pytest.mark.parametrize(("law", "kind"), STATES)
def test_tangent_with_a_prescribed_node_and_partial_coverage(law, kind):
    # The upper block juts out, and one inner node of its lower side is held.
    domain = stack(MPI.COMM_SELF, (5, 6), rows=1, shift=0.22, slope=0.1)
    low = domain.mesh.geometry.x
    inner = low[np.isclose(low[:, 0], 0.22 + 0.5)]
    x, y = inner[np.isclose(inner[:, 1], 0.5 + 0.1 * (0.22 + 0.5 - 0.72))][0, :2]
    model = Blocks(domain, law, fixed={("bottom_0", None): np.zeros(2)}, bcs=[held_at(x, y, 0)])
    result = tangent_error(model, kind)
    assert result.error < 1e-7
    coverage = model.operator.coverage
    assert np.any((coverage > 0.0) & (coverage < 0.99)) and np.sum(~result.kept) >= 2


@pytest.mark.parametrize(("law", "kind"), STATES)
def test_tangent_of_small_motion(law, kind):
    model = Blocks(stack(MPI.COMM_SELF, (5, 3), rows=1, slope=0.3), law, motion="small")
    assert tangent_error(model, kind).error < 1e-7


def test_tangent_without_geometry_is_another():
    law = hm.CoulombFriction(0.4, 0.1)
    model = Blocks(stack(MPI.COMM_SELF, (5, 3), rows=1, slope=0.3), law, linearised=False)
    assert tangent_error(model, "slip").error > 1e-4


# --- patches ------------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize("slope", [0.0, 0.7, -0.4])
@pytest.mark.parametrize("across", [(11, 7), (5, 17)])
@pytest.mark.parametrize("swap", [False, True])
def test_uniform_stress_passes_a_frictionless_interface(comm, slope, across, swap):
    # Principal along and across the interface, where the shear vanishes.
    n = np.array([-slope, 1.0]) / np.hypot(slope, 1.0)
    stress = -0.4 * np.eye(2) - 0.6 * np.outer(n, n)
    E, nu = MATERIAL.E, MATERIAL.nu
    strain = (1 + nu) / E * (stress - nu * np.trace(stress) * np.eye(2))
    sides = {"left": (-1, 0), "right": (1, 0)}
    model = Blocks(
        stack(comm, across, slope=slope),
        hm.Frictionless(),
        fixed={("bottom_0", None): lambda x: strain @ x[:2]},
        bcs=[held_at(0.0, 1.0, 0, strain[0] @ (0.0, 1.0))],
        tractions={f"{s}_{k}": stress @ t for s, t in sides.items() for k in (0, 1)}
        | {"top_1": stress @ (0, 1)},
        swap=swap,
        motion="small",
    )
    iterations, state = model.solve()
    assert iterations == 1 and model.status.closed.all()
    exact = fem.Function(model.V)
    exact.interpolate(lambda x: strain @ x[:2])
    assert largest(model.u.x.array - exact.x.array, comm) < 1e-11 * np.abs(strain).max()
    eps = model.problem.node_cells.gradient(model.u, "deviatoric")
    eps = 0.5 * (eps + np.swapaxes(eps, -1, -2))
    trace = np.trace(eps, axis1=-2, axis2=-1)[..., None, None]
    found = 2 * MATERIAL.shear_modulus * eps + MATERIAL.lame * trace * np.eye(2)
    assert largest(found - stress, comm) < 1e-11
    np.testing.assert_allclose(state.pressure, 1.0, rtol=0, atol=1e-11)
    np.testing.assert_allclose(state.shear, 0.0, atol=1e-11)


@pytest.mark.mpi
def test_what_sticks_is_tied(comm):
    # Shear below the bound across the interface: the same as without an interface.
    stress = np.array([[-0.4, 0.25], [0.25, -1.0]])
    E, nu = MATERIAL.E, MATERIAL.nu
    strain = (1 + nu) / E * (stress - nu * np.trace(stress) * np.eye(2))
    sides = {"left": (-1, 0), "right": (1, 0)}
    for slope in (0.0, 0.3):
        model = Blocks(
            stack(comm, (11, 7), slope=slope),
            hm.CoulombFriction(5.0),
            fixed={("bottom_0", None): lambda x: strain @ x[:2]},
            tractions={f"{s}_{k}": stress @ t for s, t in sides.items() for k in (0, 1)}
            | {"top_1": stress @ (0, 1)},
            motion="small",
        )
        iterations, state = model.solve()
        assert iterations == 1 and model.status.sticking.all()
        n = np.array([-slope, 1.0]) / np.hypot(slope, 1.0)
        exact = fem.Function(model.V)
        exact.interpolate(lambda x: strain @ x[:2])
        assert largest(model.u.x.array - exact.x.array, comm) < 1e-11 * np.abs(strain).max()
        np.testing.assert_allclose(state.pressure, -n @ stress @ n, rtol=0, atol=1e-11)
        # The primary pushes the secondary with -stress n; the tangent is (n_y, -n_x).
        np.testing.assert_allclose(state.shear, -stress @ n @ (n[1], -n[0]), rtol=0, atol=1e-11)


# --- pushed block -------------------------------------------------------------------------------


class Pushed(Blocks):
    """A block under load 1 on another, its top pushed to the right."""

    def __init__(self, comm, law, *, across=(7, 13), length=1.0, force=1.0, E=100.0, **options):
        levels = np.array([0.0, 0.5, 0.8]) * length
        domain = stack(comm, across, levels=levels, width=length)
        self.push = fem.Constant(domain.mesh, 0.0)
        super().__init__(
            domain,
            law,
            fixed={("bottom_0", None): np.zeros(2), ("top_1", 0): self.push},
            # Force per thickness is traction by width.
            tractions={"top_1": (0.0, -force / length)},
            material=hm.LinearElastic(E, 0.3),
            **options,
        )

    def step(self, push):
        self.push.value = push
        iterations, state = self.solve()
        held = total(self.problem.reactions(self.u), self.domain, "top_1")[0]
        return SimpleNamespace(iterations=iterations, state=state, force=held)


LAWS = [
    hm.CoulombFriction(0.2),
    hm.CoulombFriction(0.6),
    hm.CoulombFriction(0.3, 0.05),
    Saturating(0.5, 0.3),
]
IDS = ["low", "high", "cohesion", "own-law"]


@pytest.mark.mpi
@pytest.mark.parametrize("motion", ["small", "finite"])
@pytest.mark.parametrize("law", LAWS, ids=IDS)
def test_force_of_a_pushed_block_is_the_law_summed(comm, law, motion):
    model = Pushed(comm, law, motion=motion)
    forces = []
    for push in 0.008 * np.arange(1, 6):
        step = model.step(push)
        state, status = step.state, model.status
        assert step.iterations <= 10
        forces.append(step.force)
        # Where nothing slides the shear is below the bound, where it slides on it, against it.
        bound = law.bound(np.maximum(state.pressure, 0.0))[0]
        assert np.all(np.abs(state.shear) <= bound * (1 + 1e-8) + 1e-10)
        slipping = status.slipping
        np.testing.assert_allclose(
            state.shear[slipping], -(status.direction * bound)[slipping], atol=1e-9
        )
        assert np.all(state.pressure[status.closed] >= 0)
        np.testing.assert_allclose(
            state.pressure[~status.closed & model.operator.kept], 0, atol=1e-9
        )
        # Equilibrium: tractions of the nodes carry the load and the push.
        tangents = np.column_stack((state.normals[:, 1], -state.normals[:, 0]))
        traction = state.pressure[:, None] * state.normals + state.shear[:, None] * tangents
        between = model.area @ np.where(model.operator.kept[:, None], traction, 0.0)
        np.testing.assert_allclose(between, (-step.force, 1.0), rtol=0, atol=1e-9)
    closed = status.closed
    assert (
        closed.any() and np.array_equal(slipping, closed) and np.all(status.direction[closed] > 0)
    )
    assert forces[0] < forces[-1]
    if motion == "small":
        summed = model.area[closed] @ law.bound(state.pressure[closed])[0]
        assert step.force == pytest.approx(summed, rel=1e-9)
        if isinstance(law, hm.CoulombFriction):
            # All nodes are beyond the ramp, the load is 1.
            expected = law.mu + law.cohesion * model.area[closed].sum()
            assert step.force == pytest.approx(expected, rel=1e-9)


@pytest.mark.mpi
@pytest.mark.parametrize("motion", ["small", "finite"])
def test_lagged_friction_is_bounded_by_the_pressures_of_the_start(comm, motion):
    model = Pushed(comm, hm.CoulombFriction(0.2, 0.05, lagged=True), motion=motion)
    first = model.step(0.01)
    np.testing.assert_allclose(first.state.shear[model.operator.kept], 0.0, atol=1e-9)
    law, before = hm.CoulombFriction(0.2, 0.05), first.state
    for push in (0.02, 0.03, 0.04):
        start = model.problem.save()
        step = model.step(push)
        bound = np.where(before.closed, law.bound(np.maximum(before.pressure, 0.0))[0], 0.0)
        kept, slipping = model.operator.kept, model.status.slipping
        assert np.all(np.abs(step.state.shear[kept]) <= bound[kept] + 1e-9) and slipping.any()
        np.testing.assert_allclose(step.state.shear[slipping], -bound[slipping], atol=1e-9)
        # A step that is given up leaves no trace.
        model.problem.restore(start)
        assert model.step(push).force == pytest.approx(step.force, rel=1e-12)
        before = step.state
    if motion == "small":
        # By now the pressures hardly change: what is lagged is what is.
        summed = model.area[before.closed] @ bound[before.closed]
        assert step.force == pytest.approx(summed, rel=1e-9)
        assert summed == pytest.approx(0.2 + 0.05 * model.area[before.closed].sum(), rel=1e-3)
    nodes = model.coupling.nodal_states()
    held = np.where(before.closed, law.bound(np.maximum(before.pressure, 0.0))[0], 0.0)
    np.testing.assert_allclose(nodes[0].nodal["bound"], held, atol=1e-12)
    current = np.concatenate([v.x.array for v in model.problem.unknowns])
    model.coupling.commit()
    model.coupling.set_nodal_states(*nodes, current)
    again = model.coupling.nodal_states()[0].nodal["bound"]
    np.testing.assert_array_equal(again, nodes[0].nodal["bound"])


@pytest.mark.mpi
def test_no_friction_needs_no_push(comm):
    for law in (hm.Frictionless(), hm.CoulombFriction(0.0)):
        model = Pushed(comm, law, motion="small")
        step = model.step(0.02)
        assert abs(step.force) < 1e-10 and not model.status.slipping.any()
        np.testing.assert_allclose(step.state.shear, 0.0, atol=1e-10)


@pytest.mark.mpi
def test_pushed_back_the_block_slides_back(comm):
    model = Pushed(comm, hm.CoulombFriction(0.2), motion="small")
    there, back = model.step(0.02).force, model.step(0.0)
    assert there == pytest.approx(0.2, rel=1e-9) and back.force == pytest.approx(-0.2, rel=1e-9)
    assert np.all(model.status.direction[model.status.slipping] < 0)
    # Less than the way to slip: it sticks, the force in between.
    part = model.step(1e-4)
    assert -0.2 < part.force < -0.19 and model.status.sticking.any()


@pytest.mark.parametrize("law", LAWS[2:], ids=IDS[2:])
def test_back_at_a_state_on_the_bound_round_off_does_not_decide(law):
    # Away without sliding and back again: what slid last is on the bound, neither below nor above.
    model = Pushed(MPI.COMM_SELF, law)
    for push in (0.02, 0.0):
        before = model.step(push)
    for push in (1e-4, 0.001, 0.002, 0.003, 0.004, 0.003):
        model.step(push)
    after = model.step(0.0)
    assert after.iterations <= 5 and after.force == pytest.approx(before.force, rel=1e-8)


@pytest.mark.mpi
@pytest.mark.parametrize("motion", ["small", "finite"])
def test_units_do_not_matter(comm, motion):
    # A load of 1 N/m on stiffness in Pa; the same in kN/mm and kN/mm^2.
    metre, newton = 1e3, 1e-3
    per_area = newton / metre**2
    runs = []
    for length, stress in ((1.0, 1.0), (metre, per_area)):
        law = hm.CoulombFriction(0.3, 0.05 * stress)
        model = Pushed(
            comm, law, length=length, force=stress * length, E=100.0 * stress, motion=motion
        )
        steps = [model.step(push * length) for push in 0.004 * np.arange(1, 5)]
        runs.append((model, steps, length, stress))
    (one, steps, *_), (other, others, length, stress) = runs
    assert [s.iterations for s in steps] == [s.iterations for s in others]
    assert one.status.same(other.status) and one.status.slipping.any()
    for a, b in zip(steps, others, strict=True):
        assert b.force / (stress * length) == pytest.approx(a.force, rel=1e-9)
        for name in ("pressure", "shear"):
            values, reference = getattr(b.state, name) / stress, getattr(a.state, name)
            np.testing.assert_allclose(values, reference, rtol=0, atol=1e-9)
    change = other.u.x.array / length - one.u.x.array
    assert largest(change, comm) < 1e-9 * largest(one.u.x.array, comm)


@pytest.mark.mpi
def test_same_answer_on_any_number_of_ranks(comm):
    law = hm.CoulombFriction(0.3, 0.05)
    runs = [Pushed(c, law, motion="finite") for c in (comm, MPI.COMM_SELF)]
    for push in (0.004, 0.008, 0.012):
        together, alone = (model.step(push) for model in runs)
        assert together.iterations == alone.iterations
        assert together.force == pytest.approx(alone.force, rel=1e-9)
        a, b = together.state, alone.state
        np.testing.assert_allclose(a.points, b.points, rtol=0, atol=1e-12)
        np.testing.assert_allclose(a.pressure, b.pressure, rtol=0, atol=1e-9)
        np.testing.assert_allclose(a.shear, b.shear, rtol=0, atol=1e-9)
        assert runs[0].status.same(runs[1].status)
    norms = [np.linalg.norm(gathered(model.problem, model.u.x.array)) for model in runs]
    assert norms[0] == pytest.approx(norms[1], rel=1e-9)


# --- parting blocks -----------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize("motion", ["small", "finite"])
@pytest.mark.parametrize("law", [hm.Frictionless(), hm.CoulombFriction(0.4)], ids=["free", "rough"])
@pytest.mark.parametrize("slope", [0.0, 0.2])
def test_blocks_that_part_lose_all_contact_force(comm, law, motion, slope):
    domain = stack(comm, (7, 5), slope=slope)
    load = fem.Constant(domain.mesh, np.array([0.0, -0.5]))
    spring = 2.0
    model = Blocks(
        domain,
        law,
        fixed={("bottom_0", None): np.zeros(2)},
        tractions={"top_1": load},
        spring=("top_1", spring),
        motion=motion,
        newton=hm.NewtonOptions(tolerance=1e-13),
    )

    _, pressed = model.solve()
    before = model.u.x.array.copy()
    assert model.status.closed.any() and np.nanmax(pressed.pressure) > 0.3

    load.value[:] = (0.0, 0.1)
    _, parted = model.solve()
    assert not model.status.closed.any() and not model.status.slipping.any()
    np.testing.assert_allclose(parted.pressure[model.operator.kept], 0.0, atol=1e-10)
    np.testing.assert_allclose(parted.shear[model.operator.kept], 0.0, atol=1e-10)
    # The upper block floats on its spring, the lower one has no load.
    exact = fem.Function(model.V)
    upper = domain.cell_tags.find(domain.bodies["block_1"])
    exact.interpolate(lambda x: np.stack((0 * x[0], 0 * x[0] + 0.1 / spring)), cells0=upper)
    exact.x.scatter_forward()
    assert largest(model.u.x.array - exact.x.array, comm) < 1e-11

    # Pressed again they carry what they did, but for the way that friction remembers.
    load.value[:] = (0.0, -0.5)
    _, again = model.solve()
    assert model.status.closed.any()
    if isinstance(law, hm.Frictionless):
        np.testing.assert_allclose(again.pressure, pressed.pressure, rtol=0, atol=1e-9)
        assert largest(model.u.x.array - before, comm) < 1e-10


@pytest.mark.mpi
def test_blocks_out_of_reach_have_no_contact(comm):
    model = Blocks(
        stack(comm, (7, 5)),
        hm.CoulombFriction(0.4),
        fixed={("bottom_0", None): np.zeros(2)},
        tractions={"top_1": (0.0, 0.1)},
        spring=("top_1", 0.02),
        newton=hm.NewtonOptions(tolerance=1e-13),
    )
    _, state = model.solve()
    assert not model.operator.kept.any() and not model.status.closed.any()
    assert np.all(np.isnan(state.pressure))
    assert largest(model.u.x.array, comm) == pytest.approx(5.0, rel=1e-9)
