# SPDX-License-Identifier: LGPL-3.0-or-later
"""Stresses of materials in weak forms: values, tangents, what a step keeps, several bodies."""

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.materials import MaterialStress
from fenicsx_hmcontact.poromechanics import finite_strain
from tests.smoothing.helpers import (
    add_up,
    input_dofs,
    make_mesh,
    set_values,
    smoothed_terms,
    square,
    tag_cells,
)

pytestmark = pytest.mark.mpi

POINTS, TRIANGLES = square("unstructured", 4)
ELASTIC = hm.LinearElastic(1.0, 0.3)
TRESCA = hm.Tresca(1.0, 0.3, c=0.02)
FULL = hm.node_cells_measure("full")
MEASURES = {name: hm.node_cells_measure(name) for name in ("deviatoric", "full", "none")}
MEASURES["triangles"] = ufl.dx


class Body:
    """Displacement, stress and problem of one body with a fixed bottom."""

    def __init__(
        self, material, measure=hm.dc, kinematics="small", degree=1, comm=MPI.COMM_WORLD, **options
    ):
        self.mesh = make_mesh(POINTS, TRIANGLES, comm)
        V = self.V = fem.functionspace(self.mesh, ("P", degree, (2,)))
        self.u, self.u_n = fem.Function(V, name="displacement"), fem.Function(V)
        self.v = ufl.TestFunction(V)
        self.stress = MaterialStress(material, self.u, self.u_n, measure, kinematics=kinematics)
        if kinematics == "finite":
            self.F = finite_strain.equilibrium(
                self.stress.stress,
                self.stress.deformation,
                self.u,
                self.u_n,
                None,
                self.v,
                smoothed=self.stress.measure,
            )
        else:
            self.F = hm.equilibrium(self.stress.stress, None, self.v, smoothed=self.stress.measure)
        bottom, self.top = (
            fem.locate_dofs_geometrical(V, lambda x, y=y: np.isclose(x[1], y)) for y in (0.0, 1.0)
        )
        self.plate = fem.Function(V)
        bcs = [
            fem.dirichletbc(np.zeros(2), bottom, V),
            fem.dirichletbc(self.plate, self.top),
        ]
        self.problem = hm.ContactProblem(self.F, self.u, bcs=bcs, **options)

    def displace(self, values):
        set_values(self.u, values)

    def push(self, x, y):
        """Displacement of the top."""
        array = self.plate.x.array.reshape(-1, 2)
        array[self.top] = x, y

    def residual(self):
        self.problem.residual()
        return self.globally(self.problem._raw)

    def tangent_times(self, direction):
        function = fem.Function(self.V)
        set_values(function, direction)
        self.problem._assemble_tangent()
        result = self.problem._matrix.multiply(function.x.array.copy())
        self.problem.layout.add_ghosts_to_owners(result)
        return self.globally(result)

    def globally(self, local):
        """Array of the owned unknowns in the input's numbering, on all ranks."""
        dofs = input_dofs(self.V)
        owned = self.problem.layout.owned
        result = np.zeros(2 * len(POINTS))
        result[dofs[owned]] = local[owned]
        return self.mesh.comm.allreduce(result)


def random_displacement(seed, size=0.02):
    return np.random.default_rng(seed).normal(scale=size, size=2 * len(POINTS))


def start_stress(x):
    return np.array([-0.03 + 0.01 * x[1], -0.05 + 0.02 * x[0], -0.03 + 0.0 * x[0], 0.01 * x[1]])


# --- against forms of UFL alone ------------------------------------------------------------------


@pytest.mark.parametrize("name", MEASURES)
def test_elastic_stress_is_that_of_ufl(name):
    body = Body(ELASTIC, MEASURES[name])
    body.displace(random_displacement(1))
    direction = random_displacement(2)
    form = ufl.inner(ELASTIC.stress(body.u), ufl.grad(body.v)) * MEASURES[name]
    problem = hm.ContactProblem(form, body.u)
    problem.residual()
    expected = body.globally(problem._raw)
    assert np.allclose(body.residual(), expected, rtol=0, atol=1e-14 * abs(expected).max())
    ours = body.tangent_times(direction)
    problem._assemble_tangent()
    function = fem.Function(body.V)
    set_values(function, direction)
    product = problem._matrix.multiply(function.x.array.copy())
    problem.layout.add_ghosts_to_owners(product)
    expected = body.globally(product)
    assert np.allclose(ours, expected, rtol=0, atol=1e-13 * abs(expected).max())


@pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="P2 numbering")
def test_quadratic_displacements_have_three_points():
    body = Body(ELASTIC, ufl.dx, degree=2)
    body.u.interpolate(lambda x: (x[0] ** 2 - x[1], x[0] * x[1]))
    body.problem.residual()
    form = ufl.inner(ELASTIC.stress(body.u), ufl.grad(body.v)) * ufl.dx
    expected = fem.assemble_vector(fem.form(form)).array
    assert body.stress.values().shape == (len(TRIANGLES), 3, 4)
    assert np.allclose(body.problem._raw, expected, rtol=0, atol=1e-14)


# --- tangents ------------------------------------------------------------------------------------


@pytest.mark.parametrize("material", [ELASTIC, TRESCA], ids=["elastic", "Tresca"])
@pytest.mark.parametrize(
    ("kinematics", "name"),
    [("small", "deviatoric"), ("small", "triangles")]
    + [("finite", name) for name in ("full", "none", "triangles")],
)
def test_tangent(material, kinematics, name):
    """Finite differences about a random state in a step that has a history."""
    body = Body(material, MEASURES[name], kinematics)
    body.stress.set_stress(start_stress)
    set_values(body.u_n, random_displacement(3, 0.005))
    state = random_displacement(3, 0.005) + random_displacement(4, 0.008)
    direction = random_displacement(5, 1.0)
    ends = []
    for step in (1e-6, -1e-6):
        body.displace(state + step * direction)
        ends.append(body.residual())
    body.displace(state)
    body.problem.residual()
    if material is TRESCA:
        plastic = body.mesh.comm.allgather(body.stress.history("kappa").ravel() > 0.0)
        assert 0.2 < np.concatenate(plastic).mean() < 1.0
    difference = (ends[0] - ends[1]) / 2e-6
    error = abs(body.tangent_times(direction) - difference).max()
    assert error < 2e-8 * abs(difference).max()


def test_tangent_is_symmetric_at_no_increment():
    """F-bar at the start of a step is the deviatoric enhancement of small strain."""
    tangents = []
    for measure, kinematics in ((hm.dc, "small"), (FULL, "finite")):
        body = Body(ELASTIC, measure, kinematics)
        body.residual()
        tangents.append(
            np.column_stack([body.tangent_times(e) for e in np.eye(2 * len(POINTS))[::7]])
        )
    assert np.allclose(*tangents, rtol=0, atol=5e-16 * abs(tangents[0]).max())


def test_any_number_of_ranks_gives_the_same():
    """Some steps of plastic shear and compression, the mesh following."""

    def run(comm):
        body = Body(TRESCA, FULL, "finite", comm=comm)
        for step in range(1, 7):
            body.push(0.02 * step, -0.015 * step)
            body.problem.solve()
            body.problem.move_mesh(body.u, body.u_n)
        return body.globally(body.u.x.array), body.residual(), body

    u, residual, body = run(MPI.COMM_WORLD)
    u_alone, residual_alone, alone = run(MPI.COMM_SELF)
    assert np.allclose(u, u_alone, rtol=0, atol=1e-10)
    assert np.allclose(residual, residual_alone, rtol=0, atol=1e-9 * abs(residual_alone).max())
    angles = body.mesh.comm.allreduce(body.stress.node_cells.angles.sum())
    assert angles == pytest.approx(alone.stress.node_cells.angles.sum(), rel=1e-8)
    assert angles < -0.1


# --- what a step keeps ---------------------------------------------------------------------------


def test_a_step_that_converged_is_the_start_of_the_next():
    """Two halves of an elastic step are one step, and the start changes with success alone."""
    body = Body(ELASTIC)
    body.push(0.01, -0.02)
    body.problem.solve()
    assert body.stress.start is body.stress.end
    body.u_n.x.array[:] = body.u.x.array
    body.push(0.02, -0.04)
    body.problem.solve()
    twice = body.stress.values()
    once = Body(ELASTIC)
    once.push(0.02, -0.04)
    once.problem.solve()
    assert np.allclose(twice, once.stress.values(), rtol=0, atol=1e-13)
    expected = body.stress.values()[..., 2] - 0.3 * body.stress.values()[..., :2].sum(axis=-1)
    assert np.allclose(expected, 0.0, atol=1e-14)  # plane strain


