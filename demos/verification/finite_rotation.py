# SPDX-License-Identifier: LGPL-3.0-or-later
# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Large rotation, shear and compression
#
# What a stress update at finite strain must get right, one motion at a time:
#
# - **rotation**: a stressed body that turns takes its stress along, to round-off in any step; a
#   bent beam in equilibrium, turned with its load, stays in equilibrium;
# - `--shear`: Jaumann's rate has in simple shear $\gamma$ the stresses
#   $\sigma_{xy} = G\sin\gamma$, $\sigma_{xx} = -\sigma_{yy} = G(1-\cos\gamma)$;
# - `--compression`: with the sides held, $\sigma_{yy} = M\ln\lambda$.
#
# The update takes strain and spin about the middle of the step and turns by half the spin before
# and after the strain: the last two are of second order in the step.

# %%
import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.output.fields import gather_nodal
from fenicsx_hmcontact.output.figures import curves, field_plot, save
from fenicsx_hmcontact.output.report import DemoParser, Report
from fenicsx_hmcontact.output.root import on_root
from meshes.block import block

comm = MPI.COMM_WORLD
START = np.array([-0.3, -0.1, -0.2, 0.05])
"""Stress xx, yy, zz, xy of the body that turns, by Young's modulus."""
AT_REST = 1e-14
"""Displacement, by the length of the beam, at which it counts as relaxed."""


def rotation(angle):
    """Matrix that turns counterclockwise by an angle [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def turned(stress, angle):
    """Stresses xx, yy, zz, xy in a body that has turned; shape (..., 4)."""
    R, result = rotation(angle), stress.copy()
    plane = R @ stress[..., [[0, 3], [3, 1]]] @ R.T
    result[..., 0], result[..., 1], result[..., 3] = (
        plane[..., 0, 0],
        plane[..., 1, 1],
        plane[..., 0, 1],
    )
    return result


# %% [markdown]
# ## A body, and what moves it
#
# All nodes can be made to follow a motion; the reactions then are all of the residual.


# %%
class Body:
    """An elastic block at finite strain, under a dead traction on its right side."""

    def __init__(self, options, **size):
        self.options = options
        self.domain = block(comm, unstructured=options.unstructured, **size)
        self.mesh = mesh = self.domain.mesh
        mesh.topology.create_connectivity(1, 2)
        self.V = V = fem.functionspace(mesh, ("P", 1, (2,)))
        self.u, self.u_n = fem.Function(V, name="displacement"), fem.Function(V)
        self.target = fem.Function(V)
        self.rest = V.tabulate_dof_coordinates()[:, :2].copy()
        v = ufl.TestFunction(V)
        self.material = hm.LinearElastic(options.E, options.nu)
        smoothing = options.smoothing
        dc = ufl.dx if smoothing == "triangles" else hm.node_cells_measure(smoothing)
        self.stress = hm.MaterialStress(self.material, self.u, self.u_n, dc, kinematics="finite")
        self.traction = fem.Constant(mesh, np.zeros(2))
        ds = ufl.Measure("ds", domain=mesh, subdomain_data=self.domain.facet_tags)
        right = ds(self.domain.surface("right"))
        self.F = hm.finite_strain.equilibrium(
            self.stress.stress,
            self.stress.deformation,
            self.u,
            self.u_n,
            None,
            v,
            smoothed=self.stress.measure,
        ) - hm.finite_strain.dead_load(self.traction, self.u_n, v, right)
        self.clamped = fem.locate_dofs_topological(
            V, 1, self.domain.facet_tags.find(self.domain.surface("left"))
        )

    def problem(self, driven, model=None):
        """A problem whose left end is held, or all of whose nodes are driven."""
        n = self.rest.shape[0]
        dofs = np.arange(n, dtype=np.int32) if driven else self.clamped
        bc = fem.dirichletbc(self.target, dofs)
        newton = hm.NewtonOptions(tolerance=1e-12)
        return hm.ContactProblem(model or self.F, self.u, bcs=[bc], newton=newton)

    def step(self, problem):
        """Solve and let the mesh follow; return Newton's iterations."""
        iterations = problem.solve().iterations
        problem.move_mesh(self.u, self.u_n)
        return iterations

    def drive(self, problem, positions):
        """Bring all nodes to positions; shape (n, 2)."""
        self.target.x.array[:] = (positions - self.rest).ravel()
        return self.step(problem)

    def residual(self, problem):
        """Norm of the residual of all but the left end, of a driven body that stays [N]."""
        problem.solve()
        forces = problem.reactions(self.u).x.array.reshape(-1, 2).copy()
        forces[self.clamped] = 0.0
        owned = self.V.dofmap.index_map.size_local
        return np.sqrt(comm.allreduce(np.sum(forces[:owned] ** 2)))

    def largest(self, values):
        """Largest absolute value on all ranks."""
        return comm.allreduce(np.abs(values).max(initial=0.0), MPI.MAX)

    def mean_stress(self):
        """Mean stress in the plane, at the nodes [Pa]."""
        f = fem.Function(fem.functionspace(self.mesh, ("P", 1)), name="mean stress")
        cells = self.stress.node_cells or hm.create_node_cells(self.mesh)
        values = 0.5 * self.stress.values()[..., :2].sum(axis=-1).mean(axis=1)
        if self.stress.node_cells is None:
            ghosted = fem.Function(fem.functionspace(self.mesh, ("DG", 0)))
            ghosted.x.array[: len(values)] = values
            ghosted.x.scatter_forward()
            values = cells.cell_means(ghosted)[:, 0]
        f.x.array[cells.block_dofs(f.function_space)[: len(values)]] = values
        f.x.scatter_forward()
        return f


