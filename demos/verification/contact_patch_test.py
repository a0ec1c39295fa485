# SPDX-License-Identifier: LGPL-3.0-or-later
# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Patch test across a non-matching interface
#
# Two elastic blocks under a uniform stress: whatever the meshes, the slope of the interface, the
# supports and the smoothing, every point must see that stress to round-off, and so must the
# tractions between the blocks. Ends on rollers prescribe a displacement component of secondary
# nodes, which is what breaks most mortar codes.

# %%
import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.output.fields import arc_length, gather_nodal, write_interface
from fenicsx_hmcontact.output.figures import contact_plot, field_plot
from fenicsx_hmcontact.output.report import DemoParser, Report
from fenicsx_hmcontact.output.root import on_root
from meshes.patch import patch_blocks

comm = MPI.COMM_WORLD

# %% [markdown]
# ## The model


# %%
def solve(options):
    """Solve the patch; return the problem, its domain, displacement, pair and material."""
    domain = patch_blocks(
        comm,
        secondary=options.secondary,
        primary=options.primary,
        slope=options.slope,
        jitter=options.jitter,
    )
    mesh = domain.mesh
    mesh.topology.create_connectivity(1, 2)
    V = fem.functionspace(mesh, ("P", 1, (2,)))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    material = hm.LinearElastic(options.E, options.nu)
    stress, exact = uniform_state(options, material)

    traction = fem.Constant(mesh, stress) * ufl.FacetNormal(mesh)
    sides = [
        domain.surface(f"{side}_{body}") for side in ("left", "right") for body in domain.bodies
    ]
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=domain.facet_tags)
    F = ufl.inner(material.stress(u), ufl.grad(v)) * hm.node_cells_measure(options.smoothing)
    F -= ufl.dot(traction, v) * ds((domain.surface("top"), *sides))

    u_exact = fem.Function(V)
    u_exact.interpolate(lambda x: exact @ x[:2])
    bottom = domain.facet_tags.find(domain.surface("bottom"))
    bcs = [fem.dirichletbc(u_exact, fem.locate_dofs_topological(V, 1, bottom))]
    if options.ends == "rollers":
        W = V.sub(0)
        C, _ = W.collapse()
        u_x = fem.Function(C)
        u_x.interpolate(lambda x: exact[0] @ x[:2])
        for side in sides:
            dofs = fem.locate_dofs_topological((W, C), 1, domain.facet_tags.find(side))
            bcs.append(fem.dirichletbc(u_x, dofs, W))
    if options.ends == "free" and not options.tied:
        # Without friction the upper block could slide off along the interface.
        dofs = fem.locate_dofs_geometrical(
            V, lambda x: np.isclose(x[0], 0.0) & np.isclose(x[1], 1.0)
        )
        bcs.append(fem.dirichletbc(u_exact, dofs))
    pair = hm.ContactPair(
        domain.facet_tags,
        secondary=domain.surface("interface_upper"),
        primary=domain.surface("interface_lower"),
        friction=hm.Tied() if options.tied else hm.Frictionless(),
        motion="small",
    )
    problem = hm.ContactProblem(F, u, bcs=bcs, pairs=[pair])
    result = problem.solve()
    return problem, domain, u, pair, material, stress, result


def uniform_state(options, material):
    """Stress [Pa] and displacement gradient [-] of the patch."""
    sxx, sxy = options.load * options.side, options.load * options.shear
    stress = np.array([[sxx, sxy], [sxy, -options.load]])
    if not options.tied:
        # No shear on the interface: principal axes along and across it.
        along = np.array([1.0, options.slope]) / np.hypot(1.0, options.slope)
        across = np.array([-along[1], along[0]])
        stress = sxx * np.outer(along, along) - options.load * np.outer(across, across)
    out_of_plane = material.nu * np.trace(stress)
    strain = (
        (1.0 + material.nu) * stress - material.nu * np.eye(2) * np.trace(stress)
    ) / material.E
    strain -= material.nu * np.eye(2) * out_of_plane / material.E
    return stress, strain


