# SPDX-License-Identifier: LGPL-3.0-or-later
# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Bearing capacity of a strip footing
#
# A rigid footing is pressed into soil until it sinks without more load. By Prandtl (1920) clay of
# undrained strength $c$ carries $q = (2 + \pi)c$, whether the base is rough or smooth. Elements
# that lock carry more, and ever more the deeper they are pushed.
#
# - No option: Tresca in total stress, nearly incompressible.
# - `--undrained`: the same with pore water that has no time to leave; skeleton and water are apart.
# - `--phi 25 --E 1e7 --smoothing quadratic`: Mohr-Coulomb without weight, $q = cN_c + q_0N_q$ with
#   the surcharge $q_0$. Soil that dilates locks on smoothed gradients: hence quadratic triangles.
# - `--phi 25 --c 20 --weight 2e4 --E 1e7 --settlement 0.2 --h 0.0625 --growth 0.05 --smoothing
#   quadratic`: soil with weight, $q = \gamma b N_\gamma$, with $b$ the half width, from a state at
#   rest with $\sigma_x = K_0\sigma_y$.
#
# The edge of the base pulls the ground beside it down: forces at the nodes of the base are those of
# a base that is half an edge wider, a quarter for quadratic triangles. The corrected figures take
# the wider base.

# %%
import math
import sys
import time
from pathlib import Path

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem, la

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.output.fields import gather_nodal
from fenicsx_hmcontact.output.figures import curves, field_plot, save
from fenicsx_hmcontact.output.report import DemoParser, Report
from fenicsx_hmcontact.output.root import on_root
from fenicsx_hmcontact.solvers.linear import DEFAULT_OPTIONS
from meshes.strip_footing import base_edges, strip_footing

comm = MPI.COMM_WORLD
KINDS = {
    "deviatoric": "smoothed, deviatoric",
    "full": "smoothed, full",
    "none": "smoothed, none",
    "triangles": "P1",
    "quadratic": "P2",
}
QUICK = 0.5
"""Edges of the quick run over the half width."""
ROOM = 1.25
"""Least size of the ground over that of the mechanism."""
UNBALANCED = 1e-6
"""Sum of forces over the load with which a step is refused."""
SOLVER = DEFAULT_OPTIONS | {"mat_mumps_icntl_14": 200}
"""Workspace beyond the estimate [%]: Taylor-Hood at next to no permeability pivots a lot."""
SHOWN = 0.99
"""Part of the nodes whose plastic strain the colours resolve: it is singular at the edge."""
N_GAMMA = {20.0: (1.579, 2.839), 25.0: (3.461, 6.491), 30.0: (7.653, 14.75), 35.0: (17.58, 34.48)}
"""Exact factors of weight of a smooth and a rough base, by angle of friction (Martin 2005)."""


# %% [markdown]
# ## What is known
#
# Of soil without weight Prandtl's and Reissner's (1924) factors are exact, with associated flow:
# $N_q = e^{\pi\tan\varphi}\tan^2(45° + \varphi/2)$ and $N_c = (N_q - 1)\cot\varphi$. With weight
# there are exact figures for $c = q_0 = 0$.


# %%
def factors(phi):
    """Prandtl's N_c and Reissner's N_q for an angle of friction [degrees]."""
    if phi == 0.0:
        return 2.0 + math.pi, 1.0
    slope = math.tan(math.radians(phi))
    N_q = math.exp(math.pi * slope) * math.tan(math.radians(45.0 + 0.5 * phi)) ** 2
    return (N_q - 1.0) / slope, N_q


def mechanism(phi):
    """Width from the axis, and depth, of Prandtl's mechanism over the half width of the base."""
    angle, slope = math.radians(phi), math.tan(math.radians(phi))
    corner = math.pi / 4.0 + 0.5 * angle
    width = 1.0 + 2.0 * math.tan(corner) * math.exp(0.5 * math.pi * slope)
    return width, math.cos(angle) / math.cos(corner) * math.exp(corner * slope)


# %% [markdown]
# ## The model
#
# The stress comes from a `MaterialStress`, in plain UFL otherwise. Settlement is prescribed; the
# load is what the supports of the base do.


