# SPDX-License-Identifier: LGPL-3.0-or-later
"""Scenes: the same answers as models written by hand, and what is refused."""

import re
from dataclasses import replace
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.output.fields import evaluate
from tests.models import GAMMA, LOAD, fix, integral, largest, notch, stack

SOIL = hm.LinearElastic(1e6, 0.2)
STEEL = hm.LinearElastic(1e8, 0.2)
K = 1e-8
LEVELS = [0.0, 0.7, 1.0]
FRICTION = hm.CoulombFriction(0.3)
FLOW = hm.GapFlow(1e-9, aperture_cap=1e-4)
FINITE = pytest.mark.parametrize("kinematics", ["small", "finite"])


def column(domain, load=LOAD, **options):
    """A consolidating block under a load on its drained top."""
    scene = hm.Scene(domain)
    scene.body("block_0", SOIL, permeability=K, **options)
    scene.fix("bottom_0")
    for side in ("left_0", "right_0"):
        scene.fix(side, "x")
    scene.load("top_0", pressure=load)
    scene.drain("top_0")
    return scene


def footing(comm, across=(7, 5), *, shift=0.1, material=SOIL, friction=FRICTION, push=-0.02):
    """A dry block pushed into a porous one that it leaves uncovered at one end."""
    domain = stack(comm, across, rows=4, levels=LEVELS, shift=shift)
    scene = hm.Scene(domain)
    scene.body("block_0", material, permeability=K)
    scene.body("block_1", STEEL)
    scene.contact("bottom_1", "top_0", friction=friction, flow=FLOW, name="base")
    scene.fix("bottom_0", "xy")
    scene.fix("left_0", "x")
    scene.move("top_1", x=0.0, y=lambda t: push * t / 1e4)
    return scene


def footing_drained(comm):
    """A dry block that is pushed into clay until this yields, with free water beside it."""
    scene = footing(comm, material=hm.Tresca(1e6, 0.3, 5e3))
    scene.drain("top_0")
    return scene


def run(scene, *arguments, **options):
    """Run to the end; the model, and a number that tells how hard it was."""
    iterations = [step.iterations for step in scene.run(*arguments, **options)]
    return scene.model, iterations


class ByHand:
    """The column in UFL."""

    def __init__(self, domain, kinematics, load=LOAD):
        mesh, finite = domain.mesh, kinematics == "finite"
        V, Q = fem.functionspace(mesh, ("P", 1, (2,))), fem.functionspace(mesh, ("P", 1))
        self.u, self.p = fem.Function(V), fem.Function(Q)
        u, u_n, p, p_n = self.u, fem.Function(V), self.p, fem.Function(Q)
        v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))
        dt, dc = fem.Constant(mesh, 1.0), hm.node_cells_measure("full" if finite else "deviatoric")
        stress = hm.MaterialStress(SOIL, u, u_n, dc, kinematics=kinematics)
        ds = ufl.Measure("ds", domain=mesh, subdomain_data=domain.facet_tags)
        top = ds(domain.surface("top_0"))
        flow = {"permeability": K, "unit_weight": GAMMA, "smoothed": dc}
        if finite:
            form = hm.finite_strain.equilibrium(
                stress.stress, stress.deformation, u, u_n, p, v, smoothed=dc
            )
            form += hm.finite_strain.water_balance(u, u_n, p, q, dt, **flow)
            form += hm.finite_strain.pressure_load(load, u, u_n, v, top)
        else:
            form = hm.equilibrium(stress.stress, p, v, smoothed=dc)
            form += hm.water_balance(u, u_n, p, q, dt, **flow)
            form += load * v[1] * top
        form += hm.pressure_projection(p, p_n, q, SOIL.shear_modulus)
        bcs = [fix(domain, V.sub(i), "bottom_0") for i in (0, 1)]
        bcs += [fix(domain, V.sub(0), name) for name in ("left_0", "right_0")]
        problem = hm.ContactProblem(form, [u, p], bcs=[*bcs, fix(domain, Q, "top_0")])
        self.model = hm.TransientModel(
            problem,
            dt,
            [(p_n, p)] if finite else [(u_n, u), (p_n, p)],
            follow=(lambda: problem.move_mesh(u, u_n)) if finite else None,
        )


# --- the same as by hand --------------------------------------------------------------------------


@FINITE
def test_column_is_that_written_in_ufl(comm, kinematics):
    load = 1e5
    scene = column(stack(comm, [4], rows=6), load)
    hand = ByHand(stack(comm, [4], rows=6), kinematics, load)
    steps = hm.TimeStepping(hand.model).run(3e3, 1e3)
    for mine, his in zip(scene.run(3e3, 1e3, kinematics=kinematics), steps, strict=True):
        assert mine.iterations == his.iterations
        for name, value in (("u", hand.u), ("p", hand.p)):
            difference = getattr(scene.model, name).x.array - value.x.array
            assert largest(difference, comm) < 1e-12 * largest(value.x.array, comm)
    assert scene.model.problem.n_unknowns == {"displacement": 70, "pore pressure": 35}


@FINITE
def test_forces_and_water_balance(comm, kinematics):
    scene = column(stack(comm, [4], rows=6))
    model = None
    for _ in scene.run(3e3, 1e3, kinematics=kinematics, newton=hm.NewtonOptions(1e-12)):
        model = scene.model
        np.testing.assert_allclose(model.force("bottom_0")[1], LOAD, rtol=1e-9)
        left, right = (model.force(f"{side}_0") for side in ("left", "right"))
        assert left[0] > 0.0 > right[0] and left[1] == right[1] == 0.0
        F = ufl.Identity(2) + ufl.grad(model.u - model.u_n)
        change = ufl.det(F) - 1.0 if kinematics == "finite" else ufl.tr(F) - 2.0
        lost = -integral(fem.form(change * ufl.dx), comm)
        assert model.outflow() == pytest.approx(lost, rel=1e-9)
        assert model.outflow("top_0") == pytest.approx(lost, rel=1e-9)
        assert abs(model.outflow("bottom_0")) < 1e-9 * lost


