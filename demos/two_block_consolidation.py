# SPDX-License-Identifier: LGPL-3.0-or-later
# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Consolidation of two tied blocks
#
# Two porous blocks with meshes that do not match are tied across a closed interface. A load $p_0$
# on the drained top consolidates the column; pore pressure and settlement follow Terzaghi's series
# (Eqs. 101-103), as if there were no interface.
#
# The model is written in UFL: displacement $u$ and pore pressure $p$, backward Euler in time,
# $$
# \int \sigma'(u):\nabla v - p\,\nabla\cdot v\,dx + \int_{top} p_0 v_y\,ds = 0, \qquad
# \int q\,\nabla\cdot(u-u_n) + \Delta t\,\nabla q\cdot\frac{k}{\gamma}\nabla p\,dx
# + \int\frac{\tau}{2G}(q-\Pi q)(\delta p-\Pi\delta p)\,dx = 0 .
# $$
# Terms with gradients on both sides are smoothed over node cells (measure `dc`), the others live on
# triangles. The last term stabilises equal-order interpolation (polynomial pressure projection).

# %%
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.contact import surface_values
from fenicsx_hmcontact.output.fields import FieldWriter, evaluate, gather_nodal
from fenicsx_hmcontact.output.figures import curves, field_plot, render_field, save
from fenicsx_hmcontact.output.report import DemoParser, Report, progress
from fenicsx_hmcontact.output.root import on_root
from fenicsx_hmcontact.poromechanics.analytic import (
    consolidation_coefficient,
    terzaghi_degree,
    terzaghi_pressure,
)
from meshes.two_blocks import two_blocks

comm = MPI.COMM_WORLD
TAYLOR_HOOD = "taylor-hood"
CHECK_TIMES = (100.0, 1000.0, 10000.0)
PICTURE_TIMES = (100.0, 1e3, 1e4, 5e4, 1e5)

# %% [markdown]
# ## The model
#
# Everything a user writes: spaces, form, conditions, and one contact pair.


