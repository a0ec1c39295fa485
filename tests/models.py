# SPDX-License-Identifier: LGPL-3.0-or-later
"""Small models that tests share: stacked blocks, elastic or consolidating, and matrices of them."""

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.domain import Domain, MeshArrays

MATERIAL = hm.LinearElastic(1e8, 0.2)
K = 1e-9
GAMMA = 1e4
LOAD = 1e4


def stack(comm, across, *, width=1.0, levels=None, rows=3, slope=0.0, shift=0.0, alternate=False):
    """Blocks on top of each other, body k with ``across[k]`` edges across and its own nodes.

    Block k lies between levels k and k + 1; those inside have a slope about the middle. Surfaces
    are bottom_k, right_k, top_k and left_k. Block k is shifted by ``k * shift`` to the right.
    """
    n = len(across)
    levels = np.linspace(0.0, 1.0, n + 1) if levels is None else np.asarray(levels, float)
    slopes = np.zeros(n + 1)
    slopes[1:-1] = slope
    points, cells, groups, facets, facet_groups = [], [], [], [], []
    surfaces, first = {}, 0
    for k, nx in enumerate(across):
        x, eta = np.meshgrid(np.linspace(0.0, width, nx + 1), np.linspace(0.0, 1.0, rows + 1))
        low, high = (levels[i] + slopes[i] * (x - width / 2) for i in (k, k + 1))
        y = low + eta * (high - low)
        points.append(np.column_stack([x.ravel() + k * shift, y.ravel(), 0.0 * y.ravel()]))
        id_ = first + np.arange(x.size).reshape(x.shape)
        a, b, c, d = (v.ravel() for v in (id_[:-1, :-1], id_[:-1, 1:], id_[1:, 1:], id_[1:, :-1]))
        turn = (np.indices((rows, nx)).sum(axis=0).ravel() % 2 == 1) & alternate
        cells += [
            np.column_stack([a, b, np.where(turn, d, c)]),
            np.column_stack([np.where(turn, b, a), c, d]),
        ]
        groups += [np.full(2 * a.size, k + 1)]
        sides = dict(bottom=id_[0], right=id_[:, -1], top=id_[-1], left=id_[:, 0])
        for name, nodes in sides.items():
            surfaces[f"{name}_{k}"] = tag = len(surfaces) + 1
            facets.append(np.column_stack([nodes[:-1], nodes[1:]]))
            facet_groups.append(np.full(nodes.size - 1, tag))
        first += x.size
    arrays = MeshArrays(
        np.concatenate(points),
        np.concatenate(cells),
        np.concatenate(groups).astype(np.int32),
        np.concatenate(facets),
        np.concatenate(facet_groups).astype(np.int32),
        {f"block_{k}": k + 1 for k in range(n)},
        surfaces,
    )
    return Domain.from_arrays(arrays if comm.rank == 0 else None, comm, name="stack")


def fix(domain, space, surface, value=0.0):
    """Prescribe a constant or a function of x on a surface, of a space or one component."""
    facets = domain.facet_tags.find(domain.surface(surface))
    dofs = fem.locate_dofs_topological(space, 1, facets)
    if isinstance(value, fem.Constant) or not callable(value):
        return fem.dirichletbc(value, dofs, space)
    if not space.component():
        function = fem.Function(space)
        function.interpolate(value)
        return fem.dirichletbc(function, dofs)
    collapsed, _ = space.collapse()
    function = fem.Function(collapsed)
    function.interpolate(value)
    dofs = fem.locate_dofs_topological((space, collapsed), 1, facets)
    return fem.dirichletbc(function, dofs, space)


class Elastic:
    """Dry blocks; ``fixed`` maps (surface, component or None for both) to values."""

    def __init__(
        self,
        domain,
        *,
        fixed,
        tractions=None,
        pairs=(),
        material=MATERIAL,
        smoothing="deviatoric",
        **options,
    ):
        mesh = domain.mesh
        mesh.topology.create_connectivity(1, 2)
        self.domain = domain
        self.V = V = fem.functionspace(mesh, ("P", 1, (2,)))
        self.u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
        self.F = ufl.inner(material.stress(self.u), ufl.grad(v)) * hm.node_cells_measure(smoothing)
        self.F += loads(domain, v, tractions or {})
        bcs = [
            fix(domain, V if i is None else V.sub(i), name, value)
            for (name, i), value in fixed.items()
        ]
        self.pairs = contact_pairs(domain, pairs)
        self.problem = hm.ContactProblem(
            self.F, self.u, bcs=bcs, pairs=self.pairs, domain=domain, **options
        )


