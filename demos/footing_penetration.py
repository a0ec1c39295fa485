# SPDX-License-Identifier: LGPL-3.0-or-later
# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A footing pushed into the ground above a cavity
#
# Section 5.2 of the paper: a rigid footing, 2 m wide, is pushed 1 m deep into saturated clay. Two
# metres below lies a lens-shaped cavity, full of water. It is squeezed until it closes, and goes on
# being sheared while it is closed. The clay follows Tresca's law with $c$ = 10 kPa. Friction and
# cohesion act on the base and the sides of the footing, and between the faces of the cavity.
#
# The water decides when the cavity closes. The paper prints a unit weight of 1000 kN/m³ and a
# viscosity of 10 Pa s; water has 10 kN/m³ and 1 mPa s. Both are run.
#
# A conventional interface element has the pressures of both faces as unknowns, and its matrix
# becomes singular as the gap closes. Its condition number is computed for the same states of the
# same mesh, whose nodes lie opposite each other at the start.

# %%
import argparse
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

from mpi4py import MPI

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.contact import gather_surface, surface_values
from fenicsx_hmcontact.gap_flow.conventional import ConventionalInterface
from fenicsx_hmcontact.output.figures import curves, field_plot, save
from fenicsx_hmcontact.output.film import film
from fenicsx_hmcontact.output.report import DemoParser, Report
from fenicsx_hmcontact.output.root import on_root
from fenicsx_hmcontact.output.series import Series, gather_frame
from fenicsx_hmcontact.solvers.condition import normalised_condition
from meshes.footing_over_cavity import footing_over_cavity

comm = MPI.COMM_WORLD

FACES = "cavity_upper", "cavity_lower"
CLOSED = 1e-16
"""Aperture of a closed conventional element [m], as in Section 5.1 of the paper."""
SINGULAR = 1.0 / float(np.finfo(float).eps)
"""Condition number of a matrix that is singular to working precision."""
ROUND_OFF = 1e-9
"""A place counts as in a triangle up to this part of its height."""
SHEAR = 3
"""Component xy of stresses xx, yy, zz, xy."""
IN_SIGHT = (-4.0, 4.0), (-4.5, 1.6)
"""What films and pictures show [m]."""


# %% [markdown]
# ## The scene
#
# Free water stands on the ground where the footing does not cover it. Wide gaps lead so well that
# the matrix would suffer; beyond the cap of the aperture the pressure in the gap is uniform to
# $10^{-5}$. One closed node seals: what is squeezed out must not leak through pinched facets.
#
# Water that is trapped balloons the tips of the cavity and drives its faces over each other: with
# the printed values the faces are remeshed, and friction follows the pressures of the step's start.


# %%
def matched(options, water):
    """Whether nodes of facing surfaces lie opposite each other, for conventional elements."""
    return options.matching and water == "water"


def describe(options, water):
    """The scene with one of the waters."""
    o = options
    domain = footing_over_cavity(
        comm,
        h=o.h,
        growth=o.growth,
        ratio=o.ratio,
        matching=matched(o, water),
        half_width=o.half_width,
        height=o.height,
        width=o.width,
        depth=o.depth,
        cavity_half_width=o.cavity_half_width,
        cavity_depth=o.cavity_depth,
        cavity_radius=o.cavity_radius,
    )
    unit_weight, viscosity = o.unit_weight, o.viscosity
    if water == "printed":
        unit_weight, viscosity = o.printed_unit_weight, o.printed_viscosity
    scene = hm.Scene(domain)
    scene.water(unit_weight)
    scene.body("soil", hm.Tresca(E=o.E, nu=o.nu, c=o.c), permeability=o.permeability, tau=o.tau)
    scene.body("footing", hm.LinearElastic(E=o.footing_E, nu=o.footing_nu))
    between = {
        "friction": hm.CoulombFriction(o.mu, o.cohesion, lagged=water == "printed"),
        "flow": hm.GapFlow(
            o.transverse_permeability,
            viscosity=viscosity,
            unit_weight=unit_weight,
            aperture_cap=(12.0 * viscosity * 1e6 * o.permeability * o.h / unit_weight) ** (1 / 3),
            sealing=True,
        ),
    }
    scene.contact("footing_base", "ground", name="base", **between)
    # The wall of soil beside the footing is free but where it is next to it.
    near = hm.MortarOptions(search_radius=o.side_search)
    for side in ("left", "right"):
        scene.contact(f"footing_{side}", "ground", name=side, mortar=near, **between)
    scene.contact(*FACES, name="cavity", **between)
    scene.fix("left", "x")
    scene.fix("right", "x")
    scene.fix("bottom")
    scene.move("footing_top", x=0.0, y=lambda t: -o.settlement * t / o.duration)
    scene.drain("ground")
    return scene


