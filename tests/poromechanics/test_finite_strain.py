# SPDX-License-Identifier: LGPL-3.0-or-later
"""Finite strain: stress updates of known motions, water, a mesh and axes that follow."""

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem

import fenicsx_hmcontact as hm
from fenicsx_hmcontact._kernels import rotation as rotation_kernels
from fenicsx_hmcontact.materials import MaterialStress
from fenicsx_hmcontact.poromechanics import finite_strain
from tests.models import contact_pairs, fix, integral, largest, stack, total
from tests.smoothing.helpers import make_mesh, set_values, square

pytestmark = pytest.mark.mpi

POINTS, TRIANGLES = square("unstructured", 4)
ELASTIC = hm.LinearElastic(1.0, 0.3)
FULL = hm.node_cells_measure("full")
MEASURES = {"full": FULL, "none": hm.node_cells_measure("none"), "triangles": ufl.dx}
TIGHT = hm.NewtonOptions(tolerance=1e-12)


class Driven:
    """A square whose nodes all follow a given motion."""

    def __init__(self, material=ELASTIC, measure=FULL):
        self.mesh = make_mesh(POINTS, TRIANGLES)
        V = fem.functionspace(self.mesh, ("P", 1, (2,)))
        self.u, self.u_n, v = fem.Function(V, name="u"), fem.Function(V), ufl.TestFunction(V)
        self.stress = MaterialStress(material, self.u, self.u_n, measure, kinematics="finite")
        form = finite_strain.equilibrium(
            self.stress.stress,
            self.stress.deformation,
            self.u,
            self.u_n,
            None,
            v,
            smoothed=self.stress.measure,
        )
        self.problem = hm.ContactProblem(form, self.u)
        self.rest = self.mesh.geometry.x[:, :2].copy()

    def move(self, motion):
        """Bring the material through one step of a linear map of the rest positions."""
        set_values(self.u, (POINTS @ motion.T - POINTS).ravel())
        self.problem._update_materials()
        for stress in self.problem._stresses:
            stress.commit()
        self.problem.move_mesh(self.u, self.u_n)

    def drive(self, motion, steps):
        for step in range(1, steps + 1):
            self.move(motion(step / steps))
        return self.stress.values()