class Porous:
    """Consolidating blocks; one step at a time.

    ``fixed`` maps (surface, component) to values, ``drained`` surfaces to pressures, ``fluxes``
    surfaces to outflows. A ``weight`` of the whole brings gravity, of the water too.
    """

    def __init__(
        self,
        domain,
        *,
        fixed,
        drained,
        tractions=None,
        pairs=(),
        material=MATERIAL,
        permeability=K,
        unit_weight=GAMMA,
        smoothing="deviatoric",
        degree=1,
        tau=1.0,
        weight=None,
        fluxes=None,
        dt=100.0,
        **options,
    ):
        mesh = domain.mesh
        mesh.topology.create_connectivity(1, 2)
        self.domain = domain
        self.V = V = fem.functionspace(mesh, ("P", degree, (2,)))
        self.Q = Q = fem.functionspace(mesh, ("P", 1))
        self.u, self.p = fem.Function(V, name="displacement"), fem.Function(Q, name="pore pressure")
        self.u_n, self.p_n = fem.Function(V), fem.Function(Q)
        v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))
        self.dt = fem.Constant(mesh, float(dt))
        gamma = fem.Constant(mesh, float(unit_weight))
        if not isinstance(permeability, fem.Function):
            permeability = fem.Constant(mesh, np.eye(2) * permeability)
        down = None if weight is None else ufl.as_vector((0.0, -1.0))
        dc = hm.node_cells_measure(smoothing)
        F = hm.equilibrium(
            material.stress(self.u),
            self.p,
            v,
            smoothed=dc,
            body_force=None if down is None else fem.Constant(mesh, float(weight)) * down,
        )
        F += loads(domain, v, tractions or {})
        F += hm.water_balance(
            self.u,
            self.u_n,
            self.p,
            q,
            self.dt,
            permeability=permeability,
            unit_weight=gamma,
            gravity=down,
            smoothed=dc,
        )
        if tau:
            F += hm.pressure_projection(self.p, self.p_n, q, material.shear_modulus, tau=tau)
        ds = ufl.Measure("ds", domain=mesh, subdomain_data=domain.facet_tags)
        for name, flux in (fluxes or {}).items():
            F += self.dt * fem.Constant(mesh, float(flux)) * q * ds(domain.surface(name))
        self.F = F
        self.bcs = [fix(domain, V.sub(i), name, value) for (name, i), value in fixed.items()]
        self.bcs += [fix(domain, Q, name, value) for name, value in drained.items()]
        self.pairs = contact_pairs(domain, pairs)
        self.volume_change = fem.form(ufl.div(self.u - self.u_n) * ufl.dx)
        self.problem = hm.ContactProblem(
            F, [self.u, self.p], bcs=self.bcs, pairs=self.pairs, time_step=self.dt, **options
        )

    def step(self, dt=None):
        """Solve one step and return Newton's result."""
        if dt is not None:
            self.dt.value = dt
        self.u_n.x.array[:] = self.u.x.array
        self.p_n.x.array[:] = self.p.x.array
        return self.problem.solve()

    def outflow(self, surface=None):
        """Water that left in the step, through drained faces [m^3]."""
        drained = self.problem.reactions(self.p)
        return -total(drained, self.domain, surface)[0]


def loads(domain, v, tractions):
    """Virtual work of tractions on surfaces."""
    ds = ufl.Measure("ds", domain=domain.mesh, subdomain_data=domain.facet_tags)
    form = 0
    for name, t in tractions.items():
        if not isinstance(t, fem.Constant):
            t = fem.Constant(domain.mesh, np.asarray(t, float))
        form -= ufl.dot(t, v) * ds(domain.surface(name))
    return form


def contact_pairs(domain, pairs):
    """Pairs from (secondary, primary, flow), tied, or with a friction law at the end."""
    return [
        hm.ContactPair(
            domain.facet_tags,
            domain.surface(s),
            domain.surface(m),
            *(law or [hm.Tied()]),
            flow=flow,
        )
        for s, m, flow, *law in pairs
    ]