# %% [markdown]
# ## What is looked at
#
# The conventional element stays on the nodes that lay opposite each other at the start, which
# remeshing keeps.


# %%
def conventional_condition(model, state):
    """Condition number with conventional elements in the cavity, at most that of round-off."""
    domain, problem = model.domain, model.problem
    tags = [domain.surface(name) for name in FACES]
    faces = [gather_surface(domain.mesh, domain.facet_tags, tag, str(tag)) for tag in tags]
    moved = tuple(surface_values(model.u_n, domain.facet_tags, tag)[1] for tag in tags)
    flow = model.pairs["cavity"].flow
    elements = ConventionalInterface(*faces, flow, problem.layout, moved)
    matrix, prescribed = problem.bulk_tangent()
    aperture = np.where(state.closed | ~(state.gap > CLOSED), CLOSED, state.gap)
    found = []

    def compute():
        dt = float(model.dt.value)
        system, _ = elements.system(matrix, prescribed, aperture, dt, closed=state.closed)
        found.append(min(float(normalised_condition(system)), SINGULAR))

    on_root(comm, compute)
    return comm.bcast(found[0] if found else None)


def wet_triangles(frame):
    """Points, triangles and pressures [Pa] of the soil in a frame."""
    p = frame.nodal["pore pressure"]
    return frame.points, frame.cells[np.isfinite(p[frame.cells]).all(axis=1)], p


def asymmetry(frame):
    """Root mean square of p(x, y) - p(-x, y) over that of p, at the nodes of the soil."""
    points, cells, p = wet_triangles(frame)
    nodes = np.unique(cells)
    mirrored = np.full(len(nodes), np.nan)
    first, *sides = np.moveaxis(points[cells], 1, 0)
    sides = np.stack(sides, axis=-1) - first[..., None]
    for i, (x, y) in enumerate(points[nodes]):
        # Faces that touch overlap by round-off: the triangle that holds the place best.
        weights = np.linalg.solve(sides, ((-x, y) - first)[..., None])[..., 0]
        weights = np.column_stack((1.0 - weights.sum(axis=1), weights))
        best = int(np.argmax(weights.min(axis=1)))
        if weights[best].min() > -ROUND_OFF:
            mirrored[i] = weights[best] @ p[cells[best]]
    seen = np.isfinite(mirrored)
    difference = (p[nodes] - mirrored)[seen]
    return float(np.sqrt(np.mean(difference**2) / np.mean(p[nodes][seen] ** 2)))


def pressure_jump(model, state):
    """Largest difference of both faces' pressures where the cavity is closed, over the largest.

    None where it is closed nowhere.
    """
    if not state.closed.any():
        return {"pressure_drop": None, "pressure_jump": None}
    (upper, p_upper), (lower, p_lower) = (
        surface_values(model.p, model.porous.facet_tags, model.porous.surface(name))
        for name in FACES
    )
    order = np.argsort(lower[:, 0])
    opposite = np.interp(upper[:, 0], lower[order, 0], p_lower[order, 0])
    jump = np.abs(p_upper[:, 0] - opposite)[state.closed]
    largest = comm.allreduce(float(np.abs(model.p.x.array).max(initial=0.0)), MPI.MAX)
    return {
        "pressure_drop": float(np.abs(state.jump[state.closed]).max()) / largest,
        "pressure_jump": float(jump.max()) / largest,
    }