# %% [markdown]
# ## Rotation


# %%
def turn_stress(options):
    """Turn a body under a uniform stress; return the error of the stress, relative to its norm."""
    body = Body(options, across=6, rows=6)
    body.stress.set_stress(lambda x: options.E * np.repeat(START[:, None], x.shape[1], axis=1))
    problem = body.problem(driven=True)
    end = np.radians(options.degrees)
    for step in range(1, options.steps + 1):
        body.drive(problem, body.rest @ rotation(end * step / options.steps).T)
    error = turned(body.stress.values(), -end) / options.E - START
    return body.largest(error) / np.linalg.norm(START)


def elastica(load):
    """Tip of a slender cantilever under P L^2/(E I) = load: shortening and deflection, by L."""

    def shape(tip):
        """From the tip: angle, curvature, and the way along the axis and across it."""

        def rate(_, y):
            return [y[1], -load * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])]

        return solve_ivp(rate, (0, 1), [tip, 0, 0, 0], rtol=1e-10, atol=1e-12).y[:, -1]

    tip = brentq(lambda angle: shape(angle)[0], 0.0, 0.5 * np.pi)
    _, _, along, across = shape(tip)
    return 1.0 - along, across


def turn_beam(options, report):
    """Bend a beam, wait until it rests, turn it with its load; return figures and pictures."""
    length, height = options.slenderness, 1.0
    size = {"width": length, "height": height, "across": options.across, "rows": options.rows}
    body, figures = Body(options, **size), {}
    modulus = options.E / (1.0 - options.nu**2)
    force = options.load * modulus * height**3 / 12.0 / length**2
    bending = body.problem(driven=False)
    report.unknowns = bending.n_unknowns
    for step in range(1, options.bending_steps + 1):
        body.traction.value[1] = -force / height * step / options.bending_steps
        report.step(body.step(bending))
    # New cells leave a small residual, which steps without load take away.
    relaxations, moved = 0, np.inf
    while moved > AT_REST * length and relaxations < options.relaxations:
        bending.solve()
        moved = body.largest(body.u.x.array - body.u_n.x.array)
        bending.move_mesh(body.u, body.u_n)
        relaxations += 1
    names, tip = ("shortening", "deflection"), -mean_tip(body) / length
    figures["tip"] = dict(zip(names, tip, strict=True))
    figures["tip_elastica"] = dict(zip(names, elastica(options.load), strict=True))
    figures["relaxations"] = relaxations
    bent = body.rest + body.u.x.array.reshape(-1, 2)
    pictures = {"bent": gather_nodal(body.mean_stress())}

    driven = body.problem(driven=True, model=bending.model)
    body.target.x.array[:] = body.u.x.array
    figures["bent_residual"] = body.residual(driven) / force
    driven.move_mesh(body.u, body.u_n)
    end, load = np.radians(options.degrees), body.traction.value.copy()
    for step in range(1, options.steps + 1):
        body.drive(driven, bent @ rotation(end * step / options.steps).T)
    body.traction.value[:] = rotation(end) @ load
    figures["rotated_residual"] = body.residual(driven) / force
    driven.move_mesh(body.u, body.u_n)
    pictures["rotated"] = gather_nodal(body.mean_stress())
    if options.smoothing == "full":
        # What points on axes that do not turn would make of it
        body.stress.node_cells.angles[:] -= end
        body.stress.node_cells.follow()
        figures["residual_on_fixed_axes"] = body.residual(driven) / force
    return figures, pictures