# %%
class Footing:
    """Half a strip footing on the ground.

    Args:
        options: Parameters of the demo.
        comm: Communicator.
    """

    def __init__(self, options, comm=comm):
        self.options, o = options, options
        self.domain = strip_footing(
            comm,
            h=o.h,
            half_width=o.half_width,
            width=o.width,
            depth=o.depth,
            growth=o.growth,
        )
        mesh, self.quadratic = self.domain.mesh, o.smoothing == "quadratic"
        measure = hm.node_cells_measure("triangles" if self.quadratic else o.smoothing)
        V = self.V = fem.functionspace(mesh, ("P", 2 if self.quadratic else 1, (2,)))
        self.u, self.u_n = fem.Function(V, name="displacement"), fem.Function(V)
        strength = dict(c=o.c, phi=o.phi, psi=o.psi) if o.phi > 0.0 else dict(c=o.c)
        law = hm.MohrCoulomb if o.phi > 0.0 else hm.Tresca
        self.material = law(o.E, o.nu, **strength)
        self.stress = hm.MaterialStress(self.material, self.u, self.u_n, measure)
        self.stress.set_stress(self.at_rest)

        self.dt = fem.Constant(mesh, o.duration / o.steps)
        self.settlement = fem.Constant(mesh, 0.0 if o.smooth_base else np.zeros(2))
        conditions = [self.held(name, 0) for name in ("axis", "side", "bottom")]
        conditions.append(self.held("bottom", 1))
        base = V.sub(1) if o.smooth_base else V
        dofs = fem.locate_dofs_topological(base, 1, self.facets("base"))
        conditions.append(fem.dirichletbc(self.settlement, dofs, base))
        if o.undrained:
            F, unknowns, previous = self.with_water(conditions)
        else:
            F, unknowns, previous = self.equilibrium(None, ufl.TestFunction(V)), [self.u], []
        self.problem = hm.ContactProblem(
            F,
            unknowns,
            bcs=conditions,
            newton=hm.NewtonOptions(tolerance=o.tolerance),
            petsc_options=SOLVER,
            domain=self.domain,
        )
        self.model = hm.TransientModel(
            self.problem,
            self.dt,
            previous=[(self.u_n, self.u), *previous],
            histories=[(self.settlement, self.path)],
            check=self.check,
        )
        vertical = fem.locate_dofs_topological(V.sub(1), 1, self.facets("base"))
        self.base = vertical[vertical < V.dofmap.bs * V.dofmap.index_map.size_local]
        self.history = {"settlement": [0.0], "q_over_c": [self.pressure_at_rest(0.0) / o.c]}
        self.steps, self.imbalances = [], []

    def equilibrium(self, p, v):
        """Weak form of equilibrium under weight and surcharge."""
        o, mesh = self.options, self.domain.mesh
        ds = ufl.Measure("ds", domain=mesh, subdomain_data=self.domain.facet_tags)
        weight = fem.Constant(mesh, np.array([0.0, -o.weight])) if o.weight > 0.0 else None
        stress, measure = self.stress.stress, self.stress.measure
        F = hm.equilibrium(stress, p, v, body_force=weight, smoothed=measure)
        if o.surcharge > 0.0:
            F += fem.Constant(mesh, o.surcharge) * v[1] * ds(self.domain.surface("surface"))
        return F

    def with_water(self, conditions):
        """Weak form with excess pore pressures, drained at the free surface."""
        o, mesh = self.options, self.domain.mesh
        measure = ufl.dx if self.quadratic else hm.node_cells_measure(o.smoothing)
        Q = fem.functionspace(mesh, ("P", 1))
        p, p_n = fem.Function(Q, name="pressure"), fem.Function(Q)
        v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(self.V, Q))
        F = self.equilibrium(p, v) + hm.water_balance(
            self.u,
            self.u_n,
            p,
            q,
            self.dt,
            permeability=fem.Constant(mesh, o.permeability),
            unit_weight=o.unit_weight,
            smoothed=measure,
        )
        if not self.quadratic:
            F += hm.pressure_projection(p, p_n, q, self.material.shear_modulus, tau=o.tau)
        free = fem.locate_dofs_topological(Q, 1, self.facets("surface"))
        conditions.append(fem.dirichletbc(0.0, free, Q))
        return F, [self.u, p], [(p_n, p)]

    def facets(self, surface):
        """Facets of a surface."""
        return self.domain.facet_tags.find(self.domain.surface(surface))

    def held(self, surface, component):
        """Condition that a surface keeps its place in one direction."""
        space = self.V.sub(component)
        dofs = fem.locate_dofs_topological(space, 1, self.facets(surface))
        return fem.dirichletbc(0.0, dofs, space)

    def pressure_at_rest(self, depth):
        """Vertical effective pressure before the footing sinks [Pa]."""
        return self.options.surcharge + self.options.weight * depth

    def at_rest(self, x):
        """Effective stress xx, yy, zz, xy before the footing sinks [Pa]; shape (4, n)."""
        down = -self.pressure_at_rest(-x[1])
        across = self.options.k0 * down
        return np.array([across, down, across, 0.0 * down])

    def path(self, t):
        """Displacement of the base at a time [m]."""
        down = -self.options.settlement * t / self.options.duration
        return down if self.options.smooth_base else (0.0, down)

    def push(self):
        """Push the footing down, and keep its load after each step."""
        o = self.options
        stepping = hm.TimeStepping(self.model)
        for step in stepping.run(o.duration, dt=o.duration / o.steps, bar="settlement"):
            self.steps.append(step)
            self.imbalances.append(self.imbalance())
            self.history["settlement"].append(o.settlement * step.t / o.duration)
            self.history["q_over_c"].append(self.load() / (o.half_width * o.c))

    def check(self):
        """Refuse a step whose forces do not balance, however small its residual looks."""
        if not self.imbalance() < UNBALANCED:
            raise hm.StepRejected(f"out of balance by {self.imbalance():.1e} of the load")

    def imbalance(self):
        """Vertical forces of all supports less weight and surcharge, over the load [-]."""
        o, V = self.options, self.V
        forces = self.problem.reactions(self.u).x.array[: 2 * V.dofmap.index_map.size_local]
        carried = self.problem.comm.allreduce(forces[1::2].sum())
        applied = o.weight * o.width * o.depth + o.surcharge * (o.width - o.half_width)
        return abs(carried - applied) / max(abs(self.load()), applied)

    def load(self):
        """Load on half the footing [N/m]."""
        forces = self.problem.reactions(self.u).x.array
        return -self.problem.comm.allreduce(forces[self.base].sum())

    @property
    def wider(self):
        """What the forces at the nodes of the base add to its half width, relative to it [-]."""
        nodes = base_edges(self.options.h, self.options.half_width) * (2 if self.quadratic else 1)
        return 0.5 / nodes

    def figures(self):
        """Figures of the report."""
        o, s, q = self.options, self.history["settlement"], self.history["q_over_c"]
        iterations = [step.iterations for step in self.steps]
        N_c, N_q = factors(o.phi)
        found = {
            "q_over_c": q[-1],
            "q_over_c_corrected": q[-1] / (1.0 + self.wider),
            "plateau_slope": (q[-1] - q[-2]) / (s[-1] - s[-2]),
            "newton_mean": float(np.mean(iterations)),
            "newton_max": max(iterations),
            "failed_steps": sum(step.cuts for step in self.steps),
            "imbalance": max(self.imbalances),
        }
        if o.weight == 0.0:
            found["q_over_c_exact"] = N_c + N_q * o.surcharge / o.c
        else:
            found["N_gamma"] = q[-1] * o.c / (o.weight * o.half_width)
            # Load goes with the square of the width: it is what the corrected load is divided by.
            found["N_gamma_corrected"] = found["N_gamma"] / (1.0 + self.wider) ** 2
            if o.phi in N_GAMMA:
                found["N_gamma_exact"] = N_GAMMA[o.phi][not o.smooth_base]
        return found

    def plastic_strain(self):
        """Equivalent plastic strain at the nodes, the mean of the points around each."""
        kappa = self.stress.history("kappa").mean(axis=1)
        field = fem.Function(fem.functionspace(self.domain.mesh, ("P", 1)), name="plastic strain")
        cells = self.stress.node_cells
        if cells is not None:
            field.x.array[cells.block_dofs(field.function_space)[: len(cells)]] = kappa
            return field
        constant = fem.Function(fem.functionspace(self.domain.mesh, ("DG", 0)))
        constant.x.array[: kappa.size] = kappa
        constant.x.scatter_forward()
        q = ufl.TestFunction(field.function_space)
        sums = []
        for form in (constant * q * ufl.dx, q * ufl.dx(self.domain.mesh)):
            vector = fem.assemble_vector(fem.form(form))
            vector.scatter_reverse(la.InsertMode.add)
            sums.append(vector.array)
        owned = field.function_space.dofmap.index_map.size_local
        field.x.array[:owned] = sums[0][:owned] / sums[1][:owned]
        return field


