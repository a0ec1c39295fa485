# SPDX-License-Identifier: LGPL-3.0-or-later
# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Water in the gap between two blocks
#
# Small scenes, each with a known answer. `--case` picks one; all run otherwise.
#
# - `channel`: water flows along a gap of aperture $g$, $Q = g^3\Delta p/(12\mu_f W)$.
# - `leak-off`: water flows up through block, gap and block, resistances in series:
#   $q = \Delta p/\gamma_f\,/\,(h/k + g/k_T + h/k)$.
# - `closure`: a load squeezes the gap until it closes; series solution, see `exact_gap`.
# - `sliding`: the gap opens, slides over several facets and off the end of the base, and closes:
#   no water is lost.
# - `dry-body`: a porous and a dry block under uniform pressure and load keep that state.
# - `hydrostatic`: water at rest in an inclined gap stays at rest.
# - `condition`: condition number by aperture, as in Fig. 8 of the paper; that of a conventional
#   interface element grows like $1/g$.

# %%
import argparse
import math
import sys
import time
from pathlib import Path

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.contact import gather_surface
from fenicsx_hmcontact.gap_flow.conventional import ConventionalInterface
from fenicsx_hmcontact.output.fields import FieldWriter, arc_length, gather_nodal, write_interface
from fenicsx_hmcontact.output.figures import contact_plot, curves, field_plot, save
from fenicsx_hmcontact.output.report import DemoParser, Report, progress
from fenicsx_hmcontact.output.root import on_root
from fenicsx_hmcontact.solvers.condition import normalised_condition
from meshes.sliding import sliding_blocks
from meshes.two_blocks import two_blocks

comm = MPI.COMM_WORLD

FACES = "interface_upper", "interface_lower"
RIGID = {("bottom", 0): 0.0, ("bottom", 1): 0.0}
"""Supports of the lower block where both are nearly rigid."""

# %% [markdown]
# ## The model
#
# Displacement and pore pressure in plain UFL, one contact pair, steps by backward Euler. The blocks
# touch in the mesh; a first displacement of the upper one makes the gap.


