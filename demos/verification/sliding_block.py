# SPDX-License-Identifier: LGPL-3.0-or-later
# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Pushed block, block on an incline
#
# An elastic block rests on an elastic base under a load $N$ on its top, and its left side is
# pushed. When all of its lower side slides, the push $R$ is what the law of friction allows,
# $$
# R = \sum_{closed} D_i \left(\mu p_i + c \min(1, p_i/p_{ref})\right), \qquad p_{ref} = 0.1\,c ,
# $$
# to round-off, on any meshes: $p_i$ is the effective contact pressure of node $i$ and $D_i$ the
# length it stands for. Where no node is open or within the ramp of the cohesion, this is
# $\mu (N - p_w A) + c A$ with a pore pressure $p_w$ everywhere (`--water-pressure`) and the length
# $A$ of the block.
#
# With `--incline` the block stands on a slope under its weight $W$, held by a weak spring: below
# the angle of friction it sticks, above it the spring carries $W(\sin\alpha - \mu\cos\alpha)$.

# %%
import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem, la

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.output.fields import arc_length, gather_nodal, write_interface
from fenicsx_hmcontact.output.figures import contact_plot, curves, field_plot, save
from fenicsx_hmcontact.output.report import DemoParser, Report, progress
from fenicsx_hmcontact.output.root import on_root
from meshes.sliding import sliding_blocks

comm = MPI.COMM_WORLD

WIDTH, HEIGHT, START = 1.0, 0.5, 0.5

# %% [markdown]
# ## The model
#
# Without water there are no pressure unknowns. With it the flow is steady and the load on the top
# is of solid and water together, so that the skeleton carries $N - p_w A$ across the interface.


