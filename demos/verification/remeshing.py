# SPDX-License-Identifier: LGPL-3.0-or-later
# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A footing pushed in by half its width
#
# A rigid rough footing of width $B$ is pushed into clay of undrained strength $c$. The ground
# beside its edge is drawn down along a cut that one edge of the first mesh would have to span, and
# triangles there turn over. Rebuilding triangles over the same nodes does not help: nodes must
# come.
#
# - `--case penetration`: the push, with a `Simulation` that remeshes where triangles call for it.
# - `--case identity`: a yielded state whose triangles are as they should be, remeshed once more,
#   changes no bit.
# - `--case consolidation`: the ground is porous and drains while it is remeshed after every step;
#   water that leaves is what the ground loses in volume.
# - `--case crossing`: a block is dragged off the end of a softer base, and both are remeshed.
#
# Two loads are known to compare with. A strip embedded at depth $D$ in ground that was never
# disturbed carries $q = (2+\pi)c\,(1 + 0.27\sqrt{D/B})$, fitted to finite element limit analysis
# (Salgado, Lyamin, Sloan and Yu 2004). And when Prandtl's fan turns by $\pi$, from the base to a
# vertical cut that carries nothing, $q = (2 + 2\pi)c$.

# %%
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.domain import gather_states
from fenicsx_hmcontact.output.fields import gather_nodal, gather_values
from fenicsx_hmcontact.output.figures import curves, field_plot, save
from fenicsx_hmcontact.output.film import film
from fenicsx_hmcontact.output.report import DemoParser, Report
from fenicsx_hmcontact.output.root import on_root
from fenicsx_hmcontact.output.series import gather_frame
from fenicsx_hmcontact.solvers import restore_values, save_values
from meshes.sliding import sliding_blocks
from meshes.strip_footing import base_edges, strip_footing

comm = MPI.COMM_WORLD
MARKS = ("0.25", "0.5", "1.0")
"""Depths, by the width of the footing, at which the load is reported."""
SAME = 1e-6
"""Relative difference of steps that are of the same length."""
PRESSING = 0.1
"""Part of the time in which the block is pressed, before it is dragged."""
FRAMES = 50
"""About as many pictures of a film."""
RELAXATIONS = 6
"""Most steps without load after a remesh in place."""
AT_REST = 1e-8
"""Residual over load at which they end."""
COMPARED = (0.05, 0.5)
"""Depths, by the width of the footing, between which meshes are compared."""


# %% [markdown]
# ## The model
#
# All that depends on the mesh is built by one function of the domain, here the constructor: spaces,
# forms, conditions. What the run wants to know later are attributes of the model.