# %%
class Blocks:
    """Two blocks with water between them, ready to step.

    Args:
        options: Parameters of the case.
        domain: The mesh.
        flow: Law of the water in the gap; None where only the bodies are wanted.
        held: Displacements [m] by surface and component.
        pressures: Prescribed pore pressures [Pa] by surface, numbers or functions of the place.
        load: Surface and pressure on it [Pa].
        lift: First displacement of the upper block [m], the gap.
        faces: Secondary and primary surface.
        friction: Law between the solids.
        motion: As in `ContactPair`.
        porous: Bodies with pore water; all by default.
        gravity: Whether the water weighs.
    """

    def __init__(
        self,
        options,
        domain,
        flow,
        held,
        pressures,
        load=("top", 0.0),
        lift=0.0,
        faces=FACES,
        friction=hm.Frictionless(),
        motion="small",
        porous=None,
        gravity=False,
    ):
        self.options, self.domain = options, domain
        mesh = domain.mesh
        mesh.topology.create_connectivity(1, 2)
        bodies = porous or list(domain.bodies)
        self.wet, entity_map = domain.submesh(*bodies) if porous else (domain, None)
        V = fem.functionspace(mesh, ("P", 1, (2,)))
        Q = fem.functionspace(self.wet.mesh, ("P", 1))
        self.u, self.p = fem.Function(V, name="displacement"), fem.Function(Q, name="pore pressure")
        self.u_n, self.p_n = fem.Function(V), fem.Function(Q)
        v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))
        self.dt = fem.Constant(mesh, options.time_step)
        material = hm.LinearElastic(options.E, options.nu)
        tagged = {"domain": mesh, "subdomain_data": domain.cell_tags}
        tags = tuple(map(domain.body, bodies))
        dc = hm.node_cells_measure(options.smoothing, **tagged)
        wet = ufl.Measure("dx", **tagged)(tags)
        F = hm.equilibrium(material.stress(self.u), self.p, v, smoothed=dc, triangles=wet)
        F += hm.water_balance(
            *(self.u, self.u_n, self.p, q, self.dt),
            permeability=options.permeability,
            unit_weight=options.unit_weight,
            gravity=ufl.as_vector((0.0, -1.0)) if gravity else None,
            smoothed=dc(tags),
            triangles=wet,
        )
        F += hm.pressure_projection(
            self.p, self.p_n, q, material.shear_modulus, tau=options.tau, triangles=wet
        )
        ds = ufl.Measure("ds", domain=mesh, subdomain_data=domain.facet_tags)
        F += fem.Constant(mesh, float(load[1])) * v[1] * ds(domain.surface(load[0]))
        bcs = [prescribed(domain, V.sub(i), name, u) for (name, i), u in held.items()]
        bcs += [prescribed(self.wet, Q, name, p) for name, p in pressures.items()]
        if lift:
            cells = domain.cell_tags.find(domain.body("upper"))
            self.u.x.array[2 * np.unique(V.dofmap.list[cells]) + 1] = lift
        self.pair = hm.ContactPair(
            domain.facet_tags,
            *map(domain.surface, faces),
            friction=friction,
            flow=flow,
            motion=motion,
        )
        self.problem = hm.ContactProblem(
            F,
            [self.u, self.p],
            bcs=bcs,
            pairs=[self.pair] if flow else [],
            time_step=self.dt,
            newton=hm.NewtonOptions(options.tolerance),
            entity_maps=[entity_map] if porous else None,
            domain=domain,
        )
        self._swelling = fem.form(ufl.div(self.u - self.u_n) * wet)

    def step(self, report):
        """Advance by a step; return what is between the blocks."""
        self.u_n.x.array[:], self.p_n.x.array[:] = self.u.x.array, self.p.x.array
        report.step(self.problem.solve().iterations)
        return self.problem.interface(self.pair)

    def inflow(self, surface=None):
        """Water that came in through a surface, or all of them, in the step [m^3/m]."""
        values = self.problem.reactions(self.p).x.array
        space = self.p.function_space
        nodes = np.arange(space.dofmap.index_map.size_local)
        if surface is not None:
            facets = self.wet.facet_tags.find(self.wet.surface(surface))
            nodes = np.intersect1d(nodes, fem.locate_dofs_topological(space, 1, facets))
        return comm.allreduce(values[nodes].sum())

    def balance(self, state):
        """Water that bodies, gap and outside lost together in the step, and what moved [m^3/m]."""
        bodies = comm.allreduce(fem.assemble_scalar(self._swelling))
        parts = bodies, state.taken_up, -self.inflow()
        return abs(sum(parts)), max(map(abs, parts))

    def write(self, state):
        """Write fields for ParaView and a table of the gap."""
        for function in (self.u, self.p):
            path = self.options.out / f"{function.name.replace(' ', '_')}.pvd"
            with FieldWriter(path, function.function_space.mesh, [function]) as writer:
                writer.write(0.0)
        write_interface(comm, self.options.out / "gap.csv", state)


def prescribed(domain, space, surface, value):
    """Condition on a surface: a number, a constant, or a function of the place."""
    dofs = fem.locate_dofs_topological(space, 1, domain.facet_tags.find(domain.surface(surface)))
    if callable(value) and not isinstance(value, fem.Constant):
        function = fem.Function(space)
        function.interpolate(value)
        return fem.dirichletbc(function, dofs)
    return fem.dirichletbc(value, dofs, space)


def column(options, **more):
    """Mesh of two blocks; the upper one has the secondary surface."""
    return two_blocks(
        comm,
        width=options.width,
        height=options.height,
        upper=options.secondary,
        lower=options.primary,
        rows=options.rows,
        **more,
    )


def law(options, **more):
    """Flow law of the gap from the options."""
    return hm.GapFlow(
        options.transverse_permeability, options.viscosity, options.unit_weight, **more
    )


def largest(array):
    """Largest absolute value on all ranks."""
    return comm.allreduce(float(np.abs(array).max(initial=0.0)), MPI.MAX)


# %% [markdown]
# ## Flow along the gap
#
# Reservoirs at both ends prescribe the pore pressures of the blocks' sides, and with them the mean
# pressure of the gap. The blocks are nearly rigid, and what little they let through counts.


# %%
def channel(options, report):
    """Flow between reservoirs at both ends of the gap, against the cubic law."""
    o = options
    held = RIGID | {("top", 0): 0.0, ("top", 1): o.gap}
    pressures = {"left": o.drop, "right": 0.0}
    model = Blocks(o, column(o), law(o), held, pressures, lift=o.gap)
    report.unknowns = model.problem.n_unknowns
    state = model.step(report)
    blocks = o.permeability / o.unit_weight * o.height
    exact = (o.gap**3 / (12.0 * o.viscosity) + blocks) * o.drop / o.width
    flows = np.array([model.inflow("left"), -model.inflow("right")]) / o.time_step
    report.figures |= {
        "flow": flows[0],
        "flow_exact": exact,
        "flow_error": np.abs(flows / exact - 1.0).max(),
        "pressure_error": largest(state.pore_pressure - o.drop * (1 - state.points[:, 0] / o.width))
        / o.drop,
    }
    model.write(state)
    x = np.sort(state.points[:, 0])
    by_place = np.argsort(state.points[:, 0])
    figure = curves(
        {"computed": (x, state.pore_pressure[by_place])},
        x=("x", "m"),
        y=("mean pressure in the gap", "Pa"),
        reference=[(x, o.drop * (1.0 - x / o.width))],
        reference_label="exact",
    )
    on_root(comm, lambda: save(figure, o.out / "pressure_along.png"))