def test_a_step_that_failed_leaves_all_as_it_was():
    body = Body(TRESCA, newton=hm.NewtonOptions(max_iterations=2))
    body.push(0.0, -0.001)
    body.problem.solve()
    body.u_n.x.array[:] = body.u.x.array
    before = body.stress.start
    arrays = [f.values.copy() for f in body.stress.functions]
    body.push(0.3, -0.3)
    with pytest.raises(hm.ConvergenceError):
        body.problem.solve()
    assert body.stress.start is before and body.stress.end is before
    for f, array in zip(body.stress.functions, arrays, strict=True):
        assert np.array_equal(f.values, array)
    assert np.array_equal(body.u.x.array, body.u_n.x.array)


def pressed(kinematics="small", measure=hm.dc):
    """A body at the start of a step in the plastic range, and the tangent that it came with."""
    body = Body(TRESCA, measure, kinematics)
    for step in (1, 2, 3):
        body.push(0.005 * step, -0.02 * step)
        body.problem.solve()
        tangent = body.stress.end.tangent
        if kinematics == "finite":
            body.problem.move_mesh(body.u, body.u_n)
        else:
            body.u_n.x.array[:] = body.u.x.array
    body.push(0.02, -0.08)
    return body, tangent


@pytest.mark.parametrize(("kinematics", "measure"), [("small", hm.dc), ("finite", FULL)])
def test_a_step_begins_with_the_tangent_that_the_last_one_ended_on(kinematics, measure):
    """At rest all points are elastic: the law itself would give another one."""
    body, tangent = pressed(kinematics, measure)
    stress, history = body.stress.end.stress, body.stress.end.history
    elastic = Body(ELASTIC).stress
    elastic.update()
    stiffness = elastic.end.tangent[0, :, :3]
    plastic = abs(tangent[:, :, :3] - stiffness).max(axis=(1, 2)) > 0.1
    assert body.mesh.comm.allreduce(plastic.sum()) > 0.2 * 4 * len(POINTS)
    body.problem.residual()
    assert np.array_equal(body.stress.end.tangent, tangent)
    assert np.array_equal(body.stress.end.stress, stress)
    assert np.array_equal(body.stress.end.history, history)


def test_the_last_tangent_saves_iterations():
    """Against the same state given to another body, which begins as elastic points do."""
    body, _ = pressed()
    other = Body(TRESCA)
    for f in ("u", "u_n"):
        getattr(other, f).x.array[:] = getattr(body, f).x.array
    other.push(0.02, -0.08)
    other.stress.set_stress(lambda x: body.stress.values().reshape(-1, 4).T)
    other.stress.set_history("kappa", lambda x: body.stress.history("kappa").ravel())
    iterations = [b.problem.solve().iterations for b in (body, other)]
    assert iterations[0] < iterations[1]
    difference = body.globally(body.u.x.array) - other.globally(other.u.x.array)
    assert abs(difference).max() < 1e-9


@pytest.mark.parametrize(("kinematics", "measure"), [("small", hm.dc), ("finite", FULL)])
def test_a_rejected_step_brings_the_tangent_back(kinematics, measure):
    body, tangent = pressed(kinematics, measure)
    before = body.problem.save()
    first = body.problem.solve()
    assert not np.array_equal(body.stress.end.tangent, tangent)
    end = body.u.x.array.copy()
    body.problem.restore(before)
    assert np.array_equal(body.stress.functions[1].values.ravel(), tangent.ravel())
    body.problem.residual()
    assert np.array_equal(body.stress.end.tangent, tangent)
    body.problem.restore(before)
    assert body.problem.solve().history == first.history
    assert np.array_equal(body.u.x.array, end)