# %%
class Footing(hm.TransientModel):
    """Half of the ground under a footing that is pushed down at a constant rate.

    Args:
        domain: The ground.
        options: Parameters of the demo.
    """

    def __init__(self, domain, options):
        self.options, self.domain, o = options, domain, options
        mesh = domain.mesh
        V = self.V = fem.functionspace(mesh, ("P", 1, (2,)))
        u, u_n = fem.Function(V, name="displacement"), fem.Function(V)
        self.u, self.u_n = u, u_n
        dt = fem.Constant(mesh, 1.0)
        material = hm.Tresca(E=o.E, nu=o.nu, c=o.c)
        self.stress = hm.MaterialStress(
            material, u, u_n, hm.node_cells_measure("full"), kinematics="finite"
        )
        settlement = fem.Constant(mesh, np.zeros(2))
        self.base = fem.locate_dofs_topological(V, 1, self.facets("base"))
        conditions = [self.held(name, 0) for name in ("axis", "side", "bottom")]
        conditions += [self.held("bottom", 1), fem.dirichletbc(settlement, self.base, V)]
        unknowns, previous, p, v = [u], [], None, ufl.TestFunction(V)
        if o.porous:
            Q = fem.functionspace(mesh, ("P", 1))
            p, p_n = fem.Function(Q, name="pore pressure"), fem.Function(Q)
            v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))
            unknowns, previous, self.p = [u, p], [(p_n, p)], p
        F = hm.finite_strain.equilibrium(
            self.stress.stress, self.stress.deformation, u, u_n, p, v, smoothed=self.stress.measure
        )
        if o.porous:
            F += hm.finite_strain.water_balance(
                u,
                u_n,
                p,
                q,
                dt,
                permeability=o.permeability,
                unit_weight=o.unit_weight,
                smoothed=self.stress.measure,
            )
            F += hm.pressure_projection(p, p_n, q, material.shear_modulus, tau=o.tau)
            free = fem.locate_dofs_topological(Q, 1, self.facets("surface"))
            conditions.append(fem.dirichletbc(0.0, free, Q))
        problem = hm.ContactProblem(F, unknowns, bcs=conditions, domain=domain)
        super().__init__(
            problem,
            dt,
            previous,
            histories=[(settlement, lambda t: (0.0, -o.settlement * t / o.duration))],
            follow=lambda: problem.move_mesh(u, u_n),
        )
        F_step = ufl.Identity(2) + ufl.grad(u - u_n)
        self._strained = fem.form((ufl.det(F_step) - 1.0) * ufl.dx)
        self._area = fem.form(fem.Constant(mesh, 1.0) * ufl.dx)

    def facets(self, surface):
        """Facets of a surface."""
        return self.domain.facet_tags.find(self.domain.surface(surface))

    def held(self, surface, component):
        """Condition that a surface keeps its place in one direction."""
        space = self.V.sub(component)
        dofs = fem.locate_dofs_topological(space, 1, self.facets(surface))
        return fem.dirichletbc(0.0, dofs, space)

    def load(self):
        """Load on half the footing over half width and strength [-], of the step last solved."""
        forces = self.problem.reactions(self.u).x.array.reshape(-1, 2)
        owned = self.base[self.base < self.V.dofmap.index_map.size_local]
        return -comm.allreduce(forces[owned, 1].sum()) / (self.options.c * self.options.half_width)

    def outflow(self):
        """Water that leaves through the surface in the step [m^2]."""
        water = self.problem.reactions(self.p)
        owned = water.function_space.dofmap.index_map.size_local
        return -comm.allreduce(water.x.array[:owned].sum())

    def area(self):
        """Area of the mesh, where it stands [m^2]."""
        return comm.allreduce(fem.assemble_scalar(self._area))

    def strained(self):
        """Area that the step adds on triangles, of a mesh that stands at its start [m^2]."""
        return comm.allreduce(fem.assemble_scalar(self._strained))

    def inverted(self):
        """Number of triangles without positive area at the end of the step."""
        mesh = self.domain.mesh
        owned = mesh.topology.index_map(2).size_local
        cells, dofs = mesh.geometry.dofmaps[0][:owned], self.V.dofmap.list[:owned]
        step = (self.u.x.array - self.u_n.x.array).reshape(-1, 2)
        x = mesh.geometry.x[cells, :2] + step[dofs]
        a, b = (x[:, i] - x[:, 0] for i in (1, 2))
        return comm.allreduce(int(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] <= 0.0)))

    def plastic_strain(self):
        """Equivalent plastic strain at the nodes, the mean of the points around each."""
        result = fem.Function(fem.functionspace(self.domain.mesh, ("P", 1)), name="plastic strain")
        kappa = self.stress.history("kappa").mean(axis=1)
        dofs = self.stress.node_cells.block_dofs(result.function_space)
        result.x.array[dofs[: len(kappa)]] = kappa
        result.x.scatter_forward()
        return result


def ground(options):
    """The first mesh."""
    o = options
    return strip_footing(comm, h=o.h, half_width=o.half_width, width=o.width, depth=o.depth)


# %% [markdown]
# ## The run
#
# What a remesh changes in the load is what the next step carries, against the same step on the old
# mesh. A `Simulation` that takes this twin before each remesh goes back bit for bit afterwards.


# %%
class Watched(hm.Simulation):
    """A simulation that takes the step after each remesh without it as well.

    Attributes:
        twins: Length of the step without remesh, and its load, None where it failed; by the number
            of the step.
        aside: Wall time of twins [s].
        looking: Wall time of looking for poor triangles [s], with that of moving the mesh.
    """

    def __init__(self, build, domain, remeshing=None, *, end):
        super().__init__(build, domain, remeshing)
        self.end, self.twins, self.aside, self.looking, self._remeshing = end, {}, 0.0, 0.0, 0.0

    def accept(self):
        """Accept the step, and see how long looking takes. Collective."""
        begin, before = time.perf_counter(), self._remeshing
        super().accept()
        self.looking += time.perf_counter() - begin - (self._remeshing - before)

    def remesh(self, reasons):
        """Take the next step without remesh, go back, and remesh. Collective."""
        begin, number = time.perf_counter(), len(self.records)
        twin = self.without_remesh()
        middle = time.perf_counter()
        super().remesh(reasons)
        self.aside += middle - begin
        self._remeshing += time.perf_counter() - begin
        if twin is not None and len(self.records) > number:
            self.twins[self.n_steps + 1] = twin

    def without_remesh(self):
        """Length and load of the next step on this mesh; None at the end of the run."""
        model, dt = self.model, float(self.model.dt.value)
        if self.t + dt > self.end * (1.0 + SAME):
            return None
        prescribed = [model.dt, *(target for target, _ in model.histories)]
        state, values = model.save(), save_values(prescribed)
        self.prescribe(self.t + dt, dt)
        _, failure, _ = self._agreed(model.solve)
        load = None if failure else model.load()
        model.restore(state)
        restore_values(prescribed, values)
        return dt, load