# %% [markdown]
# ## Flow across the gap


# %%
def leak_off(options, report):
    """Flow up through block, gap and block, against resistances in series."""
    o = options
    held = RIGID | {("top", 0): 0.0, ("top", 1): o.gap}
    pressures = {"bottom": o.drop, "top": 0.0}
    model = Blocks(o, column(o), law(o), held, pressures, lift=o.gap)
    report.unknowns = model.problem.n_unknowns
    state = model.step(report)
    block = 0.5 * o.height / o.permeability
    flux = o.drop / o.unit_weight / (2.0 * block + o.gap / o.transverse_permeability)
    exact = flux * o.width
    flows = np.array([model.inflow("bottom"), -model.inflow("top")]) / o.time_step
    fall = flux * o.unit_weight * o.gap / o.transverse_permeability
    report.figures |= {
        "flow": flows[0],
        "flow_exact": exact,
        "flow_error": np.abs(flows / exact - 1.0).max(),
        "drop_error": largest(state.jump + fall) / o.drop,
    }
    model.write(state)
    gathered = gather_nodal(model.p)

    def draw():
        points, _, p = gathered
        # Of the nodes at mid-height those of the lower block, with the higher pressure, come first.
        order = np.lexsort((-p[:, 0].round(6), points[:, 1].round(9)))
        below, above = o.drop - flux * o.unit_weight * block, flux * o.unit_weight * block
        middle = 0.5 * o.height
        figure = curves(
            {"computed": (p[order, 0], points[order, 1])},
            x=("pore pressure", "Pa"),
            y=("height", "m"),
            reference=[([o.drop, below, above, 0.0], [0.0, middle, middle, o.height])],
            reference_label="exact",
        )
        save(figure, o.out / "pressure_across.png")

    on_root(comm, draw)


# %% [markdown]
# ## A gap that closes
#
# A load $q$ on the drained top of the upper block presses on the water of the gap, which can leave
# through that block alone. The lower block is sealed. Until the gap is closed the water carries the
# whole load, and the upper block consolidates from its lower side.


# %%
def exact_gap(t, gap, load, k, unit_weight, modulus, height):
    """Gap under a load whose water leaves through the block above [m].

    The lower side of the block, at y = 0, has the pressure q, its top p = 0; at the start p = q
    everywhere. The water that flows through the lower side is what the gap loses (heat conduction
    in a slab, Carslaw and Jaeger 1959).

    Args:
        t: Time [s].
        gap: Gap at the start [m].
        load: q [Pa].
        k: Permeability of the block [m/s].
        unit_weight: Unit weight of water [N/m^3].
        modulus: Oedometric modulus of the block [Pa].
        height: Height of the block [m].
    """
    n, cv = np.arange(1, 2000), k * modulus / unit_weight
    decay = (1.0 - np.exp(-((n * np.pi / height) ** 2) * cv * t)) * (height / (n * np.pi)) ** 2 / cv
    return gap - k * load / (unit_weight * height) * (t + 2.0 * np.sum((-1.0) ** n * decay))


def squeeze(options, report, dt, t_end):
    """Squeeze the gap step by step.

    Returns:
        Model; its last state; rows of time, gap at both ends, exact gap, contact and film pressure,
        and whether it is closed; water lost in a step at most, relative to all that moved.
    """
    o = options
    held = RIGID | {("left", 0): 0.0, ("right", 0): 0.0}
    model = Blocks(*(o, column(o), law(o), held, {"top": 0.0}), load=("top", o.load), lift=o.gap)
    model.dt.value = dt
    modulus = hm.LinearElastic(o.E, o.nu).oedometric_modulus
    block = o.permeability, o.unit_weight, modulus, 0.5 * o.height
    rows, moved, lost = [], 0.0, 0.0
    for i in progress(range(1, round(t_end / dt) + 1), comm, "closure"):
        state = model.step(report)
        defect, size = model.balance(state)
        moved, lost = moved + size, max(lost, defect)
        paired = state.state != hm.NodeState.UNPAIRED
        mean = [values[paired].mean() for values in (state.pressure, state.pore_pressure)]
        exact = exact_gap(i * dt, o.gap, o.load, *block)
        rows.append((i * dt, *state.gap[paired][[0, -1]], exact, *mean, state.closed[paired].all()))
    return model, state, np.array(rows), lost / moved