def test_inflow_runs_through(comm):
    domain = stack(comm, [4], rows=4)
    scene = column(domain, 0.0)
    scene.inflow("bottom_0", lambda t: 1e-7)
    model, _ = run(scene, 1e9, 1e8)
    assert model.outflow("bottom_0") == pytest.approx(-1e-7 * 1e8, rel=1e-12)
    assert model.outflow("top_0") == pytest.approx(1e-7 * 1e8, rel=1e-6)
    assert abs(model.outflow()) < 1e-6 * 10.0
    p = evaluate(model.p, [(0.3, 0.5)])
    np.testing.assert_allclose(p, GAMMA * 1e-7 / K * 0.5, rtol=1e-6)


def test_tensor_of_permeability_and_triangles(comm):
    """A tensor across the flow changes nothing; on triangles the stress at nodes is the mean."""
    answers = []
    for k in (K, [[3.0 * K, 0.0], [0.0, K]]):
        scene = column(stack(comm, [4], rows=6))
        scene.body("block_0", SOIL, permeability=k)
        model, _ = run(scene, 1e10, 1e9, smoothing="triangles")
        answers.append(evaluate(model.p, [(0.3, 0.4), (0.7, 0.2)]))
        yy = model.nodal_stress().x.array.reshape(-1, 4)[:, 1]
        assert largest(yy + LOAD, comm) < 1e-6 * LOAD
    np.testing.assert_allclose(*answers, atol=1e-9 * LOAD)


# --- contact, dry bodies and free water -----------------------------------------------------------


@pytest.mark.mpi
@FINITE
def test_dry_body_has_no_pressure_and_presses(comm, kinematics):
    scene = footing(comm)
    scene.drain("top_0", 2e3)
    for _ in scene.run(2e3, 1e3, kinematics=kinematics):
        model, state = scene.model, scene.model.contact("base")
        pushed = model.force("top_1")
        np.testing.assert_allclose(pushed, -state.force, atol=1e-7 * abs(pushed[1]))
    assert pushed[1] < -10.0
    assert model.problem.n_unknowns == {"displacement": 2 * (40 + 30), "pore pressure": 40}
    # Free water stands where the dry block leaves the ground uncovered.
    np.testing.assert_allclose(evaluate(model.p, [(0.0, model_top(model))]), 2e3, rtol=1e-9)
    assert model.outflow("top_0") == pytest.approx(model.outflow(), rel=1e-9)


def model_top(model):
    """Height of the left end of the ground's surface, where the mesh is."""
    x = model.porous.mesh.geometry.x
    height = x[np.isclose(x[:, 0], 0.0), 1].max(initial=-1.0)
    return model.comm.allreduce(float(height), MPI.MAX)


@pytest.mark.mpi
def test_any_number_of_ranks_gives_the_same(comm):
    points = [(0.13, 0.04), (0.5, 0.2), (0.77, 0.31), (0.3, 0.68)]
    answers = []
    for ranks in (comm, MPI.COMM_SELF):
        scene = footing_drained(ranks)
        model, _ = run(scene, 2e3, 5e2)
        kappa, stress = model.nodal_history(), model.nodal_stress()
        answers.append([evaluate(f, points) for f in (model.u, model.p, kappa, stress)])
        answers[-1].append(scene.summary())
    assert answers[0][2].max() > 1e-4
    for a, b in zip(answers[0][:-1], answers[1][:-1], strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-9 * np.abs(b).max())
    assert answers[0][-1] == answers[1][-1]


@pytest.mark.mpi
def test_pore_pressure_on_a_part_of_a_mesh_that_moves(comm):
    """At finite strain the mesh of the porous bodies goes along with that of the whole."""
    scene = footing(comm)
    scene.drain("bottom_0", field=lambda x: 1e3 * x[0])
    model, _ = run(scene, 5e3, 1e3, kinematics="finite")
    whole, part = model.domain, model.porous
    heights = [d.mesh.geometry.x[:, 1].max(initial=-1.0) for d in (whole, part)]
    top, ground = (comm.allreduce(float(y), MPI.MAX) for y in heights)
    assert top == pytest.approx(0.99, abs=1e-9) and ground < 0.75
    surface = evaluate(model.p, [(0.5, 0.0)])
    np.testing.assert_allclose(surface, 500.0, rtol=1e-9)


def test_all_porous_or_all_dry(comm):
    domain = stack(comm, [3, 4])
    scene = hm.Scene(domain)
    for name in domain.body_names:
        scene.body(name, SOIL)
    scene.contact("bottom_1", "top_0", friction=hm.Tied())
    scene.fix("bottom_0")
    scene.load("top_1", traction=(0.0, lambda t: -t))
    model, _ = run(scene, 2.0, 1.0)
    assert model.p is None and model.problem.n_unknowns == {"displacement": 2 * 36}
    np.testing.assert_allclose(model.force("bottom_0"), (0.0, 2.0), atol=1e-9)
    with pytest.raises(ValueError, match="all bodies are dry"):
        model.outflow()
    other = hm.Scene(domain)
    for name in domain.body_names:
        other.body(name, SOIL, permeability=K)
    other.contact("bottom_1", "top_0", flow=hm.GapFlow(1e-9))
    other.fix("bottom_0")
    model = other.build()
    assert model.porous is domain
    assert model.problem.n_unknowns == {"displacement": 2 * 36, "pore pressure": 36}


def test_friction_without_strength_has_no_rows(comm):
    scene = footing(comm, friction=hm.CoulombFriction(0.0))
    model = scene.build()
    assert isinstance(model.pairs["base"].friction, hm.Frictionless)
    assert "base: Frictionless, no friction rows" in scene.summary()
    assert "with friction rows" in footing(comm).summary()


@pytest.mark.mpi
def test_drain_of_a_surface_in_contact_is_water_outside(comm):
    scene = footing(comm)
    scene.gravity()
    scene.body("block_0", SOIL, permeability=K, unit_weight=2e4)
    scene.drain("top_0", level=lambda t: 1.5 + 0.0 * t)
    flow = scene.build().pairs["base"].flow
    assert flow.gravity == (0.0, -1.0)
    np.testing.assert_allclose(flow.outside(np.array([[0.0, 0.5], [1.0, 2.0]])), (1e4, 0.0))


