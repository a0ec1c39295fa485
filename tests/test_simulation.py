# SPDX-License-Identifier: LGPL-3.0-or-later
"""Runs that remesh, are stopped and go on: what is carried, and what may not change."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.domain import gather_states
from fenicsx_hmcontact.remeshing import areas, remesh
from tests.models import fix, stack, total

FLOW = hm.GapFlow(transverse_permeability=1e-6, unit_weight=1e4, outside=0.0)
TRESCA = hm.Tresca(E=1e6, nu=0.3, c=5e3)


class Blocks(hm.TransientModel):
    """One or two porous blocks at finite strain; the top is pushed down and dragged along."""

    friction = hm.CoulombFriction(mu=0.3)

    def __init__(self, domain, *, speed=(0.004, -0.002), porous=True, law=TRESCA, flow=FLOW):
        mesh = domain.mesh
        self.domain, n = domain, len(domain.bodies)
        V, Q = fem.functionspace(mesh, ("P", 1, (2,))), fem.functionspace(mesh, ("P", 1))
        self.u, self.u_n = fem.Function(V, name="displacement"), fem.Function(V)
        self.p, self.p_n = fem.Function(Q, name="pore pressure"), fem.Function(Q)
        dt = fem.Constant(mesh, 1.0)
        self.stress = hm.MaterialStress(
            law, self.u, self.u_n, hm.node_cells_measure("full"), kinematics="finite"
        )
        stress, deformation = self.stress.stress, self.stress.deformation
        measure = self.stress.measure
        spaces = ufl.MixedFunctionSpace(*((V, Q) if porous else (V,)))
        v, *q = ufl.TestFunctions(spaces)
        p = self.p if porous else None
        F = hm.finite_strain.equilibrium(
            stress, deformation, self.u, self.u_n, p, v, smoothed=measure
        )
        drive = fem.Constant(mesh, np.zeros(2))
        bcs = [fix(domain, V, "bottom_0", np.zeros(2)), fix(domain, V, f"top_{n - 1}", drive)]
        unknowns, previous = [self.u], []
        if porous:
            F += hm.finite_strain.water_balance(
                self.u, self.u_n, p, q[0], dt, permeability=1e-7, unit_weight=1e4, smoothed=measure
            )
            F += hm.pressure_projection(p, self.p_n, q[0], TRESCA.shear_modulus, tau=1.0)
            unknowns, previous = [self.u, self.p], [(self.p_n, self.p)]
            bcs.append(fix(domain, Q, f"top_{n - 1}"))
        self.pairs = [
            hm.ContactPair(
                domain.facet_tags,
                domain.surface(f"bottom_{k + 1}"),
                domain.surface(f"top_{k}"),
                self.friction,
                flow=flow if porous else None,
            )
            for k in range(n - 1)
        ]
        problem = hm.ContactProblem(
            F, unknowns, bcs=bcs, pairs=self.pairs, time_step=dt if porous else None, domain=domain
        )
        super().__init__(
            problem,
            dt,
            previous,
            histories=[(drive, lambda t: np.multiply(speed, t))],
            follow=lambda: problem.move_mesh(self.u, self.u_n),
        )

    def force(self):
        """What moves the top, and the water that leaves there."""
        surface = f"top_{len(self.domain.bodies) - 1}"
        forces = total(self.problem.reactions(self.u), self.domain, surface)
        if len(self.problem.unknowns) == 1:
            return forces
        water = total(self.problem.reactions(self.p), self.domain, surface)
        return np.append(forces, water)


class LaggedBlocks(Blocks):
    """The same, with friction by the pressures of the step's start."""

    friction = hm.CoulombFriction(mu=0.3, lagged=True)


def two_blocks(comm, **options):
    """A domain of two blocks that do not match, the upper one narrower by its shift."""
    return stack(comm, (6, 5), rows=4, shift=0.05, **options)


def forces(simulation, times, dt=1.0):
    """Forces of all steps; shape (steps, 2 or 3)."""
    return np.array([simulation.model.force() for _ in simulation.run(times, dt)])


def nodes_of(simulation):
    """Everything that nodes hold, on rank 0."""
    model = simulation.model
    whole = gather_states(model.comm, model.nodal_state(), len(simulation.domain.arrays().points))
    return {(name, key): array for name, s in whole.items() for key, array in s.nodal.items()}


def same(one, other):
    """Whether arrays are equal bit for bit, nan included."""
    return one.keys() == other.keys() and all(
        np.array_equal(one[key], other[key], equal_nan=True) for key in one
    )