@dataclass
class History:
    """What a run leaves for figures, a value for each of the asked steps.

    Attributes:
        settlement: Of the footing [m].
        load: On it [N/m].
        gap: At the centre of the cavity [m].
        volume: Of the cavity [m^2].
        closed: Number of nodes where its faces touch.
        condition: Condition number.
        conventional: The same with conventional elements.
        asymmetry: Of the pore pressure.
        iterations: Of Newton's method in each of the steps and parts of steps.
        cuts: How often steps were cut.
        remeshes: How often bodies were remeshed.
        closure_step: The step in which the centre closes; None if it does not.
        jump: Differences of pressures of the closed faces at the end.
        lost: Water that is missing after all steps [m^2].
        moved: Water that moved in all steps [m^2].
        frame: Fields at the end, on rank 0.
        failure: Why the run ended early.
        seconds: Wall time.
    """

    settlement: list = field(default_factory=list)
    load: list = field(default_factory=list)
    gap: list = field(default_factory=list)
    volume: list = field(default_factory=list)
    closed: list = field(default_factory=list)
    condition: list = field(default_factory=list)
    conventional: list = field(default_factory=list)
    asymmetry: list = field(default_factory=list)
    iterations: list = field(default_factory=list)
    cuts: int = 0
    remeshes: int = 0
    closure_step: int | None = None
    jump: dict = field(default_factory=dict)
    lost: float = 0.0
    moved: float = 0.0
    frame: object = None
    failure: str = ""
    seconds: float = 0.0

    @property
    def balance(self):
        """Water that is missing over what moved."""
        return self.lost / self.moved if self.moved else 0.0


# %% [markdown]
# ## The run
#
# Steps are even in time. The first ones, in which the clay begins to yield, are taken in shorter
# parts.


# %%
def push(options, water, report, series=None, conditions=True):
    """Push the footing in; return the scene and its history."""
    o, history, begin = options, History(), time.perf_counter()
    scene, step_length = describe(o, water), o.duration / o.steps
    keep = FACES if matched(o, water) else ()
    # The load is as wide as the edges at the footing's corners are long, which stretch.
    remesh = hm.Remeshing(
        keep=keep,
        fire_angle=o.fire_angle,
        fire_boundary_edge=1.04 * o.boundary_edge,
        longest_boundary_edge=o.boundary_edge,
        fill_creases=o.fill_creases,
    )
    newton = hm.NewtonOptions(o.tolerance, o.max_iterations)
    asked = step_length * np.arange(1, o.steps + 1)
    early = asked[: o.early_steps]
    stages = [(early, o.early_parts), (asked[len(early) :], o.parts)]
    words = {"kinematics": "finite", "remesh": remesh, "newton": newton, "bar": water}
    try:
        for times, parts in stages:
            if len(times):
                for step in scene.run(list(times), step_length / parts, **words):
                    report.step(step.iterations)
                    look(history, o, water, scene.model, step, series, conditions)
    except hm.TimeSteppingError as error:
        history.failure = str(error)
    report.unknowns = scene.model.problem.n_unknowns
    history.remeshes = len(scene.simulation.records)
    history.seconds = time.perf_counter() - begin
    return scene, history


def look(history, options, water, model, step, series, conditions):
    """Take down what a step brought."""
    history.iterations.append(step.iterations)
    history.cuts += step.cuts
    lost, moved = model.water_balance()
    history.lost, history.moved = history.lost + abs(lost), history.moved + moved
    if not step.asked:
        return
    state = model.contact("cavity")
    centre = int(np.argmin(np.abs(state.points[:, 0])))
    history.settlement.append(options.settlement * step.t / options.duration)
    history.load.append(-model.force("footing_top")[1])
    history.gap.append(state.gap[centre])
    history.volume.append(state.volume)
    history.closed.append(int(state.closed.sum()))
    if history.closure_step is None and state.closed[centre]:
        history.closure_step = len(history.load)
    if conditions:
        history.condition.append(model.problem.condition_number())
        if matched(options, water):
            history.conventional.append(conventional_condition(model, state))
    history.jump = pressure_jump(model, state)
    stress = model.nodal_stress()
    fields = [model.u, model.p, stress, model.nodal_history()]
    frame = history.frame = gather_frame(step.t, fields, (model.u, model.u_n))
    history.asymmetry.append(comm.bcast(asymmetry(frame) if frame is not None else None))
    if series is not None:
        series.write(step.t, fields, (model.u, model.u_n))


