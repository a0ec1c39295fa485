# SPDX-License-Identifier: LGPL-3.0-or-later
# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Add a contact pair to a model of your own
#
# A strip load consolidates ground of two layers. The model is plain DOLFINx: a gmsh mesh, function
# spaces, a UFL residual and Dirichlet conditions. The two layers were meshed separately, so their
# meshes do not match: one `ContactPair` ties them and lets the water through. That is all there is
# to add:
#
# - the mesh is read with `partitioner=hm.vertex_ghost_partitioner()`, so that node cells are
#   complete on every rank (not needed without smoothing);
# - terms to be smoothed are written on `hm.dc` instead of `ufl.dx`;
# - a list of pairs goes to `hm.ContactProblem`, which takes the place of DOLFINx's
#   `NonlinearProblem`.

# %%
import sys
import tempfile
from pathlib import Path

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.io import gmsh as gmshio

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.output.fields import FieldWriter, gather_nodal
from fenicsx_hmcontact.output.figures import curves, field_plot, save
from fenicsx_hmcontact.output.report import DemoParser, Report, progress
from fenicsx_hmcontact.output.root import on_root
from meshes.two_blocks import two_blocks

comm = MPI.COMM_WORLD

# %% [markdown]
# ## The mesh
#
# Any gmsh file will do whose bodies share no nodes. Here it is written first, then read the way
# DOLFINx users read meshes.


# %%
def read_mesh(options, single):
    """Mesh, cell tags, facet tags and tags by name."""
    with tempfile.TemporaryDirectory() as folder:
        file = comm.bcast(str(Path(folder) / "ground.msh"))
        two_blocks(
            comm,
            width=options.width,
            height=options.depth,
            lower=options.lower,
            upper=options.upper,
            rows=options.rows,
            single=single,
            out=file,
        )
        data = gmshio.read_from_msh(file, comm, gdim=2, partitioner=hm.vertex_ghost_partitioner())
        comm.barrier()
    tags = {name: group.tag for name, group in data.physical_groups.items()}
    return data.mesh, data.facet_tags, tags


# %% [markdown]
# ## The model, in plain UFL
#
# $$
# \int \sigma'(u):\nabla v - p\,\nabla\cdot v + \int_{x<b} q_0 v_y = 0, \qquad
# \int q\,\nabla\cdot(u-u_n) + \Delta t\,\tfrac{k}{\gamma}\nabla p\cdot\nabla q
# + \tfrac{\tau}{2G}(\ldots) = 0
# $$


# %%
def consolidate(options, report, single=False):
    """Run the model; return times, settlements of the loaded strip and the final fields."""
    mesh, facet_tags, tags = read_mesh(options, single)
    mesh.topology.create_connectivity(1, 2)
    V = fem.functionspace(mesh, ("P", 1, (2,)))
    Q = fem.functionspace(mesh, ("P", 1))
    u, p = fem.Function(V, name="displacement"), fem.Function(Q, name="pore pressure")
    u_n, p_n = fem.Function(V), fem.Function(Q)
    v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))
    dt = fem.Constant(mesh, 1.0)

    G = options.E / (2.0 * (1.0 + options.nu))
    lame = options.E * options.nu / ((1.0 + options.nu) * (1.0 - 2.0 * options.nu))

    def sigma(w):
        eps = ufl.sym(ufl.grad(w))
        return 2.0 * G * eps + lame * ufl.tr(eps) * ufl.Identity(2)

    x = ufl.SpatialCoordinate(mesh)
    strip = ufl.conditional(ufl.lt(x[0], options.strip), options.load, 0.0)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
    k_over_gamma = options.permeability / options.unit_weight

    F = ufl.inner(sigma(u), ufl.grad(v)) * hm.dc - p * ufl.div(v) * ufl.dx
    F += strip * v[1] * ds(tags["top"])
    F += q * ufl.div(u - u_n) * ufl.dx
    F += dt * k_over_gamma * ufl.inner(ufl.grad(p), ufl.grad(q)) * hm.dc
    F += hm.pressure_projection(p, p_n, q, G)

    def fixed(space, name):
        return fem.dirichletbc(
            0.0, fem.locate_dofs_topological(space, 1, facet_tags.find(tags[name])), space
        )

    bcs = [fixed(V.sub(0), side) for side in ("left", "right")]
    bcs += [fixed(V.sub(0), "bottom"), fixed(V.sub(1), "bottom"), fixed(Q, "top")]

    # What the package adds: the pair, and the problem that takes it.
    pairs = []
    if not single:
        pairs.append(
            hm.ContactPair(
                facet_tags,
                secondary=tags["interface_upper"],
                primary=tags["interface_lower"],
                friction=hm.Tied(),
                flow=hm.GapFlow(transverse_permeability=options.permeability),
            )
        )
    problem = hm.ContactProblem(F, [u, p], bcs=bcs, pairs=pairs)

    settlement = fem.form(
        ufl.conditional(ufl.lt(x[0], options.strip), -u[1], 0.0) / options.strip * ds(tags["top"])
    )
    volume_change = fem.form(ufl.div(u - u_n) * ufl.dx)
    t, history, balance = 0.0, [], 0.0
    for step in progress(np.geomspace(*options.steps, num=options.number), comm, "consolidation"):
        dt.value = step
        u_n.x.array[:], p_n.x.array[:] = u.x.array, p.x.array
        report.step(problem.solve().iterations)
        t += step
        history.append((t, comm.allreduce(fem.assemble_scalar(settlement))))
        owned = Q.dofmap.index_map.size_local
        outflow = -comm.allreduce(problem.reactions(p).x.array[:owned].sum())
        lost = -comm.allreduce(fem.assemble_scalar(volume_change))
        balance = max(balance, abs(outflow - lost) / abs(outflow))
    return problem, u, p, np.array(history), balance


