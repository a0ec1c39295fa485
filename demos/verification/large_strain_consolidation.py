# SPDX-License-Identifier: LGPL-3.0-or-later
# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Consolidation by 30 % of the height
#
# A column of soil under a dead load $q_0$ settles by almost a third. With $\nu=0$ the effective
# stress is $\sigma' = M\ln\lambda$ of the stretch $\lambda$, and equilibrium makes
# $p = q_0 + M\ln\lambda$. Darcy's law then gives, in the material height $X$,
# $$
# \frac{\partial\lambda}{\partial t} = -c_v\frac{\partial^2}{\partial X^2}\frac1\lambda, \qquad
# \lambda = \lambda_1 = e^{-q_0/M} \text{ at the top},\qquad
# \frac{\partial\lambda}{\partial X} = 0 \text{ at the base}, \qquad c_v = \frac{kM}{\gamma}.
# $$
# In space $1/\lambda$ obeys the linear equation of diffusion under a moving top. As long as the
# base does not feel the load the settlement is $s = 2\beta\sqrt{c_v t}$ with
# $\sqrt\pi\,\beta\,e^{\beta^2}\mathrm{erfc}\,\beta = 1-\lambda_1$.

# %%
import sys
import time
from itertools import product
from pathlib import Path

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.special import erfcx

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.output.fields import gather_nodal
from fenicsx_hmcontact.output.figures import curves, save
from fenicsx_hmcontact.output.report import DemoParser, Report
from fenicsx_hmcontact.output.root import on_root
from fenicsx_hmcontact.poromechanics.analytic import terzaghi_degree
from meshes.block import block

comm = MPI.COMM_WORLD
CHECK_TIMES = {"1e5": 1e5, "5e5": 5e5}
PICTURE_TIMES = (1e4, 1e5, 2e5, 5e5, 1e6)
KINDS = {"full": "smoothed, F-bar", "none": "smoothed, none", "triangles": "P1"}


# %% [markdown]
# ## The exact solution
#
# Finite volumes in the material height, finer towards the top, and time steps by their error. The
# difference to half as many volumes is about three times its own error.


# %%
class Exact:
    """Stretch and settlement of the column at given times."""

    def __init__(self, options, times, volumes=400):
        self.options = o = options
        self.times = np.asarray(times, float)
        self.X = o.height * (1.0 - np.linspace(1.0, 0.0, volumes + 1) ** 2)
        size, middle = np.diff(self.X), 0.5 * (self.X[1:] + self.X[:-1])
        distance = np.append(np.diff(middle), o.height - middle[-1])
        cv = o.permeability * o.E / o.unit_weight

        def rate(_, stretch):
            flux = cv * np.diff(1.0 / np.append(stretch, o.stretch)) / distance
            return -np.diff(flux, prepend=0.0) / size

        banded = {"method": "LSODA", "lband": 1, "uband": 1}
        accuracy = {"rtol": 1e-9, "atol": 1e-11, "first_step": 1e-6 * size[-1] ** 2 / cv}
        solution = solve_ivp(
            rate, (0.0, self.times[-1]), np.ones(volumes), t_eval=self.times, **banded, **accuracy
        )
        if not solution.success:
            raise RuntimeError(f"the exact solution: {solution.message}")
        self.middle, self.stretch = middle, solution.y.T
        self.settlement = o.height - self.stretch @ size

    def pressure(self, t, X):
        """Pore pressure [Pa] at one of the times and any material heights [m]."""
        o, stretch = self.options, self.stretch[np.searchsorted(self.times, 0.999999 * t)]
        known = np.append(stretch, o.stretch)
        return load_of(o) + o.E * np.log(np.interp(X, np.append(self.middle, o.height), known))

    def height(self, t):
        """Heights [m] of the material heights ``X`` at one of the times."""
        stretch = self.stretch[np.searchsorted(self.times, 0.999999 * t)]
        return np.append(0.0, np.cumsum(stretch * np.diff(self.X)))


def load_of(options):
    """Dead load [Pa] under which the column ends at its final stretch."""
    return -options.E * np.log(options.stretch)


def early_settlement(options, t):
    """Settlement [m] while the base does not feel the load."""
    cv = options.permeability * options.E / options.unit_weight
    beta = brentq(lambda b: np.sqrt(np.pi) * b * erfcx(b) - 1.0 + options.stretch, 0.0, 1e3)
    return 2.0 * beta * np.sqrt(cv * t)