def test_a_start_that_has_not_followed_is_refused():
    body = Body(ELASTIC)
    body.push(0.0, -0.01)
    body.problem.solve()
    with pytest.raises(RuntimeError, match="where the last one did, but not stress: set u_n to u"):
        body.problem.solve()
    body = Body(ELASTIC, FULL, "finite")
    body.push(0.0, -0.01)
    body.problem.solve()
    body.u_n.x.array[:] = body.u.x.array
    with pytest.raises(RuntimeError, match="call move_mesh"):
        body.problem.solve()


def test_initial_stress_balances_weight():
    """Stresses linear in depth under gravity: no force anywhere but at the boundary."""
    for measure in (hm.dc, ufl.dx):
        body = Body(TRESCA, measure)
        weight = fem.Constant(body.mesh, np.array([0.0, -0.03]))
        form = body.F - ufl.dot(weight, body.v) * ufl.dx
        body.problem = hm.ContactProblem(form, body.u)

        def at_rest(x):
            s = 0.03 * (x[1] - 1.0)
            return np.array([0.5 * s, s, 0.5 * s, 0.0 * s])

        body.stress.set_stress(at_rest)
        force = body.residual().reshape(-1, 2)
        sides = (abs(POINTS - [0.5, 1.0]) > [0.5 - 1e-9, 1.0 - 1e-9]).any(axis=1)
        assert np.abs(force[sides]).max() > 1e-3
        assert np.abs(force[~sides]).max() < 1e-16


def test_set_values_are_checked():
    body = Body(TRESCA)
    with pytest.raises(ValueError, match="must have shape"):
        body.stress.set_stress(lambda x: x)
    with pytest.raises(ValueError, match="history 'void ratio' is none of kappa"):
        body.stress.set_history("void ratio", lambda x: x[0])
    body.stress.set_history("kappa", lambda x: x[0])
    kappa = body.stress.history("kappa")
    x = body.stress.node_cells.points[: len(kappa), 0]
    assert np.array_equal(kappa, np.repeat(x[:, None], 4, axis=1))


# --- several bodies ------------------------------------------------------------------------------


def two_bodies():
    """Two squares side by side that do not touch."""
    points = np.concatenate([POINTS, POINTS + np.array([1.5, 0.0])])
    triangles = np.concatenate([TRIANGLES, TRIANGLES + len(POINTS)])
    mesh = make_mesh(points, triangles)
    tags = tag_cells(mesh, np.repeat([1, 2], len(TRIANGLES)))
    return mesh, tags, points


@pytest.mark.parametrize("smoothing", ["deviatoric", "triangles"])
def test_each_body_has_its_material(smoothing):
    mesh, tags, points = two_bodies()
    measure = hm.node_cells_measure(smoothing, domain=mesh, subdomain_data=tags)
    V = fem.functionspace(mesh, ("P", 1, (2,)))
    u, u_n, v = fem.Function(V), fem.Function(V), ufl.TestFunction(V)
    soft, stiff = hm.LinearElastic(1.0, 0.3), hm.LinearElastic(7.0, 0.2)
    first = MaterialStress(soft, u, u_n, measure(1))
    second = MaterialStress(stiff, u, u_n, measure(2), node_cells=first.node_cells)
    form = sum(ufl.inner(s.stress, ufl.grad(v)) * s.measure for s in (first, second))
    problem = hm.ContactProblem(form, u)
    assert problem.node_cells is first.node_cells
    set_values(u, np.random.default_rng(1).normal(size=2 * len(points)))
    expected = hm.ContactProblem(
        sum(
            ufl.inner(material.stress(u), ufl.grad(v)) * measure(i)
            for i, material in ((1, soft), (2, stiff))
        ),
        u,
    )
    for p in (problem, expected):
        p.residual()
        p._assemble_tangent()
    raw = expected._raw
    assert np.allclose(problem._raw, raw, rtol=0, atol=1e-14 * abs(raw).max())
    x = np.random.default_rng(2).normal(size=raw.size)
    ours, theirs = (p._matrix.multiply(x) for p in (problem, expected))
    assert np.allclose(ours, theirs, rtol=0, atol=1e-13 * abs(theirs).max())