# %% [markdown]
# ## The demo
#
# The same ground in one body, meshed as finely, must settle the same.


# %%
def main():
    """Run the demo."""
    parser = DemoParser(
        "add_contact_pair", "A contact pair added to a consolidation model in plain UFL.", comm
    )
    parser.parameter("--width", 5.0, "m", "half width of the ground")
    parser.parameter("--depth", 5.0, "m", "depth of the ground, two layers")
    parser.parameter("--strip", 1.0, "m", "half width of the load")
    parser.parameter("--load", 1e4, "Pa", "pressure of the load")
    parser.parameter("--E", 1e7, "Pa", "Young's modulus")
    parser.parameter("--nu", 0.3, "-", "Poisson's ratio")
    parser.parameter("--permeability", 1e-8, "m/s", "of the ground")
    parser.parameter("--unit-weight", 1e4, "N/m^3", "unit weight of water")
    parser.parameter("--lower", 20, "-", "edges across the lower layer")
    parser.parameter("--upper", 30, "-", "edges across the upper layer")
    parser.parameter("--rows", 12, "-", "rows of cells a layer")
    parser.parameter("--steps", (100.0, 2e5), "s", "first and last step")
    parser.parameter("--number", 40, "-", "number of steps, growing evenly")
    options = parser.parse_args()
    report = Report("add_contact_pair", comm, parser.parameters(options))
    with report.phase("two layers"):
        problem, u, p, history, balance = consolidate(options, report)
    with report.phase("one body"):
        _, _, _, one_body, _ = consolidate(options, Report("one body", comm, {}), single=True)
    report.unknowns = problem.n_unknowns
    report.figures |= {
        "settlement": history[-1, 1],
        "settlement_one_body": one_body[-1, 1],
        "settlement_difference": float(np.abs(history / one_body - 1.0)[:, 1].max()),
        "mass_balance": balance,
    }
    with FieldWriter(options.out / "fields.pvd", u.function_space.mesh, [u, p]) as writer:
        writer.write(history[-1, 0])
    gathered = gather_nodal(p)

    def draw():
        series = {
            "two layers, tied": (history[:, 0], 1e3 * history[:, 1]),
            "one body": (one_body[:, 0], 1e3 * one_body[:, 1]),
        }
        figure = curves(
            series, x=("time", "s"), y=("settlement of the strip", "mm"), scale=("log", "linear")
        )
        save(figure, options.out / "settlement.png")
        points, cells, values = gathered
        field_plot(
            points,
            cells,
            values / 1e3,
            options.out / "pore_pressure.png",
            label="pore pressure",
            unit="kPa",
            edges=True,
        )

    on_root(comm, draw)
    report.table()
    report.write(options.report)
    assert report.figures["settlement_difference"] < 0.02
    assert balance < 1e-11


if __name__ == "__main__":
    main()
