# SPDX-License-Identifier: LGPL-3.0-or-later
# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Hertz contact, and partial slip after Cattaneo and Mindlin
#
# An elastic half disc is pressed on an elastic block by a given load. While the contact is small
# against the radius, Hertz gives its half width $a = \sqrt{4PR/\pi E^*}$ and the pressure, a half
# ellipse of height $p_0 = 2P/\pi a$. With friction (`--mu 0.3`), a force $Q < \mu P$ along the
# plane then makes the rim of the contact slip; the middle sticks on the half width
# $c = a\sqrt{1 - Q/\mu P}$. There the shear is below $\mu p$ by another half ellipse, that of half
# width $c$.
#
# Half spaces and parabolas are the limit $a/R \to 0$ of this model: at $a/R = 0.05$ peak and half
# width differ from theirs by 0.6 to 0.8 percent, however fine the mesh. `--half-width 0.1` makes
# that a tenth of a percent.

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
from fenicsx_hmcontact.contact.analytic import (
    cattaneo_mindlin_shear,
    contact_modulus,
    hertz_half_width,
    hertz_load,
    hertz_pressure,
    moment_half_width,
    stick_half_width,
)
from fenicsx_hmcontact.output.fields import gather_nodal, write_interface
from fenicsx_hmcontact.output.figures import contact_plot, curves, field_plot, save
from fenicsx_hmcontact.output.report import DemoParser, Report
from fenicsx_hmcontact.output.root import on_root
from meshes.hertz import hertz

comm = MPI.COMM_WORLD
APPROACH = 0.6
"""Part of the half width that the starting position of the disc closes."""
QUICK = 0.25
"""Edges of the quick run, by the half width."""
KINDS = {
    "triangles": "P1",
    "deviatoric": "smoothed, deviatoric",
    "full": "smoothed, full",
    "none": "smoothed, none",
}


# %% [markdown]
# ## The model
#
# The load is a uniform traction on the cut of the disc. Without friction nothing keeps the disc
# from spinning, so its axis stays upright. Bodies of equal material press on each other without
# shear: friction may wait until the disc is pushed.


# %%
class Disc:
    """Half disc on a block.

    Args:
        options: Parameters of the demo.
        comm: Communicator.
    """

    def __init__(self, options, comm=comm):
        self.options = options
        edges = np.array([1.0, options.ratio]) * options.h_over_a * options.half_width
        disc, plane = edges if options.secondary == "cylinder" else edges[::-1]
        self.domain = hertz(
            comm,
            radius=options.radius,
            half_width=options.half_width,
            disc_size=disc,
            plane_size=plane,
            growth=options.growth,
        )
        mesh = self.domain.mesh
        mesh.topology.create_connectivity(2, 2)
        self.V = fem.functionspace(mesh, ("P", 1, (2,)))
        self.u, v = fem.Function(self.V, name="displacement"), ufl.TestFunction(self.V)
        material = hm.LinearElastic(options.E, options.nu)
        elastic = (options.E, options.nu)
        other = None if options.rigid_plane else elastic
        self.modulus = contact_modulus(*elastic, other)
        self.load = hertz_load(options.half_width, options.radius, self.modulus)
        self.traction = fem.Constant(mesh, np.array([0.0, -self.load / (2.0 * options.radius)]))
        ds = ufl.Measure("ds", domain=mesh, subdomain_data=self.domain.facet_tags)
        dc = hm.node_cells_measure(options.smoothing)
        F = ufl.inner(material.stress(self.u), ufl.grad(v)) * dc
        self.model = F - ufl.dot(self.traction, v) * ds(self.domain.surface("top"))
        self.n_unknowns = {}

    def press(self):
        """Press without friction; return Newton's iterations and what acts."""
        # Where disc and block touch in one point only, little holds the disc: start nearer.
        disc = self._cells("disc")
        depth = (APPROACH * self.options.half_width) ** 2 / (2.0 * self.options.radius)
        self.u.interpolate(lambda x: np.stack((0.0 * x[0], 0.0 * x[0] - depth)), cells0=disc)
        V_x, middle = self.V.sub(0), 0.5 * self.options.radius
        C, _ = V_x.collapse()
        axis = fem.locate_dofs_geometrical(
            (V_x, C), lambda x: (np.abs(x[0]) < 1e-9 * middle) & (x[1] > middle)
        )
        upright = fem.dirichletbc(fem.Function(C), axis, V_x)
        return self._solve([self._held(), upright], hm.Frictionless())

    def push(self, force):
        """Push the disc by a force [N/m] to the right; return iterations and what acts."""
        # Held at the height that it has: the disc must not roll.
        V_y = self.V.sub(1)
        top = self.domain.facet_tags.find(self.domain.surface("top"))
        pressed = self.u.copy()
        height = fem.dirichletbc(pressed.sub(1), fem.locate_dofs_topological(V_y, 1, top))
        self.traction.value[0] = force / (2.0 * self.options.radius)
        return self._solve([self._held(), height], hm.CoulombFriction(self.options.mu))

    def _held(self):
        """The bottom of the block, or all of a rigid one."""
        if self.options.rigid_plane:
            dofs = fem.locate_dofs_topological(self.V, 2, self._cells("block"))
        else:
            bottom = self.domain.facet_tags.find(self.domain.surface("bottom"))
            dofs = fem.locate_dofs_topological(self.V, 1, bottom)
        return fem.dirichletbc(np.zeros(2), dofs, self.V)

    def _cells(self, body):
        return self.domain.cell_tags.find(self.domain.body(body))

    def _solve(self, bcs, friction):
        sides = [self.domain.surface(f"{body}_contact") for body in ("disc", "plane")]
        if self.options.secondary == "plane":
            sides.reverse()
        pair = hm.ContactPair(self.domain.facet_tags, *sides, friction=friction)
        problem = hm.ContactProblem(self.model, self.u, bcs=bcs, pairs=[pair])
        result = problem.solve()
        self.model, self.n_unknowns = problem.model, problem.n_unknowns
        return result.iterations, problem.interface(pair)