# %%
class Block:
    """The block on its base, ready to be pushed or to slide down."""

    def __init__(self, options):
        self.options = options
        self.domain = domain = sliding_blocks(
            comm,
            width=WIDTH,
            height=HEIGHT,
            start=START,
            secondary=options.secondary,
            primary=options.primary,
            rows=options.rows,
            base_rows=options.rows,
        )
        mesh = domain.mesh
        mesh.topology.create_connectivity(1, 2)
        V = fem.functionspace(mesh, ("P", 1, (2,)))
        self.u = u = fem.Function(V, name="displacement")
        self.dt = fem.Constant(mesh, 1e5)
        self.material = hm.LinearElastic(options.E, options.nu)
        dc = hm.node_cells_measure(options.smoothing)
        bcs = [fem.dirichletbc(np.zeros(2), self.dofs(V, "base_bottom"), V)]
        if options.water_pressure:
            Q = fem.functionspace(mesh, ("P", 1))
            p = fem.Function(Q, name="pore pressure")
            v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))
            unknowns = [u, p]
            flux = hm.darcy_flux(p, options.permeability, options.unit_weight)
            F = hm.equilibrium(self.material.stress(u), p, v, smoothed=dc)
            F -= self.dt * ufl.dot(flux, ufl.grad(q)) * dc
            sides = ("block_top", "block_right", "block_left", "base_right", "base_left")
            outside = np.unique(np.concatenate([self.dofs(Q, side) for side in sides]))
            bcs.append(fem.dirichletbc(options.water_pressure, outside, Q))
            # Steps so long that all pressures are those of the reservoir outside.
            flow = hm.GapFlow(
                options.permeability, unit_weight=options.unit_weight, aperture_cap=1e-3
            )
        else:
            v, unknowns, flow = ufl.TestFunction(V), u, None
            F = hm.equilibrium(self.material.stress(u), None, v, smoothed=dc)

        self.push = fem.Constant(mesh, 0.0)
        if options.incline:
            F += self.slope(v)
        else:
            # Above the corner: a prescribed node would not be in contact.
            side = fem.locate_dofs_geometrical(
                (V.sub(0), V.sub(0).collapse()[0]),
                lambda x: np.isclose(x[0], START) & (x[1] > 0.5 * HEIGHT / options.rows),
            )
            self.side = side[0][side[0] < 2 * V.dofmap.index_map.size_local]
            bcs.append(fem.dirichletbc(self.push, side[0], V.sub(0)))
            ds = ufl.Measure("ds", domain=mesh, subdomain_data=domain.facet_tags)
            load = fem.Constant(mesh, options.load / WIDTH)
            F += load * v[1] * ds(domain.surface("block_top"))
        self.pair = hm.ContactPair(
            domain.facet_tags,
            secondary=domain.surface("block_bottom"),
            primary=domain.surface("base_top"),
            friction=hm.CoulombFriction(options.mu, options.cohesion),
            flow=flow,
            motion=options.motion,
        )
        self.problem = hm.ContactProblem(
            F,
            unknowns,
            bcs=bcs,
            pairs=[self.pair],
            time_step=self.dt,
            # Where few nodes carry all, they stick and slip in turns for long.
            newton=hm.NewtonOptions(1e-12, max_iterations=150),
        )

    def dofs(self, space, surface):
        facets = self.domain.facet_tags.find(self.domain.surface(surface))
        return fem.locate_dofs_topological(space, 1, facets)

    def slope(self, v):
        """Virtual work of the weight on the slope, and of the spring along it."""
        mesh, o = self.domain.mesh, self.options
        dx = ufl.Measure("dx", domain=mesh, subdomain_data=self.domain.cell_tags)
        dx = dx(self.domain.body("block"))
        down = np.array([o.incline, -1.0]) / np.hypot(o.incline, 1.0)
        weight = fem.Constant(mesh, o.load / (WIDTH * HEIGHT) * down)
        spring = fem.Constant(mesh, o.spring / (WIDTH * HEIGHT))
        self.pull = fem.form(spring * self.u[0] * dx)
        return spring * self.u[0] * v[0] * dx - ufl.dot(weight, v) * dx

    def spring_force(self):
        """Force of the spring up the slope [N/m]."""
        return comm.allreduce(fem.assemble_scalar(self.pull))

    def resistance(self):
        """Force along the base that the block is held or driven with [N/m], without the tractions.

        From the reactions of the push, or on the slope from weight and spring.
        """
        o = self.options
        if o.incline:
            return o.load * np.sin(np.arctan(o.incline)) - self.spring_force()
        return comm.allreduce(self.problem.reactions(self.u).x.array[self.side].sum())

    def law(self, state):
        """Force [N/m] that all closed nodes sliding along x resist with, from pressures alone."""
        o, closed = self.options, state.closed
        p = state.pressure[closed]
        bound = o.mu * p
        if o.cohesion:
            bound += o.cohesion * np.minimum(1.0, p / (0.1 * o.cohesion))
        n_x, n_y = state.normals[closed].T
        resisted = state.length[closed] @ (bound * n_y - p * n_x)
        # Water presses on edges that have turned, too; where they are open as well.
        return resisted - state.water_forces[:, 0].sum()


# %% [markdown]
# ## A run
#
# The load comes with the first step; short pushes come first, while parts still stick. On the slope
# one step is all.


# %%
def solve(options, report):
    """Push the block step by step; return it, what lies between at the end, and the curve."""
    block = Block(options)
    report.unknowns = block.problem.n_unknowns
    steps = 1 if options.incline else options.steps
    failed, curve = 0, []
    for k in progress(range(1, steps + 1), comm, "sliding block"):
        block.push.value = 0.0 if options.incline else options.push * (k / steps) ** 2
        try:
            report.step(block.problem.solve().iterations)
        except hm.ConvergenceError:
            failed += 1
            continue
        state = block.problem.interface(block.pair)
        curve.append((float(block.push.value), block.resistance(), block.law(state)))
    if not curve:
        raise RuntimeError(f"none of {steps} steps converged")
    figures = report.figures
    figures["failed_steps"] = failed
    figures["newton_mean"] = report.newton_iterations / report.steps
    figures["sticks"] = int(np.any(state.state == hm.NodeState.STICKING))
    figures["open_nodes"] = int(np.sum(state.state == hm.NodeState.OPEN))
    pushes, resistances, laws = np.transpose(curve)
    figures["resistance"] = resistances[-1]
    if not figures["sticks"]:
        # Below the bound the law says nothing.
        figures["resistance_error"] = abs(resistances[-1] - laws[-1]) / options.load
    if options.incline:
        figures["spring_force"] = block.spring_force()
    else:
        figures["curve"] = {"push": pushes, "resistance": resistances, "law": laws}
    return block, state