@pytest.mark.mpi
@pytest.mark.parametrize("porous", [False, True])
def test_built_anew_on_the_same_mesh_nothing_changes(comm, porous):
    """All that the nodes hold is equal to the last bit, and the next steps to round-off."""

    def build(domain):
        return Blocks(domain, porous=porous)

    still = forces(hm.Simulation(build, two_blocks(comm)), 8.0)
    simulation = hm.Simulation(build, two_blocks(comm), hm.Remeshing())
    first = forces(simulation, 5.0)
    before, arrays = nodes_of(simulation), simulation.domain.arrays()
    simulation.rebuild()
    after = simulation.domain.arrays()
    assert same(before, nodes_of(simulation))
    assert np.array_equal(arrays.points, after.points)
    assert np.array_equal(arrays.cells, after.cells)
    rest = forces(simulation, 8.0)
    assert np.abs(np.concatenate([first, rest]) - still).max() <= 1e-9 * np.abs(still).max()


@pytest.mark.mpi
@pytest.mark.parametrize("blocks", [Blocks, LaggedBlocks])
def test_restart_goes_on_to_the_last_bit(comm, shared_tmp_path, blocks):
    """A run that writes a checkpoint and one begun from it give the same figures.

    On several ranks MUMPS adds up as messages come in: the last digits may differ between any two
    runs there, and only what the file holds is the same to the last bit.
    """
    file = shared_tmp_path / "run.checkpoint"
    options = hm.Remeshing(every=3)
    simulation = hm.Simulation(blocks, two_blocks(comm), options)
    forces(simulation, 4.0)
    simulation.write_checkpoint(file)
    held = nodes_of(simulation)
    went_on = forces(simulation, 8.0)
    again = hm.Simulation.restart(file, blocks, comm, options)
    assert again.t == 4.0 and again.n_steps == 4
    assert [r.step for r in again.records] == [r.step for r in simulation.records][
        : len(again.records)
    ]
    assert same(nodes_of(again), held)
    goes_on = forces(again, 8.0)
    if comm.size == 1:
        assert np.array_equal(goes_on, went_on)
        assert same(nodes_of(again), nodes_of(simulation))
    assert np.abs(goes_on - went_on).max() <= 1e-10 * np.abs(went_on).max()
    assert len(again.records) == len(simulation.records) > 0


@pytest.mark.mpi
def test_restart_on_another_number_of_ranks(comm, shared_tmp_path):
    """Every rank goes on alone with the file of all ranks; the figures agree to round-off."""
    file = shared_tmp_path / "run.checkpoint"
    simulation = hm.Simulation(Blocks, two_blocks(comm), hm.Remeshing(every=2))
    forces(simulation, 3.0)
    simulation.write_checkpoint(file)
    went_on = forces(simulation, 6.0)
    alone = hm.Simulation.restart(file, Blocks, MPI.COMM_SELF, hm.Remeshing(every=2))
    assert np.abs(forces(alone, 6.0) - went_on).max() <= 1e-8 * np.abs(went_on).max()


@pytest.mark.mpi
def test_remesh_keeps_what_old_nodes_know(comm):
    """Old nodes hold the same to the last bit, new ones what lies between their parents."""
    simulation = hm.Simulation(Blocks, two_blocks(comm))
    forces(simulation, 4.0)
    simulation.remeshing = finer()
    old, arrays, n = nodes_of(simulation), simulation.domain.arrays(), len(simulation.domain.bodies)
    sizes = simulation._sizes
    simulation.remesh({f"block_{k}": ["finer"] for k in range(n)})
    new = nodes_of(simulation)
    assert len(simulation.records) == 1
    if comm.rank > 0:
        return
    result = remesh(arrays, sizes, finer())
    kept = result.transfer.kept
    assert 0 < len(result.sizes) - len(kept)
    for key, values in old.items():
        assert np.array_equal(new[key][: len(kept)], values[kept], equal_nan=True)
        inserted, low, high = new[key][len(kept) :], np.nanmin(values), np.nanmax(values)
        slack = 1e-12 * max(abs(low), abs(high), 1e-300)
        known = inserted[np.isfinite(inserted)]
        assert np.all((known >= low - slack) & (known <= high + slack))


def finer():
    """Options that ask for smaller triangles everywhere, and get them in one remesh."""
    return hm.Remeshing(size=lambda x: np.full(len(x), 0.1))