# %% [markdown]
# ## Pictures and study


# %%
def draw_load(footing):
    """Draw the load against the settlement."""
    o, figures = footing.options, footing.figures()
    s, q = (np.array(footing.history[name]) for name in ("settlement", "q_over_c"))
    name, scale, power = "q / c", 1.0, 1
    exact = figures.get("q_over_c_exact")
    if o.weight > 0.0:
        name, scale, power = "q / (unit weight b)", o.c / (o.weight * o.half_width), 2
        exact = figures.get("N_gamma_exact")
    wider = (1.0 + footing.wider) ** power
    figure = curves(
        {"nodal forces": (s, scale * q), "corrected for the edge": (s, scale * q / wider)},
        x=("settlement", "m"),
        y=(name, ""),
        reference=[] if exact is None else [(s[[0, -1]], [exact, exact])],
        title=f"{KINDS[o.smoothing]}, h = {o.h:g} m",
    )
    save(figure, o.out / "load.png")


def draw_plastic_strain(gathered, options):
    """Draw the equivalent plastic strain, all of it and around the footing."""
    points, cells, values = gathered
    width, depth = (ROOM * options.half_width * x for x in mechanism(options.phi))
    near = (0.0, min(width, options.width)), (-min(depth, options.depth), 0.0)
    for name, limits in (("plastic_strain", None), ("mechanism", near)):
        field_plot(
            points,
            cells,
            values,
            options.out / f"{name}.png",
            label="equivalent plastic strain",
            unit="",
            title=f"{KINDS[options.smoothing]}, settlement {options.settlement:g} m",
            edges=limits is not None,
            clim=(0.0, float(np.quantile(values, SHOWN))),
            limits=limits,
        )


