# SPDX-License-Identifier: LGPL-3.0-or-later
# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A fracture: opening under pressure, and leak-off
#
# **Opening** (`--case opening`). Water of the pressure $p$ opens a straight crack of the length
# $L_f$ in an infinite elastic body (Sneddon 1946), plane strain:
# $$
# w(s) = \frac{4(1-\nu^2)\,p}{E}\sqrt{\tfrac14 L_f^2 - s^2} .
# $$
# The body is two halves on meshes that do not match. Beyond the crack they are tied; along it they
# are a pair that opens, with water in the gap. A node at a tip belongs to both pairs: it is in the
# first of the list, the tied one, and a dropped node of the other. The exact displacements of
# Westergaard's stress function hold the outside of the square, so that its size does not matter:
# all error is that of the mesh, of first order in its size, as the stress is singular at the tips.
# The rock is so tight that its pores take no part in carrying loads (Biot's coefficient zero).
#
# **Leak-off** (`--case leak-off`). Water enters a fracture of constant aperture $w$ at its left end
# and leaks through its lower side. The rock above is impermeable, the rock below is drained. With
# $T = w^3/(12\mu_f)$ and $c_T = k_T/(\gamma_f w)$, the two faces' equations are
# $$
# -\tfrac12 T\bar p'' + c_T(p_S - p_M) = 0 \quad\text{(upper)}, \qquad
# -\tfrac12 T\bar p'' - c_T(p_S - p_M) = -q \quad\text{(lower)},
# $$
# $q$ being what leaks into the rock below. With $p_M = 0$ the mean pressure is $\bar p = p_S/2$,
# and
# $$
# T\bar p'' = 4 c_T\,\bar p, \qquad
# \bar p = p_0\,\frac{\cosh((W - x)/L)}{\cosh(W/L)}, \quad L = \sqrt{\frac{w^3}{12\mu_f\, c}}, \quad
# c = 4 c_T ,
# $$
# which is $p_0\,e^{-x/L}$ far from the closed end at $x = W$. The factor four: $q = 2c_T p_S = 4
# c_T\bar p$, since the lower equation adds what flows in its half of the aperture to what comes
# across. The node at the inlet itself does not leak; so the pressure converges with second order,
# the flow with first.

# %%
import argparse
import sys
import time
from pathlib import Path

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.output.fields import FieldWriter, gather_nodal, write_interface
from fenicsx_hmcontact.output.figures import curves, field_plot, save
from fenicsx_hmcontact.output.report import DemoParser, Report
from fenicsx_hmcontact.output.root import on_root
from meshes.fracture import fracture
from meshes.two_blocks import two_blocks

comm = MPI.COMM_WORLD

KINDS = {
    "triangles": "P1",
    "deviatoric": "smoothed, deviatoric",
    "full": "smoothed, full",
}


def dofs_on(domain, space, *surfaces):
    """Unknowns of a space on surfaces."""
    facets = np.concatenate([domain.facet_tags.find(domain.surface(name)) for name in surfaces])
    return fem.locate_dofs_topological(space, 1, np.sort(facets))


# %% [markdown]
# ## Opening


# %%
def opening(x, options):
    """Sneddon's opening of the crack [m] at a place [m]."""
    o = options
    inside = np.maximum(0.25 * o.length**2 - x**2, 0.0)
    return 4.0 * (1.0 - o.nu**2) * o.pressure / o.E * np.sqrt(inside)


def displacement(x, options):
    """Displacement [m] of an infinite body with a crack under pressure, off the crack itself.

    By Westergaard's function Z = p (z / sqrt(z^2 - a^2) - 1), plane strain (Tada, Paris and Irwin,
    The Stress Analysis of Cracks Handbook, 2000).

    Args:
        x: Points [m]; shape (3, n).
        options: Parameters.

    Returns:
        Displacements; shape (2, n).
    """
    p, nu, a = options.pressure, options.nu, 0.5 * options.length
    z, y = x[0] + 1j * x[1], x[1]
    root = np.sqrt(z - a) * np.sqrt(z + a)
    stress, integral = p * (z / root - 1.0), p * (root - z)
    along = (1.0 - 2.0 * nu) * integral.real - y * stress.imag
    across = 2.0 * (1.0 - nu) * integral.imag - y * stress.real
    return np.array((along, across)) * (1.0 + nu) / options.E