# %% [markdown]
# ## Pictures


# %%
def draw(histories, options, out):
    """Figures 8 to 10 of the paper, load and gap; on rank 0."""
    first = next(iter(histories.values()))
    steps = np.arange(1, len(first.load) + 1)
    if first.condition:
        lines = {"here": (steps, first.condition)}
        if first.conventional:
            finite = np.isfinite(first.conventional)
            lines["conventional element"] = steps[finite], np.array(first.conventional)[finite]
        axes = {"x": ("step", ""), "y": ("condition number", "")}
        save(curves(lines, **axes, scale=("linear", "log")), out / "fig8_condition_number.png")
    loads = {
        name: ([0.0, *h.settlement], np.array([0.0, *h.load]) / 1e3)
        for name, h in histories.items()
    }
    axes = {"x": ("settlement", "m"), "y": ("load", "kN/m")}
    strip = (2.0 + np.pi) * options.c * 2.0 * options.half_width / 1e3
    known = {"reference": [([0.0, options.settlement], [strip, strip])]}
    save(curves(loads, **axes, **known, reference_label="(2 + π) c B"), out / "load.png")
    gaps = {
        name: (np.arange(1, len(h.gap) + 1), np.array(h.gap) * 1e3) for name, h in histories.items()
    }
    axes = {"x": ("step", ""), "y": ("gap at the centre of the cavity", "mm")}
    save(curves(gaps, **axes), out / "gap.png")
    for name, h in histories.items():
        if h.frame is None:
            continue
        points, cells, p = wet_triangles(h.frame)
        pictures = {
            f"fig9_pore_pressure_{name}": ("pore pressure", p, "viridis"),
            f"fig10_shear_stress_{name}": (
                "shear stress",
                h.frame.nodal["stress"][:, SHEAR],
                "RdBu",
            ),
        }
        nodes = np.unique(cells)
        row = np.searchsorted(nodes, cells)
        for file, (label, values, cmap) in pictures.items():
            shown = {"label": label, "unit": "kPa", "cmap": cmap, "limits": IN_SIGHT}
            shown["title"] = f"{name}, settlement {h.settlement[-1]:.2g} m"
            if cmap == "RdBu":
                shown["clim"] = (-options.c / 1e3, options.c / 1e3)
            field_plot(points[nodes], row, values[nodes] / 1e3, out / f"{file}.png", **shown)


# %% [markdown]
# ## Figures


# %%
def figures_of(histories):
    """What the report holds; where there are two waters, condition and load are of the first."""
    first = next(iter(histories.values()))
    every = list(histories.values())
    return {
        "load_curve": list(zip(first.settlement, first.load, strict=True)),
        "closure_step": {name: h.closure_step for name, h in histories.items()},
        "condition_number": first.condition,
        "condition_number_conventional": first.conventional,
        "asymmetry": max((a for h in every for a in h.asymmetry), default=0.0),
        "failed_steps": sum(bool(h.failure) for h in every),
        "newton_median": float(np.median([n for h in every for n in h.iterations] or [0])),
        "water_balance": max(h.balance for h in every),
        "runs": {
            name: {
                "load": h.load,
                "gap": h.gap,
                "volume": h.volume,
                "closed_nodes": h.closed,
                "asymmetry": h.asymmetry,
                "newton_median": float(np.median(h.iterations or [0])),
                "newton_max": max(h.iterations, default=0),
                "parts_of_steps": len(h.iterations),
                "cuts": h.cuts,
                "remeshes": h.remeshes,
                "water_balance": h.balance,
                "failure": h.failure,
                "seconds": h.seconds,
                **h.jump,
            }
            for name, h in histories.items()
        },
    }