# %%
class Column:
    """The column on one mesh, ready to step."""

    def __init__(self, options, smoothing, tau):
        self.options = options
        self.domain = domain = two_blocks(
            comm,
            width=options.width,
            height=options.height,
            lower=options.lower,
            upper=options.upper,
            rows=options.rows,
            tilt=options.tilt,
            single=options.single,
            unstructured=options.unstructured,
        )
        mesh = domain.mesh
        mesh.topology.create_connectivity(1, 2)
        degree = 2 if smoothing == TAYLOR_HOOD else 1
        V = fem.functionspace(mesh, ("P", degree, (2,)))
        Q = fem.functionspace(mesh, ("P", 1))
        u, p = fem.Function(V, name="displacement"), fem.Function(Q, name="pore pressure")
        u_n, p_n = fem.Function(V), fem.Function(Q)
        v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))

        material = hm.LinearElastic(options.E, options.nu)
        self.modulus = material.oedometric_modulus
        dt = fem.Constant(mesh, 1.0)
        load = fem.Constant(mesh, options.load)
        k = fem.Constant(mesh, np.diag([options.kx, options.ky]))
        dc = hm.node_cells_measure("triangles" if smoothing == TAYLOR_HOOD else smoothing)
        ds = ufl.Measure("ds", domain=mesh, subdomain_data=domain.facet_tags)
        top = domain.surface("top")
        F = hm.equilibrium(material.stress(u), p, v, smoothed=dc)
        F += load * v[1] * ds(top)
        F += hm.water_balance(
            u, u_n, p, q, dt, permeability=k, unit_weight=options.unit_weight, smoothed=dc
        )
        if tau > 0.0 and smoothing != TAYLOR_HOOD:
            F += hm.pressure_projection(p, p_n, q, material.shear_modulus, tau=tau)

        def fixed(space, name):
            dofs = fem.locate_dofs_topological(space, 1, domain.facet_tags.find(name))
            return fem.dirichletbc(0.0, dofs, space)

        bcs = [
            fixed(V.sub(1), domain.surface("bottom")),
            fixed(V.sub(0), domain.surface("left")),
            fixed(V.sub(0), domain.surface("right")),
            fixed(Q, top),
        ]
        pairs = []
        if not options.single:
            sides = [domain.surface("interface_upper"), domain.surface("interface_lower")]
            if options.secondary == "lower":
                sides.reverse()
            flow = hm.GapFlow(
                options.transverse_permeability,
                unit_weight=options.unit_weight,
                aperture=options.gap or None,
            )
            pairs = [hm.ContactPair(domain.facet_tags, *sides, friction=hm.Tied(), flow=flow)]
        self.problem = hm.ContactProblem(F, [u, p], bcs=bcs, pairs=pairs, time_step=dt)
        self.u, self.p, self.u_n, self.p_n, self.dt, self.pairs = u, p, u_n, p_n, dt, pairs
        self.p_exact = fem.Function(Q, name="exact pore pressure")
        self._settlement = fem.form(-u[1] * ds(top))
        self._volume_change = fem.form(ufl.div(u - u_n) * ufl.dx)
        self._error = fem.form((p - self.p_exact) ** 2 * ufl.dx)
        self.t = 0.0

    def step(self, dt):
        """Advance by dt [s]; return Newton's iterations and the defect of the water balance."""
        self.dt.value = dt
        self.u_n.x.array[:] = self.u.x.array
        self.p_n.x.array[:] = self.p.x.array
        result = self.problem.solve()
        self.t += dt
        drained = self.problem.reactions(self.p)
        owned = drained.function_space.dofmap.index_map.size_local
        outflow = -comm.allreduce(drained.x.array[:owned].sum())
        lost = -comm.allreduce(fem.assemble_scalar(self._volume_change))
        return result.iterations, abs(outflow - lost) / abs(outflow)

    def settlement(self):
        """Mean settlement of the top [m]."""
        return comm.allreduce(fem.assemble_scalar(self._settlement)) / self.options.width

    def set_exact(self):
        """Fill the exact pore pressure."""
        o = self.options
        cv = consolidation_coefficient(o.ky, o.unit_weight, o.E, o.nu)
        self.p_exact.interpolate(lambda x: terzaghi_pressure(x[1], self.t, o.height, cv, o.load))

    def errors(self):
        """Error of p against the series: largest at a node, and area-weighted rms, both / p0."""
        self.set_exact()
        nodal = np.abs(self.p.x.array - self.p_exact.x.array).max(initial=0.0)
        area = self.options.width * self.options.height
        squares = comm.allreduce(fem.assemble_scalar(self._error))
        largest = comm.allreduce(nodal, MPI.MAX)
        return largest / self.options.load, np.sqrt(squares / area) / self.options.load

    def interface(self):
        """Coordinates and pore pressures of the nodes on the upper and the lower side."""
        return [
            surface_values(self.p, self.domain.facet_tags, self.domain.surface(f"interface_{side}"))
            for side in ("upper", "lower")
        ]

    def interface_error(self):
        """Largest error of p at a node of either side, / p0."""
        o = self.options
        cv = consolidation_coefficient(o.ky, o.unit_weight, o.E, o.nu)
        return (
            max(
                np.abs(
                    values[:, 0] - terzaghi_pressure(points[:, 1], self.t, o.height, cv, o.load)
                ).max()
                for points, values in self.interface()
            )
            / o.load
        )

    def interface_jump(self):
        """Largest difference of the two sides' pressures at any node of either side, / p0."""
        (above, p_above), (below, p_below) = self.interface()
        x = np.union1d(above[:, 0], below[:, 0])
        sides = []
        for points, values in ((above, p_above), (below, p_below)):
            order = np.argsort(points[:, 0])
            sides.append(np.interp(x, points[order, 0], values[order, 0]))
        return np.abs(sides[0] - sides[1]).max() / self.options.load


# %% [markdown]
# ## A run


# %%
@dataclass
class History:
    """What a run leaves for figures."""

    t: list = field(default_factory=list)
    degree: list = field(default_factory=list)
    profiles: dict = field(default_factory=dict)
    balance: float = 0.0
    errors: dict = field(default_factory=dict)
    interface_errors: dict = field(default_factory=dict)
    degree_errors: dict = field(default_factory=dict)


def parse_schedule(text):
    """Steps from words such as 20x5: twenty steps of five seconds."""
    steps = []
    for word in text.split():
        count, size = word.split("x")
        steps += [float(size)] * int(count)
    return steps