def mean_tip(body):
    """Mean displacement of the right side [m]."""
    ds = ufl.Measure("ds", domain=body.mesh, subdomain_data=body.domain.facet_tags)
    right, one = ds(body.domain.surface("right")), fem.Constant(body.mesh, 1.0)
    forms = [fem.form(f * right) for f in (one, body.u[0], body.u[1])]
    size, x, y = (comm.allreduce(fem.assemble_scalar(form)) for form in forms)
    return np.array([x, y]) / size


def draw_beam(pictures, options):
    """Mean stress in the bent and in the rotated beam."""
    for name, (points, cells, values) in pictures.items():
        label = {"label": "mean stress", "unit": "kPa", "edges": True}
        field_plot(points, cells, values / 1e3, options.out / f"{name}.png", **label)


# %% [markdown]
# ## Shear and compression


# %%
def follow(options, motion):
    """Stresses xx, yy, zz, xy of a body that follows a linear motion, by Pa; and their scatter."""
    body = Body(options, across=4, rows=4)
    problem, values, scatter = body.problem(driven=True), [np.zeros(4)], 0.0
    for step in range(1, options.steps + 1):
        body.drive(problem, body.rest @ motion(step / options.steps).T)
        points = body.stress.values().reshape(-1, 4)
        count = comm.allreduce(len(points))
        mean = comm.allreduce(points.sum(axis=0)) / count
        scatter = max(scatter, body.largest(points - mean))
        values.append(mean)
    return np.array(values), scatter, body.material


def shear(options):
    """Largest error of shear and normal stress on the way of simple shear, by G; and stresses."""
    gamma = options.shear * np.linspace(0.0, 1.0, options.steps + 1)
    values, scatter, material = follow(
        options, lambda t: np.array([[1.0, options.shear * t], [0.0, 1.0]])
    )
    G = material.shear_modulus
    errors = {
        "shear_error": np.abs(values[:, 3] / G - np.sin(gamma)).max(),
        "normal_error": np.abs(values[:, 0] / G - 1.0 + np.cos(gamma)).max(),
        "scatter": scatter / G,
    }
    return errors, gamma, values / G


def compression(options):
    """Error of the stress in confined compression, relative; and stresses by M."""
    stretch = 1.0 - options.compression * np.linspace(0.0, 1.0, options.steps + 1)
    values, scatter, material = follow(
        options, lambda t: np.diag([1.0, 1.0 - options.compression * t])
    )
    M = material.oedometric_modulus
    errors = {
        "compression_error": values[-1, 1] / (M * np.log(stretch[-1])) - 1.0,
        "scatter": scatter / M,
    }
    return errors, stretch, values / M


def draw_shear(gamma, values, options):
    """Stresses over the shear."""
    fine = np.linspace(0.0, gamma[-1], 200)
    figure = curves(
        {"shear stress": (gamma, values[:, 3]), "normal stress along x": (gamma, values[:, 0])},
        x=("shear strain", ""),
        y=("stress / G", ""),
        reference=[(fine, np.sin(fine)), (fine, 1.0 - np.cos(fine))],
    )
    save(figure, options.out / "shear.png")


def draw_compression(stretch, values, options):
    """Stress over the stretch."""
    fine = np.linspace(stretch[-1], 1.0, 200)
    figure = curves(
        {"vertical stress": (stretch, values[:, 1])},
        x=("stretch", ""),
        y=("stress / M", ""),
        reference=[(fine, np.log(fine))],
    )
    save(figure, options.out / "compression.png")