def closure(options, report):
    """A gap squeezed until it closes, against the series."""
    o = options
    model, state, rows, balance = squeeze(o, report, o.time_step, o.end)
    report.unknowns = model.problem.n_unknowns
    report.figures |= closing_figures(o, rows)
    report.figures["mass_balance"] = balance
    model.write(state)
    t, gap, _, exact, contact, film, _ = rows.T

    def draw():
        figure = curves(
            {"computed": (t, gap * 1e6)},
            x=("time", "s"),
            y=("gap", "µm"),
            reference=[(t, np.maximum(exact, 0.0) * 1e6)],
            reference_label="series",
        )
        save(figure, o.out / "gap.png")
        figure = curves(
            {"contact pressure": (t, contact / 1e3), "water in the gap": (t, film / 1e3)},
            x=("time", "s"),
            y=("pressure", "kPa"),
            reference=[(t, np.full_like(t, o.load / 1e3))],
            reference_label="load",
        )
        save(figure, o.out / "pressures.png")

    on_root(comm, draw)


def closing_figures(options, rows):
    """Errors of the gap while it is open, / gap at the start, and of the closing time, / step."""
    t, left, right, exact, _, _, closed = rows.T
    if not closed.any() or exact[-1] > 0.0:
        raise ValueError(f"the gap is not closed at --end {options.end:g} s")
    is_open = exact > 0.0
    error = np.maximum(np.abs(left - exact), np.abs(right - exact))[is_open].max()
    steps = np.argmax(closed > 0.0) - np.argmax(exact <= 0.0)
    return {
        "gap_error_max": error / options.gap,
        "closing_time": t[np.argmax(closed > 0.0)],
        "closing_time_error_steps": abs(int(steps)),
    }


# %% [markdown]
# ## A gap that opens, slides and closes
#
# A block is lifted off its base, moved along by several facets and set down again: water flows in
# while the gap opens, is carried along, comes in or stays behind where ends of the gap sweep over
# facets, and is pressed out. In every step
# $$ \int \nabla\cdot\Delta u + (\text{taken up by the gap}) + (\text{outflow}) = 0 $$
# to round-off. The gap's volume changes by what is taken up and what is swept in at its ends.


# %%
def path(options):
    """Push and lift of the block's top [m], step by step."""
    o, n = options, options.steps
    rise = [(0.0, -0.05 * o.gap), (0.0, 0.5 * o.gap), (0.0, o.gap)]
    along = [(o.slide * (i + 1) / n, o.gap * (1.0 - 0.5 * (i + 1) / n)) for i in range(n)]
    down = [(o.slide, -0.05 * o.gap), (o.slide + 0.01 * o.width, -0.1 * o.gap)]
    return [*rise, *along, *down]


