# SPDX-License-Identifier: LGPL-3.0-or-later
# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Delayed failure of an excavated slope
#
# A slope of 45 degrees and height $H$ = 16 m is cut at once into soil that could stand at no such
# slope once it has drained. Soil that is sheared dilates, and saturated soil can only dilate as
# fast as it sucks in water: the slope stands on suction at first and fails over days. A geological
# interface, a cut at 30 degrees that passes under the toe and ends in the soil, needs no water to
# slide, and the failure comes sooner.
#
# 1. Gravity, one step of 100 years; then displacements are reset, and the water is hydrostatic in
#    the ground as designed.
# 2. The excavation, in the first 0.05 days: what the soil there carried is taken off evenly. The
#    new surface is drained from the first step on. Twenty days follow.
#
# The same with and without the interface. Compared are the total equivalent plastic strain
# $\int\bar\varepsilon^p\,\mathrm{d}\Omega$ (Eq. 104 of Fang et al. 2024), the largest displacement,
# and the days when they reach parts of what they come to.

# %%
import math
import sys
from dataclasses import dataclass, field
from pathlib import Path

from mpi4py import MPI

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.output.figures import curves, field_plot, save
from fenicsx_hmcontact.output.film import film
from fenicsx_hmcontact.output.report import DemoParser, Report
from fenicsx_hmcontact.output.root import on_root
from fenicsx_hmcontact.output.series import Series, read_series
from meshes.excavated_slope import excavated_slope

comm = MPI.COMM_WORLD
DAY = 86400.0
CENTURY = 36525.0 * DAY
CASES = {"with": "with interface", "without": "without interface"}
EARLY = 5.0
"""Day until which steps are short."""
LEVELLED = 2.0
"""Days at the end in which the plastic strain must hardly grow."""
SLOW = 0.02
"""Rate of plastic strain, relative to its peak, below which it hardly grows."""
PARTS = {"day_0.1H": 0.1, "day_0.2H": 0.2}
"""Parts of the height of the slope that the largest displacement reaches."""
MARKS = {"t50": 0.5, "t90": 0.9, "t98": 0.98}
"""Parts of the final plastic strain; the last one is the paper's measure of failure."""


# %% [markdown]
# ## The scene
#
# The body meets itself along the cut: its faces share the node at the tip and no others. Where they
# are closed the pore pressure is continuous; where they part, water fills the gap.


# %%
def describe(options, interface):
    """The scene before the first stage."""
    o = options
    domain = excavated_slope(
        comm,
        h=o.h,
        h_fine=o.h_fine,
        growth=o.growth,
        ratio=o.ratio,
        interface=interface,
        width=o.width,
        height=o.height,
        crest=o.crest,
        slope_height=o.slope_height,
        slope_angle=o.slope_angle,
        cut_start=o.cut_start,
        cut_end=o.cut_end,
        cut_angle=o.cut_angle,
    )
    scene = hm.Scene(domain)
    soil = hm.MohrCoulomb(E=o.E, nu=o.nu, c=o.c, phi=o.phi)
    scene.body("soil", soil, permeability=o.permeability, unit_weight=o.unit_weight, tau=o.tau)
    scene.gravity()
    scene.water(o.water_weight)
    scene.fix("bottom", "xy")
    scene.fix("left", "x")
    scene.fix("right", "x")
    scene.drain("surface")
    scene.drain("excavated_surface")
    scene.initial_pressure("soil", hydrostatic(o))
    if interface:
        scene.contact(
            "cut_upper",
            "cut_lower",
            friction=hm.CoulombFriction(mu=o.mu, cohesion=o.interface_cohesion),
            flow=hm.GapFlow(
                transverse_permeability=o.interface_permeability,
                viscosity=o.viscosity,
                unit_weight=o.water_weight,
                aperture_cap=o.aperture_cap,
            ),
            name="cut",
        )
    return scene