class Crack:
    """Two halves, tied beyond a crack that water opens.

    Args:
        options: Parameters.
        comm: Communicator.
    """

    def __init__(self, options, comm=comm):
        o = self.options = options
        primary = max(round(o.ratio * o.edges), 2)
        self.domain = domain = fracture(
            comm,
            length=o.length,
            size=o.size * o.length,
            upper=o.edges,
            lower=primary,
            growth=o.growth,
        )
        mesh = domain.mesh
        mesh.topology.create_connectivity(1, 2)
        V, Q = fem.functionspace(mesh, ("P", 1, (2,))), fem.functionspace(mesh, ("P", 1))
        self.u, self.p = fem.Function(V, name="displacement"), fem.Function(Q, name="pore pressure")
        v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))
        dt = fem.Constant(mesh, 1.0)
        dc = hm.node_cells_measure(o.smoothing)
        stress = hm.LinearElastic(o.E, o.nu).stress(self.u)
        F = hm.equilibrium(stress, None, v, smoothed=dc)
        flux = hm.darcy_flux(self.p, o.permeability, o.unit_weight)
        F -= dt * ufl.dot(flux, ufl.grad(q)) * dc
        sides = "outside_upper", "outside_lower"
        far = fem.Function(V)
        far.interpolate(lambda x: displacement(x, o))
        bcs = [
            fem.dirichletbc(far, dofs_on(domain, V, *sides)),
            fem.dirichletbc(0.0, dofs_on(domain, Q, *sides), Q),
            fem.dirichletbc(o.pressure, dofs_on(domain, Q, "crack_upper", "crack_lower"), Q),
        ]
        flow = hm.GapFlow(o.permeability, o.viscosity, o.unit_weight)
        bond, self.pair = (
            hm.ContactPair(
                domain.facet_tags,
                domain.surface(f"{name}_upper"),
                domain.surface(f"{name}_lower"),
                friction=friction,
                flow=flow,
                motion="small",
            )
            for name, friction in (("bond", hm.Tied()), ("crack", hm.Frictionless()))
        )
        self.problem = hm.ContactProblem(
            F, [self.u, self.p], bcs=bcs, pairs=[bond, self.pair], time_step=dt, domain=domain
        )

    def solve(self):
        """Open the crack; return Newton's iterations and what is between the halves."""
        iterations = self.problem.solve().iterations
        return iterations, self.problem.interface(self.pair)

    def errors(self, state):
        """Errors of the opening, at the centre and rms, / the largest one, and of the volume."""
        o, here = self.options, ~np.isnan(state.gap)
        x, gap, widest = state.points[here, 0], state.gap[here], opening(0.0, o)
        errors = (gap - opening(x, o)) / widest
        volume = 0.25 * np.pi * o.length * widest
        return {
            "centre_error": errors[np.argmin(np.abs(x))],
            "opening_error": np.sqrt(state.length[here] @ errors**2 / o.length),
            "volume_error": state.volume / volume - 1.0,
        }


def run_opening(options, report):
    """Open a crack by water, against Sneddon."""
    o = options
    crack = Crack(o)
    report.unknowns = crack.problem.n_unknowns
    iterations, state = crack.solve()
    report.step(iterations)
    report.figures |= crack.errors(state)
    gathered = gather_nodal(crack.u)
    for function in (crack.u, crack.p):
        path = o.out / f"{function.name.replace(' ', '_')}.pvd"
        with FieldWriter(path, crack.domain.mesh, [function]) as writer:
            writer.write(0.0)
    write_interface(comm, o.out / "crack.csv", state)

    def draw():
        order, fine = np.argsort(state.points[:, 0]), 0.5 * o.length * np.linspace(-1, 1, 401)
        figure = curves(
            {"computed": (state.points[order, 0], state.gap[order] * 1e3)},
            x=("x", "m"),
            y=("opening", "mm"),
            reference=[(fine, opening(fine, o) * 1e3)],
            reference_label="Sneddon",
        )
        save(figure, o.out / "opening.png")
        points, cells, u = gathered
        near = 1.0 * o.length
        field_plot(
            *(points, cells, u[:, 1] * 1e3, o.out / "crack.png"),
            label="vertical displacement",
            unit="mm",
            title=f"displacements x {0.1 * o.length / opening(0.0, o):.0f}",
            edges=True,
            displacement=u * 0.1 * o.length / opening(0.0, o),
            limits=((-near, near), (-near, near)),
        )

    on_root(comm, draw)