def study(options, report):
    """Load over settlement on several meshes, with one water."""
    from rich.console import Console
    from rich.table import Table

    o, loads, failures, rows = options, {}, {}, []
    for h in o.meshes:
        o.h = h
        scene, history = push(o, waters(o)[0], report, conditions=False)
        loads[h] = history.settlement, np.array(history.load)
        failures[h] = history.failure
        unknowns = sum(scene.model.problem.n_unknowns.values())
        rows.append((h, unknowns, float(np.median(history.iterations)), history.seconds))
    finest = loads[min(loads)][1]
    # Runs that end early are compared as far as all came.
    common = min(len(load) for _, load in loads.values())
    if common == 0:
        raise RuntimeError(f"a run of the study has no step: {failures}")
    differences = {h: load[:common] / finest[:common] - 1.0 for h, (_, load) in loads.items()}
    report.figures |= {
        "failed_steps": sum(bool(failure) for failure in failures.values()),
        "failure": {str(h): failure for h, failure in failures.items()},
        "loads": {str(h): load for h, (_, load) in loads.items()},
        "difference_mean": {str(h): float(np.abs(d).mean()) for h, d in differences.items()},
        "difference_max": {str(h): float(np.abs(d).max()) for h, d in differences.items()},
    }
    if comm.rank == 0:
        table = Table(title="load, relative to that of the finest mesh")
        for heading in (
            "h [m]",
            "unknowns",
            "mean",
            "largest",
            "reached [m]",
            "load there [kN/m]",
            "solves",
            "s",
        ):
            table.add_column(heading)
        for h, unknowns, solves, seconds in rows:
            d = np.abs(differences[h])
            last = f"{loads[h][0][-1]:.2f}", f"{loads[h][1][-1] / 1e3:.1f}"
            words = f"{d.mean():.1%}", f"{d.max():.1%}", *last, f"{solves:g}", f"{seconds:.0f}"
            table.add_row(f"{h:g}", str(unknowns), *words)
        Console(width=100).print(table)

    def picture():
        lines = {f"h = {h:g} m": (d, load / 1e3) for h, (d, load) in loads.items()}
        axes = {"x": ("settlement", "m"), "y": ("load", "kN/m")}
        save(curves(lines, **axes), o.out / "study_load.png")

    on_root(comm, picture)


# %% [markdown]
# ## The demo

# %%
QUICK = {"h": 0.4, "settlement": 0.3, "steps": 6, "duration": 900.0, "printed": False}
"""Parameters of --quick: the first 0.3 m on a coarse mesh, with water."""
FINE = {"h": 0.15}
"""Edges of --fine [m]."""


def waters(options):
    """Waters to be run."""
    if options.printed is None:
        return ["water", "printed"]
    return ["printed" if options.printed else "water"]


