# SPDX-License-Identifier: LGPL-3.0-or-later
# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Sliding over a wavy base
#
# A block of St. Venant-Kirchhoff material lies on the waves of a base, into which its lower side
# fits. Its clamped top is pressed down, then moved along over many elements, so that waves ride on
# waves: nodes meet new facets, part and close again, and normals turn. At every step the supports
# must carry what acts between the surfaces, forces and moments of the surfaces must balance, and
# Newton's method must converge.
#
# In total Lagrangian form, with $F = I + \nabla u$ and $E = (F^T F - I)/2$,
# $$
# \int (F S) : \nabla v\,dX = 0, \qquad S = \lambda\,\mathrm{tr}(E)\,I + 2 G E .
# $$

# %%
import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem, la

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.output.fields import (
    FieldWriter,
    InterfaceFields,
    arc_length,
    gather_nodal,
    write_interface,
)
from fenicsx_hmcontact.output.figures import contact_plot, curves, field_plot, save
from fenicsx_hmcontact.output.report import DemoParser, Report
from fenicsx_hmcontact.output.root import on_root
from meshes.sliding import sliding_blocks

comm = MPI.COMM_WORLD

WIDTH, HEIGHT, BASE, START = 0.7, 0.4, 2.4, 0.4
"""Size of the block, width of the base and where the block starts on it [m]."""

SLIDE = 8
"""Way of the block, in its element lengths [-]."""

SHORTEST = 1 / 16
"""Smallest part of a step that is tried [-]."""

# %% [markdown]
# ## The model


# %%
class Slider:
    """The block on its base, ready to be pressed down and moved along.

    Attributes:
        displacements: Local arrays, one a step that was accepted.
    """

    def __init__(self, options):
        self.options, self.displacements = options, []
        self.domain = domain = sliding_blocks(
            comm,
            width=WIDTH,
            height=HEIGHT,
            base_width=BASE,
            base_height=HEIGHT,
            start=START,
            secondary=options.secondary,
            primary=options.primary,
            rows=options.rows,
            base_rows=options.rows,
            amplitude=options.amplitude,
        )
        mesh = domain.mesh
        mesh.topology.create_connectivity(1, 2)
        V = fem.functionspace(mesh, ("P", 1, (2,)))
        self.u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
        material = hm.LinearElastic(options.E, options.nu)
        unit = ufl.Identity(2)
        self.F = unit + ufl.grad(self.u)
        strain = (self.F.T * self.F - unit) / 2
        self.S = material.lame * ufl.tr(strain) * unit + 2 * material.shear_modulus * strain
        work = ufl.inner(self.F * self.S, ufl.grad(v))

        self.top = fem.Constant(mesh, np.zeros(2))
        self.pair = hm.ContactPair(
            domain.facet_tags,
            secondary=domain.surface("block_bottom"),
            primary=domain.surface("base_top"),
            friction=hm.CoulombFriction(options.mu),
            motion="finite",
        )
        self.problem = hm.ContactProblem(
            work * hm.node_cells_measure(options.smoothing),
            self.u,
            bcs=[
                fem.dirichletbc(self.top, self.dofs("block_top"), V),
                fem.dirichletbc(np.zeros(2), self.dofs("base_bottom"), V),
            ],
            pairs=[self.pair],
            newton=hm.NewtonOptions(tolerance=1e-13),
        )

    def dofs(self, surface):
        facets = self.domain.facet_tags.find(self.domain.surface(surface))
        return fem.locate_dofs_topological(self.u.function_space, 1, facets)

    def move(self, slide):
        """Move the pressed top to where it has slid [m]; return Newton's iterations."""
        self.top.value[:] = slide, -self.options.press
        return self.problem.solve().iterations

    def support(self, surface):
        """Force of a clamped side on its body [N/m]; shape (2,)."""
        dofs = self.dofs(surface)
        mine = dofs[dofs < self.u.function_space.dofmap.index_map.size_local]
        forces = self.problem.reactions(self.u).x.array.reshape(-1, 2)[mine]
        return comm.allreduce(forces.sum(axis=0))


