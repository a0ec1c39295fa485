# SPDX-License-Identifier: LGPL-3.0-or-later
"""Compiling a model once, and using it on another mesh."""

import gc
import weakref

import numpy as np
import pytest
import ufl
from dolfinx import fem

import fenicsx_hmcontact as hm
from fenicsx_hmcontact import _compat
from fenicsx_hmcontact.model import compile_model
from tests.models import LOAD, MATERIAL, K, contact_pairs, fix, loads, stack

FLOW = hm.GapFlow(1e-9, aperture=1e-4)


class Scene:
    """Functions, constants, tags, pairs and conditions of a model on one mesh."""

    def __init__(self, comm, across, slope):
        self.domain = domain = stack(comm, across, slope=slope)
        domain.mesh.topology.create_connectivity(1, 2)
        self.V, self.Q = (fem.functionspace(domain.mesh, ("P", 1, s)) for s in ((2,), ()))
        self.u = fem.Function(self.V, name="displacement")
        self.p = fem.Function(self.Q, name="pore pressure")
        self.u_n, self.p_n = fem.Function(self.V), fem.Function(self.Q)
        self.dt = fem.Constant(domain.mesh, 100.0)
        self.load = fem.Constant(domain.mesh, (0.2 * LOAD, -LOAD))
        self.p_n.interpolate(lambda x: 100 * np.sin(3 * x[0] + x[1]))
        self.bcs = [fix(domain, self.V.sub(i), "bottom_0") for i in (0, 1)]
        self.bcs += [fix(domain, self.Q, "top_1")]
        self.pairs = contact_pairs(domain, [("bottom_1", "top_0", FLOW)])

    def residual(self, smoothing="deviatoric"):
        v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(self.V, self.Q))
        dc = hm.node_cells_measure(smoothing)
        F = hm.equilibrium(MATERIAL.stress(self.u), self.p, v, smoothed=dc)
        F += loads(self.domain, v, {"top_1": self.load})
        F += hm.water_balance(
            self.u, self.u_n, self.p, q, self.dt, permeability=K, unit_weight=1e4, smoothed=dc
        )
        return F + hm.pressure_projection(self.p, self.p_n, q, MATERIAL.shear_modulus)

    def data(self):
        """What forms refer to besides the unknowns."""
        return [self.u_n, self.p_n, self.dt, self.load, self.domain.facet_tags]

    def problem(self, residual, **options):
        return hm.ContactProblem(
            residual,
            [self.u, self.p],
            bcs=self.bcs,
            pairs=self.pairs,
            time_step=self.dt,
            **options,
        )


def refuse(*arguments, **options):
    raise AssertionError("compiled a second time")


@pytest.mark.mpi
@pytest.mark.parametrize("smoothing", ["deviatoric", "triangles"])
def test_reused_model_is_the_fresh_one_bit_for_bit(comm, monkeypatch, smoothing):
    old = Scene(comm, (3, 5), 0.0)
    problem = old.problem(old.residual(smoothing))
    problem.solve()
    before = old.u.x.array.copy()

    fresh, rebound = (Scene(comm, (7, 4), 0.2) for _ in range(2))
    fresh_problem = fresh.problem(fresh.residual(smoothing))
    monkeypatch.setattr(_compat, "compile_forms", refuse)
    replace = dict(zip(old.data(), rebound.data(), strict=True))
    rebound_problem = rebound.problem(problem.model, replace=replace)
    assert rebound_problem.model is problem.model
    for dt in (100.0, 30.0):
        for scene, p in ((fresh, fresh_problem), (rebound, rebound_problem)):
            scene.dt.value = dt
            p.solve()
            scene.u_n.x.array[:] = scene.u.x.array
            scene.p_n.x.array[:] = scene.p.x.array
    assert np.abs(fresh.p.x.array).max() > 0.1 * LOAD or comm.size > 1
    np.testing.assert_array_equal(rebound.u.x.array, fresh.u.x.array)
    np.testing.assert_array_equal(rebound.p.x.array, fresh.p.x.array)
    assert rebound_problem.n_factorisations == fresh_problem.n_factorisations == 2
    # The old problem has kept its mesh and data.
    np.testing.assert_array_equal(old.u.x.array, before)
    old.load.value *= 2.0
    problem.solve()
    assert comm.allreduce(float(np.abs(old.u.x.array - before).max(initial=0.0))) > 0


@pytest.mark.mpi
def test_everything_is_compiled_in_one_module(comm, monkeypatch):
    calls = []
    compile_forms = _compat.compile_forms

    def count(*arguments):
        calls.append(arguments)
        return compile_forms(*arguments)

    monkeypatch.setattr(_compat, "compile_forms", count)
    scene = Scene(comm, (3, 4), 0.1)
    scene.problem(scene.residual())
    assert len(calls) == 1


def test_tangent_coefficients_leave_out_what_is_linear(comm):
    scene = Scene(comm, (2, 2), 0.0)
    model = compile_model(scene.residual(), [scene.u, scene.p])
    assert model.tangent_coefficients == [scene.dt]
    assert model.is_smoothed
    assert not compile_model(scene.residual("triangles"), [scene.u, scene.p]).is_smoothed
    v = ufl.TestFunction(scene.Q)
    cubic = (scene.p**3 + scene.p_n) * v * ufl.dx
    assert compile_model(cubic, [scene.p]).tangent_coefficients == [scene.p]


@pytest.mark.mpi
def test_refuses_another_number_of_unknowns(comm):
    scene = Scene(comm, (2, 3), 0.0)
    problem = scene.problem(scene.residual())
    with pytest.raises(ValueError, match="the model has 2 unknowns, 1 were given"):
        hm.ContactProblem(problem.model, scene.u)


def test_a_solved_problem_leaves_nothing_behind(comm):
    """A kept mesh keeps its communicators, of which MPI has about two thousand."""

    def solve():
        scene = Scene(comm, (4, 6), 0.2)
        problem = hm.ContactProblem(
            scene.residual(),
            [scene.u, scene.p],
            bcs=scene.bcs,
            pairs=scene.pairs,
            time_step=scene.dt,
        )
        problem.solve()
        return weakref.ref(scene.domain.mesh)

    mesh = solve()
    gc.collect()
    assert mesh() is None