# %% [markdown]
# ## Leak-off
#
# A tied pair knows a constant aperture, always full of water. So the rock's displacements do not
# matter, and a reservoir's pressure is prescribed at the left side of the rock above.


# %%
def leakage_length(options):
    """L [m], in which the pressure falls by the factor e; four times c_T, see above."""
    o = options
    c = 4.0 * o.transverse_permeability / (o.unit_weight * o.aperture)
    return np.sqrt(o.aperture**3 / (12.0 * o.viscosity * c))


def mean_pressure(x, options):
    """Mean pressure in the fracture [Pa] at a place [m]."""
    L, W = leakage_length(options), options.extent
    return options.inlet * np.cosh((W - x) / L) / np.cosh(W / L)


class Leak:
    """A fracture of constant aperture between impermeable and drained rock.

    Args:
        options: Parameters.
        comm: Communicator.
    """

    def __init__(self, options, comm=comm):
        o = self.options = options
        self.domain = domain = two_blocks(
            comm,
            width=o.extent,
            height=0.5 * o.extent,
            upper=o.upper,
            lower=max(round(o.lower_ratio * o.upper), 2),
            rows=4,
        )
        mesh = domain.mesh
        mesh.topology.create_connectivity(1, 2)
        mesh.topology.create_connectivity(2, 2)
        V, Q = fem.functionspace(mesh, ("P", 1, (2,))), fem.functionspace(mesh, ("P", 1))
        self.u, self.p = fem.Function(V, name="displacement"), fem.Function(Q, name="pore pressure")
        v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))
        self.dt = fem.Constant(mesh, 1.0)
        stress = hm.LinearElastic(o.E, o.nu).stress(self.u)
        F = hm.equilibrium(stress, None, v, smoothed=ufl.dx)
        flux = hm.darcy_flux(self.p, o.rock_permeability, o.unit_weight)
        F -= self.dt * ufl.dot(flux, ufl.grad(q)) * ufl.dx
        below = fem.locate_dofs_topological(Q, 2, domain.cell_tags.find(domain.body("lower")))
        left = np.setdiff1d(dofs_on(domain, Q, "left"), below)
        bcs = [
            fem.dirichletbc(np.zeros(2), dofs_on(domain, V, "bottom", "top"), V),
            fem.dirichletbc(0.0, below, Q),
            fem.dirichletbc(o.inlet, left, Q),
        ]
        self.pair = hm.ContactPair(
            domain.facet_tags,
            domain.surface("interface_upper"),
            domain.surface("interface_lower"),
            flow=hm.GapFlow(
                o.transverse_permeability, o.viscosity, o.unit_weight, aperture=o.aperture
            ),
        )
        self.problem = hm.ContactProblem(
            F, [self.u, self.p], bcs=bcs, pairs=[self.pair], time_step=self.dt, domain=domain
        )
        self._inlet, self._below = left, below

    def solve(self):
        """Let the water flow; return Newton's iterations and what is between the rocks."""
        iterations = self.problem.solve().iterations
        return iterations, self.problem.interface(self.pair)

    def errors(self, state):
        """Errors of the mean pressure, of the flow in, and water lost."""
        o = self.options
        exact, L = mean_pressure(state.points[:, 0], o), leakage_length(o)
        flow = o.aperture**3 / (12.0 * o.viscosity) * o.inlet / L * np.tanh(o.extent / L)
        values = self.problem.reactions(self.p).x.array / float(self.dt.value)
        n = self.p.function_space.dofmap.index_map.size_local
        entering, leaving = (
            self.domain.mesh.comm.allreduce(values[nodes[nodes < n]].sum())
            for nodes in (self._inlet, self._below)
        )
        return {
            "leak_pressure_error": np.abs(state.pore_pressure - exact).max() / o.inlet,
            "leak_flow_error": entering / flow - 1.0,
            "mass_balance": abs(entering + leaving) / flow,
        }