def sliding(options, report):
    """A gap that opens, slides over several facets and closes: no water is lost."""
    o = options
    domain = sliding_blocks(
        comm,
        width=o.width,
        height=0.5 * o.height,
        base_width=o.base_width,
        base_height=0.5 * o.height,
        start=o.start,
        secondary=o.block,
        primary=o.base,
        rows=o.rows,
        base_rows=o.rows,
    )
    push, lift = (fem.Constant(domain.mesh, 0.0) for _ in range(2))
    held = {("base_bottom", 0): 0.0, ("base_bottom", 1): 0.0}
    held |= {("block_top", 0): push, ("block_top", 1): lift}
    faces = ["block_bottom", "base_top"]
    if o.secondary_body == "base":
        faces.reverse()
    model = Blocks(
        *(o, domain, law(o), held, {"block_top": 0.0, "base_bottom": 0.0}),
        load=("block_top", 0.0),
        faces=faces,
        friction=hm.CoulombFriction(o.mu) if o.mu > 0.0 else hm.Frictionless(),
        motion="finite",
    )
    report.unknowns = model.problem.n_unknowns
    named = {3: "lifted", 3 + o.steps: "slid"}
    rows, lost, moved, iterations, pictures = [], 0.0, 0.0, [], {}
    for push.value, lift.value in progress(path(o), comm, "sliding"):
        before = report.newton_iterations
        state = model.step(report)
        iterations.append(report.newton_iterations - before)
        defect, size = model.balance(state)
        lost, moved = max(lost, defect), max(moved, size)
        rows.append((state.volume, state.taken_up, state.swept, state.closed.sum()))
        if len(rows) in named:
            fields = gather_nodal(model.u), gather_nodal(model.p), state
            pictures[named[len(rows)]] = fields
    volume, taken_up, swept, closed = np.array(rows).T
    report.figures |= {
        "mass_balance": lost / moved,
        "taken_up": taken_up.sum(),
        "swept": swept.sum(),
        "exchanged_at_ends": np.abs(swept).sum(),
        "volume_max": volume.max(),
        "ledger_error": abs(volume[-1] - taken_up.sum() - swept.sum()) / volume.max(),
        "facets_passed": o.slide / o.base_width * o.base,
        "newton_mean": float(np.mean(iterations)),
        "newton_max": max(iterations),
        "steps_closed": int(np.sum(closed > 0)),
    }
    model.write(state)

    def draw():
        steps = np.arange(1, len(rows) + 1)
        figure = curves(
            {
                "volume of the gap": (steps, volume * 1e6),
                "taken up, sum": (steps, np.cumsum(taken_up) * 1e6),
                "swept in, sum": (steps, np.cumsum(swept) * 1e6),
            },
            x=("step", ""),
            y=("water", "cm³/m"),
        )
        save(figure, o.out / "ledger.png")
        for name, ((_, _, u), (points, cells, p), at) in pictures.items():
            field_plot(
                *(points, cells, p, o.out / f"{name}.png"),
                label="pore pressure",
                unit="Pa",
                displacement=u,
                states=[at],
                edges=True,
            )

    on_root(comm, draw)


# %% [markdown]
# ## A dry body
#
# One of the blocks has no pore water, and no unknowns for it. The water between them has the
# pressure of the porous face. A uniform pore pressure $p_0$ and a load $q$ give a contact pressure
# $q - p_0$.


# %%
def dry_body(options, report):
    """A porous and a dry block under uniform pressure and load."""
    o = options
    porous, side = ("upper", "top") if o.dry == "primary" else ("lower", "bottom")
    held = {("bottom", 1): 0.0, ("left", 0): 0.0}
    model = Blocks(
        *(o, column(o), law(o), held, {side: o.pressure}),
        load=("top", o.load),
        porous=[porous],
    )
    report.unknowns = model.problem.n_unknowns
    # Steps so long that two of them consolidate the porous block to the last digit.
    for _ in range(2):
        state = model.step(report)
    paired = state.state != hm.NodeState.UNPAIRED
    errors = {
        "pore_pressure_error": largest(model.p.x.array - o.pressure) / o.load,
        "contact_pressure_error": largest(state.pressure[paired] - (o.load - o.pressure)) / o.load,
        "film_pressure_error": largest(state.pore_pressure - o.pressure) / o.load,
    }
    report.figures |= errors | {
        "patch_error": max(errors.values()),
        "condition_number": model.problem.condition_number(),
        "closed_nodes": int(state.closed.sum()),
    }
    model.write(state)
    along, gathered = arc_length(model.domain.mesh, model.pair), gather_nodal(model.u)
    ends = [along.min(), along.max()]
    exact = [(ends, [value, value]) for value in (o.load - o.pressure, o.pressure)]

    def draw():
        contact_plot(state, o.out / "contact.png", along=along, reference=exact)
        points, cells, u = gathered
        field_plot(
            *(points, cells, u[:, 0], o.out / "displacement.png"),
            label="horizontal displacement",
            unit="m",
            edges=True,
        )

    on_root(comm, draw)


# %% [markdown]
# ## Water at rest
#
# In water at rest $p + \gamma_f y$ is the same everywhere, in blocks and gap. Across an inclined
# gap the pressure then drops by $\gamma_f g n_y$, along it by the height; neither makes it flow. At
# small strain the water of a block has the heights of the mesh: only differences of height matter,
# and the pressure of the lifted top is prescribed where that is.