def hydrostatic(options):
    """Pore pressure below a water table at the ground [Pa], by coordinates."""
    return lambda x: options.water_weight * (options.height - x[1])


# %% [markdown]
# ## The run


# %%
@dataclass
class Slide:
    """What a run leaves for figures.

    Attributes:
        days: Ends of the steps; the first is that of the gravity stage.
        plastic_strain: Total equivalent plastic strain [m^2].
        displacement: Largest displacement [m].
        slip: Sum over the steps of the largest slip of the interface [m].
        jump: Largest jump of the pore pressure across closed parts of the interface [Pa].
        iterations: Of Newton's method.
        halvings: How often steps were cut.
        failure: Why the run ended early; empty where it did not.
        settlement: Largest displacement of the gravity stage [m].
        balance: Water taken in less the growth of the ground, relative to the former.
    """

    days: list = field(default_factory=lambda: [0.0])
    plastic_strain: list = field(default_factory=lambda: [0.0])
    displacement: list = field(default_factory=lambda: [0.0])
    slip: float = 0.0
    jump: float = 0.0
    iterations: list = field(default_factory=list)
    halvings: int = 0
    failure: str = ""
    settlement: float = 0.0
    balance: float = 0.0


class Excavation:
    """The stages of a slope.

    Args:
        options: Parameters of the demo.
        interface: Whether there is the interface.
        series: Takes frames of the run.
    """

    def __init__(self, options, interface, series=None):
        self.options, self.interface, self.series = options, interface, series
        self.scene, self.slide = describe(options, interface), Slide()
        self.inflow = self.gained = 0.0

    def gravity(self):
        """Let the ground come to rest under its weight, in the geometry of the design."""
        o, scene = self.options, self.scene
        for step in scene.run(
            0.0,
            dt=CENTURY,
            start=-CENTURY,
            kinematics="finite",
            remesh=hm.Remeshing(fill_creases=o.fill_creases),
            newton=hm.NewtonOptions(max_iterations=o.iterations),
            steps=hm.StepOptions(max_cuts=o.cuts, smallest=1e-4),
        ):
            self.slide.settlement = self.largest_displacement()
            self.slide.iterations.append(step.iterations)
            self.slide.halvings += step.cuts
        scene.reset_displacements({"soil": hydrostatic(o)})

    def excavate(self):
        """Take the soil away, and follow the slope."""
        o, scene = self.options, self.scene
        scene.remove("excavated", "slope", over=o.excavation * DAY)
        scene.drain("slope")
        self.area = self.ground()
        first = min(o.excavation, o.days)
        stages = [(first, first / o.excavation_steps), (min(EARLY, o.days), o.dt_early)]
        stages.append((o.days, o.dt_late))
        try:
            for end, dt in stages:
                if end > self.slide.days[-1]:
                    for step in scene.run(end * DAY, dt=dt * DAY, bar=CASES[self.case]):
                        self.observe(step)
        except hm.TimeSteppingError as error:
            if len(self.slide.days) == 1:
                raise
            self.slide.failure = str(error)
        self.close_balance()

    @property
    def case(self):
        """Key of the figures."""
        return "with" if self.interface else "without"

    def observe(self, step):
        """Keep what figures need of a step."""
        s, model = self.slide, self.scene.model
        s.days.append(step.t / DAY)
        (integral, _), *_ = model.problem.integrals().values()
        s.plastic_strain.append(integral)
        s.displacement.append(self.largest_displacement())
        s.iterations.append(step.iterations)
        s.halvings += step.cuts
        self.inflow -= model.outflow()
        if self.interface:
            state = model.contact("cut")
            s.slip += float(np.abs(state.slip).max())
            s.jump = max(s.jump, float(np.abs(state.jump[state.closed]).max(initial=0.0)))
            self.inflow -= state.taken_up
        if self.series is not None:
            fields = [model.nodal_history(), model.p]
            self.series.write(step.t, fields, displacement=(model.u, model.u_n))

    def largest_displacement(self):
        """Largest displacement of a node since the stage began [m]."""
        u = self.scene.model.u.x.array.reshape(-1, 2)
        return comm.allreduce(float(np.hypot(*u.T).max(initial=0.0)), MPI.MAX)

    def ground(self):
        """Area of the ground where the mesh stands [m^2]."""
        arrays = self.scene.domain.arrays()
        x = arrays.points[arrays.cells, :2]
        a, b = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]
        return comm.bcast(0.5 * float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])))

    def close_balance(self):
        """Compare the water that came in with the growth of the ground."""
        simulation = self.scene.simulation
        simulation.accept()
        merged = sum(record.merged_water for record in simulation.records)
        grown = self.ground() - self.area - merged
        self.slide.balance = abs(grown - self.inflow) / max(abs(self.inflow), 1e-300)