# --- gravity --------------------------------------------------------------------------------------


@FINITE
def test_ground_and_water_at_rest_stay(comm, kinematics):
    weight, k0 = 2e4, 0.5
    scene = hm.Scene(stack(comm, [5], rows=5))
    scene.body("block_0", SOIL, permeability=K, unit_weight=weight)
    scene.gravity((0.0, -9.81))
    scene.fix("bottom_0")
    for side in ("left_0", "right_0"):
        scene.fix(side, "x")
    scene.drain("top_0", level=1.0)
    scene.drain("left_0", level=1.0)

    def at_rest(x):
        down = (GAMMA - weight) * (1.0 - x[1])
        return np.array([k0 * down, down, k0 * down, 0.0 * down])

    scene.initial_stress("block_0", at_rest)
    scene.initial_pressure("block_0", lambda x: GAMMA * (1.0 - x[1]))
    for _ in scene.run(2e6, 1e6, kinematics=kinematics):
        model = scene.model
        assert largest(model.u.x.array, comm) < 1e-12
        np.testing.assert_allclose(model.force("bottom_0")[1], weight, rtol=1e-9)
        assert abs(model.outflow()) < 1e-12
    np.testing.assert_allclose(evaluate(model.p, [(0.5, 0.4)]), 0.6 * GAMMA, rtol=1e-9)
    nodal = evaluate(model.nodal_stress(), [(0.5, 0.4)])
    np.testing.assert_allclose(nodal[0], (-3e3, -6e3, -3e3, 0.0), atol=1e-6)


def test_load_by_traction_is_dead_and_by_pressure_follows(comm):
    """A block that is turned by its support carries its pressure along, not its traction."""
    forces = []
    for load in ({"pressure": 1e3}, {"traction": (0.0, -1e3)}):
        scene = hm.Scene(stack(comm, [3], rows=3))
        scene.body("block_0", SOIL)
        scene.fix("bottom_0")
        scene.move("left_0", x=lambda t: 0.1 * t)
        scene.load("top_0", **load)
        model, _ = run(scene, 2.0, 1.0, kinematics="finite")
        forces.append(sum(model.force(name) for name in ("bottom_0", "left_0")))
    assert forces[1][1] == pytest.approx(1e3, rel=1e-6)
    assert abs(forces[0][1] - 1e3) > 1.0


# --- runs -----------------------------------------------------------------------------------------


@FINITE
def test_stages_with_other_values_are_one_run(comm, kinematics):
    """Values stated anew hold from the next run on, as a function of time would have them."""
    once = column(stack(comm, [4], rows=6), lambda t: LOAD if t < 2.5e3 else 2.0 * LOAD)
    whole, _ = run(once, 4e3, 1e3, kinematics=kinematics)
    scene = column(stack(comm, [4], rows=6))
    model, _ = run(scene, 2e3, 1e3, kinematics=kinematics)
    scene.load("top_0", pressure=2.0 * LOAD)
    times = [step.t for step in scene.run(4e3, 1e3)]
    assert times == [3e3, 4e3] and scene.model is model
    assert largest(whole.u.x.array - model.u.x.array, comm) == 0.0
    assert largest(whole.p.x.array - model.p.x.array, comm) == 0.0


@FINITE
def test_stages_with_other_supports_go_on_from_the_state(comm, kinematics):
    """A model built anew between runs goes on like the old one; a support that is free now acts."""
    one, parts = footing_drained(comm), footing_drained(comm)
    whole, iterations = run(one, 1.5e3, 5e2, kinematics=kinematics)
    old, first = run(parts, 1e3, 5e2, kinematics=kinematics)
    parts.release("left_0")
    parts.fix("left_0", "x")
    model, last = run(parts, 1.5e3, 5e2)
    assert model is not old and first + last == iterations and len(last) == 1
    for name in ("u", "p"):
        expected = getattr(whole, name).x.array
        difference = getattr(model, name).x.array - expected
        assert largest(difference, comm) < 1e-9 * largest(expected, comm)
    pressures = [m.contact("base").pressure for m in (model, whole)]
    np.testing.assert_allclose(*pressures, rtol=1e-7)
    parts.release("left_0")
    model, _ = run(parts, 2e3, 5e2)
    with pytest.raises(ValueError, match="'left_0' is neither fixed nor moved"):
        model.force("left_0")
    sideways = evaluate(model.u, [(0.001, 0.35)])[0, 0]
    assert sideways < -1e-6


def test_forms_are_compiled_once_for_all_meshes(comm, monkeypatch):
    scene, fresh = footing_drained(comm), footing_drained(comm)
    scene.build(kinematics="finite")
    meshes = [{"across": (9, 6), "rows": 3}, {"across": (4, 7), "rows": 5}]
    expected = [fresh_model(comm, **mesh) for mesh in meshes]

    def refuse(*arguments):
        raise AssertionError("compiled a second time")

    monkeypatch.setattr("fenicsx_hmcontact.problem.compile_model", refuse)
    for mesh, other in zip(meshes, expected, strict=True):
        model = scene.build(stack(comm, levels=LEVELS, shift=0.1, **mesh), kinematics="finite")
        for m in (model, other):
            for _ in hm.TimeStepping(m).run(1e3, 5e2):
                pass
        assert largest(model.u.x.array - other.u.x.array, comm) == 0.0
        assert largest(model.p.x.array - other.p.x.array, comm) == 0.0
    with pytest.raises(AssertionError, match="a second time"):
        fresh.build(kinematics="finite")


