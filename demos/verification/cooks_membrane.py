# SPDX-License-Identifier: LGPL-3.0-or-later
# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Cook's membrane
#
# A tapered panel in plane strain, clamped on the left and sheared on the right. Near
# incompressibility linear triangles lock; so does the smoothing of the paper, which enhances the
# divergence with the rest of the gradient. The deviatoric enhancement does not.

# %%
import sys
import time
from pathlib import Path

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.output.fields import evaluate, gather_nodal
from fenicsx_hmcontact.output.figures import curves, field_plot, save
from fenicsx_hmcontact.output.report import DemoParser, Report
from fenicsx_hmcontact.output.root import on_root
from meshes.cooks_membrane import cooks_membrane

comm = MPI.COMM_WORLD
TIP = np.array([[48.0, 60.0]])
KNOWN = {0.3333: 22.571, 0.4999: 19.304}
"""Tip displacement [m] at E = 1 Pa and unit shear force, quadratic triangles, 64 edges a side."""


# %%
def conditions(domain, V, options):
    """Clamp on the left and work of the shear force on the right."""
    domain.mesh.topology.create_connectivity(1, 2)
    left = fem.locate_dofs_topological(V, 1, domain.facet_tags.find(domain.surface("left")))
    clamp = fem.dirichletbc(np.zeros(2), left, V)
    ds = ufl.Measure("ds", domain=domain.mesh, subdomain_data=domain.facet_tags)
    return [clamp], fem.Constant(domain.mesh, options.force / 16.0), ds(domain.surface("right"))


def membrane(options, cells, smoothing):
    """Displacement of the membrane on a mesh of about ``cells`` edges a side."""
    domain = cooks_membrane(comm, cells=cells, unstructured=options.unstructured)
    degree = 2 if smoothing == "quadratic" else 1
    V = fem.functionspace(domain.mesh, ("P", degree, (2,)))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    material = hm.LinearElastic(options.E, options.nu)
    bcs, shear, right = conditions(domain, V, options)
    dc = hm.node_cells_measure("triangles" if smoothing == "quadratic" else smoothing)
    F = ufl.inner(material.stress(u), ufl.grad(v)) * dc - shear * v[1] * right
    problem = hm.ContactProblem(F, u, bcs=bcs)
    return problem, u, problem.solve()


def reference(options):
    """Tip displacement to compare with: known values, else Taylor-Hood in u and mean pressure."""
    for nu, tip in KNOWN.items():
        if abs(options.nu - nu) < 1e-4 and options.nu < 0.49995:
            return tip * options.force / options.E
    domain = cooks_membrane(comm, cells=64, unstructured=False)
    V = fem.functionspace(domain.mesh, ("P", 2, (2,)))
    Q = fem.functionspace(domain.mesh, ("P", 1))
    u, p = fem.Function(V, name="displacement"), fem.Function(Q, name="mean pressure")
    v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))
    material = hm.LinearElastic(options.E, options.nu)
    bcs, shear, right = conditions(domain, V, options)
    strain = ufl.sym(ufl.grad(u))
    F = ufl.inner(2.0 * material.shear_modulus * strain, ufl.grad(v)) * ufl.dx
    F += -p * ufl.div(v) * ufl.dx - shear * v[1] * right
    F += (ufl.div(u) + p / material.lame) * q * ufl.dx
    hm.ContactProblem(F, [u, p], bcs=bcs).solve()
    return float(evaluate(u, TIP)[0, 1])


def study(options, exact):
    """Error against wall time and unknowns for every discretisation."""
    from rich.console import Console
    from rich.table import Table

    results = {}
    table = Table(title=f"Cook's membrane, nu = {options.nu:g}: tip error")
    for heading in ("discretisation", "edges a side", "unknowns", "tip error", "seconds"):
        table.add_column(heading)
    kinds = ("triangles", "deviatoric", "full", "none", "quadratic")
    names = dict(
        zip(kinds, ("P1", "smoothed, deviatoric", "smoothed, full", "none", "P2"), strict=True)
    )
    names["none"] = "smoothed, none"
    for kind in kinds:
        membrane(options, 4, kind)
        for cells in (8, 16, 32, 64):
            start = time.perf_counter()
            problem, u, _ = membrane(options, cells, kind)
            seconds = comm.allreduce(time.perf_counter() - start, MPI.MAX)
            error = abs(float(evaluate(u, TIP)[0, 1]) / exact - 1.0)
            unknowns = sum(problem.n_unknowns.values())
            results.setdefault(names[kind], []).append((unknowns, seconds, error))
            table.add_row(names[kind], str(cells), str(unknowns), f"{error:.2%}", f"{seconds:.2f}")
    if comm.rank == 0:
        Console(width=100).print(table)

    def draw():
        for index, what, unit in ((0, "unknowns", ""), (1, "wall time", "s")):
            series = {
                name: ([r[index] for r in rows], [r[2] for r in rows])
                for name, rows in results.items()
            }
            figure = curves(
                series,
                x=(what, unit),
                y=("tip error", ""),
                scale=("log", "log"),
                title=f"Cook's membrane, nu = {options.nu:g}",
            )
            save(figure, options.out / f"study_error_against_{what.replace(' ', '_')}.png")

    on_root(comm, draw)


# %%
def main():
    """Run the demo."""
    p = DemoParser("cooks_membrane", "Cook's membrane: bending without locking.", comm, study=True)
    p.parameter("--nu", 1.0 / 3.0, "-", "Poisson's ratio")
    p.parameter("--E", 1.0, "Pa", "Young's modulus")
    p.parameter("--force", 1.0, "N", "shear force on the right, per metre thickness")
    p.parameter("--cells", 16, "-", "edges on the left side")
    p.parameter("--unstructured", True, "", "Delaunay mesh")
    p.parameter(
        "--smoothing",
        "deviatoric",
        "",
        "enhancement of the smoothed gradient, or unsmoothed P1, or P2",
        choices=("deviatoric", "full", "none", "triangles", "quadratic"),
    )
    options = p.parse_args()
    report = Report("cooks_membrane", comm, p.parameters(options))
    with report.phase("reference"):
        exact = reference(options)
    if options.study:
        study(options, exact)
        return
    with report.phase("solve"):
        problem, u, result = membrane(options, options.cells, options.smoothing)
    report.unknowns = problem.n_unknowns
    report.step(result.iterations)
    tip = float(evaluate(u, TIP)[0, 1])
    report.figures |= {"tip": tip, "tip_reference": exact, "tip_error": tip / exact - 1.0}

    if options.smoothing != "quadratic":
        gathered = gather_nodal(u)

        def draw():
            points, cells, values = gathered
            scale = 0.3 * options.E / options.force
            field_plot(
                points + scale * values,
                cells,
                values[:, 1],
                options.out / "deformed.png",
                label="vertical displacement",
                unit="m",
                title=f"displacements x {scale:g}",
                edges=True,
            )

        on_root(comm, draw)
    report.table()
    report.write(options.report)


if __name__ == "__main__":
    main()