# %% [markdown]
# ## Forces, moments, and the law of friction
#
# The resistance of a block that slides everywhere follows from pressures and normals alone.


# %%
def imbalance(slider, state):
    """Defects of forces / contact force, and of moments / (contact force x length) [-]."""
    size = np.linalg.norm(state.force)
    forces = (
        slider.support("block_top") + state.force,
        slider.support("base_bottom") + state.primary_forces.sum(axis=0),
    )
    x, y = state.primary_points.T
    f_x, f_y = state.primary_forces.T
    moment = state.moment() + np.sum(x * f_y - y * f_x)
    return np.linalg.norm(forces, axis=1).max() / size, abs(moment) / (size * WIDTH)


def law(options, state):
    """Force [N/m] that all closed nodes sliding along x resist with."""
    closed = state.closed
    n_x, n_y = state.normals[closed].T
    return (state.length * state.pressure)[closed] @ (options.mu * n_y - n_x)


# %% [markdown]
# ## A run
#
# The block is pressed down first. A step that does not converge leaves the state as it was and is
# cut into halves.


# %%
def solve(options, report):
    """Slide the block; return it and what lies between the surfaces after each step."""
    slider = Slider(options)
    report.unknowns = slider.problem.n_unknowns
    step = options.slip_per_step * WIDTH / options.secondary
    end = SLIDE * WIDTH / options.secondary
    slides, resistances, laws, defects, counts, states = [], [], [], [], [], []

    def accept(slide, iterations):
        report.step(iterations)
        state = slider.problem.interface(slider.pair)
        slides.append(slide)
        resistances.append(slider.support("block_top")[0])
        laws.append(law(options, state))
        defects.append(imbalance(slider, state))
        counts.append(iterations)
        states.append(state)
        slider.displacements.append(slider.u.x.array.copy())

    accept(0.0, slider.move(0.0))
    size, failed = step, 0
    while slides[-1] < end * (1 - 1e-9):
        slide = min(slides[-1] + size, end)
        try:
            accept(slide, slider.move(slide))
        except hm.ConvergenceError:
            failed += 1
            size /= 2
            if size < SHORTEST * step:
                raise
        else:
            size = min(2 * size, step)
    force, moment = np.max(defects, axis=0)
    report.figures |= {
        "failed_steps": failed,
        "newton_max": max(counts),
        "newton_mean": float(np.mean(counts)),
        "force_imbalance": force,
        "moment_imbalance": moment,
        "curve": {"slide": slides, "resistance": resistances, "law": laws},
    }
    return slider, slides, states


# %% [markdown]
# ## Pictures and files


# %%
def vertical_stress(slider):
    """Vertical Cauchy stress at the nodes [Pa], the mean of the triangles around each."""
    Q = fem.functionspace(slider.domain.mesh, ("P", 1))
    q = ufl.TestFunction(Q)
    stress = (slider.F * slider.S * slider.F.T)[1, 1] / ufl.det(slider.F)
    total, area = (fem.assemble_vector(fem.form(f * q * ufl.dx)) for f in (stress, 1.0))
    for vector in (total, area):
        vector.scatter_reverse(la.InsertMode.add)
        vector.scatter_forward()
    result = fem.Function(Q, name="vertical stress")
    result.x.array[:] = total.array / area.array
    return result


def write(slider, slides, states, out):
    """Write displacement and contact of all steps for ParaView, and a table of the last one."""
    mesh, u = slider.domain.mesh, slider.u
    fields = InterfaceFields(mesh, [slider.pair])
    with FieldWriter(out / "contact.pvd", mesh, [u, *fields.functions]) as writer:
        for slide, state, displacement in zip(slides, states, slider.displacements, strict=True):
            u.x.array[:] = displacement
            fields.update([state])
            writer.write(slide)
    write_interface(comm, out / "contact.csv", states[-1])