# %%
def hydrostatic(options, report):
    """Water at rest in an inclined gap: nothing flows."""
    o = options

    def at_rest(lift):
        return lambda x: o.unit_weight * (o.height - x[1] - lift)

    held = RIGID | {("top", 0): 0.0, ("top", 1): o.gap}
    pressures = {"bottom": at_rest(0.0), "top": at_rest(o.gap)}
    model = Blocks(
        *(o, column(o, tilt=o.tilt), law(o, gravity=(0.0, -1.0)), held, pressures),
        lift=o.gap,
        motion="finite",
        gravity=True,
    )
    report.unknowns = model.problem.n_unknowns
    # The first step compresses the blocks a little; in the second nothing happens.
    for _ in range(2):
        state = model.step(report)
    length = o.width / math.cos(math.radians(o.tilt))
    per_area = o.transverse_permeability * length
    excess = state.jump + o.unit_weight * state.gap * state.normals[:, 1]
    across = o.transverse_permeability / o.unit_weight * excess / state.gap * state.length
    through = model.problem.reactions(model.p).x.array / o.time_step
    report.figures |= {
        "spurious_flow": max(largest(across), largest(through)) / per_area,
        "spurious_flow_across": largest(across) / per_area,
        "spurious_flow_outside": largest(through) / per_area,
        "drop": float(np.abs(state.jump).max()),
    }
    model.write(state)
    gathered = gather_nodal(model.u), gather_nodal(model.p)

    def draw():
        (_, _, u), (points, cells, p) = gathered
        field_plot(
            *(points, cells, p / 1e3, o.out / "pore_pressure.png"),
            label="pore pressure",
            unit="kPa",
            displacement=u,
            edges=True,
        )

    on_root(comm, draw)


# %% [markdown]
# ## Condition number
#
# The matrix of a step, scaled to unit diagonal (Eq. 95), for apertures down to what stands for
# closed. A conventional interface element has the pressures of both faces as unknowns; the leakage
# $k_T/(\gamma_f g)$ between them makes its matrix singular as $g\to 0$. Here the pressure drop is
# an unknown of its own. Wide gaps lead so well along that any matrix becomes singular, as $g^3$;
# the cap of the aperture, $(12\mu_f C k h/\gamma_f)^{1/3}$ with $C = 10^6$, ends that at an error
# of the pressures of about $10^{-5}$.


# %%
APERTURES = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-8, 1e-10, 1e-12, 1e-14, 1e-16)


def condition(options, report):
    """Condition number by aperture, with a conventional interface element for comparison."""
    o = options
    held = {("left", 0): 0.0, ("right", 0): 0.0, ("bottom", 1): 0.0}
    domain, h = column(o), 0.5 * o.height / o.rows
    cap = (12.0 * o.viscosity * o.contrast * o.permeability * h / o.unit_weight) ** (1.0 / 3.0)

    def tied(aperture, **more):
        flow = law(o, aperture=aperture, **more)
        model = Blocks(
            *(o, domain, flow, held, {"top": 0.0}), load=("top", o.load), friction=hm.Tied()
        )
        model.step(report)
        report.unknowns = model.problem.n_unknowns
        return model

    bodies = Blocks(o, domain, None, held, {"top": 0.0}, load=("top", o.load))
    faces = (gather_surface(domain.mesh, domain.facet_tags, domain.surface(n), n) for n in FACES)
    elements = ConventionalInterface(*faces, law(o), bodies.problem.layout)
    matrix, prescribed_unknowns = bodies.problem.bulk_tangent()

    ours, uncapped, usual = {}, {}, {}
    for aperture in progress(APERTURES, comm, "condition"):
        key = str(aperture)
        ours[key] = tied(aperture, aperture_cap=cap).problem.condition_number()
        uncapped[key] = tied(aperture).problem.condition_number()
        system, _ = elements.system(matrix, prescribed_unknowns, aperture, o.time_step, closed=True)
        usual[key] = float(normalised_condition(system))
    report.figures |= {
        "condition_number": ours,
        "condition_number_uncapped": uncapped,
        "condition_number_conventional": usual,
        "aperture_cap": cap,
    }

    def draw():
        figure = curves(
            {
                "here": (APERTURES, list(ours.values())),
                "conventional element": (APERTURES, list(usual.values())),
            },
            reference=[(APERTURES, list(uncapped.values()))],
            reference_label="here, without aperture cap",
            x=("aperture", "m"),
            y=("condition number", ""),
            scale=("log", "log"),
        )
        save(figure, o.out / "condition_number.png")

    on_root(comm, draw)


# %% [markdown]
# ## Study
#
# Errors of flow along and across gaps are round-off on any mesh. `--study` runs the closing gap
# over meshes, steps and discretisations of P1; contact refuses others, Taylor-Hood among them.