def run(column, report, description, on_time=None):
    """Step through the schedule; call on_time(t) at the times of the checks and pictures."""
    o = column.options
    cv = consolidation_coefficient(o.ky, o.unit_weight, o.E, o.nu)
    final = o.load * o.height / column.modulus
    history = History()
    for dt in progress(parse_schedule(o.schedule), comm, description):
        iterations, defect = column.step(dt)
        report.step(iterations)
        history.balance = max(history.balance, defect)
        history.t.append(column.t)
        history.degree.append(column.settlement() / final)
        t = round(column.t, 9)
        if t in CHECK_TIMES:
            key = f"{t:.0f}"
            history.errors[key] = column.errors()
            history.degree_errors[key] = history.degree[-1] - float(
                terzaghi_degree(column.t, o.height, cv)
            )
            if not o.single:
                history.interface_errors[key] = column.interface_error()
        # The first step is where the unstabilised pressure oscillates.
        if t in PICTURE_TIMES or len(history.t) == 1:
            history.profiles[t] = profile(column)
        if on_time is not None:
            on_time(t)
    return history


def profile(column):
    """Nodal heights and pore pressures, sorted by height, on rank 0."""
    gathered = gather_nodal(column.p)
    if gathered is None:
        return None
    points, _, values = gathered
    order = np.lexsort((points[:, 0], points[:, 1]))
    return points[order, 1], values[order, 0]


# %% [markdown]
# ## Figures 4, 5 and 6 of the paper


# %%
def draw_profiles(history, options, path, title):
    """Fig. 4: pore pressure over height."""
    cv = consolidation_coefficient(options.ky, options.unit_weight, options.E, options.nu)
    y = np.linspace(0.0, options.height, 400)
    series, exact = {}, []
    for t, (heights, p) in history.profiles.items():
        series[f"t = {t:g} s"] = (p / options.load, heights)
        exact.append((terzaghi_pressure(y, t, options.height, cv, options.load) / options.load, y))
    figure = curves(
        series,
        x=("pore pressure / load", ""),
        y=("height", "m"),
        reference=exact,
        reference_label="series",
        title=title,
    )
    save(figure, path)


def draw_degree(histories, options, path):
    """Fig. 5: degree of consolidation over time."""
    cv = consolidation_coefficient(options.ky, options.unit_weight, options.E, options.nu)
    series = {name: (h.t, h.degree) for name, h in histories.items()}
    t = np.geomspace(1.0, max(h.t[-1] for h in histories.values()), 400)
    figure = curves(
        series,
        x=("time", "s"),
        y=("degree of consolidation", ""),
        reference=[(t, terzaghi_degree(t, options.height, cv))],
        reference_label="series",
        scale=("log", "linear"),
    )
    save(figure, path)


def draw_interface(sides, exact, path):
    """Fig. 6b: pore pressure on the two sides of the interface."""
    series = {}
    for name, (points, values) in zip(("upper side", "lower side"), sides, strict=True):
        order = np.argsort(points[:, 0])
        series[name] = (points[order, 0], values[order, 0] / 1e3)
    figure = curves(
        series,
        x=("x", "m"),
        y=("pore pressure", "kPa"),
        reference=[(exact[0], exact[1] / 1e3)],
        reference_label="series",
    )
    for axes in figure.axes:
        middle = float(np.mean(exact[1])) / 1e3
        reach = max(0.02 * middle, 1.2 * np.abs(exact[1] / 1e3 - middle).max())
        axes.set_ylim(middle - reach, middle + reach)
    save(figure, path)


def draw_contour(gathered, out, t):
    """Fig. 6a: pore pressure on the mesh."""
    points, cells, values = gathered
    label = {"label": "pore pressure", "unit": "kPa", "title": f"t = {t:g} s", "edges": True}
    field_plot(points, cells, values / 1e3, out / "fig6a_pore_pressure.png", **label)
    render_field(points, cells, values / 1e3, out / "fig6a_pore_pressure_rendered.png", **label)


# %% [markdown]
# ## Error against time and size
#
# `--study` runs the column over meshes, steps ($\Delta t\sim h^2$) and discretisations, and shows
# the error at 1000 s against wall time and against the number of unknowns.