# %% [markdown]
# ## Figures
#
# The part of 98 % means something only where the curve has levelled: in a window that ends earlier,
# it comes earlier too.


# %%
def day_of(value, days, values):
    """First day on which values reach one, between steps linear; None if never."""
    values = np.asarray(values)
    if not values.max() >= value:
        return None
    i = int(np.argmax(values >= value))
    if i == 0:
        return float(days[0])
    part = (value - values[i - 1]) / (values[i] - values[i - 1])
    return float(days[i - 1] + part * (days[i] - days[i - 1]))


def figures_of(slide, options):
    """Figures of one run, by name."""
    days, strain = np.array(slide.days), np.array(slide.plastic_strain)
    rates = np.diff(strain) / np.diff(days)
    late = days[1:] > days[-1] - LEVELLED
    figures = {
        name: day_of(part * options.slope_height, days, slide.displacement)
        for name, part in PARTS.items()
    }
    figures |= {name: day_of(part * strain.max(), days, strain) for name, part in MARKS.items()}
    return figures | {
        "levelled": bool(rates[late].max() < SLOW * rates.max()),
        "late_rate": float(rates[late].max() / rates.max()),
        "plastic_strain_total": float(strain[-1]),
        "displacement_max": float(slide.displacement[-1]),
        "settlement": slide.settlement,
        "slip": slide.slip,
        "pressure_jump": slide.jump,
        "failed_steps": int(bool(slide.failure)),
        "failure": slide.failure,
        "step_halvings": slide.halvings,
        "newton_median": float(np.median(slide.iterations)),
        "water_balance": slide.balance,
    }


def together(found):
    """Figures of both runs, {"with": , "without": } each, and those of all."""
    names = next(iter(found.values()))
    figures = {name: {case: f[name] for case, f in found.items()} for name in names}
    figures |= {
        "failed_steps": sum(figures["failed_steps"].values()),
        "newton_median": max(figures["newton_median"].values()),
        "water_balance": max(figures["water_balance"].values()),
    }
    if len(found) == 2:
        both = figures["plastic_strain_total"]
        figures["plastic_strain_larger"] = max(both, key=both.get)
        for name in PARTS:
            first, second = (figures[name][case] for case in CASES)
            if first is not None and second is not None:
                figures[f"{name}_ratio"] = first / second
    return figures


# %% [markdown]
# ## Pictures: Figures 15, 16 and 17 of the paper, and a film


# %%
def limits_of(options):
    """What is to be seen of the ground: the slope and what moves."""
    o = options
    toe = o.crest + o.slope_height / math.tan(math.radians(o.slope_angle))
    right = min(o.width, toe + 2.0 * o.slope_height)
    return (o.cut_start - 10.0, right), (o.height - 2.0 * o.slope_height, o.height + 2.0)


