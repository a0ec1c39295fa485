# SPDX-License-Identifier: LGPL-3.0-or-later
# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Uplift of a shallow footing
#
# Section 5.3 of the paper: a footing, 2 m wide and 1 m high, its top flush with the ground, is
# pulled out of saturated clay at nine velocities. Clay and footing have no bond: what holds the
# footing is suction. Water must come in before the base can part from the soil.
#
# - Fast: no water comes in time. The soil follows the base, and fails as if the footing were
#   pushed down: the resistance is the undrained one.
# - Slow: water fills the gap as it opens, and nothing resists.
#
# The walls of the notch move away from the sides of the footing, so water soon stands at the corner
# of the base. What keeps the suction is a neck of closed nodes. Behind it the gap is as wide as
# the water that has come in.
#
# The concrete passes $10^5$ times less water than the soil. The footing is dry unless
# `--footing-permeability` is given.
#
# Where the soil closes in below the corner that rises, a trench is left; `fill_creases` fills it.

# %%
import argparse
import sys
from dataclasses import dataclass, field
from pathlib import Path

from mpi4py import MPI

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.output.figures import curves, save, style
from fenicsx_hmcontact.output.film import EMPTY, film
from fenicsx_hmcontact.output.report import DemoParser, Report
from fenicsx_hmcontact.output.root import on_root
from fenicsx_hmcontact.output.series import Series, gather_frame
from meshes.embedded_footing import embedded_footing

comm = MPI.COMM_WORLD

MM_PER_HOUR = 1e-3 / 3600.0
"""Velocity of 1 mm/h [m/s]."""
PUSH_DOWN = "push-down"
"""Name of the run in which the footing goes down."""
PICTURED = "200", "0.25"
"""Velocities of Fig. 13 [mm/h]."""
IN_SIGHT = (0.0, 3.0), (-2.5, 0.5)
"""What films and pictures show [m]."""


# %% [markdown]
# ## The scene
#
# Half of it, x > 0, all forces doubled. The notch is the secondary surface: below the risen
# footing its walls must not look at the base, hence `largest_angle`. One closed node seals the neck
# (`sealing`), and the water flows through the gaps of the step's start (`lagged`): suction keeps a
# wall shut until water enters, then it parts.


# %%
def describe(options, velocity):
    """The scene with a velocity of the footing [m/s], positive upwards."""
    o = options
    domain = embedded_footing(
        comm,
        h=o.h,
        h_corner=o.h_corner,
        growth=o.growth,
        ratio=o.ratio,
        half_width=o.half_width,
        height=o.height,
        chamfer=o.chamfer,
        width=o.width,
        depth=o.depth,
    )
    scene = hm.Scene(domain)
    scene.water(o.unit_weight)
    scene.body("soil", hm.Tresca(E=o.E, nu=o.nu, c=o.c), permeability=o.permeability, tau=o.tau)
    concrete = hm.LinearElastic(E=o.footing_E, nu=o.footing_nu)
    if o.footing_permeability:
        scene.body("footing", concrete, permeability=o.footing_permeability, tau=o.tau)
        scene.drain("footing_top")
    else:
        scene.body("footing", concrete)
    scene.contact(
        "notch",
        "footing_face",
        name="face",
        friction=hm.CoulombFriction(o.mu),
        # The base stays in sight of the shortest edges.
        mortar=hm.MortarOptions(
            search_radius=max(5.0, 2.0 * o.uplift / o.h_corner), largest_angle=o.largest_angle
        ),
        flow=hm.GapFlow(
            transverse_permeability=o.transverse_permeability,
            viscosity=o.viscosity,
            unit_weight=o.unit_weight,
            aperture_cap=o.aperture_cap,
            sealing=True,
            lagged=True,
        ),
    )
    scene.fix("bottom")
    for surface in ("side", "soil_axis", "footing_axis"):
        scene.fix(surface, "x")
    scene.move("footing_top", y=lambda t: velocity * t)
    scene.drain("ground")
    return scene


# %% [markdown]
# ## What is looked at


# %%
def base_of(state):
    """Nodes of the notch that face the base: normals within 45 degrees of the vertical."""
    return (np.abs(state.normals[:, 1]) > np.sqrt(0.5)) & np.isfinite(state.gap)


def mean_gap(state):
    """Mean gap along the base [m]."""
    base = base_of(state)
    return float(np.average(state.gap[base], weights=state.length[base])) if base.any() else 0.0


def suction(state):
    """What the water pulls the base of the whole footing down with [N/m]."""
    base = base_of(state)
    pull = state.pore_pressure * state.length * state.normals[:, 1]
    return 2.0 * abs(float(pull[base].sum()))