# %%
def study(options, out):
    """Table and pictures of error against cost, with isotropic permeability."""
    from rich.console import Console
    from rich.table import Table

    options.kx, options.gap, options.tilt = options.ky, 0.0, 0.0
    kinds = [
        ("P1, two blocks", "triangles", False),
        ("smoothed, deviatoric, two blocks", "deviatoric", False),
        ("smoothed, full, two blocks", "full", False),
        ("smoothed, none, two blocks", "none", False),
        ("smoothed, deviatoric, one block", "deviatoric", True),
        ("Taylor-Hood, one block", TAYLOR_HOOD, True),
    ]
    levels = [(5, 4, 6, "25x40"), (10, 8, 12, "100x10"), (20, 16, 24, "400x2.5")]
    rows, results = [], {}
    for name, smoothing, single in kinds:
        previous = None
        for n, lower, upper, schedule in levels:
            options.rows, options.lower, options.upper = n, lower, upper
            options.single, options.schedule = single, schedule
            column = Column(options, smoothing, options.tau)
            report = Report("study", comm, {})
            start = time.perf_counter()
            run(column, report, name)
            seconds = comm.allreduce(time.perf_counter() - start, MPI.MAX)
            largest, rms = column.errors()
            order = float("nan") if previous is None else np.log2(previous / rms)
            previous = rms
            unknowns = sum(column.problem.n_unknowns.values())
            rows.append((name, n, unknowns, report.steps, largest, rms, order, seconds))
            results.setdefault(name, []).append((unknowns, seconds, rms))
    if comm.rank == 0:
        table = Table(title="pore pressure at 1000 s, time step proportional to h squared")
        for heading in ("discretisation", "rows", "unknowns", "steps", "max error / p0"):
            table.add_column(heading)
        for heading in ("rms error / p0", "order", "seconds"):
            table.add_column(heading)
        for name, n, unknowns, steps, largest, rms, order, seconds in rows:
            table.add_row(
                name,
                str(n),
                str(unknowns),
                str(steps),
                f"{largest:.2e}",
                f"{rms:.2e}",
                "" if np.isnan(order) else f"{order:.2f}",
                f"{seconds:.2f}",
            )
        Console(width=120).print(table)

    def draw():
        for index, (what, unit, file) in enumerate(
            (("unknowns", "", "unknowns"), ("wall time", "s", "time"))
        ):
            series = {
                name: ([r[index] for r in points], [r[2] for r in points])
                for name, points in results.items()
            }
            figure = curves(
                series,
                x=(what, unit),
                y=("rms error of pore pressure / load", ""),
                scale=("log", "log"),
                title="two-block column at 1000 s",
            )
            save(figure, out / f"study_error_against_{file}.png")

    on_root(comm, draw)
    return {
        "study": [
            dict(zip(("name", "rows", "unknowns", "steps", "max", "rms"), row[:6], strict=True))
            for row in rows
        ]
    }


# %% [markdown]
# ## The demo


# %%
def parser():
    """Options of the demo."""
    p = DemoParser(
        "two_block_consolidation",
        "Two tied porous blocks on non-matching meshes consolidate as one (Section 5.1).",
        comm,
        study=True,
    )
    p.parameter("--width", 0.5, "m", "width of the column")
    p.parameter("--height", 1.0, "m", "height of the column")
    p.parameter("--lower", 20, "-", "edges across the lower block")
    p.parameter("--upper", 32, "-", "edges across the upper block, or the single one")
    p.parameter("--rows", 20, "-", "rows of cells in each block")
    p.parameter("--tilt", 0.0, "degrees", "inclination of the interface; needs kx = ky")
    p.parameter("--unstructured", False, "", "Delaunay meshes; needs kx = ky")
    p.parameter("--single", False, "", "one block without interface")
    p.parameter("--secondary", "upper", "", "secondary block", choices=("upper", "lower"))
    p.parameter("--E", 1e8, "Pa", "Young's modulus")
    p.parameter("--nu", 0.0, "-", "Poisson's ratio")
    p.parameter("--kx", 1.0, "m/s", "horizontal permeability; 1 needs horizontal rows of nodes")
    p.parameter("--ky", 1e-9, "m/s", "vertical permeability")
    p.parameter("--unit-weight", 1e4, "N/m^3", "unit weight of water")
    p.parameter("--load", 1e4, "Pa", "load on the top")
    p.parameter("--gap", 0.0, "m", "aperture of the interface, 0 for exactly closed")
    p.parameter("--transverse-permeability", 1e-9, "m/s", "of the interface; matters with a gap")
    p.parameter("--tau", 1.0, "-", "pressure stabilisation, 0 for none")
    p.parameter(
        "--smoothing",
        "deviatoric",
        "",
        "enhancement of the smoothed gradient, or unsmoothed P1, or P2-P1 (single block)",
        choices=("deviatoric", "full", "none", "triangles", TAYLOR_HOOD),
    )
    p.parameter("--schedule", "20x5 45x20 90x100 90x1000", "", "steps: number x size [s]")
    return p