def print_residuals(steps):
    """Print the residuals of the step with most iterations: they fall quadratically."""
    from rich.console import Console
    from rich.table import Table

    slowest = max(steps, key=lambda step: step.iterations)
    table = Table(title=f"residuals over the increment, step {1 + steps.index(slowest)}")
    table.add_column("iteration")
    table.add_column("largest residual")
    for i, residuals in enumerate(slowest.result.history, start=1):
        table.add_row(str(i), f"{max(residuals):.1e}")
    if comm.rank == 0:
        Console().print(table)
    return [max(residuals) for residuals in slowest.result.history]


def study(options):
    """Error of the load against wall time and unknowns for every discretisation."""
    from rich.console import Console
    from rich.table import Table

    exact = options.c * factors(options.phi)[0] + options.surcharge * factors(options.phi)[1]
    exact /= options.c
    results = {}
    title = f"strip footing, nu = {options.nu:g}{', undrained' if options.undrained else ''}"
    table = Table(title=f"{title}: q/c, exact {exact:.4f}")
    columns = "discretisation", "h", "unknowns", "q/c", "corrected", "slope", "iterations", "s"
    for heading in columns:
        table.add_column(heading)
    for kind, name in KINDS.items():
        for h in (0.5, 0.25, 0.125):
            options.smoothing, options.h = kind, h * options.half_width
            start = time.perf_counter()
            footing = Footing(options)
            footing.push()
            seconds = comm.allreduce(time.perf_counter() - start, MPI.MAX)
            figures, unknowns = footing.figures(), sum(footing.problem.n_unknowns.values())
            q, corrected = figures["q_over_c"], figures["q_over_c_corrected"]
            results.setdefault(name, []).append((unknowns, seconds, abs(q / exact - 1.0)))
            slope, newton = figures["plateau_slope"], figures["newton_mean"]
            numbers = f"{q:.3f}", f"{corrected:.3f}", f"{slope:.2f}", f"{newton:.2f}"
            table.add_row(name, f"{h:g}", str(unknowns), *numbers, f"{seconds:.1f}")
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
                y=("error of the load", ""),
                scale=("log", "log"),
                title=title,
            )
            save(figure, options.out / f"study_error_against_{what.replace(' ', '_')}.png")

    on_root(comm, draw)


# %% [markdown]
# ## The demo