def rotation(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


@pytest.mark.parametrize("name", MEASURES)
def test_stress_turns_with_a_rigid_rotation(name):
    body = Driven(measure=MEASURES[name])
    start = np.array([-0.3, -0.1, -0.2, 0.05])
    body.stress.set_stress(lambda x: np.repeat(start[:, None], x.shape[1], axis=1))
    values = body.drive(lambda t: rotation(0.5 * np.pi * t), 10)
    assert np.allclose(values, [-0.1, -0.3, -0.2, -0.05], rtol=0, atol=1e-14)
    x = body.mesh.geometry.x[:, :2]
    assert np.allclose(x, body.rest @ rotation(0.5 * np.pi).T, rtol=0, atol=1e-15)
    if body.stress.node_cells is not None:
        assert np.allclose(body.stress.node_cells.angles, 0.5 * np.pi, rtol=0, atol=1e-13)


def test_uniaxial_compression_follows_the_logarithm():
    values = Driven().drive(lambda t: np.diag([1.0, 1.0 - 0.3 * t]), 10)
    exact = ELASTIC.oedometric_modulus * np.log(0.7)
    assert np.allclose(values[..., 1], exact, rtol=1.5e-3)
    fine = Driven().drive(lambda t: np.diag([1.0, 1.0 - 0.3 * t]), 40)
    assert np.allclose(fine[..., 1], exact, rtol=1e-4)


def test_simple_shear_is_of_second_order():
    """Jaumann's rate has the shear stress G sin(gamma) and the normal stress G (1 - cos gamma)."""
    G = ELASTIC.shear_modulus
    errors = []
    for steps in (10, 20, 40):
        values = Driven().drive(lambda t: np.array([[1.0, 2.0 * t], [0.0, 1.0]]), steps)
        exact = G * np.array([1.0 - np.cos(2.0), np.cos(2.0) - 1.0, 0.0, np.sin(2.0)])
        errors.append(np.abs(values - exact).max() / G)
    assert errors[0] < 5e-3
    assert 3.6 < errors[0] / errors[1] < 4.4 and 3.6 < errors[1] / errors[2] < 4.4


def test_a_turned_body_has_turned_forces():
    """The points turn with the body: a state in turned axes exerts the turned forces."""
    rng = np.random.default_rng(1)
    shape = rng.normal(scale=0.02, size=2 * len(POINTS))
    forces = []
    for angle in (0.0, 1.1):
        body = Driven()
        if angle:
            body.drive(lambda t, angle=angle: rotation(angle * t), 5)
        u = ((POINTS + shape.reshape(-1, 2)) @ rotation(angle).T - POINTS).ravel()
        set_values(body.u, u)
        body.problem.residual()
        dofs = body.problem.layout.owned
        local = body.problem._raw[dofs].reshape(-1, 2) @ rotation(angle)
        forces.append(local)
        scale = largest(local, body.mesh.comm)
    assert scale > 1e-3
    assert np.allclose(*forces, rtol=0, atol=1e-13 * scale)


def test_rotation_kernels():
    """Against matrices; the tangent is differenced above. Compiled and as Python."""
    rng = np.random.default_rng(2)
    stress, w = rng.normal(size=(20, 4)), rng.normal(size=20)
    by_strain, by_stress = rng.normal(size=(20, 4, 3)), rng.normal(size=(20, 4, 4))
    turned = rotation_kernels.turned_stress(stress, w)
    for (xx, yy, zz, xy), spin, result in zip(stress, w, turned, strict=True):
        R = rotation(-np.arctan(0.5 * spin))
        expected = R @ np.array([[xx, xy], [xy, yy]]) @ R.T
        assert np.allclose(result, [*np.diag(expected), zz, expected[0, 1]], rtol=0, atol=1e-14)
    arguments = (turned, stress, by_strain, by_stress, w)
    for kernel, its_arguments in (
        (rotation_kernels.turned_stress, (stress, w)),
        (rotation_kernels.turned_tangent, arguments),
    ):
        assert np.allclose(kernel(*its_arguments), kernel.py_func(*its_arguments), rtol=1e-13)
    # Of plane rotation alone: a linear law with start stress, by differences of the spin.
    h = 1e-6

    def end(spin):
        start = rotation_kernels.turned_stress(stress, spin)
        law = np.einsum("nij,nj->ni", by_stress, start)
        return rotation_kernels.turned_stress(law, spin), start

    (high, _), (low, _), (now, start) = end(w + h), end(w - h), end(w)
    tangent = rotation_kernels.turned_tangent(now, start, by_strain, by_stress, w)
    difference = (high - low)[:, [0, 1, 3]] / (2.0 * h)
    assert np.allclose(tangent[:, :, 3], difference, rtol=0, atol=1e-8)


def test_an_inverted_triangle_is_named():
    body = Driven()
    x = body.u.function_space.tabulate_dof_coordinates()[:, :2]
    body.u.x.array[:] = (-2.2 * (x - [0.0, 0.5]) * (x[:, :1] < 0.3)).ravel()
    with pytest.raises(FloatingPointError, match=r"triangles are turned inside out, one at x = 0"):
        body.problem.residual()


# --- equilibrium ---------------------------------------------------------------------------------


def block(measure, comm, steps, material=ELASTIC, **options):
    """A block squeezed by 30 % between rough plates; yields problem, stress and Newton's result."""
    domain = stack(comm, [6], rows=6, alternate=True)
    V = fem.functionspace(domain.mesh, ("P", 1, (2,)))
    u, u_n, v = fem.Function(V, name="u"), fem.Function(V), ufl.TestFunction(V)
    stress = MaterialStress(material, u, u_n, measure, kinematics="finite")
    form = finite_strain.equilibrium(
        stress.stress, stress.deformation, u, u_n, None, v, smoothed=stress.measure
    )
    domain.mesh.topology.create_connectivity(1, 2)
    plate = fem.Constant(domain.mesh, 0.0)
    fixed = [(V.sub(i), name) for i, name in ((0, "bottom_0"), (1, "bottom_0"), (0, "top_0"))]
    bcs = [fix(domain, space, name) for space, name in fixed]
    bcs.append(fix(domain, V.sub(1), "top_0", plate))
    problem = hm.ContactProblem(form, u, bcs=bcs, newton=TIGHT, **options)
    for step in range(1, steps + 1):
        plate.value = -0.3 * step / steps
        result = problem.solve()
        yield problem, stress, result, domain
        problem.move_mesh(u, u_n)


@pytest.mark.parametrize("name", MEASURES)
def test_newton_converges_quadratically(name, comm):
    iterations = [result.iterations for *_, result, _ in block(MEASURES[name], comm, 6)]
    assert max(iterations) <= 5


@pytest.mark.parametrize(
    "law", [hm.Frictionless(), hm.CoulombFriction(0.3)], ids=["smooth", "rough"]
)
def test_contact_of_moving_meshes(law, comm):
    """Blocks with meshes that do not match, squeezed by 30 %: one uniform stress, step by step."""
    domain = stack(comm, [3, 4], rows=3, alternate=True)
    mesh = domain.mesh
    mesh.topology.create_connectivity(1, 2)
    V = fem.functionspace(mesh, ("P", 1, (2,)))
    u, u_n, v = fem.Function(V, name="u"), fem.Function(V), ufl.TestFunction(V)
    stress = MaterialStress(ELASTIC, u, u_n, FULL, kinematics="finite")
    form = finite_strain.equilibrium(stress.stress, stress.deformation, u, u_n, None, v)
    plate = fem.Constant(mesh, 0.0)
    sides = [fix(domain, V.sub(0), f"{side}_{k}") for side in ("left", "right") for k in (0, 1)]
    ends = [fix(domain, V.sub(1), "bottom_0"), fix(domain, V.sub(1), "top_1", plate)]
    pairs = contact_pairs(domain, [("bottom_1", "top_0", None, law)])
    problem = hm.ContactProblem(form, u, bcs=[*sides, *ends], pairs=pairs)
    expected = np.zeros(4)
    for step in range(1, 6):
        plate.value = -0.06 * step
        problem.solve()
        problem.move_mesh(u, u_n)
        values = stress.values()
        before, now = 1.0 - 0.06 * (step - 1), 1.0 - 0.06 * step
        strain = 2.0 * (now - before) / (now + before)
        lame, M = ELASTIC.lame, ELASTIC.oedometric_modulus
        expected += strain * np.array([lame, M, lame, 0.0])
        assert largest(values - expected, comm) < 1e-9
    y = mesh.geometry.x[:, 1]
    assert comm.allreduce(float(y.max()), MPI.MAX) == pytest.approx(0.7, abs=1e-12)


def test_cells_at_rest_after_relaxation(comm):
    """Rebuilt cells bring a residual, which a few steps without load remove (F-bar)."""
    *_, (problem, _, _, _) = block(FULL, comm, 6)
    u, (stress,) = problem.unknowns[0], problem._stresses
    problem.move_mesh(u, stress.u_n)
    residuals = []
    for _ in range(4):
        problem.residual()
        support = largest(problem.reactions(u).x.array, comm)
        free = np.where(problem._constrained, 0.0, problem._condensed)[problem.layout.owned]
        residuals.append(largest(free, comm) / support)
        problem.solve()
        problem.move_mesh(u, stress.u_n)
    assert 1e-9 < residuals[0] < 2e-2
    assert residuals[-1] < 1e-2 * residuals[0]


def test_saved_steps_come_back_with_their_mesh(comm):
    """Going back over a step restores mesh, node cells and axes bit for bit."""
    steps = block(FULL, comm, 3)
    problem, stress, *_ = next(steps)
    u = problem.unknowns[0]
    state, u_n = problem.save(), stress.u_n.x.array.copy()
    x = problem._mesh.geometry.x.copy()
    cells = problem.node_cells
    kept = [a.copy() for a in (cells.gradients, cells.areas, cells.weights, cells.angles)]
    values = stress.values().copy()
    problem.move_mesh(u, stress.u_n)
    assert largest(problem._mesh.geometry.x - x, comm) > 0.01
    problem.restore(state)
    stress.u_n.x.array[:] = u_n
    assert np.array_equal(problem._mesh.geometry.x, x)
    for now, before in zip(
        (cells.gradients, cells.areas, cells.weights, cells.angles), kept, strict=True
    ):
        assert np.array_equal(now, before)
    assert np.array_equal(stress.values(), values)


def test_a_mesh_moved_by_hand_is_refused():
    body = Driven()
    body.mesh.geometry.x[:] += 0.1
    with pytest.raises(RuntimeError, match="the mesh has moved"):
        body.problem.solve()
    with pytest.raises(RuntimeError, match="the mesh has moved"):
        body.problem.move_mesh(body.u, body.u_n)


# --- with water ----------------------------------------------------------------------------------


class Consolidating:
    """A square of soil, laterally confined, drained and loaded at its top."""

    def __init__(
        self,
        comm,
        measure=FULL,
        *,
        load=0.2,
        confined=True,
        material=hm.LinearElastic(1.0, 0.2),
        permeability=np.array([[2.0, 0.3], [0.3, 1.0]]),
        unit_weight=1.0,
        domain=None,
    ):
        self.domain = domain or stack(comm, [4], rows=6, alternate=True)
        mesh = self.mesh = self.domain.mesh
        mesh.topology.create_connectivity(1, 2)
        V, Q = fem.functionspace(mesh, ("P", 1, (2,))), fem.functionspace(mesh, ("P", 1))
        self.u, self.u_n = fem.Function(V, name="u"), fem.Function(V)
        self.p, self.p_n = fem.Function(Q, name="p"), fem.Function(Q)
        v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))
        self.dt = fem.Constant(mesh, 0.01)
        self.stress = MaterialStress(material, self.u, self.u_n, measure, kinematics="finite")
        measure = self.stress.measure
        F = finite_strain.equilibrium(
            self.stress.stress,
            self.stress.deformation,
            self.u,
            self.u_n,
            self.p,
            v,
            smoothed=measure,
        )
        F += finite_strain.water_balance(
            self.u,
            self.u_n,
            self.p,
            q,
            self.dt,
            permeability=fem.Constant(mesh, permeability),
            unit_weight=unit_weight,
            smoothed=measure,
        )
        F += hm.pressure_projection(self.p, self.p_n, q, material.shear_modulus)
        ds = ufl.Measure("ds", domain=mesh, subdomain_data=self.domain.facet_tags)
        F += load * v[1] * ds(self.domain.surface("top_0"))
        sides = [(1, "bottom_0"), (0, "left_0"), *([(0, "right_0")] if confined else [])]
        bcs = [fix(self.domain, V.sub(i), name) for i, name in sides]
        bcs.append(fix(self.domain, Q, "top_0"))
        self.problem = hm.ContactProblem(F, [self.u, self.p], bcs=bcs, newton=TIGHT)
        self.one = fem.Constant(mesh, 1.0)

    def area(self):
        return integral(fem.form(self.one * ufl.dx(domain=self.mesh)), self.mesh.comm)

    def step(self):
        self.p_n.x.array[:] = self.p.x.array
        return self.problem.solve()

    def outflow(self):
        return -total(self.problem.reactions(self.p), self.domain)[0]