def run_leak_off(options, report):
    """Let water leak out of a fracture, against the exact pressure."""
    o = options
    leak = Leak(o)
    report.unknowns = leak.problem.n_unknowns
    iterations, state = leak.solve()
    report.step(iterations)
    report.figures |= leak.errors(state) | {"leakage_length": leakage_length(o)}
    with FieldWriter(o.out / "pore_pressure.pvd", leak.domain.mesh, [leak.p]) as writer:
        writer.write(0.0)
    write_interface(comm, o.out / "fracture.csv", state)

    def draw():
        order, fine = np.argsort(state.points[:, 0]), np.linspace(0.0, o.extent, 401)
        figure = curves(
            {"computed": (state.points[order, 0], state.pore_pressure[order] / 1e3)},
            x=("x", "m"),
            y=("mean pressure in the fracture", "kPa"),
            reference=[(fine, mean_pressure(fine, o) / 1e3)],
            reference_label="exact",
        )
        save(figure, o.out / "pressure.png")

    on_root(comm, draw)


# %% [markdown]
# ## Study


# %%
def study_opening(options):
    """Rows of name, edges, unknowns, seconds, and errors of opening and centre."""
    growth, coarsest = options.growth, 8
    # What is compiled once is not timed.
    Crack(options).solve()
    for kind, name in KINDS.items():
        for edges in coarsest * 2 ** np.arange(4):
            options.smoothing, options.edges = kind, int(edges)
            # The rest of the mesh becomes finer with the crack.
            options.growth = 2.0 * growth * coarsest / edges
            start = time.perf_counter()
            crack = Crack(options)
            _, state = crack.solve()
            seconds = comm.allreduce(time.perf_counter() - start, MPI.MAX)
            unknowns, errors = sum(crack.problem.n_unknowns.values()), crack.errors(state)
            yield name, edges, unknowns, seconds, errors["opening_error"], errors["centre_error"]


def study_leak_off(options):
    """Rows of name, edges, unknowns, seconds, and errors of pressure and flow."""
    Leak(options).solve()
    for ratio in (1.0, 0.5, 1.5):
        for edges in (8, 16, 32, 64, 128):
            options.upper, options.lower_ratio = edges, ratio
            start = time.perf_counter()
            leak = Leak(options)
            _, state = leak.solve()
            seconds = comm.allreduce(time.perf_counter() - start, MPI.MAX)
            unknowns, errors = sum(leak.problem.n_unknowns.values()), leak.errors(state)
            pressure, flow = errors["leak_pressure_error"], errors["leak_flow_error"]
            yield f"lower / upper edges {ratio:g}", edges, unknowns, seconds, pressure, flow


def study(case, options):
    """Table and pictures of the error against wall time and unknowns."""
    from rich.console import Console
    from rich.table import Table

    what, other, rows = {
        "opening": ("rms error of the opening", "at the centre", study_opening),
        "leak-off": ("largest error of the pressure", "of the flow in", study_leak_off),
    }[case]
    table, results = Table(title=f"fracture, {case}"), {}
    for heading in ("", "edges", "unknowns", what, "order", other, "s"):
        table.add_column(heading)
    for name, edges, unknowns, seconds, error, second in rows(options):
        before = results.setdefault(name, [])
        order = f"{np.log2(before[-1][2] / error):.2f}" if before else ""
        before.append((unknowns, seconds, error))
        table.add_row(
            *(name, str(edges), str(unknowns), f"{error:.2e}", order),
            *(f"{second:+.2e}", f"{seconds:.2f}"),
        )
    if comm.rank == 0:
        Console(width=110).print(table)

    def draw():
        for index, quantity, unit in ((0, "unknowns", ""), (1, "wall time", "s")):
            series = {
                name: ([r[index] for r in points], [r[2] for r in points])
                for name, points in results.items()
            }
            figure = curves(
                series,
                x=(quantity, unit),
                y=(what, ""),
                scale=("log", "log"),
                title=f"fracture, {case}",
            )
            save(figure, options.out / f"study_error_against_{quantity.replace(' ', '_')}.png")

    on_root(comm, draw)