def test_groups_may_have_other_numbers(comm):
    """Forms hold the numbers of groups; those of another mesh are its own."""

    def turned(tags):
        return {name: max(tags.values()) + min(tags.values()) - tag for name, tag in tags.items()}

    domain = stack(comm, (7, 5), rows=4, levels=LEVELS, shift=0.1)
    arrays = domain.arrays()
    groups = {}
    for name in ("bodies", "surfaces"):
        tags = turned(getattr(arrays, name))
        groups |= {name: tags}
        which = "cell_groups" if name == "bodies" else "facet_groups"
        total = max(tags.values(), default=0) + min(tags.values(), default=0)
        groups[which] = (total - getattr(arrays, which)).astype(np.int32)
    mine = replace(arrays, **groups) if comm.rank == 0 else None
    other = hm.Domain.from_arrays(mine, comm, name="turned")
    assert other.bodies == {"block_0": 2, "block_1": 1}
    scene, answers = footing_drained(comm), []
    scene.load("right_0", pressure=1e2)
    for mesh in (domain, other):
        model = scene.build(mesh)
        for _ in hm.TimeStepping(model).run(1e3, 5e2):
            pass
        answers.append(evaluate(model.u, [(0.5, 0.3), (0.7, 0.8)]))
    np.testing.assert_allclose(*answers, rtol=1e-9)


@pytest.mark.mpi
def test_water_on_a_surface_of_several_bodies(comm):
    """A surface may lie on more bodies than one, and on layers; all of them must be porous."""
    arrays = stack(comm, [3, 4, 5]).arrays()
    tag = {name: value for name, value in arrays.surfaces.items() if name.startswith("left")}
    left = np.isin(arrays.facet_groups, list(tag.values()))
    arrays = replace(arrays, facet_groups=np.where(left, 4, arrays.facet_groups).astype(np.int32))
    mine = arrays if comm.rank == 0 else None
    layers = {"ground": ["block_0"], "cap": ["block_2"]}
    domain = hm.Domain.from_arrays(mine, comm, name="side", layers=layers)
    assert domain.bodies_of_surface("left_0") == ["ground", "block_1", "cap"]
    assert domain.bodies_of_surface("right_2") == ["cap"]
    assert domain.tags("cap") == domain.tags("block_2") == [3]
    with pytest.raises(ValueError, match="on the bodies 'ground' and 'block_1' and 'cap'"):
        domain.body_of_surface("left_0")
    scene = hm.Scene(domain)
    for name, k in (("ground", K), ("block_1", K), ("cap", None)):
        scene.body(name, SOIL, permeability=k)
    scene.inflow("left_0", 1e-9)
    with pytest.raises(ValueError, match="'left_0' is given an inflow, but body 'cap' is dry"):
        scene.build()


def fresh_model(comm, **mesh):
    """A model whose forms were compiled for its own mesh."""
    scene = footing_drained(comm)
    return scene.build(stack(comm, levels=LEVELS, shift=0.1, **mesh), kinematics="finite")


def test_remeshing_keeps_surfaces_that_are_moved_as_a_whole(comm):
    scene = footing_drained(comm)
    before, _ = run(scene, 5e2, 5e2, kinematics="finite", remesh=hm.Remeshing(keep=("left_0",)))
    assert scene.simulation.remeshing.keep == ("left_0", "bottom_0", "top_1")
    run(scene, 1e3, 5e2, remesh=hm.Remeshing(every=1, longest_edge=1.1))
    assert scene.simulation.records and scene.model is not before
    assert scene.domain is scene.simulation.domain is scene.model.domain
    assert scene.model.problem.n_unknowns["displacement"] > 140
    forces = [(s.iterations, scene.model.force("top_1")[1]) for s in scene.run(2e3, 5e2)]
    assert forces[-1][1] < forces[0][1] < -10.0
    scene.release("left_0")
    scene.build()
    scene.fix("top_1")
    scene.release("bottom_0")
    scene.fix("bottom_0", "y")
    before = scene.model
    scene.run(3e3, 5e2)
    assert scene.simulation.remeshing.keep == ("top_1",) and scene.model is not before


@pytest.mark.parametrize("flood", [{}, {"sealing": True, "lagged": True}])
def test_units_do_not_matter(comm, flood):
    """The same scene in N, m, s and in kN, mm, days."""
    answers = []
    for metre, second, newton in ((1.0, 1.0, 1.0), (1e3, 1.0 / 86400.0, 1e-3)):
        pascal = newton / metre**2
        domain = stack(
            comm,
            (7, 5),
            rows=4,
            levels=metre * np.array([0.0, 0.7, 1.0]),
            width=metre,
            shift=0.1 * metre,
        )
        scene = hm.Scene(domain)
        scene.water(GAMMA * newton / metre**3)
        clay = hm.Tresca(1e6 * pascal, 0.3, 5e3 * pascal)
        scene.body("block_0", clay, permeability=K * metre / second)
        scene.body("block_1", hm.LinearElastic(1e8 * pascal, 0.2))
        flow = hm.GapFlow(
            1e-9 * metre / second,
            viscosity=1e-3 * pascal * second,
            unit_weight=GAMMA * newton / metre**3,
            aperture_cap=1e-4 * metre,
            **flood,
        )
        scene.contact("bottom_1", "top_0", friction=FRICTION, flow=flow, name="base")
        scene.fix("bottom_0")
        scene.fix("left_0", "x")
        scene.move("top_1", x=0.0, y=lambda t, m=metre, s=second: -0.02 * m * t / (1e4 * s))
        scene.drain("top_0", 1e3 * pascal)
        model, iterations = run(scene, 1e3 * second, 5e2 * second, kinematics="finite")
        answers.append((iterations, model.force("top_1") / (newton / metre)))
    assert answers[0][0] == answers[1][0]
    np.testing.assert_allclose(*(a[1] for a in answers), rtol=1e-8, atol=1e-8 * 1e3)


def ends_of_steps(scene, t, lengths):
    """The models after steps of these lengths [s], each from the present state; collective."""
    model, simulation = scene.model, scene.simulation
    simulation.accept()
    start = model.save()
    for dt in lengths:
        model.restore(start)
        simulation.prescribe(t + dt, dt)
        model.solve()
        yield model