@pytest.mark.parametrize("name", MEASURES)
def test_water_is_conserved(name, comm):
    """What flows out is what the true area of the deformed mesh loses."""
    body = Consolidating(comm, MEASURES[name], confined=False)
    before = body.area()
    for _ in range(3):
        body.step()
        outflow = body.outflow()
        body.problem.move_mesh(body.u, body.u_n)
        after = body.area()
        assert outflow > 1e-3
        assert before - after == pytest.approx(outflow, abs=1e-12)
        before = after


@pytest.mark.parametrize("name", MEASURES)
def test_tangent_of_soil_and_water(name, comm):
    body = Consolidating(comm, MEASURES[name])
    problem, rng = body.problem, np.random.default_rng(3)
    body.stress.set_stress(lambda x: np.array([-0.1, -0.2, -0.1, 0.05])[:, None] + 0.0 * x[:1])
    states = {body.u: 0.01, body.u_n: 0.002, body.p: 0.1}
    for f, size in states.items():
        f.interpolate(
            lambda x, a=rng.normal(size=(f.function_space.dofmap.bs, 3)), size=size: (
                size * np.sin(7.0 * a @ np.vstack([x[:2], 1.0 + 0.0 * x[:1]]))
            ).squeeze()
        )
    state = problem._current()
    direction = np.cos(state * 1e3)

    def put(values):
        for f, view in zip(problem.unknowns, problem.layout.views(values), strict=True):
            f.x.array[:] = view
            f.x.scatter_forward()

    ends = []
    problem.layout.update_ghosts(direction)
    for h in (1e-6, -1e-6):
        put(state + h * direction)
        problem.residual()
        ends.append(problem._raw.copy())
    put(state)
    problem.residual()
    problem._assemble_tangent()
    product = problem._matrix.multiply(direction)
    problem.layout.add_ghosts_to_owners(product)
    owned = problem.layout.owned
    difference = (ends[0] - ends[1])[owned] / 2e-6
    for view in (difference, product[owned]):
        assert largest(view, comm) > 1e-2
    assert largest(product[owned] - difference, comm) < 1e-7 * largest(difference, comm)