# %% [markdown]
# ## The model
#
# Stress and water at finite strain; the mesh follows each step.


# %%
class Column:
    """The column, ready to step."""

    def __init__(self, options, smoothing, rows):
        self.options = o = options
        size = o.height / rows
        self.domain = domain = block(
            comm, width=o.across * size, height=o.height, across=o.across, rows=rows
        )
        mesh = domain.mesh
        mesh.topology.create_connectivity(1, 2)
        V, Q = fem.functionspace(mesh, ("P", 1, (2,))), fem.functionspace(mesh, ("P", 1))
        u, p = fem.Function(V, name="displacement"), fem.Function(Q, name="pore pressure")
        u_n, p_n = fem.Function(V), fem.Function(Q)
        v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))
        dt = fem.Constant(mesh, 1.0)

        material = hm.LinearElastic(o.E, 0.0)
        dc = ufl.dx if smoothing == "triangles" else hm.node_cells_measure(smoothing)
        skeleton = hm.MaterialStress(material, u, u_n, dc, kinematics="finite")
        F = hm.finite_strain.equilibrium(
            skeleton.stress, skeleton.deformation, u, u_n, p, v, smoothed=skeleton.measure
        )
        F += hm.finite_strain.water_balance(
            u,
            u_n,
            p,
            q,
            dt,
            permeability=o.permeability,
            unit_weight=o.unit_weight,
            smoothed=skeleton.measure,
        )
        if o.tau > 0.0:
            F += hm.pressure_projection(p, p_n, q, material.shear_modulus, tau=o.tau)
        ds = ufl.Measure("ds", domain=mesh, subdomain_data=domain.facet_tags)
        top = domain.surface("top")
        # The width stays, so that the load per area does.
        F += load_of(o) * v[1] * ds(top)

        def fixed(space, name):
            dofs = fem.locate_dofs_topological(space, 1, domain.facet_tags.find(name))
            return fem.dirichletbc(0.0, dofs, space)

        sides = [(1, "bottom"), (0, "left"), (0, "right")] + [(0, "top")] * o.rough_top
        bcs = [fixed(V.sub(i), domain.surface(name)) for i, name in sides]
        self.problem = hm.ContactProblem(F, [u, p], bcs=[*bcs, fixed(Q, top)])
        self.u, self.p, self.u_n = u, p, u_n
        model = hm.TransientModel(
            self.problem, dt, [(p_n, p)], follow=lambda: self.problem.move_mesh(u, u_n)
        )
        self.stepping = hm.TimeStepping(model)
        self._settlement = fem.form(-u[1] * ds(top))
        self._area = fem.form(fem.Constant(mesh, 1.0) * ufl.dx)
        self._width = o.across * size

    def settlement(self):
        """Mean settlement of the top at the end of the step [m]."""
        return comm.allreduce(fem.assemble_scalar(self._settlement)) / self._width

    def area(self):
        """Area of the mesh, which stands at the start of the step [m^2]."""
        return comm.allreduce(fem.assemble_scalar(self._area))

    def outflow(self):
        """Water that leaves in the step, per metre thickness [m^3]."""
        water = self.problem.reactions(self.p)
        owned = water.function_space.dofmap.index_map.size_local
        return -comm.allreduce(water.x.array[:owned].sum())

    def profile(self):
        """Material heights, heights [m] and pore pressures [Pa] of all nodes on rank 0, upwards."""
        gathered = [gather_nodal(f) for f in (self.u_n, self.u, self.p)]
        if gathered[0] is None:
            return None
        (points, _, u_n), (_, _, u), (_, _, p) = gathered
        X = points[:, 1] - u_n[:, 1]
        order = np.argsort(X)
        return X[order], (X + u[:, 1])[order], p[order, 0]


# %% [markdown]
# ## A run


# %%
class History:
    """What a run leaves for figures."""

    def __init__(self):
        self.t, self.settlement, self.profiles, self.cuts, self.balance = [], [], {}, 0, 0.0