@dataclass
class History:
    """What a run leaves for figures; lists have a value for each step.

    Attributes:
        uplift: Displacement of the footing, positive as it moves [m].
        resistance: Of the whole footing against the motion [N/m].
        gap: Mean gap along the base [m].
        suction: Pull of the water on the base of the whole footing [N/m].
        iterations: Of Newton's method.
        cuts: How often steps were cut.
        remeshes: How often bodies were remeshed.
        taken_up: Water that the gap took from the bodies [m^2].
        swept: Water that came into it at its ends, where what faces the footing changes [m^2].
        remeshed: Change of its volume by remeshing [m^2].
        volume: Of the gap [m^2].
        lost: Water that is missing [m^2].
        moved: Water that moved [m^2].
        frame: Fields at the end, on rank 0.
        failure: Why the run ended early; empty where it did not.
    """

    uplift: list = field(default_factory=list)
    resistance: list = field(default_factory=list)
    gap: list = field(default_factory=list)
    suction: list = field(default_factory=list)
    iterations: list = field(default_factory=list)
    cuts: int = 0
    remeshes: int = 0
    taken_up: float = 0.0
    swept: float = 0.0
    remeshed: float = 0.0
    volume: float = 0.0
    lost: float = 0.0
    moved: float = 0.0
    frame: object = None
    failure: str = ""


# %% [markdown]
# ## The run


# %%
def move(options, velocity, report, series=None, *, down=False):
    """Move the footing with a velocity [mm/h], and return the scene and its history."""
    o, history, speed = options, History(), velocity * MM_PER_HOUR
    scene, end = describe(o, -speed if down else speed), o.uplift / speed
    try:
        for step in scene.run(
            end,
            end / o.steps,
            kinematics="finite",
            remesh=hm.Remeshing(fill_creases=o.fill_creases),
            newton=hm.NewtonOptions(max_iterations=o.max_iterations, relaxation=o.relaxation),
            steps=hm.StepOptions(max_cuts=o.max_cuts),
            bar=PUSH_DOWN if down else f"{velocity:g} mm/h",
        ):
            report.step(step.iterations)
            look(history, scene.model, step, speed, series, down)
    except hm.TimeSteppingError as error:
        history.failure = str(error)
    records = scene.simulation.records
    history.remeshes = len(records)
    before_the_end = (r for r in records if r.step < len(history.iterations))
    history.remeshed = sum(b - a for r in before_the_end for a, b in r.gap_volumes.values())
    report.unknowns = scene.model.problem.n_unknowns
    return scene, history


def look(history, model, step, speed, series, down):
    """Take down what a step brought."""
    state, load = model.contact("face"), 2.0 * model.force("footing_top")[1]
    history.uplift.append(speed * step.t)
    history.resistance.append(-load if down else load)
    history.gap.append(mean_gap(state))
    history.suction.append(suction(state))
    history.iterations.append(step.iterations)
    history.cuts += step.cuts
    history.taken_up += state.taken_up
    history.swept += state.swept
    history.volume = state.volume
    lost, moved = model.water_balance()
    history.lost, history.moved = history.lost + abs(lost), history.moved + moved
    fields = [model.u, model.p, model.nodal_history()]
    history.frame = gather_frame(step.t, fields, (model.u, model.u_n))
    if series is not None:
        series.write(step.t, fields, (model.u, model.u_n))


# %% [markdown]
# ## Figures
#
# The water that the gap took is what it holds, but for what left it at its ends: where a wall loses
# sight of the risen base, the water beside it is no longer that of the gap (`gap_swept`).


# %%
def figures_of(histories):
    """What the report holds; runs by velocity [mm/h], and the push-down."""
    raised = {name: h for name, h in histories.items() if name != PUSH_DOWN}
    whole = {name: h for name, h in raised.items() if not h.failure and h.uplift}
    down = histories.get(PUSH_DOWN)
    capacity = None if down is None or down.failure else down.resistance[-1] / 1e3
    every = list(histories.values())
    resistance = {name: h.resistance[-1] / 1e3 for name, h in whole.items()}
    fastest = max(raised, key=float)
    return {
        "resistance": resistance,
        "mean_gap": {name: h.gap[-1] / h.uplift[-1] for name, h in whole.items()},
        "push_down_capacity": capacity,
        "fastest_to_push_down": (
            resistance[fastest] / capacity if capacity and fastest in resistance else None
        ),
        "ended_early": {
            name: {
                "reached": h.uplift[-1],
                "resistance": h.resistance[-1] / 1e3,
                "mean_gap": h.gap[-1] / h.uplift[-1],
            }
            for name, h in histories.items()
            if h.failure and h.uplift
        },
        "suction_share": {name: h.suction[-1] / h.resistance[-1] for name, h in whole.items()},
        "gap_water_balance": max(gap_balance(h) for h in raised.values()),
        "failed_steps": sum(bool(h.failure) for h in every),
        "newton_median": max(float(np.median(h.iterations or [0])) for h in every),
        "water_balance": max(h.lost / h.moved if h.moved else 0.0 for h in every),
        "step_halvings": sum(h.cuts for h in every),
        "runs": {name: figures_of_run(h) for name, h in histories.items()},
    }