@dataclass
class Curve:
    """What a push leaves for figures.

    Attributes:
        depth: Settlement after each step [m].
        load: Load over half width and strength [-].
        jumps: Relative difference of the load after a remesh to that without it.
        left_out: Remeshes whose next step was cut, or failed without them.
        iterations: Of Newton's method in each step.
        halvings: How often steps were cut.
        inverted: Inverted triangles at the ends of steps.
        balance: Largest difference of the area from what was booked, by the area.
        seconds: Wall time, without film.
        failure: Why the run ended early.
    """

    depth: list = field(default_factory=lambda: [0.0])
    load: list = field(default_factory=lambda: [0.0])
    jumps: list = field(default_factory=list)
    left_out: int = 0
    iterations: list = field(default_factory=list)
    halvings: int = 0
    inverted: int = 0
    balance: float = 0.0
    seconds: float = 0.0
    failure: str = ""

    def at(self, depth):
        """Load at a depth [m] that was reached."""
        return float(np.interp(depth, self.depth, self.load))


def push(run, options, bar, frames=None):
    """Push the footing in; return the curve, and fill frames of a film where there is a list."""
    o, curve, begin, filming = options, Curve(), time.perf_counter(), 0.0
    start, strained = run.model.area(), 0.0

    def check_area():
        booked = sum(sum(record.merged.values()) for record in run.records)
        area = run.model.area()
        curve.balance = max(curve.balance, abs(area - start - booked - strained) / area)

    marks = [float(mark) * 2.0 * o.half_width / o.settlement for mark in MARKS]
    times = [o.duration * mark for mark in marks if mark < 1.0 - SAME] + [o.duration]
    try:
        for step in run.run(times, o.duration / o.steps, bar=bar):
            check_area()
            strained += run.model.strained()
            curve.inverted += run.model.inverted()
            curve.depth.append(o.settlement * step.t / o.duration)
            curve.load.append(run.model.load())
            curve.iterations.append(step.iterations)
            curve.halvings += step.cuts
            if frames is not None and len(curve.load) % max(o.steps // FRAMES, 1) == 0:
                before, model = time.perf_counter(), run.model
                frames.append(gather_frame(step.t, [model.plastic_strain()], (model.u, model.u_n)))
                filming += time.perf_counter() - before
            if isinstance(run, Watched) and (twin := run.twins.get(run.n_steps + 1)):
                dt, load = twin
                if load is None or abs(dt - step.dt) > SAME * dt:
                    curve.left_out += 1
                else:
                    curve.jumps.append(abs(curve.load[-1] / load - 1.0))
        check_area()
    except hm.TimeSteppingError as error:
        if not curve.iterations:
            raise
        curve.failure = str(error)
    curve.seconds = time.perf_counter() - begin - filming
    return curve


def loads_of(curve, options):
    """Load over half width and strength at those marks that were reached."""
    depths = {mark: float(mark) * 2.0 * options.half_width for mark in MARKS}
    end = curve.depth[-1] * (1.0 + SAME)
    return {mark: curve.at(depth) for mark, depth in depths.items() if depth <= end}


def wider(options):
    """By how much nodal forces at the base are those of a wider one: half an edge, relative."""
    return 0.5 / base_edges(options.h, options.half_width)


def penetrate(options, report, *, remeshing=True, bar="penetration", frames=None):
    """Push the footing in with or without remeshing; return the run and the curve."""
    every = options.every or None
    how = hm.Remeshing(keep=("base",), fire_angle=options.fire_angle, every=every)

    def build(domain):
        return Footing(domain, options)

    if remeshing:
        run = Watched(build, ground(options), how, end=options.duration)
    else:
        # Triangles turn over sooner or later, and no shorter step helps.
        few = hm.StepOptions(max_cuts=2)
        run = hm.Simulation(build, ground(options), options=few)
    report.unknowns = report.unknowns or run.model.problem.n_unknowns
    return run, push(run, options, bar, frames)


def penetration(options, report):
    """Case penetration: figures and pictures."""
    o, frames = options, []
    with report.phase("with remeshing"):
        run, curve = penetrate(o, report, frames=frames)
    with report.phase("without remeshing"):
        plain = penetrate(o, report, remeshing=False, bar="without remeshing")[1]
    for iterations in curve.iterations:
        report.step(iterations)
    records, area = run.records, run.model.area()
    loads = loads_of(curve, o)
    first = records[0].step if records else len(curve.load) - 1
    early = [abs(a / b - 1.0) for a, b in zip(curve.load[1:], plain.load[1:], strict=False)][:first]
    share = sum(record.seconds for record in records) + run.looking
    report.figures |= {
        "remeshes": len(records),
        "smallest_angle": min((r.smallest_angle[1] for r in records), default=None),
        "smallest_angle_before": min((r.smallest_angle[0] for r in records), default=None),
        "inverted_triangles": curve.inverted,
        "merged_area": sum(r.merged_total for r in records) / area,
        "area_balance": curve.balance,
        "load_difference_early": max(early, default=None),
        "load_jump_median": float(np.median(curve.jumps)) if curve.jumps else None,
        "load_jump_max": max(curve.jumps, default=None),
        "load_jumps": curve.jumps,
        "load_jumps_left_out": curve.left_out,
        "q_over_c": loads,
        "q_over_c_corrected": {mark: q / (1.0 + wider(o)) for mark, q in loads.items()},
        "remeshing_share": share / (curve.seconds - run.aside),
        "step_halvings": curve.halvings,
        "failed_steps": int(bool(curve.failure)),
        "plastic_strain_drift": run.drifts(),
        "newton_mean": float(np.mean(curve.iterations)),
        "newton_max": max(curve.iterations),
        "failure": curve.failure,
        "failure_without_remeshing": plain.failure,
        "reached": curve.depth[-1],
        "reached_without_remeshing": plain.depth[-1],
        "load_curve": {"settlement": curve.depth, "q_over_c": curve.load},
        "load_curve_without_remeshing": {"settlement": plain.depth, "q_over_c": plain.load},
    }
    gathered = gather_nodal(run.model.plastic_strain())

    def draw():
        draw_load(curve, plain, options)
        draw_ground(gathered, options, "plastic strain", "", "plastic_strain")

    with report.phase("pictures"):
        on_root(comm, draw)
        film(
            frames,
            o.out / "plastic_strain.gif",
            field="plastic strain",
            unit="",
            clim=(0.0, 1.0),
            edges=True,
            title=lambda t: f"settlement {o.settlement * t / o.duration:.2f} m",
            limits=view(o),
        )


# %% [markdown]
# ## Remeshed in place
#
# Remeshing begins with the old triangles and ends where nothing calls for a change: done again it
# changes no triangle. The state is gathered, a new domain and model are built, and the state goes
# back to the nodes: every number and every force must be the same bit for bit.
#
# The residual is not zero after a step of finite strain, remeshed or not: node cells begin each
# step anew. Steps without load take it away.


# %%
class InPlace(hm.Simulation):
    """A simulation that remeshes until no triangle changes."""

    def settle(self, most=10):
        """Remesh all bodies until no triangle changes; return how often it took. Collective."""
        for number in range(1, most + 1):
            known = len(self.records)
            self.remesh({body: ["settle"] for body in self.domain.bodies})
            if len(self.records) == known:
                return number
        raise RuntimeError(f"the triangles change still in remesh {most}")


def residual_of(model):
    """Residual of the displacement where the mesh stands, zero where it is prescribed."""
    problem = model.problem
    problem.residual()
    result = fem.Function(model.V, name="residual")
    result.x.array[:] = problem.layout.views(problem._condensed)[0]
    for bc in problem.bcs:
        dofs, _ = bc.dof_indices()
        result.x.array[dofs] = 0.0
    result.x.scatter_forward()
    return result


def norm(function):
    """Euclidean norm of the values of a function."""
    dofmap = function.function_space.dofmap
    owned = function.x.array[: dofmap.bs * dofmap.index_map.size_local]
    return np.sqrt(comm.allreduce(owned @ owned))


def snapshot(run):
    """All that nodes hold, of all nodes, and the residual; on rank 0."""
    model = run.model
    number = comm.bcast(len(run.domain.arrays().points))
    whole = gather_states(comm, model.nodal_state(), number)
    tables = {
        (name, key): table for name, state in whole.items() for key, table in state.nodal.items()
    }
    gathered = gather_nodal(model.u)
    if gathered is not None:
        tables |= {("mesh", "points"): gathered[0], ("mesh", "cells"): gathered[1]}
    return tables


def identity(options, report):
    """Case identity: figures."""
    o = options
    run = InPlace(lambda domain: Footing(domain, o), ground(o), hm.Remeshing(keep=("base",)))
    report.unknowns = run.model.problem.n_unknowns
    with report.phase("steps"):
        curve = push(run, o, "loading")
    for iterations in curve.iterations:
        report.step(iterations)
    load = curve.load[-1] * o.c * o.half_width
    with report.phase("remesh"):
        passes = run.settle()
        residual = residual_of(run.model)
        before, old = snapshot(run), gather_values(residual)
        start = norm(residual) / load
        run.rebuild()
        after, new = snapshot(run), gather_values(residual_of(run.model))
    change = residual_change = 0.0
    if comm.rank == 0:
        same = before.keys() == after.keys()
        change = max(difference(before[key], after[key]) for key in before) if same else np.inf
        residual_change = np.linalg.norm(new - old) / load
    relaxed = [start]
    with report.phase("relax"):
        # The conditions of the new model are those of no step yet.
        run.prescribe(run.t, float(run.model.dt.value))
        for _ in range(RELAXATIONS):
            run.model.solve()
            run.model.accept()
            relaxed.append(norm(residual_of(run.model)) / load)
            if relaxed[-1] <= AT_REST:
                break
    report.figures |= {
        "passes": passes,
        "remeshes": len(run.records),
        "plastic_strain_max": comm.allreduce(run.model.stress.history("kappa").max(), MPI.MAX),
        "history_change": comm.bcast(change),
        "residual_change": comm.bcast(residual_change),
        "residual_at_start": start,
        "residual_relaxed": relaxed[-1],
        "relaxations": len(relaxed) - 1,
        "residuals": relaxed,
        "failed_steps": int(bool(curve.failure)),
    }


def difference(a, b):
    """Largest difference of two arrays; infinite where shapes or missing values differ."""
    if a.shape != b.shape or not np.array_equal(np.isnan(a), np.isnan(b)):
        return np.inf
    return float(np.nanmax(np.abs(a - b), initial=0.0))


# %% [markdown]
# ## Remeshed while it drains
#
# Incompressible water and grains: what leaves is what the ground loses, and what merges of boundary
# nodes add or take is booked. A spot of finer triangles that wanders along the surface makes every
# remesh change some.


# %%
class Spot:
    """Target size of triangles that are finer around a place on the surface.

    Args:
        options: Parameters of the demo.

    Attributes:
        x: Where the place is [m].
    """

    def __init__(self, options):
        self.options, self.x = options, options.half_width

    def __call__(self, points):
        o = self.options
        distance = np.hypot(points[:, 0] - self.x, points[:, 1]) / (2.0 * o.half_width)
        return o.h * np.clip(0.4 + distance, 0.4, 1.0)


def consolidation(options, report):
    """Case consolidation: figures and pictures."""
    o, spot = options, Spot(options)
    how = hm.Remeshing(every=o.every or None, size=spot, keep=("base",))
    run = hm.Simulation(lambda domain: Footing(domain, o), ground(o), how)
    report.unknowns = run.model.problem.n_unknowns
    start, outflow, balance, halvings = run.model.area(), 0.0, 0.0, 0
    curve = {"t": [], "q_over_c": [], "outflow": []}

    def check_water():
        booked = sum(record.merged_water for record in run.records)
        return abs(start + booked - run.model.area() - outflow) / outflow

    failure = ""
    with report.phase("steps"):
        try:
            for step in run.run(o.duration, o.duration / o.steps, bar="consolidation"):
                if outflow:
                    balance = max(balance, check_water())
                outflow += run.model.outflow()
                report.step(step.iterations)
                halvings += step.cuts
                values = step.t, run.model.load(), outflow
                for series, value in zip(curve.values(), values, strict=True):
                    series.append(value)
                spot.x = o.half_width + (o.width - o.half_width) * step.t / o.duration
        except hm.TimeSteppingError as error:
            if not report.steps:
                raise
            failure = str(error)
        balance = max(balance, check_water())
    records, area = run.records, run.model.area()
    report.figures |= {
        "water_balance": balance,
        "outflow": outflow,
        "remeshes": len(records),
        "merged_area": sum(record.merged_total for record in records) / area,
        "merged_water": sum(record.merged_water for record in records),
        "smallest_angle": min((r.smallest_angle[1] for r in records), default=None),
        "plastic_strain_drift": run.drifts(),
        "newton_mean": report.newton_iterations / report.steps,
        "step_halvings": halvings,
        "failed_steps": int(bool(failure)),
        "failure": failure,
        "curve": curve,
    }
    gathered = gather_nodal(run.model.p)

    def draw():
        t = np.array(curve["t"])
        figure = curves(
            {"water that left": (t, curve["outflow"])}, x=("time", "s"), y=("outflow", "m^2")
        )
        save(figure, o.out / "outflow.png")
        draw_ground(gathered, o, "pore pressure", "Pa", "pore_pressure")

    on_root(comm, draw)


# %% [markdown]
# ## Dragged off the end
#
# A block is pressed into a softer base that yields, and dragged until it has left it. Its front
# ploughs, the end of the base is wiped off, and both bodies are remeshed on their own; contact goes
# with the nodes. Reactions of the top tell the forces. The secondary surface is that of the block,
# finer than the base, whose nodes would find ways between nodes of a coarser one.


# %%
class Blocks(hm.TransientModel):
    """A block whose top is pressed down, and then dragged to the right.

    Args:
        domain: Block and base.
        options: Parameters of the demo.
    """

    def __init__(self, domain, options):
        self.options, self.domain, o = options, domain, options
        mesh = domain.mesh
        V = self.V = fem.functionspace(mesh, ("P", 1, (2,)))
        u, u_n = fem.Function(V, name="displacement"), fem.Function(V)
        self.u, self.u_n, v = u, u_n, ufl.TestFunction(V)
        dc, cells, F = hm.node_cells_measure("full", subdomain_data=domain.cell_tags), None, 0
        soil, steel = hm.Tresca(o.E, o.nu, c=o.c), hm.LinearElastic(o.stiffer * o.E, o.nu)
        for name, material in (("base", soil), ("block", steel)):
            stress = hm.MaterialStress(
                material,
                u,
                u_n,
                dc(domain.body(name)),
                kinematics="finite",
                node_cells=cells,
                name=name,
            )
            cells = cells or stress.node_cells
            F += hm.finite_strain.equilibrium(
                stress.stress, stress.deformation, u, u_n, None, v, smoothed=stress.measure
            )
        moved = fem.Constant(mesh, np.zeros(2))
        self.top = self.dofs("block_top")
        conditions = [
            fem.dirichletbc(np.zeros(2), self.dofs("base_bottom"), V),
            fem.dirichletbc(moved, self.top, V),
        ]
        self.pair = hm.ContactPair(
            domain.facet_tags,
            secondary=domain.surface("block_bottom"),
            primary=domain.surface("base_top"),
            friction=hm.CoulombFriction(o.mu),
        )
        problem = hm.ContactProblem(F, u, bcs=conditions, pairs=[self.pair], domain=domain)
        super().__init__(
            problem,
            fem.Constant(mesh, 1.0),
            [],
            histories=[(moved, self.path)],
            follow=lambda: problem.move_mesh(u, u_n),
        )

    def dofs(self, surface):
        """Blocks of dofs of a surface."""
        facets = self.domain.facet_tags.find(self.domain.surface(surface))
        return fem.locate_dofs_topological(self.V, 1, facets)

    def path(self, t):
        """Displacement of the top at a time [m]."""
        o = self.options
        part = t / o.duration
        return max(part - PRESSING, 0.0) / (1.0 - PRESSING) * o.drag, -o.settlement * min(
            part / PRESSING, 1.0
        )

    def forces(self):
        """Force that drags and force that presses [N/m], of the step last solved."""
        reactions = self.problem.reactions(self.u).x.array.reshape(-1, 2)
        owned = self.top[self.top < self.V.dofmap.index_map.size_local]
        along, down = comm.allreduce(reactions[owned].sum(axis=0))
        return along, -down


def crossing(options, report):
    """Case crossing: figures and pictures."""
    o = options
    width = 2.0 * o.half_width
    domain = sliding_blocks(
        comm,
        width=width,
        height=0.5 * width,
        base_width=o.width,
        base_height=o.depth,
        start=0.5 * (o.width - width),
        secondary=round(1.2 * width / o.h) + 1,
        primary=round(o.width / o.h),
        rows=round(0.6 * width / o.h),
        base_rows=round(o.depth / o.h),
    )
    run = hm.Simulation(
        lambda domain: Blocks(domain, o),
        domain,
        hm.Remeshing(fire_angle=o.fire_angle, every=o.every or None),
    )
    report.unknowns = run.model.problem.n_unknowns
    curve, halvings, failure = {"t": [], "drag": [], "along": [], "down": []}, 0, ""
    with report.phase("steps"):
        try:
            times = [PRESSING * o.duration, o.duration]
            for step in run.run(times, o.duration / o.steps, bar="crossing"):
                report.step(step.iterations)
                halvings += step.cuts
                values = step.t, run.model.path(step.t)[0], *run.model.forces()
                for series, value in zip(curve.values(), values, strict=True):
                    series.append(value)
        except hm.TimeSteppingError as error:
            if not report.steps:
                raise
            failure = str(error)
    records = run.records
    report.figures |= {
        "failed_steps": int(bool(failure)),
        "step_halvings": halvings,
        "dragged": curve["drag"][-1],
        "largest_drag": max(curve["along"]),
        "force_at_end": curve["down"][-1],
        "remeshes": len(records),
        "smallest_angle": min((r.smallest_angle[1] for r in records), default=None),
        "merged_area": sum(r.merged_total for r in records),
        "newton_mean": report.newton_iterations / report.steps,
        "failure": failure,
        "curve": curve,
    }
    gathered = gather_nodal(run.model.u)

    def draw():
        drag = curve["drag"]
        series = {"along": (drag, curve["along"]), "down": (drag, curve["down"])}
        save(curves(series, x=("drag", "m"), y=("force", "N/m")), o.out / "forces.png")
        points, cells, u = gathered
        name = {"label": "displacement along", "unit": "m", "edges": True}
        field_plot(points, cells, u[:, 0], o.out / "crossing.png", **name)

    on_root(comm, draw)


# %% [markdown]
# ## Pictures


# %%
def embedded(depth, options):
    """Load over strength of a strip embedded in undisturbed ground (Salgado et al. 2004)."""
    return (2.0 + np.pi) * (1.0 + 0.27 * np.sqrt(np.asarray(depth) / (2.0 * options.half_width)))


def draw_load(curve, plain, options):
    """Draw the load over the depth, with what is known."""
    depth, load = np.array(curve.depth), np.array(curve.load)
    known = np.linspace(0.0, depth[-1], 200)
    figure = curves(
        {
            "with remeshing": (depth, load),
            "corrected for the edge": (depth, load / (1.0 + wider(options))),
            "without remeshing": (plain.depth, plain.load),
        },
        x=("settlement", "m"),
        y=("q / c", ""),
        reference=[
            (known, embedded(known, options)),
            (known[[0, -1]], np.full(2, 2.0 + 2.0 * np.pi)),
        ],
        reference_label="embedded strip, closed mechanism",
        title=f"h = {options.h:g} m",
    )
    save(figure, options.out / "load.png")


def view(options):
    """Smallest and largest x, and y, around the footing [m]."""
    o, b = options, options.half_width
    return (0.0, min(3.0 * b, o.width)), (-min(2.5 * b + o.settlement, o.depth), 0.5 * b)


def draw_ground(gathered, options, label, unit, name):
    """Draw a field around the footing, with the triangles."""
    points, cells, values = gathered
    top = float(np.quantile(values, 0.99))
    field_plot(
        points,
        cells,
        np.minimum(values, top),
        options.out / f"{name}.png",
        label=label,
        unit=unit,
        title=f"settlement {options.settlement:g} m",
        edges=True,
        limits=view(options),
    )


# %% [markdown]
# ## Meshes compared
#
# The corrected loads of all meshes against those of the finest, over the depth.


# %%
def study(options, report):
    """Tables and pictures of load, difference and cost over meshes, with and without remeshing."""
    from rich.console import Console
    from rich.table import Table

    o, results = options, {}
    width = 2.0 * o.half_width
    low, high = (part * width for part in COMPARED)
    depths = np.linspace(low, min(high, o.settlement), 91)
    o.meshes = sorted(o.meshes)
    for remeshing in (True, False):
        for edges in o.meshes:
            o.h = width / edges
            run, curve = penetrate(o, report, remeshing=remeshing, bar=f"B/{edges}")
            seconds = curve.seconds - (run.aside if remeshing else 0.0)
            results[remeshing, edges] = {
                "unknowns": sum(run.model.problem.n_unknowns.values()),
                "seconds": comm.allreduce(seconds, MPI.MAX),
                "remeshes": len(run.records) if remeshing else 0,
                "reached": curve.depth[-1],
                "failed_steps": int(bool(curve.failure)),
                "step_halvings": curve.halvings,
                "q_over_c": loads_of(curve, o),
                "corrected": np.interp(depths, curve.depth, curve.load) / (1.0 + wider(o)),
            }
    finest = results[True, o.meshes[-1]]["corrected"]
    table = Table(title=f"footing pushed {o.settlement:g} m, {o.steps} steps")
    columns = "remeshing", "mesh", "unknowns", "remeshes", "q/c at 0.25 B", "at 0.5 B", "corrected"
    for heading in (*columns, "mean diff.", "max diff.", "reached [m]", "s"):
        table.add_column(heading)
    for (remeshing, edges), r in results.items():
        within = depths <= r["reached"] * (1.0 + SAME)
        r["depths"], r["corrected"] = depths[within], r["corrected"][within]
        difference = np.abs(r["corrected"] / finest[within] - 1.0)
        r |= {"mean_difference": difference.mean(), "max_difference": difference.max()}
        q = [r["q_over_c"].get(mark, np.nan) for mark in ("0.25", "0.5")]
        numbers = [f"{x:.3f}" for x in (*q, q[-1] / (1.0 + 1.0 / edges))]
        numbers += [f"{r[k]:.2%}" for k in ("mean_difference", "max_difference")]
        words = "with" if remeshing else "without", f"B/{edges}"
        counts = str(r["unknowns"]), str(r["remeshes"])
        table.add_row(*words, *counts, *numbers, f"{r['reached']:.3g}", f"{r['seconds']:.1f}")
    if comm.rank == 0:
        Console(width=140).print(table)

    def draw():
        for key, what, unit in (("unknowns", "unknowns", ""), ("seconds", "wall time", "s")):
            series = {}
            for remeshing, name in ((True, "with remeshing"), (False, "without")):
                rows = [results[remeshing, edges] for edges in o.meshes]
                rows = [r for r in rows if r["mean_difference"] > 0.0]
                series[name] = [r[key] for r in rows], [r["mean_difference"] for r in rows]
            figure = curves(
                series,
                x=(what, unit),
                y=(f"mean difference to B/{o.meshes[-1]}", ""),
                scale=("log", "log"),
            )
            save(figure, o.out / f"study_difference_against_{what.replace(' ', '_')}.png")
        figure = curves(
            {
                f"B/{edges}{'' if remeshing else ', no remeshing'}": (r["depths"], r["corrected"])
                for (remeshing, edges), r in results.items()
            },
            x=("settlement", "m"),
            y=("q / c, corrected", ""),
            reference=[(depths, embedded(depths, o))],
            reference_label="embedded strip",
        )
        save(figure, o.out / "study_load.png")

    on_root(comm, draw)
    report.figures["study"] = {
        f"{'remeshing' if remeshing else 'plain'} B/{edges}": r
        for (remeshing, edges), r in results.items()
    }


# %% [markdown]
# ## The demo


# %%
CASES = {
    "penetration": penetration,
    "identity": identity,
    "consolidation": consolidation,
    "crossing": crossing,
}
LEFT_OUT = {
    "penetration": dict(h=0.125, width=6.0, depth=6.0, settlement=1.0, steps=100, nu=0.49),
    "identity": dict(h=0.125, width=6.0, depth=6.0, settlement=0.3, steps=10, nu=0.49),
    "consolidation": dict(h=0.25, width=4.0, depth=4.0, settlement=0.3, steps=50, nu=0.3, every=1),
    "crossing": dict(
        half_width=0.25, h=0.05, width=1.0, depth=0.4, settlement=0.02, steps=100, nu=0.3, every=5
    ),
}
"""Parameters that were not given, by case."""
QUICK = {
    "penetration": dict(h=0.25, width=4.0, depth=4.0, settlement=0.6, steps=20),
    "identity": dict(h=0.25, width=4.0, depth=4.0, settlement=0.3, steps=6),
    "consolidation": dict(h=0.5, width=3.0, depth=3.0, settlement=0.2, steps=8),
    "crossing": dict(h=0.1, steps=50),
}
"""The same with --quick."""


def parse(words=None):
    """Read the command line, or given words; return options and parameters of the report."""
    p = DemoParser(
        "remeshing",
        "A footing pushed deep into ground whose triangles are rebuilt.",
        comm,
        quick=True,
        study=True,
    )
    p.parameter("--case", "penetration", "", "what is run", choices=tuple(CASES))
    p.parameter("--h", 0.125, "m", "edges of the first mesh; 0.25 in consolidation,")
    p.parameter("--half-width", 1.0, "m", "half width of footing; 0.25, of the block, in crossing,")
    p.parameter("--width", 6.0, "m", "width of the ground; 4 in consolidation,")
    p.parameter("--depth", 6.0, "m", "depth of the ground; 4 in consolidation,")
    p.parameter("--settlement", 1.0, "m", "settlement at the end; 0.3 in other cases,")
    p.parameter("--steps", 100, "-", "steps; 10 in identity, 50 in consolidation,")
    p.parameter("--duration", 1e6, "s", "time that the settlement takes")
    p.parameter("--E", 1e6, "Pa", "Young's modulus")
    p.parameter("--nu", 0.49, "-", "Poisson's ratio; 0.3 in consolidation,")
    p.parameter("--c", 1e4, "Pa", "shear strength of the law of Tresca")
    p.parameter("--fire-angle", 15.0, "degrees", "remesh when an angle is smaller, in penetration")
    p.parameter("--every", 0, "-", "steps between remeshes; 1 in consolidation, 5 in crossing,")
    p.parameter("--permeability", 1e-8, "m/s", "permeability, in consolidation")
    p.parameter("--unit-weight", 1e4, "N/m^3", "unit weight of water, in consolidation")
    p.parameter("--tau", 1.0, "-", "stabilisation of the pore pressure, in consolidation")
    p.parameter("--drag", 0.9, "m", "way of the block, in crossing")
    p.parameter("--mu", 0.3, "-", "coefficient of friction, in crossing")
    p.parameter("--stiffer", 10.0, "-", "Young's modulus of the block by that of its base")
    p.parameter("--meshes", (8, 12, 16), "-", "edges over the width of the footing, in --study")
    p.set_defaults(half_width=None, every=None, **dict.fromkeys(LEFT_OUT["penetration"]))
    o = p.parse_args(words)
    for name, value in (LEFT_OUT[o.case] | (QUICK[o.case] if o.quick else {})).items():
        if getattr(o, name) is None:
            setattr(o, name, value)
    o.half_width, o.every = o.half_width or 1.0, o.every or 0
    for name in ("h", "half_width", "settlement", "steps", "duration", "E", "c", "fire_angle"):
        if not getattr(o, name) > 0:
            p.error(f"--{name.replace('_', '-')} must be positive, not {getattr(o, name)}")
    if o.study and o.case != "penetration":
        p.error("--study compares meshes in --case penetration")
    parameters = p.parameters(o)
    o.porous = o.case == "consolidation"
    return o, parameters


def main():
    """Run the demo."""
    options, parameters = parse()
    report = Report("remeshing", comm, parameters)
    if options.study:
        study(options, report)
    else:
        CASES[options.case](options, report)
        report.table()
    report.write(options.report)


if __name__ == "__main__":
    main()