def run(column, refine, report, bar="consolidation"):
    """Step through the schedule with steps divided by ``refine``."""
    history, stepping = History(), column.stepping
    start, outflow = column.area(), 0.0

    def check_water():
        if outflow:
            defect = abs(start - column.area() - outflow) / outflow
            history.balance = max(history.balance, defect)

    for word in column.options.schedule.split():
        count, size = word.split("x")
        end = stepping.t + int(count) * float(size)
        for step in stepping.run(end, float(size) / refine, bar=bar):
            check_water()
            outflow += column.outflow()
            report.step(step.iterations)
            history.cuts += step.cuts
            history.t.append(step.t)
            history.settlement.append(column.settlement())
            if any(np.isclose(step.t, t) for t in (*PICTURE_TIMES, *CHECK_TIMES.values())):
                history.profiles[step.t] = column.profile()
    check_water()
    return history


def pressure_errors(exact, t, profile):
    """Error of the pore pressure at time t: largest, and rms over the material; both / load."""
    X, _, p = profile
    error = (p - exact.pressure(t, X)) / load_of(exact.options)
    return np.abs(error).max(), np.sqrt(np.trapezoid(error**2, X) / exact.options.height)


def compare(history, options):
    """Errors at the times of the checks; relative to settlement and load."""
    exact = Exact(options, history.t)
    coarse = Exact(options, history.t, volumes=200)
    figures = {"settlement_error": {}, "pressure_error": {}, "exact_uncertainty": {}}
    for name, t in CHECK_TIMES.items():
        at = np.flatnonzero(np.isclose(history.t, t))
        if at.size:
            settlement, less = exact.settlement[at[0]], coarse.settlement[at[0]]
            figures["settlement_error"][name] = history.settlement[at[0]] / settlement - 1.0
            figures["exact_uncertainty"][name] = abs(less / settlement - 1.0)
    if comm.rank == 0:
        for t, profile in history.profiles.items():
            figures["pressure_error"][f"{t:.0f}"] = pressure_errors(exact, t, profile)[0]
    return exact, comm.bcast(figures)


def draw(history, exact, options):
    """Settlement over time and pore pressure over the height."""
    t = np.geomspace(history.t[0], history.t[-1], 200)
    cv = options.permeability * options.E / options.unit_weight
    small = load_of(options) / options.E * options.height * terzaghi_degree(t, options.height, cv)
    early = t[cv * t < 0.5 * options.height**2]
    figure = curves(
        {
            "computed": (history.t, history.settlement),
            "theory of small strain": (t, small),
            "early, root of time": (early, early_settlement(options, early)),
        },
        x=("time", "s"),
        y=("settlement", "m"),
        reference=[(t, Exact(options, t).settlement)],
        scale=("log", "linear"),
    )
    figure.axes[0].lines[0].set_linestyle("")
    save(figure, options.out / "settlement.png")
    series, known = {}, []
    for t, (_, y, p) in history.profiles.items():
        series[f"t = {t:.0f} s"] = (p / load_of(options), y)
        known.append((exact.pressure(t, exact.X) / load_of(options), exact.height(t)))
    figure = curves(series, x=("pore pressure / load", ""), y=("height", "m"), reference=known)
    save(figure, options.out / "pressure.png")


# %% [markdown]
# ## Error against time and size
#
# The error at 1e5 s: over the length of the steps, and over the mesh with steps in proportion to
# $h^2$.


