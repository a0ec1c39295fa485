# SPDX-License-Identifier: LGPL-3.0-or-later
# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A block pressed between rough plates
#
# A square block is pressed to 70 % of its height; nodes on the plates keep their place, and the
# sides bulge. With the consistent tangent Newton's method converges quadratically, in elastic and
# in plastic soil.
#
# With `--water-pressure` the block is porous and stands in water of that pressure, which follows
# its bulging sides (`pressure_load`). Where the block drains faster than it is pressed, the water
# changes nothing at all: what pushes on the sides is what the pore water pushes back with.

# %%
import sys
from itertools import pairwise
from pathlib import Path

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.output.fields import gather_nodal
from fenicsx_hmcontact.output.figures import curves, field_plot, save
from fenicsx_hmcontact.output.report import DemoParser, Report
from fenicsx_hmcontact.output.root import on_root
from meshes.block import block

comm = MPI.COMM_WORLD


# %%
class Block:
    """The block between its plates, ready to be pressed from time 0 to 1."""

    def __init__(self, options):
        self.options = o = options
        self.domain = domain = block(
            comm, across=o.cells, rows=o.cells, unstructured=o.unstructured
        )
        mesh = domain.mesh
        mesh.topology.create_connectivity(1, 2)
        wet = o.water_pressure > 0.0
        V, Q = fem.functionspace(mesh, ("P", 1, (2,))), fem.functionspace(mesh, ("P", 1))
        u, u_n = fem.Function(V, name="displacement"), fem.Function(V)
        p, p_n = fem.Function(Q, name="pore pressure"), fem.Function(Q)
        v, q = (
            ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q)) if wet else (ufl.TestFunction(V), None)
        )
        dt = fem.Constant(mesh, 1.0)

        elastic = hm.LinearElastic(o.E, o.nu)
        material = elastic if o.material == "elastic" else hm.Tresca(o.E, o.nu, c=o.c)
        dc = ufl.dx if o.smoothing == "triangles" else hm.node_cells_measure(o.smoothing)
        self.skeleton = skeleton = hm.MaterialStress(material, u, u_n, dc, kinematics="finite")
        F = hm.finite_strain.equilibrium(
            skeleton.stress,
            skeleton.deformation,
            u,
            u_n,
            p if wet else None,
            v,
            smoothed=skeleton.measure,
        )
        if wet:
            # In a step of time 1/steps water diffuses over a part of the block.
            conductivity = o.drainage * o.steps / elastic.oedometric_modulus
            F += hm.finite_strain.water_balance(
                u,
                u_n,
                p,
                q,
                dt,
                permeability=conductivity,
                unit_weight=1.0,
                smoothed=skeleton.measure,
            )
            F += hm.pressure_projection(p, p_n, q, elastic.shear_modulus)
            ds = ufl.Measure("ds", domain=mesh, subdomain_data=domain.facet_tags)
            sides = ds((domain.surface("left"), domain.surface("right")))
            F += hm.finite_strain.pressure_load(o.water_pressure, u, u_n, v, sides)
            p.x.array[:] = p_n.x.array[:] = o.water_pressure

        def fixed(space, name, value=0.0):
            dofs = fem.locate_dofs_topological(
                space, 1, domain.facet_tags.find(domain.surface(name))
            )
            return fem.dirichletbc(value, dofs, space)

        plate = fem.Constant(mesh, 0.0)
        bcs = [fixed(V.sub(i), "bottom") for i in (0, 1)]
        bcs += [fixed(V.sub(0), "top"), fixed(V.sub(1), "top", plate)]
        if wet:
            bcs += [fixed(Q, name, o.water_pressure) for name in ("left", "right")]
        newton = hm.NewtonOptions(tolerance=o.tolerance)
        unknowns = [u, p] if wet else u
        self.problem = problem = hm.ContactProblem(F, unknowns, bcs=bcs, newton=newton)
        self.u, self.p, self.u_n = u, p, u_n
        model = hm.TransientModel(
            problem,
            dt,
            [(p_n, p)] if wet else [],
            histories=[(plate, lambda t: -o.strain * t)],
            follow=lambda: problem.move_mesh(u, u_n),
        )
        self.stepping = hm.TimeStepping(model)
        self.top = fem.locate_dofs_topological(V, 1, domain.facet_tags.find(domain.surface("top")))

    def force(self):
        """Force of the upper plate on the block, downwards [N]."""
        forces = self.problem.reactions(self.u).x.array.reshape(-1, 2)
        owned = self.u.function_space.dofmap.index_map.size_local
        return -comm.allreduce(forces[self.top[self.top < owned], 1].sum())

    def press(self, bar=""):
        """Press to the end; yields each step."""
        return self.stepping.run(1.0, 1.0 / self.options.steps, bar=bar)