def draw_evolution(slides, options):
    """Draw the normalised plastic strain (Fig. 15), and the largest displacement."""
    strain = {
        CASES[case]: (s.days, np.array(s.plastic_strain) / max(s.plastic_strain))
        for case, s in slides.items()
    }
    figure = curves(
        strain,
        x=("time from the start of the excavation", "d"),
        y=("plastic strain over its maximum", ""),
    )
    save(figure, options.out / "plastic_strain_over_time.png")
    moved = {
        CASES[case]: (s.days, np.array(s.displacement) / options.slope_height)
        for case, s in slides.items()
    }
    figure = curves(
        moved,
        x=("time from the start of the excavation", "d"),
        y=("largest displacement over height", ""),
    )
    save(figure, options.out / "displacement_over_time.png")


def draw_end(path, case, options):
    """Draw plastic strain (Fig. 16) and pore pressure (Fig. 17) on the final shape."""
    *_, frame = read_series(path)
    for name, scale, label, unit in (
        ("kappa", 1.0, "equivalent plastic strain", ""),
        ("pore pressure", 1e-3, "pore pressure", "kPa"),
    ):
        field_plot(
            frame.points,
            frame.cells,
            scale * frame.nodal[name].ravel(),
            options.out / f"{label.replace(' ', '_')}_{case}.png",
            label=label,
            unit=unit,
            title=f"{CASES[case]}, day {frame.time / DAY:.3g}",
            edges=name == "kappa",
            limits=limits_of(options),
        )


# %% [markdown]
# ## The demo


# %%
QUICK = {"h": 5.0, "h_fine": 3.0, "days": 8.0}
"""Parameters of --quick: a coarse mesh, eight days."""
FINE = {"h": 2.0, "h_fine": 1.0}
"""Parameters of --fine."""
PRINTED = {"viscosity": 10.0}
"""Water as the paper prints it."""


def parse(words=None):
    """Read the command line, or given words; return options and parameters of the report."""
    p = DemoParser(
        "excavated_slope",
        "Delayed failure of an excavated slope, with and without a geological interface.",
        comm,
        quick=True,
        study=True,
    )
    p.parameter("--case", "both", "", "slope to run", choices=("both", *CASES))
    p.parameter("--printed", False, "", "water as printed in the paper: same, but for viscosity")
    p.parameter("--fine", False, "", "edges of 2 m, and of 1 m at slope and cut")
    p.parameter("--h", 3.0, "m", "longest edges")
    p.parameter("--h-fine", 1.5, "m", "edges at slope and cut")
    p.parameter("--growth", 0.1, "-", "growth of edges per distance from slope and cut")
    p.parameter("--ratio", 0.8, "-", "edges of the upper face of the cut over those of the lower")
    p.parameter("--width", 125.0, "m", "width of the ground")
    p.parameter("--height", 50.0, "m", "its height")
    p.parameter("--crest", 54.5, "m", "distance of the crest from the left side")
    p.parameter("--slope-height", 16.0, "m", "height of the slope")
    p.parameter("--slope-angle", 45.0, "degrees", "its inclination")
    p.parameter(
        "--cut-start", 35.0, "m", "distance of the upper end of the interface from the left"
    )
    p.parameter("--cut-end", 75.5, "m", "distance of its tip from the left")
    p.parameter("--cut-angle", 30.0, "degrees", "its inclination")
    p.parameter("--E", 1e7, "Pa", "Young's modulus")
    p.parameter("--nu", 0.35, "-", "Poisson's ratio")
    p.parameter("--c", 5e3, "Pa", "cohesion")
    p.parameter("--phi", 25.0, "degrees", "angle of friction and dilation")
    p.parameter("--permeability", 1e-5, "m/s", "permeability of the soil")
    p.parameter("--unit-weight", 2e4, "N/m^3", "unit weight of the saturated soil")
    p.parameter("--water-weight", 1e4, "N/m^3", "unit weight of water")
    p.parameter("--viscosity", 1e-3, "Pa s", "viscosity of water; 10 with --printed")
    p.parameter("--mu", 0.3, "-", "friction of the interface")
    p.parameter("--interface-cohesion", 2e3, "Pa", "cohesion of the interface")
    p.parameter("--interface-permeability", 1e-5, "m/s", "permeability across the interface")
    p.parameter("--aperture-cap", 1e-2, "m", "gaps that are wider lead no better along")
    p.parameter("--tau", 1.0, "-", "stabilisation of the pore pressure")
    p.parameter("--days", 20.0, "d", "time from the start of the excavation")
    p.parameter("--excavation", 0.05, "d", "time in which the load of the excavated soil comes off")
    p.parameter("--excavation-steps", 4, "-", "steps of the excavation")
    p.parameter("--dt-early", 0.2, "d", "steps of the first five days")
    p.parameter("--dt-late", 0.5, "d", "steps after that")
    p.parameter("--fill-creases", 60.0, "degrees", "angle of creases of the ground that are filled")
    p.parameter("--iterations", 50, "-", "most iterations of a step")
    p.parameter("--cuts", 10, "-", "most cuts of a step")
    o = p.parse_modes(words, {"quick": QUICK, "fine": FINE, "printed": PRINTED})
    for name in (
        "h",
        "h_fine",
        "days",
        "excavation",
        "dt_early",
        "dt_late",
        "excavation_steps",
        "slope_height",
    ):
        if not getattr(o, name) > 0:
            p.error(f"--{name.replace('_', '-')} must be positive, not {getattr(o, name)}")
    return o, p.parameters(o)