def gap_balance(history):
    """Water that the gap got from soil, mouths and remeshes less its volume, over the latter."""
    h = history
    held = h.taken_up + h.swept + h.remeshed
    return abs(held - h.volume) / h.volume if h.volume else 0.0


def figures_of_run(history):
    """Figures of one run."""
    h = history
    return {
        "uplift": h.uplift,
        "resistance": [r / 1e3 for r in h.resistance],
        "largest_resistance": max(h.resistance, default=0.0) / 1e3,
        "reached": h.uplift[-1] if h.uplift else 0.0,
        "gap_taken_up": h.taken_up,
        "gap_swept": h.swept,
        "gap_remeshed": h.remeshed,
        "gap_volume": h.volume,
        "gap_water_balance": gap_balance(h),
        "water_balance": h.lost / h.moved if h.moved else 0.0,
        "newton_median": float(np.median(h.iterations or [0])),
        "newton_max": max(h.iterations, default=0),
        "parts_of_steps": len(h.iterations),
        "step_halvings": h.cuts,
        "remeshes": h.remeshes,
        "failure": h.failure,
    }


# %% [markdown]
# ## Pictures: Figures 12 and 13 of the paper, and a film


# %%
def draw(histories, out):
    """Draw resistance against displacement, and the pore pressure; on rank 0."""
    lines = {
        name if name == PUSH_DOWN else f"{name} mm/h": (
            1e3 * np.array([0.0, *h.uplift]),
            np.array([0.0, *h.resistance]) / 1e3,
        )
        for name, h in histories.items()
    }
    known = {}
    if PUSH_DOWN in lines:
        known = {"reference": [lines.pop(PUSH_DOWN)], "reference_label": PUSH_DOWN}
    axes = {"x": ("displacement", "mm"), "y": ("resistance", "kN/m")}
    save(curves(lines, **axes, **known), out / "fig12_resistance.png")
    pictured = {n: histories[n] for n in PICTURED if n in histories and histories[n].uplift}
    if pictured:
        draw_pressure(pictured, out / "fig13_pore_pressure.png")


def draw_pressure(histories, path):
    """Draw the pore pressure on the deformed meshes side by side, dry triangles grey."""
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure

    with style():
        figure = Figure(figsize=(3.6 * len(histories) + 0.2, 3.3))
        for axes, (name, h) in zip(
            figure.subplots(1, len(histories), squeeze=False)[0], histories.items(), strict=True
        ):
            x, cells = h.frame.points, h.frame.cells
            p = h.frame.nodal["pore pressure"].ravel() / 1e3
            wet = np.isfinite(p[cells]).all(axis=1)
            axes.add_collection(PolyCollection(x[cells[~wet]][..., :2], facecolors=EMPTY))
            drawn = axes.tricontourf(*x[:, :2].T, cells[wet], np.nan_to_num(p), levels=16)
            axes.triplot(*x[:, :2].T, cells, color="black", linewidth=0.3, alpha=0.4)
            axes.set(xlim=IN_SIGHT[0], ylim=IN_SIGHT[1], aspect="equal", xlabel="x [m]")
            axes.set(title=f"{name} mm/h, {1e3 * h.uplift[-1]:.0f} mm", ylabel="y [m]")
            axes.grid(False)
            figure.colorbar(drawn, ax=axes, label="pore pressure [kPa]", shrink=0.8)
    return save(figure, path)


# %% [markdown]
# ## The demo

# %%
VELOCITIES = (200.0, 2.0, 1.0, 0.75, 0.5, 0.25, 0.1, 0.01, 0.001)
QUICK = {"velocities": [200.0, 0.25], "uplift": 0.12, "steps": 12}
"""Parameters of --quick: two velocities, half of the way."""
FINE = {"h": 0.5, "growth": 0.15}
"""Parameters of --fine."""
PRINTED = {"unit_weight": 1e6, "viscosity": 10.0}
"""Water as the paper prints it."""