# %% [markdown]
# ## The demo

# %%
CASES = {"opening": run_opening, "leak-off": run_leak_off}


def parser(case):
    """Options of a case, or of both."""
    p = DemoParser(
        "fracture", "A fracture: opening under pressure, and leak-off.", comm, study=True
    )
    p.parameter("--case", "both", "", "which part", choices=(*CASES, "both"))
    if case != "leak-off":
        p.parameter("--length", 2.0, "m", "opening: length of the crack")
        p.parameter("--pressure", 2e6, "Pa", "opening: pressure of the water")
        p.parameter("--edges", 48, "-", "opening: edges of the upper half on the crack")
        p.parameter("--ratio", 0.75, "-", "opening: edges of the lower half / upper half")
        p.parameter("--size", 3.0, "-", "opening: side of the square / length of the crack")
        p.parameter("--growth", 0.2, "-", "opening: growth of edges per distance from the crack")
        p.parameter("--permeability", 1e-15, "m/s", "opening: of the rock")
        p.parameter(
            "--smoothing",
            "deviatoric",
            "",
            "opening: enhancement of the smoothed gradient, or unsmoothed P1",
            choices=tuple(KINDS),
        )
    if case != "opening":
        p.parameter("--inlet", 1e5, "Pa", "leak-off: pressure of the water at the left end")
        p.parameter("--aperture", 1e-3, "m", "leak-off: aperture w of the fracture")
        p.parameter("--extent", 2.0, "m", "leak-off: length W of the fracture")
        p.parameter("--transverse-permeability", 1e-6, "m/s", "leak-off: k_T across the fracture")
        p.parameter("--upper", 160, "-", "leak-off: edges of the rock above on the fracture")
        p.parameter("--lower-ratio", 0.7, "-", "leak-off: edges of the rock below / above")
        p.parameter("--rock-permeability", 1e-20, "m/s", "leak-off: of the rock above")
    p.parameter("--E", 2.5e10, "Pa", "Young's modulus")
    p.parameter("--nu", 0.25, "-", "Poisson's ratio")
    p.parameter("--viscosity", 1e-3, "Pa s", "of the water")
    p.parameter("--unit-weight", 1e4, "N/m^3", "of the water")
    return p


def parse(words=None):
    """Read the command line, or given words; return the options of each part that is to run."""
    words = sys.argv[1:] if words is None else words
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--case", choices=(*CASES, "both"), default="both")
    chosen = first.parse_known_args(words)[0].case
    p = parser(chosen)
    for name, value in vars(p.parse_args(words)).items():
        if isinstance(value, int | float) and name not in ("nu", "study") and not value > 0:
            p.error(f"--{name.replace('_', '-')} must be positive, not {value}")
    cases = CASES if chosen == "both" else [chosen]
    return {case: parser(case).parse_known_args(words)[0] for case in cases}


def main():
    """Run the demo."""
    cases = parse()
    options = next(iter(cases.values()))
    report, target = Report("fracture", comm, {}), options.report
    unknowns = {}
    for case, options in cases.items():
        if len(cases) > 1:
            options.out = options.out / case
        if options.study:
            study(case, options)
            continue
        report.parameters[case] = {
            k: v for k, v in vars(options).items() if k not in ("report", "out")
        }
        with report.phase(case):
            CASES[case](options, report)
        unknowns[case] = report.unknowns
    if options.study:
        return
    report.unknowns = unknowns
    report.table()
    report.write(target)


if __name__ == "__main__":
    main()