def run(case, options, report=None, series=None):
    """Run one case."""
    excavation = Excavation(options, case == "with", series)
    excavation.gravity()
    excavation.excavate()
    if report is not None:
        for iterations in excavation.slide.iterations:
            report.step(iterations)
        report.unknowns = excavation.scene.model.problem.n_unknowns
    return excavation


def study(options, report):
    """Both cases on three meshes, as a table."""
    from rich.console import Console
    from rich.table import Table

    found = {}
    table = Table(title="excavated slope, with and without the interface")
    for heading in (
        "edges [m]",
        "case",
        "0.1 H [d]",
        "0.2 H [d]",
        "t98 [d]",
        "strain [m²]",
        "u [m]",
    ):
        table.add_column(heading)
    for h in (2.0 * options.h, options.h, 0.5 * options.h):
        options.h_fine *= h / options.h
        options.h = h
        for case in CASES:
            figures = figures_of(run(case, options, report).slide, options)
            found[f"{case}, {options.h_fine:g} to {h:g} m"] = figures
            names = (*PARTS, "t98", "plastic_strain_total", "displacement_max")
            shown = ("-" if figures[n] is None else f"{figures[n]:.3g}" for n in names)
            table.add_row(f"{options.h_fine:g} to {h:g}", case, *shown)
    report.figures["study"] = found
    if comm.rank == 0:
        Console(width=100).print(table)


def main():
    """Run the demo."""
    options, parameters = parse()
    report, found, slides, paths = Report("excavated_slope", comm, parameters), {}, {}, {}
    if options.study:
        study(options, report)
        report.write(options.report)
        return
    for case in CASES if options.case == "both" else (options.case,):
        series = Series(options.out / f"{case}.pvd", comm)
        with report.phase(CASES[case]):
            slides[case] = run(case, options, report, series).slide
        found[case], paths[case] = figures_of(slides[case], options), series.path
    report.figures |= together(found)
    report.figures["curves"] = {
        case: {"day": s.days, "plastic_strain": s.plastic_strain, "displacement": s.displacement}
        for case, s in slides.items()
    }

    def draw():
        draw_evolution(slides, options)
        for case, path in paths.items():
            draw_end(path, case, options)

    with report.phase("pictures"):
        on_root(comm, draw)
        for case, path in paths.items():
            film(
                path,
                options.out / f"{case}.gif",
                field="kappa",
                label="equivalent plastic strain",
                unit="",
                limits=limits_of(options),
                title=lambda t: f"day {t / DAY:.1f}",
                comm=comm,
            )
    report.table()
    report.write(options.report)


if __name__ == "__main__":
    main()