# %%
def parse(words=None):
    """Read the command line, or given words; return options and parameters of the report."""
    p = DemoParser(
        "strip_footing",
        "Bearing capacity of a strip footing on Tresca or Mohr-Coulomb soil.",
        comm,
        quick=True,
        study=True,
    )
    p.parameter("--h", 0.25, "m", "edges under the footing")
    p.parameter("--smooth-base", False, "", "base without friction; rough otherwise")
    p.parameter("--undrained", False, "", "pore water apart from the skeleton")
    p.parameter("--E", 1e6, "Pa", "Young's modulus")
    p.parameter("--nu", 0.49, "-", "Poisson's ratio; 0.3 where --undrained or --phi is given,")
    p.parameter("--c", 1e4, "Pa", "shear strength or cohesion")
    p.parameter("--phi", 0.0, "degrees", "angle of friction")
    p.parameter("--psi", 0.0, "degrees", "angle of dilation; that of friction if left out,")
    p.parameter("--weight", 0.0, "N/m^3", "unit weight, with pore water that under buoyancy")
    p.parameter("--surcharge", 0.0, "Pa", "load on the surface beside the footing")
    p.parameter("--k0", 1.0, "-", "stress ratio at rest; 1 - sin phi if left out,")
    p.parameter("--half-width", 1.0, "m", "half width of the footing")
    p.parameter("--width", 5.0, "m", "width of the ground; at least 1.25 mechanisms if left out,")
    p.parameter("--depth", 5.0, "m", "depth of the ground; at least 1.25 mechanisms if left out,")
    p.parameter("--growth", 0.0, "-", "growth of edges per distance from the base")
    p.parameter("--settlement", 0.3, "m", "settlement at the end")
    p.parameter("--steps", 30, "-", "steps; those that fail are cut")
    p.parameter("--duration", 30.0, "s", "time that the settlement takes")
    p.parameter("--permeability", 1e-12, "m/s", "permeability, with --undrained")
    p.parameter("--unit-weight", 1e4, "N/m^3", "unit weight of water, with --undrained")
    p.parameter("--tau", 1.0, "-", "stabilisation of the pore pressure, with --undrained")
    p.parameter("--tolerance", 1e-8, "-", "residual over increment at which a step has converged")
    p.parameter(
        "--smoothing",
        "deviatoric",
        "",
        "enhancement of the smoothed gradient, or unsmoothed P1, or P2 (Taylor-Hood with water)",
        choices=tuple(KINDS),
    )
    p.set_defaults(nu=None, psi=None, k0=None, width=None, depth=None)
    o = p.parse_args(words)
    for name in ("h", "half_width", "settlement", "duration", "steps", "c", "tolerance"):
        if not getattr(o, name) > 0:
            p.error(f"--{name.replace('_', '-')} must be positive, not {getattr(o, name)}")
    for name in ("weight", "surcharge"):
        if not getattr(o, name) >= 0.0:
            p.error(f"--{name} must be zero or positive, not {getattr(o, name)}")
    if o.psi is not None and o.phi == 0.0:
        p.error("--psi goes with --phi: the law of Tresca has no dilation")
    width, depth = mechanism(o.phi)
    left_out = {
        "nu": 0.3 if o.undrained or o.phi > 0.0 else 0.49,
        "psi": o.phi,
        "k0": 1.0 - math.sin(math.radians(o.phi)),
        "width": o.half_width * max(5.0, ROOM * width),
        "depth": o.half_width * max(5.0, ROOM * depth),
    }
    for name, value in left_out.items():
        if getattr(o, name) is None:
            setattr(o, name, value)
    if o.quick:
        o.h = max(o.h, QUICK * o.half_width)
    return o, p.parameters(o)


def main():
    """Run the demo."""
    options, parameters = parse()
    if options.study:
        study(options)
        return
    report = Report("strip_footing", comm, parameters)
    with report.phase("set up"):
        footing = Footing(options)
    with report.phase("steps"):
        footing.push()
    for step in footing.steps:
        report.step(step.iterations)
    report.unknowns = footing.problem.n_unknowns
    report.figures |= footing.figures()
    report.figures["load_curve"] = footing.history
    report.figures["residuals"] = print_residuals(footing.steps)
    gathered = gather_nodal(footing.plastic_strain())

    def draw():
        draw_load(footing)
        draw_plastic_strain(gathered, options)

    on_root(comm, draw)
    report.table()
    report.write(options.report)


if __name__ == "__main__":
    main()