# %% [markdown]
# ## Pictures


# %%
def vertical_stress(block):
    """Vertical effective stress at the nodes [Pa], the mean of the triangles around each."""
    Q = fem.functionspace(block.domain.mesh, ("P", 1))
    q = ufl.TestFunction(Q)
    total, area = (
        fem.assemble_vector(fem.form(f * q * ufl.dx))
        for f in (block.material.stress(block.u)[1, 1], 1.0)
    )
    for vector in (total, area):
        vector.scatter_reverse(la.InsertMode.add)
        vector.scatter_forward()
    stress = fem.Function(Q, name="vertical stress")
    stress.x.array[:] = total.array / area.array
    return stress


def draw(options, figures, state, along, displacement, stress):
    """Resistance against push, tractions and gap along the interface, deformed bodies."""
    out = options.out
    if not options.incline:
        curve = figures["curve"]
        figure = curves(
            {"push": (curve["push"], curve["resistance"])},
            x=("push", "m"),
            y=("resistance", "N/m"),
            reference=[(curve["push"], curve["law"])],
            reference_label="law, all nodes sliding",
        )
        figure.axes[0].set_ylim(0.0, 1.1 * max(curve["law"]) or None)
        save(figure, out / "resistance.png")
    contact_plot(state, out / "tractions.png", along=along)
    order = np.argsort(along)
    gap = {"gap": (along[order], state.gap[order])}
    figure = curves(gap, x=("arc length", "m"), y=("gap", "m"))
    # Not the round-off of closed nodes.
    figure.axes[0].set_ylim(-1e-6 * WIDTH, max(1.1 * state.gap.max(), 1e-5 * WIDTH))
    save(figure, out / "gap.png")
    points, cells, u = displacement
    field_plot(
        points,
        cells,
        stress[2],
        out / "stress.png",
        label="vertical effective stress",
        unit="Pa",
        edges=True,
        displacement=u,
        states=[state],
    )


# %% [markdown]
# ## The demo


# %%
def parser():
    """Options of the demo."""
    p = DemoParser("sliding_block", "An elastic block pushed over an elastic base.", comm)
    p.parameter("--mu", 0.3, "-", "coefficient of friction")
    p.parameter("--cohesion", 0.0, "Pa", "cohesion of the interface")
    p.parameter("--water-pressure", 0.0, "Pa", "pore pressure in both blocks, 0 for dry ones")
    p.parameter("--incline", 0.0, "-", "tangent of the slope the block slides on; 0: it is pushed")
    p.parameter("--load", 1.0, "N/m", "load on the top, or weight on the slope")
    p.parameter("--push", 0.1, "m", "displacement of the left side at the end")
    p.parameter("--steps", 8, "-", "steps of the push")
    p.parameter("--spring", 0.04, "N/m^2", "stiffness of the spring along the slope")
    p.parameter("--secondary", 7, "-", "edges across the block")
    p.parameter("--primary", 23, "-", "edges across the base, twice as long")
    p.parameter("--rows", 4, "-", "rows of cells in block and base")
    p.parameter("--E", 100.0, "Pa", "Young's modulus")
    p.parameter("--nu", 0.3, "-", "Poisson's ratio")
    p.parameter("--permeability", 1e-3, "m/s", "of the blocks and across the interface")
    p.parameter("--unit-weight", 1.0, "N/m^3", "unit weight of water")
    p.parameter(
        "--motion",
        "small",
        "",
        "whether normals and segments follow the surfaces",
        choices=("small", "finite"),
    )
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
    if not 0.0 < options.push < START:
        arguments.error(f"--push must be positive and keep the block on its base: below {START:g}")
    report = Report("sliding_block", comm, arguments.parameters(options))
    with report.phase("steps"):
        block, state = solve(options, report)
    with report.phase("pictures"):
        along = arc_length(block.domain.mesh, block.pair)
        fields = gather_nodal(block.u), gather_nodal(vertical_stress(block))
        on_root(comm, lambda: draw(options, report.figures, state, along, *fields))
        write_interface(comm, options.out / "contact.csv", state)
    report.table()
    report.write(options.report)


if __name__ == "__main__":
    main()