def parse(words=None):
    """Read the command line, or given words; return options and parameters of the report."""
    p = DemoParser(
        "footing_penetration",
        "A footing is pushed into the ground above a cavity, which closes (Section 5.2).",
        comm,
        quick=True,
        study=True,
    )
    p.add_argument("--fine", action="store_true", help=f"edges of {FINE['h']:g} m")
    p.add_argument(
        "--printed",
        action=argparse.BooleanOptionalAction,
        help="the water that the paper prints alone, or water alone (default: both)",
    )
    p.parameter("--h", 0.2, "m", "edges of the soil between footing and cavity")
    p.parameter("--growth", 0.3, "-", "by how much edges grow per distance from there")
    p.parameter("--ratio", 0.8, "-", "edges of facing surfaces, without --matching")
    p.parameter("--matching", True, "", "facing nodes at the same x, in the run with water")
    p.parameter("--half-width", 1.0, "m", "half width of the footing")
    p.parameter("--height", 1.5, "m", "height of the footing")
    p.parameter("--width", 12.0, "m", "width of the soil")
    p.parameter("--depth", 6.0, "m", "depth of the soil")
    p.parameter("--cavity-half-width", 1.0, "m", "half width of the cavity")
    p.parameter("--cavity-depth", 2.0, "m", "depth of its lower face")
    p.parameter("--cavity-radius", 5.0, "m", "radius of its upper face")
    p.parameter("--settlement", 1.0, "m", "settlement of the footing at the end")
    p.parameter("--duration", 3000.0, "s", "time that it takes")
    p.parameter("--steps", 20, "-", "steps")
    p.parameter("--early-steps", 3, "-", "steps at the beginning that are taken in more parts")
    p.parameter("--early-parts", 4, "-", "their parts")
    p.parameter("--parts", 2, "-", "parts of each later step")
    p.parameter("--E", 1e6, "Pa", "Young's modulus of the soil")
    p.parameter("--nu", 0.3, "-", "Poisson's ratio of the soil")
    p.parameter("--c", 1e4, "Pa", "shear strength of the soil (Tresca)")
    p.parameter("--footing-E", 30e9, "Pa", "Young's modulus of the footing")
    p.parameter("--footing-nu", 0.3, "-", "Poisson's ratio of the footing")
    p.parameter("--mu", 0.8, "-", "coefficient of friction of all contacts")
    p.parameter("--cohesion", 2e3, "Pa", "cohesion of all contacts")
    p.parameter("--permeability", 1e-5, "m/s", "permeability of the soil")
    p.parameter("--transverse-permeability", 1e-5, "m/s", "of the water across gaps")
    p.parameter("--unit-weight", 1e4, "N/m^3", "unit weight of water")
    p.parameter("--viscosity", 1e-3, "Pa s", "viscosity of water")
    p.parameter("--printed-unit-weight", 1e6, "N/m^3", "unit weight that the paper prints")
    p.parameter("--printed-viscosity", 10.0, "Pa s", "viscosity that the paper prints")
    p.parameter(
        "--side-search", 0.01, "-", "edges within which the sides of the footing see the ground"
    )
    p.parameter("--tau", 1.0, "-", "stabilisation of the pore pressure, 0 for none")
    p.parameter("--fire-angle", 15.0, "degrees", "remesh when an angle is smaller")
    p.parameter("--boundary-edge", 1.25, "-", "longest edge of the boundary over that at the start")
    p.parameter("--fill-creases", 60.0, "degrees", "fill creases of the heave sharper than this")
    p.parameter("--tolerance", 1e-10, "-", "of Newton's method")
    p.parameter("--max-iterations", 30, "-", "of Newton's method, before a step is cut")
    p.parameter("--meshes", (0.3, 0.2, 0.15), "m", "edges, in --study")
    o = p.parse_modes(words, {"quick": QUICK, "fine": FINE})
    for name in ("h", "settlement", "duration", "steps", "parts", "early_parts", "max_iterations"):
        if not getattr(o, name) > 0:
            p.error(f"--{name.replace('_', '-')} must be positive, not {getattr(o, name)}")
    return o, p.parameters(o)


def main():
    """Run the demo."""
    options, parameters = parse()
    report = Report("footing_penetration", comm, parameters)
    out = options.out
    if options.study:
        study(options, report)
        report.write(options.report)
        return
    histories = {}
    for water in waters(options):
        series = Series(out / f"{water}.pvd", comm)
        with report.phase(water):
            _, histories[water] = push(options, water, report, series)
    report.figures = figures_of(histories)
    with report.phase("pictures"):
        on_root(comm, lambda: draw(histories, options, out))
        for water, history in histories.items():
            if history.load:
                film(
                    out / f"{water}.pvd",
                    out / f"{water}.gif",
                    field="pore pressure",
                    unit="kPa",
                    scale=1e-3,
                    limits=IN_SIGHT,
                    edges=True,
                    fps=4,
                    comm=comm,
                )
    report.table()
    report.write(options.report)


if __name__ == "__main__":
    main()