# %% [markdown]
# ## Errors
#
# The exact solution is that of the forces that act between the bodies. The half width is that of
# the half ellipse with the second moment of the nodal forces,
# $2\sqrt{\sum F x^2 / \sum F}$; the half width that sticks comes from $\mu p - q$ the same way.


# %%
class Contact:
    """Tractions along the contact beside the exact ones; arrays of shape (n,).

    Args:
        disc: The model.
        state: What acts between the surfaces.
        mu: Coefficient of friction [-]; zero without.
    """

    def __init__(self, disc, state, mu=0.0):
        order = np.argsort(state.points[:, 0])
        paired = order[~np.isnan(state.pressure[order])]
        self.mu, self.p, self.length = mu, state.pressure[paired], state.length[paired]
        # Along (n_y, -n_x) the disc is pushed back, and so is the block, whose normals point down.
        self.q = -state.shear[paired]
        self.load, self.shear_load = abs(state.force[1]), abs(state.force[0])
        self.a = hertz_half_width(self.load, disc.options.radius, disc.modulus)
        self.p0 = 2.0 * self.load / (np.pi * self.a)
        x = state.points[paired, 0]
        self.middle = (self.length * self.p) @ x / (self.length @ self.p)
        self.x = x - self.middle

    def errors(self):
        """Errors of pressure and half width [-]."""
        return {
            "peak_pressure_error": self.p.max() / self.p0 - 1.0,
            "half_width_error": moment_half_width(self.x, self.length * self.p) / self.a - 1.0,
            "pressure_error": self._rms(self.p - self.exact_pressure(self.x)) / self.p0,
        }

    def shear_errors(self):
        """Errors of shear and stick half width [-]."""
        stuck = self.length * (self.mu * self.p - self.q)
        c = stick_half_width(self.load, self.a, self.shear_load, self.mu)
        return {
            "shear_error": self._rms(self.q - self.exact_shear(self.x)) / (self.mu * self.p0),
            "stick_half_width_error": moment_half_width(self.x, stuck) / c - 1.0,
        }

    def exact_pressure(self, x):
        """Pressure after Hertz [Pa]."""
        return hertz_pressure(x, self.load, self.a)

    def exact_shear(self, x):
        """Shear after Cattaneo and Mindlin [Pa]."""
        return cattaneo_mindlin_shear(x, self.load, self.a, self.shear_load, self.mu)

    def _rms(self, values):
        return np.sqrt(self.length @ values**2 / (2.0 * self.a))


# %% [markdown]
# ## Pictures and study


# %%
def draw_tractions(contact, state, path):
    """Draw nodal tractions over the exact ones, and the gap."""
    fine = np.linspace(-1.2, 1.2, 481)
    exact = [contact.exact_pressure(fine * contact.a)]
    if contact.mu > 0.0:
        exact.append(-contact.exact_shear(fine * contact.a))
    contact_plot(
        state,
        path,
        along=(state.points[:, 0] - contact.middle) / contact.a,
        x=("x / a", ""),
        reference=[(fine, of_place) for of_place in exact],
    )


def draw_bodies(gathered, state, options):
    """Draw the deformed bodies, all of them and around the contact."""
    points, cells, values = gathered
    near = 3.0 * options.half_width
    for name, limits in (("bodies", None), ("contact", ((-near, near), (-near, near)))):
        field_plot(
            points,
            cells,
            values[:, 1],
            options.out / f"{name}.png",
            label="vertical displacement",
            unit="m",
            title="deformed",
            edges=limits is not None,
            displacement=values,
            states=[] if limits is None else [state],
            limits=limits,
        )