def test_finer_mesh_under_contact_goes_on(comm):
    """Contact goes on over a remesh of both bodies, with the forces of a fine mesh."""
    fine = forces(hm.Simulation(Blocks, stack(comm, (12, 10), rows=8, shift=0.05)), 6.0)
    simulation = hm.Simulation(Blocks, two_blocks(comm))
    forces(simulation, 4.0)
    simulation.remeshing = finer()
    closed = [simulation.model.problem.interface(pair) for pair in simulation.model.pairs]
    simulation.remesh({"block_0": ["finer"], "block_1": ["finer"]})
    after = forces(simulation, 6.0)
    state = simulation.model.problem.interface(simulation.model.pairs[0])
    assert len(state.points) > len(closed[0].points)
    assert (state.state > 0).sum() >= (closed[0].state > 0).sum()
    assert np.abs(after - fine[4:]).max() <= 0.05 * np.abs(fine).max()


def test_water_and_area_are_booked(comm):
    """One block, remeshed after every step: what leaves is what the area loses."""
    n_steps, out = 6, 0.0

    def build(domain):
        return Blocks(domain, speed=(0.0, -0.01), law=hm.LinearElastic(1e6, 0.2))

    simulation = hm.Simulation(build, stack(comm, (6,), rows=6), hm.Remeshing(every=1, size=wave))
    start = area(simulation)
    for _ in simulation.run(float(n_steps), 1.0):
        out -= simulation.model.force()[2]
    assert sum(len(r.counts) for r in simulation.records) >= 2
    booked = sum(r.merged_water for r in simulation.records)
    assert out > 1e-3
    assert abs(start + booked - area(simulation) - out) <= 1e-8 * out


def wave(x):
    """Target size that asks for small triangles in a corner."""
    return 0.08 + 0.3 * np.hypot(*x.T)


def area(simulation):
    """Area of the present mesh, on all ranks."""
    arrays = simulation.domain.arrays()
    here = float(areas(arrays.points, arrays.cells).sum()) if len(arrays.cells) else 0.0
    return simulation.model.comm.bcast(here)


def test_plastic_strain_is_booked_step_by_step(comm):
    """The sum of what steps add is the integral itself while the mesh and its cells stay."""
    simulation = hm.Simulation(Blocks, two_blocks(comm))
    forces(simulation, 6.0)
    ((name, (integral, booked)),) = simulation.model.problem.integrals().items()
    assert "kappa" in name and booked > 0.0
    assert abs(integral / booked - 1.0) < 0.01
    assert simulation.drifts() == {name: integral / booked - 1.0}


class Dug(hm.TransientModel):
    """An elastic column under its weight; what has been dug off is not there."""

    def __init__(self, domain):
        mesh = domain.mesh
        V = fem.functionspace(mesh, ("P", 1, (2,)))
        self.u, self.u_n = fem.Function(V, name="displacement"), fem.Function(V)
        tags = domain.bodies.values()
        measure = hm.node_cells_measure("full")(tuple(tags), subdomain_data=domain.cell_tags)
        law = hm.LinearElastic(1e6, 0.2)
        stress = hm.MaterialStress(law, self.u, self.u_n, measure, kinematics="finite")
        weight = fem.Constant(mesh, (0.0, -1e4))
        F = hm.finite_strain.equilibrium(
            stress.stress,
            stress.deformation,
            self.u,
            self.u_n,
            None,
            ufl.TestFunction(V),
            body_force=weight,
            smoothed=stress.measure,
        )
        sides = [("bottom_0", 1), ("left_0", 0), ("right_0", 0)]
        bcs = [fix(domain, V.sub(i), name) for name, i in sides]
        problem = hm.ContactProblem(F, self.u, bcs=bcs, domain=domain)
        dt = fem.Constant(mesh, 1.0)
        super().__init__(problem, dt, [], follow=lambda: problem.move_mesh(self.u, self.u_n))


def layered(comm):
    """A column of two layers."""
    domain = stack(comm, (4,), rows=8)
    arrays = domain.arrays()
    if comm.rank == 0:
        high = arrays.points[arrays.cells, 1].mean(axis=1) > 0.5
        groups, bodies = np.where(high, 2, 1).astype(np.int32), {"lower": 1, "upper": 2}
        arrays = replace(arrays, cell_groups=groups, bodies=bodies)
    layers = {"soil": ["lower", "upper"]}
    mine = arrays if comm.rank == 0 else None
    return hm.Domain.from_arrays(mine, comm, name="column", layers=layers)