@pytest.mark.mpi
def test_water_is_conserved_and_a_rejected_step_undone_where_flow_lags(comm):
    scene = footing(comm, push=0.002)
    flow = hm.GapFlow(1e-9, aperture_cap=1e-4, sealing=True, lagged=True)
    scene.contact("bottom_1", "top_0", friction=FRICTION, flow=flow, name="base")
    scene.drain("bottom_0")
    # The block is lifted off, so gaps open and the next step's water flows through them.
    for _ in scene.run(1e3, 5e2, kinematics="finite"):
        model = scene.model
        appeared, moved = model.water_balance()
        assert abs(appeared) < 1e-9 * moved
        assert moved > model.contact("base").taken_up > 0.0
    ends = [
        [f.x.array.copy() for f in (model.u, model.p)]
        for model in ends_of_steps(scene, 1e3, (5e2, 9e2, 5e2))
    ]
    if comm.size == 1:
        assert all(map(np.array_equal, ends[0], ends[2]))
    else:
        for one, other in zip(ends[0], ends[2], strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-10 * largest(one, comm))
    assert not np.array_equal(ends[0][0], ends[1][0])


def risen(comm, metre=1.0, second=1.0, newton=1.0):
    """A block that leaves the corner of a base; its corner is dug out, and sees nothing of it."""
    domain = notch(comm, 5, 7, size=metre, dug=0.07)
    pascal = newton / metre**2
    scene = hm.Scene(domain)
    scene.water(GAMMA * newton / metre**3)
    soil = hm.LinearElastic(1e9 * pascal, 0.2)
    scene.body("base", soil, permeability=1e-4 * metre / second)
    scene.body("block", soil)
    flow = hm.GapFlow(
        1e-5 * metre / second,
        viscosity=1e-3 * pascal * second,
        unit_weight=GAMMA * newton / metre**3,
        aperture_cap=1e-4 * metre,
    )
    sight = hm.MortarOptions(largest_angle=10.0)
    scene.contact("base", "block", friction=FRICTION, flow=flow, mortar=sight, name="gap")
    scene.fix("base bottom")
    for surface in ("block left", "block top"):
        scene.move(
            surface,
            x=lambda t: -0.08 * metre * t / (1e3 * second),
            y=lambda t: 0.05 * metre * (t / (1e3 * second)) ** 2,
        )
    scene.drain("base left")
    scene.drain("base top")
    return scene


# Along both faces, and the corner between them that neither sees
AWAY = 0.08 * 0.95 + 0.05 * 0.92 + 0.08 * 0.05 + 0.07 / 7


@pytest.mark.mpi
def test_water_behind_corners_does_not_depend_on_units(comm):
    answers = []
    for units in ((1.0, 1.0, 1.0), (1e3, 1.0 / 86400.0, 1e-3)):
        metre, second, newton = units
        scene = risen(comm, *units)
        model, iterations = run(scene, 1e3 * second, 5e2 * second, kinematics="finite")
        state = model.contact("gap")
        assert state.volume / metre**2 == pytest.approx(AWAY, rel=1e-2)
        answers.append((iterations, state.volume / metre**2, state.taken_up / metre**2))
        answers[-1] += tuple(model.force("block top") / (newton / metre))
    assert answers[0][0] == answers[1][0]
    np.testing.assert_allclose(answers[0][1:], answers[1][1:], rtol=1e-8)


@pytest.mark.mpi
def test_a_rejected_step_leaves_nothing_in_the_water_behind_corners(comm):
    scene = risen(comm)
    for _ in scene.run(5e2, 2.5e2, kinematics="finite"):
        pass
    ends = []
    for model in ends_of_steps(scene, 5e2, (5e2, 2.5e2, 5e2, 2.5e2)):
        state = model.contact("gap")
        water = np.array([state.volume, state.taken_up, state.swept])
        ends.append([model.u.x.array.copy(), model.p.x.array.copy(), state.water_forces, water])
    for first, again in ((0, 2), (1, 3)):
        for one, other in zip(ends[first], ends[again], strict=True):
            np.testing.assert_allclose(one, other, rtol=0, atol=1e-10 * largest(one, comm))
    # By then the pattern of the matrix has all that it gets.
    if comm.size == 1:
        assert all(map(np.array_equal, ends[1], ends[3]))
    assert ends[0][-1][1] > 1.9 * ends[1][-1][1] > 0.0


@pytest.mark.mpi
def test_a_finer_tight_body_has_the_pressures_of_the_film(comm):
    """Nothing but the film leads the water of its face, and no coarse node sees all of it."""
    domain = stack(comm, (4, 11), rows=4)
    scene = hm.Scene(domain)
    scene.body("block_0", SOIL, permeability=1e-6)
    scene.body("block_1", hm.LinearElastic(3e10, 0.2), permeability=1e-14)
    flow = hm.GapFlow(1e-6, aperture_cap=3e-3, lagged=True)
    scene.contact("top_0", "bottom_1", friction=FRICTION, flow=flow, name="base")
    scene.fix("bottom_0")
    for surface in ("left_0", "left_1"):
        scene.fix(surface, "x")
    scene.move("top_1", y=lambda t: 2e-6 * t)
    scene.drain("right_0")
    for step in scene.run(1e4, 1e3, kinematics="finite"):
        assert step.iterations <= 5 and step.cuts == 0
        appeared, moved = scene.model.water_balance()
        assert abs(appeared) < 1e-6 * moved
    p = scene.model.p
    x = p.function_space.tabulate_dof_coordinates()
    facets = domain.facet_tags.find(domain.surface("bottom_1"))
    face = fem.locate_dofs_topological(p.function_space, 1, facets)
    parts = comm.allgather(np.column_stack([x[face, 0], p.x.array[face]]))
    along, pressures = np.unique(np.concatenate(parts).round(9), axis=0).T
    # Water comes in from the right, smoothly.
    assert len(along) == 12 and (np.diff(pressures) > 0.01).all() and pressures[-1] < 0.0


# --- words ----------------------------------------------------------------------------------------