def study(options):
    """Error of the pressure against wall time and unknowns for every discretisation."""
    from rich.console import Console
    from rich.table import Table

    results = {}
    table = Table(title=f"Hertz contact, secondary = {options.secondary}")
    columns = "discretisation", "h/a", "unknowns", "peak", "half width", "rms", "iterations", "s"
    for heading in columns:
        table.add_column(heading)
    for kind, name in KINDS.items():
        for h_over_a in (0.4, 0.2, 0.1, 0.05):
            options.smoothing, options.h_over_a = kind, h_over_a
            start = time.perf_counter()
            disc = Disc(options)
            iterations, state = disc.press()
            seconds = comm.allreduce(time.perf_counter() - start, MPI.MAX)
            peak, width, error = Contact(disc, state).errors().values()
            unknowns = sum(disc.n_unknowns.values())
            results.setdefault(name, []).append((unknowns, seconds, error))
            figures = f"{peak:+.2%}", f"{width:+.2%}", f"{error:.2%}"
            table.add_row(
                name, f"{h_over_a:g}", str(unknowns), *figures, str(iterations), f"{seconds:.2f}"
            )
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
                y=("rms error of the pressure / p0", ""),
                scale=("log", "log"),
                title="Hertz contact",
            )
            save(figure, options.out / f"study_error_against_{what.replace(' ', '_')}.png")

    on_root(comm, draw)


# %% [markdown]
# ## The demo


# %%
def parse(words=None):
    """Read the command line, or given words; return options and parameters of the report."""
    p = DemoParser(
        "hertz",
        "Hertz contact and partial slip of a disc on a plane.",
        comm,
        quick=True,
        study=True,
    )
    p.parameter("--secondary", "cylinder", "", "secondary surface", choices=("cylinder", "plane"))
    p.parameter("--rigid-plane", False, "", "rigid block; elastic like the disc otherwise")
    p.parameter("--half-width", 0.4, "m", "exact half width a of the contact: sets the load")
    p.parameter("--radius", 8.0, "m", "radius of the disc")
    p.parameter("--E", 200.0, "Pa", "Young's modulus")
    p.parameter("--nu", 0.3, "-", "Poisson's ratio")
    p.parameter(
        "--mu", 0.0, "-", "coefficient of friction; with it the disc is pushed, once pressed"
    )
    p.parameter("--push", 0.5, "-", "force Q along the plane / (mu P)")
    p.parameter("--h-over-a", 0.1, "-", "edges of the secondary surface / a")
    p.parameter("--ratio", 1.2, "-", "edges of the primary surface / those of the secondary")
    p.parameter("--growth", 0.1, "-", "growth of edges per distance from the contact")
    p.parameter(
        "--smoothing",
        "deviatoric",
        "",
        "enhancement of the smoothed gradient, or unsmoothed P1",
        choices=tuple(KINDS),
    )
    options = p.parse_args(words)
    if options.rigid_plane and options.secondary == "plane":
        p.error("a rigid plane is prescribed at all its nodes: the cylinder must be secondary")
    if options.rigid_plane and options.mu > 0.0:
        p.error("partial slip is known for bodies of equal material: no --mu with --rigid-plane")
    if options.mu < 0.0:
        p.error(f"--mu must be zero or positive, not {options.mu}")
    if options.mu > 0.0 and not 0.0 < options.push < 1.0:
        p.error(f"--push must lie between 0 and 1, not at {options.push}: beyond, all slides")
    if options.quick:
        options.h_over_a = max(options.h_over_a, QUICK)
    return options, p.parameters(options)


def main():
    """Run the demo."""
    options, parameters = parse()
    if options.study:
        study(options)
        return
    report = Report("hertz", comm, parameters)
    with report.phase("mesh"):
        disc = Disc(options)
    with report.phase("press"):
        iterations, state = disc.press()
    report.step(iterations)
    contact = Contact(disc, state)
    report.figures |= contact.errors()
    report.figures["load_error"] = contact.load / disc.load - 1.0
    if options.mu > 0.0:
        with report.phase("push"):
            iterations, state = disc.push(options.push * options.mu * contact.load)
        report.step(iterations)
        contact = Contact(disc, state, options.mu)
        report.figures |= contact.shear_errors()
    report.unknowns = disc.n_unknowns

    gathered = gather_nodal(disc.u)

    def draw():
        draw_tractions(contact, state, options.out / "tractions.png")
        draw_bodies(gathered, state, options)

    on_root(comm, draw)
    write_interface(comm, options.out / "contact.csv", state)
    report.table()
    report.write(options.report)


if __name__ == "__main__":
    main()