@pytest.mark.mpi
def test_removed_group_leaves_the_rest_as_it_was(comm):
    """Half a column dug off: nodes hold what they held, and the ground heaves as it must."""
    simulation = hm.Simulation(Dug, layered(comm))
    for _ in simulation.run(1.0, 1.0):
        pass
    old, before = nodes_of(simulation), simulation.domain.arrays()
    simulation.remove("upper", "floor")
    domain, new, after = simulation.domain, nodes_of(simulation), simulation.domain.arrays()
    assert list(domain.bodies) == ["lower"] and domain.layers == {"soil": ("lower",)}
    assert set(domain.surfaces) == {"bottom_0", "left_0", "right_0", "floor"}
    assert comm.allreduce(len(domain.facets("floor"))) == 4
    left = np.unique(before.cells[before.cell_groups == 1])
    assert comm.rank > 0 or 0 < len(left) < len(before.points)
    assert np.array_equal(before.points[left], after.points)
    for key, values in old.items():
        assert np.array_equal(new[key], values[left], equal_nan=True)
    for _ in simulation.run(2.0, 1.0):
        pass
    # Relieved of the weight of half a metre, half a metre heaves by its strain.
    heave = 0.5 * 1e4 * 0.5 / hm.LinearElastic(1e6, 0.2).oedometric_modulus
    u = ("field displacement", "value")
    end = nodes_of(simulation)
    if comm.rank == 0:
        top = after.points[:, 1] > after.points[:, 1].max() - 1e-6
        assert (end[u] - old[u][left])[top, 1] == pytest.approx(heave, rel=0.02)
    with pytest.raises(ValueError, match="unknown body 'upper'"):
        simulation.remove("upper", "floor")


def test_reset_displacements_keeps_stress_and_geometry_of_the_design(comm):
    """Ground at rest under its weight stays where it was drawn, stressed as it is."""
    drawn = layered(comm)
    simulation = hm.Simulation(Dug, drawn)
    design = drawn.arrays().points
    for _ in simulation.run(1.0, 1.0):
        pass
    old, sunk = nodes_of(simulation), simulation.domain.arrays().points
    simulation.reset_displacements()
    new = nodes_of(simulation)
    assert comm.rank > 0 or np.abs(sunk - design).max() > 1e-3
    assert np.allclose(simulation.domain.arrays().points, design, rtol=0.0, atol=1e-14)
    if comm.rank == 0:
        key = ("material stress", "stress")
        assert np.array_equal(new[key], old[key])
        assert not new[("field displacement", "value")].any()
    for _ in simulation.run(2.0, 1.0):
        pass
    # The drawn column is longer than the sunk one by half a percent, and so heavier.
    moved = nodes_of(simulation)
    if comm.rank == 0:
        u = ("field displacement", "value")
        assert np.abs(moved[u]).max() < 0.01 * np.abs(old[u]).max()


def test_damaged_or_foreign_files_are_refused(comm, shared_tmp_path):
    """Errors name the file and the reason, on all ranks."""
    file = shared_tmp_path / "run.checkpoint"
    simulation = hm.Simulation(Blocks, two_blocks(comm))
    simulation.write_checkpoint(file)
    with pytest.raises(ValueError, match="another model"):
        hm.Simulation.restart(file, lambda d: Blocks(d, porous=False), comm)
    whole = file.read_bytes()
    half = len(whole) // 2
    flipped = bytes(255 - byte for byte in whole[half : half + 99])
    comm.Barrier()
    broken = shared_tmp_path / "broken"
    for content, reason in (
        (whole[:half], "damaged"),
        (whole[:half] + flipped + whole[half + 99 :], "damaged"),
        (b"a table", "damaged or no checkpoint"),
    ):
        if comm.rank == 0:
            broken.write_bytes(content)
        comm.Barrier()
        with pytest.raises(ValueError, match=reason):
            hm.Simulation.restart(broken, Blocks, comm)
    if comm.rank == 0:
        np.savez(shared_tmp_path / "other.npz", x=np.zeros(3))
    comm.Barrier()
    with pytest.raises(ValueError, match="no checkpoint of a run"):
        hm.Simulation.restart(shared_tmp_path / "other.npz", Blocks, comm)
    with pytest.raises(FileNotFoundError, match="nowhere"):
        hm.Simulation.restart(shared_tmp_path / "nowhere", Blocks, comm)


def test_refuses_to_remesh_without_options(comm):
    """A run without options has none to remesh by."""
    simulation = hm.Simulation(Blocks, two_blocks(comm))
    with pytest.raises(ValueError, match="remeshing="):
        simulation.remesh({"block_0": ["because"]})