def test_summary(comm):
    scene = footing(comm)
    scene.gravity()
    scene.body("block_0", SOIL, permeability=K, unit_weight=2e4)
    scene.drain("top_0", level=1.0)
    scene.load("right_0", traction=(0.0, lambda t: t))
    scene.inflow("bottom_0", 1e-9)
    assert scene.summary().splitlines() == [
        "stack",
        "bodies",
        "  block_0: porous, k = 1e-08 m/s, 20000 N/m^3; LinearElastic(E=1e+06, nu=0.2); 40 nodes",
        "  block_1: dry; LinearElastic(E=1e+08, nu=0.2); 30 nodes",
        "contacts",
        "  base: CoulombFriction(mu=0.3, cohesion=0), with friction rows; "
        "GapFlow(transverse_permeability=1e-09, viscosity=0.001, unit_weight=10000, "
        "aperture_cap=0.0001)",
        "unknowns: displacement 140, pore pressure 40",
        "prescribed",
        "  bottom_0: x 0 m",
        "  bottom_0: y 0 m",
        "  left_0: x 0 m",
        "  top_1: x 0 m",
        "  top_1: y f(t) m",
        "  right_0: traction (0, f(t)) Pa",
        "  top_0: free water, level 1 m outside the gap",
        "  bottom_0: inflow 1e-09 m/s",
        "  gravity: (0, -1)",
    ]
    model = scene.build()
    assert model.problem.n_unknowns == {"displacement": 140, "pore pressure": 40}


def test_summary_names_what_is_switched_on(comm):
    scene, flow = footing(comm), hm.GapFlow(1e-9, lagged=True)
    scene.contact("bottom_1", "top_0", friction=FRICTION, flow=flow, name="base")
    assert "unit_weight=10000, lagged)" in scene.summary()


STATEMENTS = {
    "unknown body 'clay'; known: block_0, block_1": lambda s: s.body("clay", SOIL),
    "has no method update": lambda s: s.body("block_0", 1e6),
    r"permeability of body 'block_0' is -1": lambda s: s.body("block_0", SOIL, permeability=-1.0),
    "permeability of body 'block_0' is": lambda s: s.body(
        "block_0", SOIL, permeability=[[1.0, 2.0], [2.0, 1.0]]
    ),
    "unit_weight of body 'block_0' is -1": lambda s: s.body("block_0", SOIL, unit_weight=-1.0),
    "tau of body 'block_0' is": lambda s: s.body("block_0", SOIL, tau=np.nan),
    "needs one that is positive: give shear_modulus": lambda s: s.body(
        "block_0", Rigid(), permeability=K
    ),
    "unknown surface 'side'; known: bottom_0": lambda s: s.contact("side", "top_0"),
    "surface 'top_0' cannot meet itself": lambda s: s.contact("top_0", "top_0"),
    "unknown option 'frictoin'; known: friction, flow, mortar": lambda s: s.contact(
        "bottom_1", "top_0", frictoin=FRICTION
    ),
    "contact 'bottom_1/top_0': motion is 'large'": lambda s: s.contact(
        "bottom_1", "top_0", motion="large"
    ),
    "unknown surface 'side'": lambda s: s.fix("side"),
    """directions of surface 'top_1' are "x", "y" or "xy", not 'z'""": lambda s: s.fix(
        "top_1", "z"
    ),
    "surface 'top_1' is moved in no direction": lambda s: s.move("top_1"),
    "the displacement y of surface 'top_1' is nan; it must be": lambda s: s.move("top_1", y=np.nan),
    "must be either a pressure or a traction": lambda s: s.load("top_1"),
    "'top_1' must be either a pressure or a": lambda s: s.load(
        "top_1", pressure=1.0, traction=(0.0, 1.0)
    ),
    "traction on surface 'top_1' needs two components": lambda s: s.load("top_1", traction=(1.0,)),
    "has pressure and level: give one": lambda s: s.drain("top_0", 1.0, level=2.0),
    "field of pressures at surface 'top_0' must be a function": lambda s: s.drain(
        "top_0", field=1.0
    ),
    "the inflow through surface 'top_0' is 'rain'": lambda s: s.inflow("top_0", "rain"),
    "nothing holds, loads or drains surface 'right_1'": lambda s: s.release("right_1"),
    "the traction on surface 'top_1' needs two components, not 5.0": lambda s: s.load(
        "top_1", traction=5.0
    ),
    "the direction of gravity is (0.0, 0.0)": lambda s: s.gravity((0.0, 0.0)),
    "the direction of gravity is (0.0, 0.0, -1.0)": lambda s: s.gravity((0.0, 0.0, -1.0)),
    "unit weight of water is 0": lambda s: s.water(0.0),
}


class Rigid:
    """A law that does not say how stiff it is."""

    history_names = ()

    def initial_history(self, n):
        return np.zeros((n, 0))

    def update(self, stress, strain, history):
        raise NotImplementedError


@pytest.mark.parametrize("message", STATEMENTS)
def test_statements_that_are_refused(comm, message):
    scene = footing(comm)
    with pytest.raises(ValueError, match=message.replace("(", r"\(").replace(")", r"\)")):
        STATEMENTS[message](scene)


def reweigh(scene):
    scene.gravity()
    scene.body("block_0", SOIL, permeability=K, unit_weight=1.0)


def redo(scene, **options):
    scene.contact("bottom_1", "top_0", **{"friction": FRICTION, "name": "base"} | options)


TOGETHER = {
    "there is gravity, but no body has a unit_weight or is porous": [
        lambda s: s.body("block_0", SOIL),
        lambda s: s.gravity(),
    ],
    "there is no gravity: scene.gravity": [lambda s: s.body("block_1", SOIL, unit_weight=1.0)],
    "the load on surface 'top_1' does nothing": [lambda s: s.load("top_1", pressure=1.0)],
    "'bottom_1' is fixed or moved and the secondary surface of contact 'base': swap": [
        lambda s: s.move("bottom_1", y=1.0)
    ],
    "surface 'top_1' is drained, but body 'block_1' is dry": [lambda s: s.drain("top_1")],
    "'top_1' is given an inflow, but body 'block_1' is dry": [lambda s: s.inflow("top_1", 1.0)],
    "surface 'left_0' has both an inflow and a drain": [
        lambda s: s.drain("left_0"),
        lambda s: s.inflow("left_0", 1.0),
    ],
    "level of water at surface 'left_0' needs scene.gravity": [
        lambda s: s.drain("left_0", level=1)
    ],
    "contact 'base' has no flow law that says": [redo, lambda s: s.drain("top_0")],
    "is drained and tied by contact 'base'": [
        lambda s: redo(s, friction=hm.Tied()),
        lambda s: s.drain("top_0"),
    ],
    "contact 'base' has free water outside twice": [
        lambda s: redo(s, flow=hm.GapFlow(1e-9, outside=0.0)),
        lambda s: s.drain("top_0"),
    ],
    "both surfaces of contact 'base' are drained": [
        lambda s: s.body("block_1", SOIL, permeability=K),
        lambda s: s.drain("top_0"),
        lambda s: s.drain("bottom_1"),
    ],
    "has a flow law, but the bodies 'block_1' and 'block_0' are dry": [
        lambda s: s.body("block_0", SOIL)
    ],
    "water weighs 10000 N/m^3 in contact 'base' and 9810": [lambda s: s.water(9810.0)],
    "gravity in the gap of contact 'base' is (1.0, 0.0), that of the scene (-0.0, -1.0)": [
        reweigh,
        lambda s: s.gravity((-0.0, -2.0)),
        lambda s: redo(s, flow=hm.GapFlow(1e-9, gravity=(1.0, 0.0))),
    ],
    "body 'block_1' is dry and has no initial pore pressure": [
        lambda s: s.initial_pressure("block_1", 0.0)
    ],
    "initial state is that of body 'clay', which is unknown": [
        lambda s: s.initial_stress("clay", np.zeros)
    ],
    "the initial pore pressure of body 'block_0' must have shape": [
        lambda s: s.initial_pressure("block_0", lambda x: x)
    ],
}