def test_bodies_must_share_node_cells_and_stay_in_their_cells():
    mesh, tags, _ = two_bodies()
    dc = hm.node_cells_measure("deviatoric", domain=mesh, subdomain_data=tags)
    V = fem.functionspace(mesh, ("P", 1, (2,)))
    u, u_n, v = fem.Function(V), fem.Function(V), ufl.TestFunction(V)
    clay, sand = (MaterialStress(ELASTIC, u, u_n, dc(i), name=f"body {i}") for i in (1, 2))
    form = sum(ufl.inner(s.stress, ufl.grad(v)) * s.measure for s in (clay, sand))
    with pytest.raises(ValueError, match="body 1 and body 2 have node cells of their own"):
        hm.ContactProblem(form, u)
    with pytest.raises(ValueError, match="body 1 has no values in some of the cells"):
        hm.ContactProblem(ufl.inner(clay.stress, ufl.grad(v)) * dc, u)
    dx = ufl.Measure("dx", domain=mesh, subdomain_data=tags)
    clay = MaterialStress(ELASTIC, u, u_n, dx(1))
    problem = hm.ContactProblem(ufl.inner(clay.stress, ufl.grad(v)) * clay.measure("everywhere"), u)
    with pytest.raises(FloatingPointError, match="not a number"):
        problem.residual()


def test_compiled_model_takes_another_stress():
    body, other = Body(TRESCA), Body(TRESCA)
    problem = hm.ContactProblem(body.problem.model, other.u, replace={body.stress: other.stress})
    for b in (body, other):
        b.displace(random_displacement(1))
        b.stress.set_stress(start_stress)
    problem.residual()
    assert np.array_equal(other.globally(problem._raw), body.residual())


def test_refusals():
    mesh = make_mesh(POINTS, TRIANGLES)
    V = fem.functionspace(mesh, ("P", 1, (2,)))
    u, u_n = fem.Function(V), fem.Function(V)
    for options, message in [
        (dict(kinematics="large"), "kinematics is 'large'; it must be one of small, finite"),
        (dict(kinematics="finite"), "does not go with the deviatoric enhancement"),
        (dict(measure=ufl.ds), "not on a measure of exterior_facet"),
        (dict(measure=ufl.dx(degree=3)), "leave out .*'quadrature_degree': 3"),
    ]:
        with pytest.raises(ValueError, match=message):
            MaterialStress(ELASTIC, u, u_n, **options)
    stress = MaterialStress(ELASTIC, u, u_n, name="clay")
    v = ufl.TestFunction(V)
    with pytest.raises(ValueError, match="clay lives at smoothing points"):
        hm.ContactProblem(ufl.inner(stress.stress, ufl.grad(v)) * ufl.dx, u)


def test_points_without_solution_fail_the_step():
    """Dilation-free sand pulled apart beyond its apex."""
    body = Body(hm.MohrCoulomb(1.0, 0.3, c=1e-3, phi=30.0, psi=0.0))
    body.push(0.0, 0.3)
    with pytest.raises((hm.ConvergenceError, hm.SingularSystemError)):
        body.problem.solve()
    assert np.all(body.u.x.array == 0.0) and body.stress.end is body.stress.start


def test_used_terms_keep_their_tangent_linear():
    """The stress may stand in several terms and scaled."""
    body = Body(ELASTIC)
    form = 2.0 * body.F + body.stress.stress[0, 1] * ufl.grad(body.v)[0, 1] * hm.dc
    body.displace(random_displacement(1))
    body.stress.update()
    u, v = body.u, body.v
    plain = 2.0 * ufl.inner(ELASTIC.stress(u), ufl.grad(v)) * hm.dc
    plain += ELASTIC.stress(u)[0, 1] * ufl.grad(v)[0, 1] * hm.dc
    ours, expected = (add_up(*smoothed_terms(f)) for f in (form, plain))
    assert np.allclose(ours, expected, rtol=0, atol=1e-14 * abs(expected).max())


def test_a_step_that_runs_away_has_not_converged():
    """Residuals are measured by the change in the step: beside an endless one any is small."""
    body = Body(ELASTIC)
    body.push(0.0, 100.0)
    with pytest.raises(hm.ConvergenceError, match="nothing resists: stress would be strained by"):
        body.problem.solve()
    assert np.all(body.u.x.array == 0.0)