# %%
def study(options):
    """Tables and pictures of error against steps, mesh and cost."""
    from rich.console import Console
    from rich.table import Table

    end, names = 1e5, {kind: KINDS[kind] for kind in ("full", "triangles")}
    options.schedule = "10x1e3 9x1e4"
    exact = Exact(options, [end], volumes=1600)
    levels = {"steps": [(2 * options.rows, k) for k in (1, 2, 4, 8)]}
    levels["mesh"] = [(options.rows // 4, 1), (options.rows // 2, 4), (options.rows, 16)]
    results = {over: {name: [] for name in names.values()} for over in levels}
    table = Table(title=f"at {end:g} s; steps by themselves, and with the mesh as h squared")
    for heading in ("over", "discretisation", "rows", "steps", "unknowns", "settlement error"):
        table.add_column(heading)
    for heading in ("rms pressure error / load", "order", "seconds"):
        table.add_column(heading)
    for over, smoothing in product(levels, names):
        previous = None
        for rows, refine in levels[over]:
            column = Column(options, smoothing, rows)
            report = Report("study", comm, {})
            start = time.perf_counter()
            history = run(column, refine, report, bar="")
            seconds = comm.allreduce(time.perf_counter() - start, MPI.MAX)
            (_, profile), rms = history.profiles.popitem(), None
            if profile is not None:
                rms = pressure_errors(exact, end, profile)[1]
            rms = comm.bcast(rms)
            error = history.settlement[-1] / exact.settlement[-1] - 1.0
            order = "" if previous is None else f"{np.log2(previous / rms):.2f}"
            previous = rms
            unknowns = sum(column.problem.n_unknowns.values())
            words = str(rows), str(report.steps), str(unknowns), f"{error:+.3%}", f"{rms:.2e}"
            table.add_row(over, names[smoothing], *words, order, f"{seconds:.1f}")
            row = {"rows": rows, "steps": report.steps, "unknowns": unknowns, "seconds": seconds}
            row |= {"settlement_error": error, "pressure_rms": rms}
            results[over][names[smoothing]].append(row)
    if comm.rank == 0:
        Console(width=120).print(table)

    def pictures():
        for key, what, unit in (("unknowns", "unknowns", ""), ("seconds", "wall time", "s")):
            lines = {
                name: ([r[key] for r in rows], [r["pressure_rms"] for r in rows])
                for name, rows in results["mesh"].items()
            }
            figure = curves(
                lines,
                x=(what, unit),
                y=("rms error of pore pressure / load", ""),
                scale=("log", "log"),
                title=f"column at {end:g} s, steps as h squared",
            )
            save(figure, options.out / f"study_error_against_{what.replace(' ', '_')}.png")

    on_root(comm, pictures)
    return {"study": results}


# %% [markdown]
# ## The demo


# %%
def parse(words=None):
    """Read the command line, or given words; return options and parameters of the report."""
    p = DemoParser(
        "large_strain_consolidation",
        "A column of soil consolidates by 30 % of its height, against the exact solution.",
        comm,
        study=True,
    )
    p.parameter("--height", 1.0, "m", "height of the column, drained at its top")
    p.parameter("--rows", 20, "-", "rows of square cells")
    p.parameter("--across", 1, "-", "cells across")
    p.parameter("--rough-top", True, "", "top held sideways, as under a porous plate")
    p.parameter("--E", 1e6, "Pa", "Young's modulus; Poisson's ratio is 0")
    p.parameter("--stretch", 0.7, "-", "final height by initial height: sets the load")
    p.parameter("--permeability", 1e-8, "m/s", "permeability")
    p.parameter("--unit-weight", 1e4, "N/m^3", "unit weight of water")
    p.parameter("--tau", 1.0, "-", "pressure stabilisation, 0 for none")
    p.parameter("--smoothing", "full", "", "F-bar on node cells, none, or P1", choices=[*KINDS])
    p.parameter("--schedule", "10x1e3 9x1e4 8x5e4 5x5e5", "", "steps: number x size [s]")
    p.parameter("--refine", 1, "-", "divisor of all steps; 2 halves them")
    options = p.parse_args(words)
    if not 0.0 < options.stretch < 1.0:
        p.error(f"--stretch is {options.stretch}; it must lie between 0 and 1")
    if options.refine < 1:
        p.error(f"--refine is {options.refine}; it must be at least 1")
    return options, p.parameters(options)


def main():
    """Run the demo."""
    options, parameters = parse()
    report = Report("large_strain_consolidation", comm, parameters)
    if options.study:
        report.figures = study(options)
        report.write(options.report)
        return
    with report.phase("set-up"):
        column = Column(options, options.smoothing, options.rows)
    report.unknowns = column.problem.n_unknowns
    with report.phase("steps"):
        history = run(column, options.refine, report)
    with report.phase("exact solution"):
        exact, errors = compare(history, options)
    report.figures |= errors
    report.figures["settlement"] = history.settlement[-1]
    report.figures["water_balance"] = history.balance
    report.figures["newton_mean"] = report.newton_iterations / report.steps
    report.figures["cuts"] = history.cuts
    with report.phase("pictures"):
        on_root(comm, lambda: draw(history, exact, options))
    report.table()
    report.write(options.report)


if __name__ == "__main__":
    main()