# %%
def study(options):
    """Error of the closing gap against wall time and unknowns for every discretisation."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title="gap that closes")
    columns = "discretisation", "rows", "step [s]", "unknowns", "gap error / gap", "closing", "s"
    for heading in columns:
        table.add_column(heading)
    results, levels = {}, ((5, 400.0), (10, 200.0), (20, 100.0), (40, 50.0))

    def closing(kind, rows, dt, end):
        options.smoothing, options.rows = kind, rows
        options.secondary, options.primary = rows // 4 + 1, max(2, rows // 4)
        return squeeze(options, Report("study", comm, {}), dt, end)

    # What is compiled once is not timed.
    for kind in KINDS:
        closing(kind, *levels[0], levels[0][1])
    for kind, name in KINDS.items():
        for rows, dt in levels:
            start = time.perf_counter()
            model, _, history, _ = closing(kind, rows, dt, options.end)
            seconds = comm.allreduce(time.perf_counter() - start, MPI.MAX)
            figures = closing_figures(options, history)
            unknowns = sum(model.problem.n_unknowns.values())
            results.setdefault(name, []).append((unknowns, seconds, figures["gap_error_max"]))
            table.add_row(
                *(name, str(rows), f"{dt:g}", str(unknowns), f"{figures['gap_error_max']:.2%}"),
                *(f"{figures['closing_time']:g}", f"{seconds:.1f}"),
            )
    if comm.rank == 0:
        Console(width=100).print(table)

    def draw():
        for index, what, unit in ((0, "unknowns", ""), (1, "wall time", "s")):
            series = {
                name: ([r[index] for r in points], [r[2] for r in points])
                for name, points in results.items()
            }
            figure = curves(
                series,
                x=(what, unit),
                y=("largest error of the gap / gap", ""),
                scale=("log", "log"),
                title="gap that closes",
            )
            save(figure, options.out / f"study_error_against_{what.replace(' ', '_')}.png")

    on_root(comm, draw)


# %% [markdown]
# ## The demo
#
# Every case has its own parameters and defaults: `--case closure --help` shows them.

# %%
CASES = {
    "channel": channel,
    "leak-off": leak_off,
    "closure": closure,
    "sliding": sliding,
    "dry-body": dry_body,
    "hydrostatic": hydrostatic,
    "condition": condition,
}
KINDS = {
    "triangles": "P1",
    "deviatoric": "smoothed, deviatoric",
    "full": "smoothed, full",
    "none": "smoothed, none",
}
CHOICES = {
    "--smoothing": tuple(KINDS),
    "--dry": ("primary", "secondary"),
    "--secondary-body": ("block", "base"),
}
MAY_VANISH = "mu", "nu", "tau", "tilt", "pressure", "quick", "study"
"""Parameters that may be zero."""


def parameters():
    """Unit, meaning and defaults by case of every parameter."""

    def same(value, *cases, **others):
        return dict.fromkeys(cases or CASES, value) | {
            name.replace("_", "-"): other for name, other in others.items()
        }

    column_cases = [case for case in CASES if case != "sliding"]
    return {
        "--secondary": (
            "-",
            "edges of the upper block on the gap, the secondary surface",
            same(5, *column_cases, hydrostatic=7, condition=6, closure=8),
        ),
        "--primary": (
            "-",
            "edges of the lower block on the gap, the primary surface",
            same(7, *column_cases, dry_body=13, hydrostatic=11, condition=6, closure=5),
        ),
        "--rows": ("-", "rows of cells in each block", same(4, closure=20, sliding=3)),
        "--width": ("m", "width of the upper block", same(0.5, closure=0.2, sliding=0.7)),
        "--height": ("m", "height of both blocks", same(1.0)),
        "--gap": (
            "m",
            "gap at the start; in case sliding, the widest",
            same(1e-3, "channel", "leak-off", hydrostatic=1e-4, closure=2e-5, sliding=4e-4),
        ),
        "--drop": (
            "Pa",
            "pressure of the left or lower reservoir",
            {"channel": 1e3, "leak-off": 1e4},
        ),
        "--load": ("Pa", "load on the top", same(1e4, "closure", "dry-body", "condition")),
        "--pressure": ("Pa", "pore pressure of the porous block", {"dry-body": 4e3}),
        "--dry": ("", "which block has no pore water", {"dry-body": "primary"}),
        "--tilt": ("degrees", "inclination of the gap", {"hydrostatic": 15.0}),
        "--block": ("-", "edges across the block", {"sliding": 13}),
        "--base": ("-", "edges across the base", {"sliding": 7}),
        "--base-width": ("m", "width of the base", {"sliding": 1.6}),
        "--start": ("m", "place of the block's left side on the base", {"sliding": 0.15}),
        "--secondary-body": ("", "body with the secondary surface", {"sliding": "block"}),
        "--slide": ("m", "way of the block along the base", {"sliding": 1.0}),
        "--steps": ("-", "steps of sliding", {"sliding": 10}),
        "--mu": ("-", "coefficient of friction, 0 for none", {"sliding": 0.3}),
        "--contrast": ("-", "C of the aperture cap", {"condition": 1e6}),
        "--end": ("s", "end of the run", {"closure": 16000.0}),
        "--time-step": (
            "s",
            "length of a step",
            same(1e6, closure=100.0, sliding=200.0, dry_body=1e10, condition=100.0),
        ),
        "--E": (
            "Pa",
            "Young's modulus",
            same(1e16, closure=1e8, sliding=1e8, dry_body=1e8, condition=1e8),
        ),
        "--nu": ("-", "Poisson's ratio", same(0.2, leak_off=0.0, closure=0.0, condition=0.3)),
        "--permeability": (
            "m/s",
            "of the blocks",
            same(1e-9, channel=1e-14, leak_off=1e-6, sliding=1e-5),
        ),
        "--transverse-permeability": (
            "m/s",
            "across the gap, k_T",
            same(1e-9, channel=1e-7, leak_off=1e-8, hydrostatic=1e-8),
        ),
        "--viscosity": ("Pa s", "of the water", same(1e-3)),
        "--unit-weight": ("N/m^3", "of the water", same(1e4)),
        "--tau": ("-", "pressure stabilisation", same(1.0)),
        "--tolerance": ("-", "of Newton's method; balances are as exact", same(1e-12)),
        "--smoothing": (
            "",
            "enhancement of the smoothed gradient, or unsmoothed P1",
            same("deviatoric", condition="triangles"),
        ),
    }


def parser(case):
    """Options of a case; with case "all" those of every case, with the default of each."""
    p = DemoParser(
        "gap_flow",
        "Water in the gap between two blocks, against known answers.",
        comm,
        quick=True,
        study=True,
    )
    p.parameter("--case", "all", "", "which scene", choices=(*CASES, "all"))
    for flag, (unit, meaning, defaults) in parameters().items():
        text = meaning
        if case == "all":
            values = dict.fromkeys(defaults.values())
            if len(values) > 1 or len(defaults) < len(CASES):
                text += "; " + ", ".join(f"{name} {value}" for name, value in defaults.items())
            p.parameter(flag, next(iter(values)), unit, text, choices=CHOICES.get(flag))
        elif case in defaults:
            p.parameter(flag, defaults[case], unit, text, choices=CHOICES.get(flag))
    return p


def parse(words=None):
    """Read the command line, or given words; return the options of each case that is to run."""
    words = sys.argv[1:] if words is None else words
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--case", choices=(*CASES, "all"), default="all")
    first.add_argument("--study", action="store_true")
    chosen, _ = first.parse_known_args(words)
    if chosen.study and chosen.case == "all":
        chosen.case = "closure"
    p = parser(chosen.case)
    options = p.parse_args(words)
    for name, value in vars(options).items():
        if isinstance(value, int | float) and name not in MAY_VANISH and not value > 0:
            p.error(f"--{name.replace('_', '-')} must be positive, not {value}")
    if options.study and chosen.case != "closure":
        p.error("--study is for --case closure: the others are exact on any mesh")
    # A value on the command line is for every case that knows it.
    cases = CASES if chosen.case == "all" else [chosen.case]
    found = {case: parser(case).parse_known_args(words)[0] for case in cases}
    if options.quick and "closure" in found:
        squeezed = found["closure"]
        squeezed.rows, squeezed.time_step = min(squeezed.rows, 8), max(squeezed.time_step, 800.0)
    return found


def run(case, options):
    """Run a case; return its report."""
    report = Report("gap_flow", comm, {})
    CASES[case](options, report)
    return report


def main():
    """Run the demo."""
    cases = parse()
    one = len(cases) == 1
    options = next(iter(cases.values()))
    if options.study:
        study(options)
        return
    report, target = Report("gap_flow", comm, {}), options.report
    figures, unknowns, values = {}, {}, {}
    for case, options in cases.items():
        if not one:
            options.out = options.out / case
        with report.phase(case):
            done = run(case, options)
        figures[case], unknowns[case] = done.figures, done.unknowns
        values[case] = parser(case).parameters(options)
        report.steps += done.steps
        report.newton_iterations += done.newton_iterations
    if one:
        figures, unknowns, values = (
            next(iter(of_case.values())) for of_case in (figures, unknowns, values)
        )
    report.figures, report.unknowns, report.parameters = figures, unknowns, values
    report.table()
    report.write(target)


if __name__ == "__main__":
    main()