def total(function, domain, surface=None):
    """Sum of owned nodal values, of all nodes or of those of a surface; (components,)."""
    space = function.function_space
    n, bs = space.dofmap.index_map.size_local, space.dofmap.index_map_bs
    blocks = np.arange(n)
    if surface is not None:
        facets = domain.facet_tags.find(domain.surface(surface))
        blocks = fem.locate_dofs_topological(space, 1, facets)
        blocks = blocks[blocks < n]
    values = function.x.array.reshape(-1, bs)[blocks].sum(axis=0)
    return domain.mesh.comm.allreduce(values)


def integral(form, comm):
    """Integral over all ranks."""
    return comm.allreduce(fem.assemble_scalar(form))


def largest(array, comm):
    """Largest absolute value on all ranks."""
    return comm.allreduce(float(np.abs(array).max(initial=0.0)), MPI.MAX)


def dense(matrix, comm):
    """Rows of a PETSc matrix of all ranks as one dense array on every rank."""
    indptr, indices, values = matrix.getValuesCSR()
    rows = np.repeat(np.arange(indptr.size - 1), np.diff(indptr)) + matrix.getOwnershipRange()[0]
    result = np.zeros(matrix.getSize())
    for r, c, v in comm.allgather((rows, indices, values)):
        result[r, c] = v
    return result


def gathered(problem, array):
    """Owned part of a local array of a problem in its global numbering, on every rank."""
    return np.concatenate(problem.comm.allgather(array[problem.layout.owned]))


def notch(comm, n, m, *, size=1.0, dug=0.0):
    """A block of n facets a side in the corner of an L of m facets a side.

    If its corner is dug out, the two faces of each that meet are one surface, "block" and "base".
    """
    points, cells, groups, facets, facet_groups = [], [], [], [], []
    first = 0
    squares = {"block": [(0.0, 1.0, n)], "base": [(0.0, 0.0, m), (1.0, 0.0, m), (1.0, 1.0, m)]}
    ids = {}
    for tag, (name, parts) in enumerate(squares.items(), 1):
        known = {}
        for x0, y0, k in parts:
            grid = np.linspace(0.0, 1.0, k + 1)
            numbers = np.empty((k + 1, k + 1), int)
            for j, y in enumerate(y0 + grid):
                for i, x in enumerate(x0 + grid):
                    key = (round(x, 9), round(y, 9))
                    if key not in known:
                        known[key] = first + len(known)
                        points.append((x, y, 0.0))
                    numbers[j, i] = known[key]
            a, b, c, d = numbers[:-1, :-1], numbers[:-1, 1:], numbers[1:, 1:], numbers[1:, :-1]
            quads = [q.ravel() for q in (a, b, c, d)]
            cells += [np.column_stack(quads[:3]), np.column_stack([quads[0], *quads[2:]])]
            groups.append(np.full(2 * k * k, tag))
            ids[name, x0, y0] = numbers
        first += len(known)
    lines = {
        "block bottom": ids["block", 0.0, 1.0][0],
        "block right": ids["block", 0.0, 1.0][:, -1],
        "block left": ids["block", 0.0, 1.0][:, 0],
        "block top": ids["block", 0.0, 1.0][-1],
        "base floor": ids["base", 0.0, 0.0][-1],
        "base wall": ids["base", 1.0, 1.0][:, 0],
        "base left": ids["base", 0.0, 0.0][:, 0],
        "base top": ids["base", 1.0, 1.0][-1],
        "base bottom": ids["base", 0.0, 0.0][0],
    }
    meeting = {"block bottom", "block right", "base floor", "base wall"} if dug else set()
    points[lines["base wall"][0]] = (1.0 + dug, 1.0 - dug, 0.0)
    names = {name: name.split()[0] if name in meeting else name for name in lines}
    surfaces = {name: k for k, name in enumerate(dict.fromkeys(names.values()), 1)}
    for name, nodes in lines.items():
        facets.append(np.column_stack([nodes[:-1], nodes[1:]]))
        facet_groups.append(np.full(len(nodes) - 1, surfaces[names[name]]))
    arrays = MeshArrays(
        size * np.array(points),
        np.concatenate(cells),
        np.concatenate(groups).astype(np.int32),
        np.concatenate(facets),
        np.concatenate(facet_groups).astype(np.int32),
        {"block": 1, "base": 2},
        surfaces,
    )
    return Domain.from_arrays(arrays if comm.rank == 0 else None, comm, name="notch")