@pytest.mark.parametrize("message", TOGETHER)
def test_statements_that_do_not_go_together(comm, message):
    scene = footing(comm)
    for statement in TOGETHER[message]:
        statement(scene)
    pattern = message.replace("(", r"\(").replace(")", r"\)").replace("^", r"\^")
    with pytest.raises(ValueError, match=pattern):
        scene.build()


def test_runs_that_are_refused(comm):
    with pytest.raises(ValueError, match=r"body 'block_0' has no material: scene.body\('block_0'"):
        hm.Scene(stack(comm, [2])).build()
    scene = footing(comm)
    with pytest.raises(RuntimeError, match=r"no model before scene\.run"):
        _ = scene.model
    for words, options in [
        ("kinematics is 'large'", {"kinematics": "large"}),
        ("finite kinematics does not go with", {"kinematics": "finite", "smoothing": "deviatoric"}),
        ("remesh goes with finite strain", {"remesh": hm.Remeshing()}),
        (
            "remesh goes with smoothing",
            {"remesh": hm.Remeshing(), "kinematics": "finite", "smoothing": "triangles"},
        ),
    ]:
        with pytest.raises(ValueError, match=words):
            scene.run(1.0, 1.0, **options)
    run(scene, 1e3, 1e3)
    for words, statement in [
        ("a body must be stated before the first run", lambda: scene.body("block_0", SOIL)),
        ("a contact must be stated", lambda: scene.contact("right_1", "top_0")),
        ("steps and start are those of the first", lambda: scene.run(2e3, 1e3, start=1.0)),
        ("the same in all runs", lambda: scene.run(2e3, 1e3, kinematics="finite")),
        ("unknown contact 'side'; known: base", lambda: scene.model.contact("side")),
        ("no material has a history 'kappa'", scene.model.nodal_history),
    ]:
        with pytest.raises(ValueError, match=words):
            statement()
    scene.load("right_0", pressure=lambda t: 0.0 if t < 1.5e3 else np.nan)
    with pytest.raises(ValueError, match=r"pressure on surface 'right_0' is \[nan\] at t = 2000 s"):
        run(scene, 2e3, 1e3)


@pytest.mark.mpi
@FINITE
def test_refused_statements_are_refused_until_they_are_taken_back(comm, kinematics):
    """What a run refuses leaves model and options as they were, and is not forgotten."""
    scene = footing(comm)
    scene.drain("bottom_0")
    before, _ = run(scene, 1e3, 1e3, kinematics=kinematics)
    u = before.u.x.array.copy()
    scene.drain("top_1")
    for _ in range(2):
        with pytest.raises(ValueError, match="surface 'top_1' is drained, but body"):
            scene.run(2e3, 1e3, newton=hm.NewtonOptions(1e-6))
    scene.release("top_1")
    scene.fix("top_1")
    scene.load("right_0", pressure=lambda t: np.nan)
    for _ in range(2):
        with pytest.raises(ValueError, match=r"surface 'right_0' is .* at t = 1000 s"):
            scene.run(2e3, 1e3, newton=hm.NewtonOptions(1e-6))
    assert scene.model is before and np.array_equal(before.u.x.array, u)
    scene.release("right_0")
    model, _ = run(scene, 2e3, 1e3)
    assert model.problem.newton == hm.NewtonOptions()


@pytest.mark.mpi
def test_pressures_of_other_bodies_are_refused(comm):
    scene = footing(comm)
    run(scene, 1e3, 1e3)
    u = scene.model.u.x.array.copy()
    for pressure, words in (
        ({"block_0": 1.0, "nobody": 1.0}, "that of body 'nobody', which is unknown"),
        ({"block_1": 1.0}, "body 'block_1' is dry and has no initial"),
    ):
        for statement in (scene.reset_displacements, scene.model.set_pressure):
            with pytest.raises(ValueError, match=words):
                statement(pressure)
    assert np.array_equal(scene.model.u.x.array, u) and np.abs(u).max(initial=0.0) > 0.0


@pytest.mark.mpi
def test_water_weighs_in_ground_without_weight(comm):
    """Gravity may be that of the water alone, which is at rest below its level."""
    scene = column(stack(comm, [4], rows=4), 0.0)
    scene.gravity()
    scene.drain("top_0", level=3.0)
    model, _ = run(scene, 4e10, 1e10)
    np.testing.assert_allclose(evaluate(model.p, [(0.5, 0.25)]), 2.75 * GAMMA, rtol=1e-6)


@pytest.mark.mpi
def test_body_that_nothing_holds_is_named(comm):
    scene = hm.Scene(stack(comm, [3]))
    scene.body("block_0", SOIL)
    scene.fix("bottom_0", "y")
    scene.load("top_0", traction=(1.0, 0.0))
    with pytest.raises(hm.TimeSteppingError, match="block_0"):
        run(scene, 1.0, 1.0)