def study(options):
    """Errors of shear by 2 and compression by 30 % over the number of steps."""
    from rich.console import Console
    from rich.table import Table

    options.shear, options.compression = options.shear or 2.0, options.compression or 0.3
    table = Table(title=f"shear by {options.shear:g}, compression by {options.compression:g}")
    for heading in ("steps", "shear error / G", "order", "compression error", "order"):
        table.add_column(heading)
    rows = []
    for options.steps in (10, 20, 40, 80, 160):
        errors = shear(options)[0]["shear_error"], compression(options)[0]["compression_error"]
        words = [str(options.steps)]
        for i, error in enumerate(errors):
            order = f"{np.log2(abs(rows[-1][1 + i] / error)):.2f}" if rows else ""
            words += [f"{error:.2e}", order]
        table.add_row(*words)
        rows.append((options.steps, *errors))
    if comm.rank == 0:
        Console(width=100).print(table)

    def draw():
        steps, by_shear, by_compression = np.array(rows).T
        lines = {"shear stress / G": by_shear, "vertical stress, relative": np.abs(by_compression)}
        figure = curves(
            {name: (steps, error) for name, error in lines.items()},
            x=("steps", ""),
            y=("error", ""),
            reference=[(steps, by_shear[0] * (steps[0] / steps) ** 2)],
            reference_label="second order",
            scale=("log", "log"),
        )
        save(figure, options.out / "study_error_against_steps.png")

    on_root(comm, draw)
    return {"study": rows}


# %% [markdown]
# ## The demo


# %%
def parse(words=None):
    """Read the command line, or given words; return options and parameters of the report."""
    p = DemoParser(
        "finite_rotation",
        "Stresses under large rotation, or shear, or compression, against the exact ones.",
        comm,
        study=True,
    )
    p.parameter("--degrees", 90.0, "degrees", "rotation of a stressed body and of a bent beam")
    p.parameter("--shear", 0.0, "-", "simple shear instead")
    p.parameter("--compression", 0.0, "-", "part of the height instead, with the sides held")
    p.parameter("--steps", 10, "-", "steps of the motion")
    p.parameter("--E", 1e6, "Pa", "Young's modulus")
    p.parameter("--nu", 0.0, "-", "Poisson's ratio")
    p.parameter("--load", 4.0, "-", "tip load of the beam, by EI/L^2")
    p.parameter("--slenderness", 10.0, "-", "length of the beam by its height of 1 m")
    p.parameter("--across", 40, "-", "cells along the beam")
    p.parameter("--rows", 4, "-", "cells across the beam")
    p.parameter("--bending-steps", 10, "-", "steps of the bending")
    p.parameter("--relaxations", 20, "-", "most steps without load before the beam turns")
    p.parameter("--unstructured", False, "", "Delaunay meshes")
    p.parameter(
        "--smoothing",
        "full",
        "",
        "F-bar on node cells, no enhancement, or P1",
        choices=("full", "none", "triangles"),
    )
    options = p.parse_args(words)
    if options.steps < 1:
        p.error(f"--steps is {options.steps}; it must be at least 1")
    if not 0.0 <= options.compression < 1.0:
        p.error(f"--compression is {options.compression}; it must be from 0 to less than 1")
    if options.shear and options.compression and not options.study:
        p.error("give either --shear or --compression")
    return options, p.parameters(options)


def main():
    """Run the demo."""
    options, parameters = parse()
    report = Report("finite_rotation", comm, parameters)
    if options.study:
        report.figures = study(options)
    elif options.shear:
        errors, gamma, values = shear(options)
        report.figures |= errors
        on_root(comm, lambda: draw_shear(gamma, values, options))
    elif options.compression:
        errors, stretch, values = compression(options)
        report.figures |= errors
        on_root(comm, lambda: draw_compression(stretch, values, options))
    else:
        with report.phase("stressed body"):
            report.figures["stress_error"] = turn_stress(options)
        with report.phase("beam"):
            figures, pictures = turn_beam(options, report)
        report.figures |= figures
        on_root(comm, lambda: draw_beam(pictures, options))
    if not options.study:
        report.table()
    report.write(options.report)


if __name__ == "__main__":
    main()