def test_hydrostatic_pressure_moves_nothing(comm):
    """Weight and gravity in balance with stress and pressure at rest: round-off."""
    domain = stack(comm, [4], rows=4)
    mesh = domain.mesh
    mesh.topology.create_connectivity(1, 2)
    V, Q = fem.functionspace(mesh, ("P", 1, (2,))), fem.functionspace(mesh, ("P", 1))
    u, u_n, p = fem.Function(V, name="u"), fem.Function(V), fem.Function(Q, name="p")
    v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))
    stress = MaterialStress(hm.LinearElastic(1.0, 0.2), u, u_n, FULL, kinematics="finite")
    down = ufl.as_vector((0.0, -1.0))
    weight = fem.Constant(mesh, 0.2)
    F = finite_strain.equilibrium(
        stress.stress, stress.deformation, u, u_n, p, v, body_force=weight * down
    )
    F += finite_strain.water_balance(
        u, u_n, p, q, 1.0, permeability=1.0, unit_weight=0.1, gravity=down
    )
    sides = [(0, "bottom_0"), (1, "bottom_0"), (0, "left_0"), (0, "right_0")]
    bcs = [fix(domain, V.sub(i), name) for i, name in sides] + [fix(domain, Q, "top_0")]
    problem = hm.ContactProblem(F, [u, p], bcs=bcs)
    p.interpolate(lambda x: 0.1 * (1.0 - x[1]))
    effective = np.array([0.5, 1.0, 0.5, 0.0])[:, None]
    stress.set_stress(lambda x: -0.1 * (1.0 - x[1]) * effective)
    problem.residual()
    free = np.where(problem._constrained, 0.0, problem._condensed)[problem.layout.owned]
    assert largest(problem._condensed, comm) > 1e-2
    assert largest(free, comm) < 1e-15


def test_large_strain_consolidation(comm):
    """Settlement of a column under a dead load; early, a moving boundary of known parabola.

    sigma' = M ln lambda makes the diffusion of 1/lambda linear in space: for stretch 0.7 under the
    load, s(t) = 2 beta sqrt(c_v t) with sqrt(pi) beta exp(beta^2) erfc(beta) = 0.3.
    """
    modulus, beta = 1e6, 0.2116401512
    domain = stack(comm, [1], width=0.05, rows=20)
    body = Consolidating(
        comm,
        load=-modulus * np.log(0.7),
        material=hm.LinearElastic(modulus, 0.0),
        permeability=1e-8 * np.eye(2),
        unit_weight=1e4,
        domain=domain,
    )
    for dt, steps in ((1e3, 10), (1e4, 9)):
        body.dt.value = dt
        for _ in range(steps):
            assert body.step().iterations <= 6
            body.problem.move_mesh(body.u, body.u_n)
    settlement = largest(body.u.x.array, comm)
    exact = 2.0 * beta * np.sqrt(1e-6 * 1e5)
    # Backward Euler in these steps: 1.07 % too small, 0.6 % at half of them.
    assert settlement == pytest.approx(exact, rel=0.013)
    assert settlement < 0.993 * exact