def test_page_of_the_manual_runs(comm):
    pytest.importorskip("gmsh")
    page = (Path(__file__).parents[1] / "docs" / "scene.md").read_text()
    first, second = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    names = {}
    exec(first, names)
    # Nodes and unknowns are those of the present gmsh.
    kinds = {line.split(":")[0] for line in page.splitlines() if line.startswith("    ")}
    for line in names["scene"].summary().splitlines()[1:]:
        assert "    " + line.split(":")[0] in kinds
    assert names["load"] == pytest.approx(4.156e4, rel=0.03)
    assert names["water"] == pytest.approx(1.1e-4, rel=0.1)
    exec(second, names)
    assert names["scene"].simulation.t == 8000.0


@pytest.mark.mpi
def test_stages_of_an_excavation(comm):
    """Weight comes to rest, the design geometry is restored, and the upper layer dug off."""
    arrays = stack(comm, (4,), rows=8).arrays()
    if comm.rank == 0:
        high = arrays.points[arrays.cells, 1].mean(axis=1) > 0.5
        groups, bodies = np.where(high, 2, 1).astype(np.int32), {"lower": 1, "upper": 2}
        arrays = replace(arrays, cell_groups=groups, bodies=bodies)
    layers = {"soil": ["lower", "upper"]}
    mine = arrays if comm.rank == 0 else None
    scene = hm.Scene(hm.Domain.from_arrays(mine, comm, name="column", layers=layers))
    law = hm.LinearElastic(1e7, 0.2)
    scene.body("soil", law, permeability=1e-6, unit_weight=2e4)
    scene.gravity()
    scene.fix("bottom_0", "y")
    for side in ("left_0", "right_0"):
        scene.fix(side, "x")
    scene.drain("top_0", level=1.0)
    with pytest.raises(RuntimeError, match="remove comes after the first run"):
        scene.remove("upper", "floor")
    for _ in scene.run(1e9, 1e9, kinematics="finite"):
        pass
    scene.reset_displacements(pressure={"soil": lambda x: 1e4 * (1.0 - x[1])})
    assert np.abs(scene.model.u.x.array).max(initial=0.0) == 0.0
    scene.remove("upper", "floor")
    scene.drain("floor", level=1.0)
    scene.load("floor", pressure=5e3)
    for _ in scene.run(2e9, 1e9):
        pass
    # What the effective weight of half a metre pressed together springs back.
    heave = 0.5 * 1e4 * 0.5 / law.oedometric_modulus
    u = scene.model.u.x.array[1::2]
    assert comm.allreduce(float(u.max(initial=0.0)), MPI.MAX) == pytest.approx(heave, rel=0.02)
    assert set(scene.domain.surfaces) == {"bottom_0", "left_0", "right_0", "floor"}


def two_apart(comm, weights):
    """Two dry blocks that have nothing to do with each other, the lower one of one layer."""
    arrays = stack(comm, [3, 4]).arrays()
    mine = arrays if comm.rank == 0 else None
    domain = hm.Domain.from_arrays(mine, comm, name="apart", layers={"ground": ["block_0"]})
    scene = hm.Scene(domain)
    for k, name in enumerate(("ground", "block_1")):
        scene.body(name, SOIL, unit_weight=weights[k])
        scene.fix(f"bottom_{k}")
    scene.gravity()
    run(scene, 1.0, 1.0)
    return scene


@pytest.mark.mpi
def test_last_layer_takes_its_body_along(comm):
    scene = two_apart(comm, (1e3, 1e3))
    scene.remove("block_0", "floor")
    model, _ = run(scene, 2.0, 1.0)
    assert list(model.stresses) == ["block_1"] and "ground" not in scene.summary()
    np.testing.assert_allclose(model.force("bottom_1"), (0.0, 500.0), atol=1e-9)


@pytest.mark.mpi
def test_refused_removal_leaves_the_scene_as_it_was(comm):
    scene = two_apart(comm, (1e3, 0.0))
    before, model = scene.summary(), scene.model
    for words, group, over in (
        ("the removal of 'block_0' lays no surface 'floor' bare", "block_0", 1.0),
        ("there is gravity, but no body has a unit_weight", "block_0", 0.0),
        ("'ground' has no tag of its own, its layers have: block_0", "ground", 0.0),
        ("unknown body 'clay'; known: block_0, block_1", "clay", 0.0),
    ):
        with pytest.raises(ValueError, match=words):
            scene.remove(group, "floor", over=over)
    assert scene.summary() == before
    run(scene, 2.0, 1.0)
    assert scene.model is model
    np.testing.assert_allclose(model.force("bottom_0"), (0.0, 500.0), atol=1e-9)


@pytest.mark.mpi
def test_scene_goes_on_from_a_checkpoint(comm, shared_tmp_path):
    """A scene stopped and restarted gives the figures of one that went on."""

    def scene():
        result = hm.Scene(stack(comm, (4,), rows=4))
        result.body("block_0", hm.Tresca(E=1e6, nu=0.3, c=3e4), permeability=1e-6)
        result.fix("bottom_0", "xy")
        result.move("top_0", x=0.0, y=lambda t: -1e-3 * t)
        result.drain("top_0")
        return result

    one, file = scene(), shared_tmp_path / "scene.checkpoint"
    for _ in one.run(3.0, 1.0, kinematics="finite", remesh=hm.Remeshing()):
        pass
    one.write_checkpoint(file)
    went_on = [one.model.force("top_0") for _ in one.run(5.0, 1.0)]
    other = scene()
    other.restart(file, kinematics="finite", remesh=hm.Remeshing())
    model = other.model
    again = [other.model.force("top_0") for _ in other.run(5.0, 1.0)]
    assert np.allclose(again, went_on, rtol=1e-10)
    assert other.model is model and other.simulation.remeshing == one.simulation.remeshing
    assert other.simulation.remeshing.keep == ("bottom_0", "top_0")
    with pytest.raises(TypeError, match="unexpected keyword argument 'start'"):
        scene().restart(file, start=1.0)
    with pytest.raises(RuntimeError, match="before the first run"):
        other.restart(file)