def order_of(residuals):
    """Order of convergence from the last three residuals that shrink, None where there are none."""
    r = np.array(residuals)
    falls = np.log(r[1:] / r[:-1])
    steep = [b / a for a, b in pairwise(falls) if a < -1.0 and b < -1.0]
    return steep[-1] if steep else None


def print_residuals(history):
    """Table of the residuals of some steps."""
    from rich.console import Console
    from rich.table import Table

    shown = sorted({0, len(history) // 2, len(history) - 1})
    table = Table(title="largest scaled residual after each solve, by the increment")
    table.add_column("solve")
    for step in shown:
        table.add_column(f"step {step + 1}")
    for k in range(max(len(history[step]) for step in shown)):
        words = [f"{history[s][k]:.1e}" if k < len(history[s]) else "" for s in shown]
        table.add_row(str(k + 1), *words)
    Console(width=100).print(table)


# %%
def parse(words=None):
    """Read the command line, or given words; return options and parameters of the report."""
    p = DemoParser("pressed_block", "A block pressed between rough plates at finite strain.", comm)
    p.parameter("--strain", 0.3, "-", "shortening by the height of 1 m")
    p.parameter("--steps", 12, "-", "steps")
    p.parameter("--cells", 10, "-", "edges a side")
    p.parameter("--unstructured", True, "", "Delaunay mesh")
    p.parameter("--E", 1e6, "Pa", "Young's modulus")
    p.parameter("--nu", 0.3, "-", "Poisson's ratio")
    p.parameter("--material", "elastic", "", "law of the soil", choices=("elastic", "tresca"))
    p.parameter("--c", 5e4, "Pa", "shear strength of Tresca's law")
    p.parameter("--water-pressure", 0.0, "Pa", "pressure of the water around; 0 for a dry block")
    p.parameter("--drainage", 1.0, "-", "c_v T / L^2 of the pressing time T and the side L")
    p.parameter("--tolerance", 1e-9, "-", "of Newton's method, by the increment")
    p.parameter(
        "--smoothing",
        "full",
        "",
        "F-bar on node cells, no enhancement, or P1",
        choices=("full", "none", "triangles"),
    )
    options = p.parse_args(words)
    if not 0.0 < options.strain < 1.0:
        p.error(f"--strain is {options.strain}; it must lie between 0 and 1")
    if options.water_pressure < 0.0:
        p.error(f"--water-pressure is {options.water_pressure}; it must not be negative")
    return options, p.parameters(options)


def main():
    """Run the demo."""
    options, parameters = parse()
    report = Report("pressed_block", comm, parameters)
    body = Block(options)
    report.unknowns = body.problem.n_unknowns
    history, path, cuts = [], [(0.0, 0.0)], 0
    with report.phase("steps"):
        for step in body.press("pressing"):
            report.step(step.iterations)
            history.append([max(r) for r in step.result.history])
            path.append((options.strain * step.t, body.force()))
            cuts += step.cuts
    orders = [order for order in map(order_of, history) if order is not None]
    report.figures |= {
        "newton_mean": report.newton_iterations / report.steps,
        "newton_max": max(map(len, history)),
        "cuts": cuts,
        "force": path[-1][1],
    }
    if orders:
        report.figures["convergence_order"] = float(np.median(orders))
    if options.material == "tresca":
        kappa = body.skeleton.history("kappa")
        report.figures["kappa_max"] = comm.allreduce(kappa.max(initial=0.0), MPI.MAX)
    gathered = gather_nodal(body.u)

    def draw():
        print_residuals(history)
        strain, force = np.array(path).T
        figure = curves(
            {"plate": (strain, force / 1e3)}, x=("shortening", "m"), y=("force", "kN/m")
        )
        save(figure, options.out / "force.png")
        points, cells, u = gathered
        label = {"label": "horizontal displacement", "unit": "m", "edges": True}
        field_plot(points, cells, u[:, 0], options.out / "pressed.png", **label)

    on_root(comm, draw)
    report.table()
    report.figures["residuals"] = {str(step + 1): r for step, r in enumerate(history)}
    report.write(options.report)


if __name__ == "__main__":
    main()