def parse(words=None):
    """Read the command line, or given words; return options and parameters of the report."""
    p = DemoParser(
        "footing_uplift",
        "A shallow footing is pulled out of saturated clay at several velocities (Section 5.3).",
        comm,
        quick=True,
    )
    p.add_argument("--fine", action="store_true", help="edges of 0.5 m, that grow by 0.15")
    p.add_argument(
        "--printed", action="store_true", help="unit weight and viscosity that the paper prints"
    )
    p.add_argument(
        "--push-down",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="push the footing down as well, at the fastest velocity (default: yes)",
    )
    p.parameter("--velocities", VELOCITIES, "mm/h", "velocities of the footing")
    p.parameter("--uplift", 0.24, "m", "displacement of the footing at the end")
    p.parameter("--steps", 24, "-", "steps")
    p.parameter("--h", 1.0, "m", "longest edges of the soil")
    p.parameter("--h-corner", 0.05, "m", "its edges at the corner of the base")
    p.parameter("--growth", 0.2, "-", "by how much edges grow per distance from there")
    p.parameter("--ratio", 0.8, "-", "edges of the footing over those of the soil")
    p.parameter("--half-width", 1.0, "m", "half width of the footing")
    p.parameter("--height", 1.0, "m", "height of the footing")
    p.parameter("--chamfer", 0.05, "m", "what the chamfer takes off its base and side")
    p.parameter("--width", 12.0, "m", "width of the soil")
    p.parameter("--depth", 6.0, "m", "depth of the soil")
    p.parameter("--E", 1e5, "Pa", "Young's modulus of the soil")
    p.parameter("--nu", 0.3, "-", "Poisson's ratio of the soil")
    p.parameter("--c", 1e3, "Pa", "shear strength of the soil (Tresca)")
    p.parameter("--footing-E", 30e9, "Pa", "Young's modulus of the footing")
    p.parameter("--footing-nu", 0.3, "-", "Poisson's ratio of the footing")
    p.parameter("--mu", 0.3, "-", "coefficient of friction between soil and footing")
    p.parameter("--largest-angle", 40.0, "degrees", "faces turned away by more do not meet")
    p.parameter("--permeability", 1e-6, "m/s", "permeability of the soil")
    p.parameter("--footing-permeability", 0.0, "m/s", "permeability of the footing, 0 if dry")
    p.parameter("--transverse-permeability", 5e-7, "m/s", "of the water across the gap")
    p.parameter("--aperture-cap", 4e-3, "m", "gaps that are wider lead no better along")
    p.parameter("--unit-weight", 1e4, "N/m^3", "unit weight of water; 1e6 with --printed")
    p.parameter("--viscosity", 1e-3, "Pa s", "viscosity of water; 10 with --printed")
    p.parameter("--tau", 1.0, "-", "stabilisation of the pore pressure, 0 for none")
    p.parameter("--fill-creases", 75.0, "degrees", "angle of creases of the notch that are filled")
    p.parameter("--max-iterations", 30, "-", "of Newton's method, before a step is cut")
    p.parameter("--relaxation", 2e-3, "m", "moves of soil that creeps to equilibrium, 0: never")
    p.parameter("--max-cuts", 5, "-", "most cuts of a step")
    o = p.parse_modes(words, {"quick": QUICK, "fine": FINE, "printed": PRINTED})
    for name in ("uplift", "steps", "max_iterations"):
        if not getattr(o, name) > 0:
            p.error(f"--{name.replace('_', '-')} must be positive, not {getattr(o, name)}")
    if not min(o.velocities) > 0.0:
        p.error(f"--velocities must be positive, not {min(o.velocities):g}")
    return o, p.parameters(o)


def run(options, report, series=None):
    """Run all velocities from the fastest on, and the push-down; histories by name."""
    velocities = sorted(set(options.velocities), reverse=True)
    histories = {}
    for velocity in velocities:
        name = f"{velocity:g}"
        with report.phase(f"{name} mm/h"):
            _, histories[name] = move(options, velocity, report, series and series(name))
    if options.push_down:
        with report.phase(PUSH_DOWN):
            _, histories[PUSH_DOWN] = move(options, velocities[0], report, down=True)
    return histories


def main():
    """Run the demo."""
    options, parameters = parse()
    out, report = options.out, Report("footing_uplift", comm, parameters)
    histories = run(options, report, lambda name: Series(out / f"{name}.pvd", comm))
    report.figures = figures_of(histories)
    fastest = next(iter(histories))
    with report.phase("pictures"):
        on_root(comm, lambda: draw(histories, out))
        if histories[fastest].uplift:
            film(
                out / f"{fastest}.pvd",
                out / f"{fastest}.gif",
                field="pore pressure",
                unit="kPa",
                scale=1e-3,
                limits=IN_SIGHT,
                edges=True,
                fps=4,
                title=lambda t: f"{float(fastest) * MM_PER_HOUR * t * 1e3:.0f} mm",
                comm=comm,
            )
    report.table()
    report.write(options.report)


if __name__ == "__main__":
    main()
