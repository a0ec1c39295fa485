# SPDX-License-Identifier: LGPL-3.0-or-later
"""Soil that is removed over a time: what it carried is taken off evenly."""

import numpy as np
import pytest
from dolfinx import fem

import fenicsx_hmcontact as hm
from tests.test_simulation import layered

pytestmark = pytest.mark.mpi
E, NU, WEIGHT = 1e6, 0.2, 2e4


def dug(comm, over, kinematics="small", permeability=None):
    """A column at rest under its weight, whose upper half is removed."""
    scene = hm.Scene(layered(comm))
    soil = hm.LinearElastic(E, NU)
    scene.body("soil", soil, permeability=permeability, unit_weight=WEIGHT)
    scene.gravity()
    scene.fix("bottom_0", "y")
    for side in ("left_0", "right_0"):
        scene.fix(side, "x")
        if permeability is not None:
            scene.drain(side)
    for _ in scene.run(0.0, dt=1e9, start=-1e9, kinematics=kinematics):
        pass
    scene.reset_displacements()
    scene.remove("upper", "floor", over=over)
    return scene


def heave(scene):
    """Mean displacement of the floor upwards [m]."""
    model = scene.model
    V = model.u.function_space
    dofs = fem.locate_dofs_topological(V.sub(1), 1, model.domain.facets("floor"))
    owned = dofs[dofs < 2 * V.dofmap.index_map.size_local]
    total = model.u.x.array[owned].sum(), owned.size
    total, n = scene.domain.mesh.comm.allreduce(np.array(total))
    return total / n


def test_load_of_removed_soil_comes_off_evenly(comm):
    """Linear elastic, small strain: heave in proportion to the time, and all of it at the end."""
    at_once = dug(comm, 0.0)
    for _ in at_once.run(100.0, dt=100.0):
        pass
    full = heave(at_once)
    slowly = dug(comm, 100.0)
    parts = []
    for _ in slowly.run(200.0, dt=25.0):
        parts.append(heave(slowly) / full)
    # Cells of the nodes next to the floor have changed: what that does is no load.
    np.testing.assert_allclose(parts[:3], [0.25, 0.5, 0.75], atol=5e-3)
    np.testing.assert_allclose(parts[3:], 1.0, rtol=1e-9)


def test_traction_is_carried_to_other_meshes_and_supports(comm):
    """Rebuilt, and with other statements, the unloading goes on as it was."""
    scene = dug(comm, 100.0, "finite", 1e-6)
    plain = dug(comm, 100.0, "finite", 1e-6)
    for run in (scene, plain):
        for _ in run.run(50.0, dt=25.0):
            pass
    scene.simulation.rebuild()
    scene.drain("bottom_0")
    scene.release("bottom_0")
    scene.fix("bottom_0", "y")
    for run in (scene, plain):
        for _ in run.run(100.0, dt=25.0):
            pass
    assert heave(scene) == pytest.approx(heave(plain), rel=1e-6)


def held_traction(scene):
    """Traction held on the floor by its coordinates, of all ranks; (n, 2) each."""
    model = scene.model
    V, traction = model.u.function_space, model.saved["traction on floor"]
    facets = model.domain.facet_tags.find(model.domain.surface("floor"))
    nodes = fem.locate_dofs_topological(V, 1, facets)
    x, values = V.tabulate_dof_coordinates()[nodes, :2], traction.x.array.reshape(-1, 2)[nodes]
    return (np.concatenate(model.comm.allgather(part)) for part in (x, values))


def test_what_loads_carry_is_not_held(comm):
    """A pressure on the side balances the stress there: nothing is left for the floor to hold."""
    pressure = 1e5
    scene = hm.Scene(layered(comm))
    scene.body("soil", hm.LinearElastic(E, 0.0), unit_weight=WEIGHT)
    scene.gravity()
    scene.fix("bottom_0", "y")
    scene.fix("left_0", "x")
    scene.load("right_0", pressure=pressure)
    for _ in scene.run(0.0, dt=1.0, start=-1.0):
        pass
    scene.remove("upper", "floor", over=100.0)
    x, held = held_traction(scene)
    free = x[:, 0] > 0.01
    assert np.abs(held[free, 0]).max() < 1e-3 * pressure
    np.testing.assert_allclose(held[:, 1].mean(), -0.5 * WEIGHT, rtol=0.05)


def test_half_is_left_to_hold_after_half_the_time(comm):
    """What a surface holds already is not counted among the forces that it has to hold."""
    scene = dug(comm, 100.0)
    _, before = held_traction(scene)
    for _ in scene.run(50.0, dt=25.0):
        pass
    scene.model.hold("floor")
    _, after = held_traction(scene)
    np.testing.assert_allclose(after[:, 1], 0.5 * before[:, 1], rtol=1e-6)


@pytest.mark.parametrize("over", [-1.0, float("inf"), float("nan")])
def test_times_that_make_no_sense_are_refused(comm, over):
    scene = dug(comm, 0.0)
    with pytest.raises(ValueError, match="the time in which 'lower' is removed"):
        scene.remove("lower", "bottom", over=over)