def draw(options, curve, slides, states, along, displacement, stress):
    """Resistance against slide, pressure and gap along the interface, deformed bodies."""
    out = options.out
    figure = curves(
        {"reaction of the top": (curve["slide"], curve["resistance"])},
        x=("slide", "m"),
        y=("resistance", "N/m"),
        reference=[(curve["slide"][1:], curve["law"][1:])],
        reference_label="law, all nodes sliding",
    )
    save(figure, out / "resistance.png")
    pressures, gaps = {}, {}
    for k in np.unique(np.linspace(0, len(states) - 1, 4).round().astype(int)):
        order = np.argsort(states[k].points[:, 0])
        x, name = states[k].points[order, 0], f"slide {slides[k]:.2f} m"
        pressures[name] = (x, states[k].pressure[order])
        gaps[name] = (x, states[k].gap[order])
    save(curves(pressures, x=("x", "m"), y=("contact pressure", "Pa")), out / "pressure.png")
    figure = curves(gaps, x=("x", "m"), y=("gap", "m"))
    # Not the round-off of closed nodes.
    widest = max(np.nanmax(gap) for _, gap in gaps.values())
    figure.axes[0].set_ylim(-1e-6 * WIDTH, max(1.1 * widest, 1e-5 * WIDTH))
    save(figure, out / "gap.png")
    contact_plot(states[-1], out / "contact.png", along=along, title=f"slide {slides[-1]:.2f} m")
    points, cells, u = displacement
    for name, limits in (("stress", None), ("interface", box(states[-1].points))):
        field_plot(
            points,
            cells,
            stress[2],
            out / f"{name}.png",
            label="vertical stress",
            unit="Pa",
            edges=True,
            displacement=u,
            states=states[-1:],
            limits=limits,
        )


def box(points):
    """Limits of x and y around points."""
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.1 * np.ptp(points, axis=0).max()
    return np.column_stack((low - margin, high + margin))


# %% [markdown]
# ## The demo


# %%
def parser():
    """Options of the demo."""
    p = DemoParser("wavy_sliding", "A block slides over a wavy base at finite strain.", comm)
    p.parameter("--amplitude", 0.02, "m", "amplitude of the waves, of 1 m length")
    p.parameter("--mu", 0.3, "-", "coefficient of friction")
    p.parameter("--press", 0.004, "m", "how far the top is pressed down")
    p.parameter("--slip-per-step", 0.5, "-", "way in a step, in element lengths of the block")
    p.parameter("--secondary", 7, "-", "edges across the block")
    p.parameter("--primary", 22, "-", "edges across the base")
    p.parameter("--rows", 4, "-", "rows of cells in block and base")
    p.parameter("--E", 100.0, "Pa", "Young's modulus")
    p.parameter("--nu", 0.3, "-", "Poisson's ratio")
    p.parameter(
        "--smoothing",
        "deviatoric",
        "",
        "enhancement of the smoothed gradient, or unsmoothed P1",
        choices=("deviatoric", "full", "none", "triangles"),
    )
    return p


def main():
    """Run the demo."""
    arguments = parser()
    options = arguments.parse_args()
    if not options.press > 0.0:
        arguments.error("--press must be positive: without contact there is nothing to balance")
    if not 0.0 < options.slip_per_step <= SLIDE:
        arguments.error(f"--slip-per-step must be positive, {SLIDE} at most")
    report = Report("wavy_sliding", comm, arguments.parameters(options))
    with report.phase("steps"):
        slider, slides, states = solve(options, report)
    curve = report.figures["curve"]
    with report.phase("pictures"):
        along = arc_length(slider.domain.mesh, slider.pair)
        fields = gather_nodal(slider.u), gather_nodal(vertical_stress(slider))
        on_root(comm, lambda: draw(options, curve, slides, states, along, *fields))
        write(slider, slides, states, options.out)
    report.table()
    report.write(options.report)


if __name__ == "__main__":
    main()