def stress_deviation(options, domain, u, material, stress):
    """Largest deviation of the stress at any smoothing point (or triangle), / load."""
    if options.smoothing == "triangles":
        T = fem.functionspace(domain.mesh, ("DG", 0, (2, 2)))
        s = fem.Function(T)
        s.interpolate(fem.Expression(material.stress(u), T.element.interpolation_points))
        values = s.x.array.reshape(-1, 2, 2)
    else:
        gradient = hm.create_node_cells(domain.mesh).gradient(u, options.smoothing)
        strain = 0.5 * (gradient + np.swapaxes(gradient, -1, -2))
        trace = np.trace(strain, axis1=-2, axis2=-1)[..., None, None]
        values = 2.0 * material.shear_modulus * strain + material.lame * trace * np.eye(2)
    largest = np.abs(values - stress).max(initial=0.0)
    return comm.allreduce(largest, MPI.MAX) / options.load


# %% [markdown]
# ## The demo


# %%
def main():
    """Run the demo."""
    p = DemoParser("contact_patch_test", "Patch test across a non-matching interface.", comm)
    p.parameter("--secondary", 7, "-", "edges of the secondary (upper) block on the interface")
    p.parameter("--primary", 11, "-", "edges of the primary (lower) block on the interface")
    p.parameter("--slope", 0.3, "-", "slope of the interface")
    p.parameter("--jitter", 0.0, "-", "random shift of inner nodes, part of a cell")
    p.parameter(
        "--ends", "free", "", "ends under traction or on rollers", choices=("free", "rollers")
    )
    p.parameter("--tied", False, "", "tie the blocks; frictionless contact otherwise")
    p.parameter("--load", 1.0, "Pa", "vertical pressure")
    p.parameter("--side", -0.4, "-", "horizontal stress / load, tension positive")
    p.parameter("--shear", 0.25, "-", "shear stress / load of tied blocks")
    p.parameter("--E", 100.0, "Pa", "Young's modulus")
    p.parameter("--nu", 0.3, "-", "Poisson's ratio")
    p.parameter(
        "--smoothing",
        "deviatoric",
        "",
        "enhancement of the smoothed gradient, or unsmoothed P1",
        choices=("deviatoric", "full", "none", "triangles"),
    )
    options = p.parse_args()
    report = Report("contact_patch_test", comm, p.parameters(options))
    with report.phase("solve"):
        problem, domain, u, pair, material, stress, result = solve(options)
    report.unknowns = problem.n_unknowns
    report.step(result.iterations)
    report.figures["stress_deviation_max"] = stress_deviation(options, domain, u, material, stress)

    state = problem.interface(pair)
    traction = state.normals @ stress
    normal = -np.sum(traction * state.normals, axis=1)
    tangents = np.column_stack((state.normals[:, 1], -state.normals[:, 0]))
    shear = -np.sum(traction * tangents, axis=1)
    deviation = np.abs([state.pressure - normal, state.shear - shear])
    report.figures["traction_deviation_max"] = np.nanmax(deviation) / options.load

    displacement, along = gather_nodal(u), arc_length(domain.mesh, pair)

    def draw():
        points, cells, values = displacement
        field_plot(
            points,
            cells,
            values[:, 1],
            options.out / "displacement.png",
            label="vertical displacement",
            unit="m",
            edges=True,
            displacement=values,
            states=[state],
        )
        order = np.argsort(along)
        exact = [(along[order], of_node[order]) for of_node in (normal, shear)]
        contact_plot(state, options.out / "contact.png", along=along, reference=exact)

    on_root(comm, draw)
    write_interface(comm, options.out / "contact.csv", state)
    report.table()
    report.write(options.report)


if __name__ == "__main__":
    main()