def fixed_points(options):
    """Twenty points off the interface."""
    x = options.width * np.array([0.07, 0.33, 0.61, 0.96])
    y = options.height * np.array([0.04, 0.21, 0.79, 0.9, 0.97])
    return np.array([(a, b) for b in y for a in x])


def main():
    """Run the demo."""
    arguments = parser()
    options = arguments.parse_args()
    if options.smoothing == TAYLOR_HOOD and not options.single:
        arguments.error("--smoothing taylor-hood needs --single: contact is for P1 fields")
    if options.kx != options.ky and (options.tilt or options.unstructured):
        arguments.error("without horizontal rows of nodes give the same --kx and --ky")
    report = Report("two_block_consolidation", comm, arguments.parameters(options))
    out = options.out
    if options.study:
        report.figures = study(options, out)
        report.write(options.report)
        return

    with report.phase("set-up"):
        column = Column(options, options.smoothing, options.tau)
    report.unknowns = column.problem.n_unknowns
    figures = report.figures
    at_check = {}

    def on_time(t):
        if t != CHECK_TIMES[-1]:
            return
        points = fixed_points(options)
        at_check["mesh"] = gather_nodal(column.p)
        figures["fields"] = {
            "pore_pressure": evaluate(column.p, points)[:, 0],
            "settlement": -evaluate(column.u, points)[:, 1],
        }
        if not options.single:
            figures["interface_jump_max"] = column.interface_jump()
            at_check["sides"] = column.interface()
        if options.smoothing != TAYLOR_HOOD:
            column.set_exact()
            fields = [column.u, column.p, column.p_exact]
            with FieldWriter(out / "fields.pvd", column.domain.mesh, fields) as writer:
                writer.write(t)

    with report.phase("steps"):
        history = run(column, report, "consolidation", on_time)
    figures["pressure_error_max"] = {t: e[0] for t, e in history.errors.items()}
    figures["pressure_error_l2"] = {t: e[1] for t, e in history.errors.items()}
    figures["consolidation_degree_error"] = history.degree_errors
    figures["interface_error_max"] = history.interface_errors
    figures["mass_balance"] = history.balance
    figures["factorisations"] = column.problem.n_factorisations

    histories = {f"stabilised, tau = {options.tau:g}": history}
    if options.tau > 0.0 and options.smoothing != TAYLOR_HOOD:
        with report.phase("unstabilised run for comparison"):
            plain = Column(options, options.smoothing, 0.0)
            histories["not stabilised"] = run(plain, Report("plain", comm, {}), "unstabilised")

    def draw():
        for (name, h), file in zip(histories.items(), ("b_stabilised", "a_plain"), strict=False):
            draw_profiles(h, options, out / f"fig4{file}.png", name)
        draw_degree(histories, options, out / "fig5_degree_of_consolidation.png")
        if "mesh" in at_check:
            draw_contour(at_check["mesh"], out, CHECK_TIMES[-1])
        if "sides" in at_check:
            points = at_check["sides"][0][0]
            x, y = points[np.argsort(points[:, 0])].T
            cv = consolidation_coefficient(options.ky, options.unit_weight, options.E, options.nu)
            p = terzaghi_pressure(y, CHECK_TIMES[-1], options.height, cv, options.load)
            draw_interface(at_check["sides"], (x, p), out / "fig6b_interface.png")

    with report.phase("pictures"):
        on_root(comm, draw)
    report.table()
    report.write(options.report)


if __name__ == "__main__":
    main()
