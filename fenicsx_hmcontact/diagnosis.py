# SPDX-License-Identifier: LGPL-3.0-or-later
"""What makes a linear system singular, in words: motions and pressures of bodies nothing holds.

Every body is tried as a rigid one, and every scalar field as a constant on a body. A combination of
such trials is free if, in every row of the condensed matrix, terms cancel that are not small.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import numpy.typing as npt
import scipy.sparse
from dolfinx import fem, la
from dolfinx.mesh import Mesh
from scipy.sparse.csgraph import connected_components

from ._compat import cell_nodes
from .domain import Domain

if TYPE_CHECKING:
    from .problem import ContactProblem

Float = npt.NDArray[np.float64]

RESISTANCE = 1e-9
"""What is left of the terms of a row, relative to their sum, where something holds a body."""

ROUND_OFF = 1e2 * float(np.finfo(np.float64).eps)
"""The same of what coordinates far from the origin leave, times their size over that of a body."""

NOISE = 1e-12
"""Rows whose terms are below this part of the largest ones are round-off."""

SAME = 1e-6
"""Motions of length 1 that differ less are the same."""


@dataclass(frozen=True, eq=False)
class _Bodies:
    """The connected parts of a mesh, in the order of their labels, the same on all ranks.

    Attributes:
        labels: What to call each; (n,).
        centres: Mean of the nodes of each [m]; shape (n, 2).
        radii: Root mean square distance of the nodes from it [m]; (n,).
        of_cell: Body of every local cell.
    """

    labels: list[str]
    centres: Float
    radii: Float
    of_cell: npt.NDArray[np.intp]

    @property
    def tolerance(self) -> float:
        """What may be left of the terms of a row where nothing holds a body."""
        far = np.linalg.norm(self.centres, axis=1) / self.radii
        return max(RESISTANCE, ROUND_OFF * float(far.max()))

    def name(self, which: Sequence[int]) -> str:
        """Subject of a sentence about some bodies."""
        labels = [self.labels[i] for i in which]
        article = "the " if labels[0].startswith("around") else ""
        return f"{article}{'body' if len(labels) == 1 else 'bodies'} {_listed(labels)}"


def free_motions(problem: ContactProblem, domain: Domain | None = None) -> list[str]:
    """Say which bodies nothing holds, and which pressures nothing sets. Collective.

    Looks at the system last assembled, after `SingularSystemError` at that which is singular.

    Args:
        problem: The problem.
        domain: Names of the bodies; without it they are called by where they are.

    Returns:
        One sentence for each body, or each group of bodies that only move together; the same on
        all ranks. Empty if no rigid motion and no constant is free.

    Raises:
        RuntimeError: If no system has been assembled yet.
    """
    if problem._system.linear is None:
        raise RuntimeError("no system has been assembled yet: solve the problem first")
    found = []
    for field, u in enumerate(problem.unknowns):
        space = u.function_space
        bodies = _bodies(space.mesh, domain, problem.entity_maps)
        if space.value_shape == ():
            null = _null_space(problem, field, _constants(space, bodies), RESISTANCE)
            name = problem.field_names[field]
            for group in _groups(null, len(bodies.labels)):
                found.append(
                    f"the {name} of {bodies.name(group)} is prescribed nowhere and not stored"
                )
        elif space.value_shape == (2,):
            null = _null_space(problem, field, _rigid_motions(space, bodies), bodies.tolerance)
            if space.dofmap.index_map_bs == 2 and problem.comm.allreduce(bool(u.x.array.any())):
                # A large rotation is about the displaced points, a small one about those at rest.
                trials = _rigid_motions(space, bodies, u.x.array)
                moved = _null_space(problem, field, trials, bodies.tolerance)
                null = max(null, moved, key=lambda motions: motions.shape[1])
            for group in _groups(null, len(bodies.labels)):
                found += _sentences(null, bodies, group)
    return found


# --- bodies -------------------------------------------------------------------------------------


def _bodies(mesh: Mesh, domain: Domain | None, entity_maps: Sequence[Any]) -> _Bodies:
    """Find the bodies of a mesh and name them. Collective."""
    n, of_node, of_cell = _connected_parts(mesh)
    comm, owned = mesh.comm, mesh.geometry.index_map().size_local
    points, of_owned = mesh.geometry.x[:owned, :2], of_node[:owned]

    def mean(values: Float) -> Float:
        sums = [np.bincount(of_owned, column, n) for column in (*values.T, np.ones(owned))]
        *sums, count = comm.allreduce(np.array(sums))
        return np.column_stack(sums) / count[:, None]

    centres = mean(points)
    squares = np.sum((points - centres[of_owned]) ** 2, axis=1)
    radii = np.sqrt(mean(squares[:, None])[:, 0])

    names = [""] * n
    if domain is not None:
        for name in domain.body_names:
            cells = _cells_of(mesh, domain, name, entity_maps)
            for part in set().union(*comm.allgather(set(of_cell[cells].tolist()))):
                names[part] = name
    labels = []
    for name, centre, radius in zip(names, centres, radii, strict=True):
        label = f"'{name}'" if name else ""
        if not name or names.count(name) > 1:
            label = f"{label} around {_point(centre, radius)}".strip()
        labels.append(label)
    order = np.array(sorted(range(n), key=labels.__getitem__), np.intp)
    return _Bodies(
        [labels[i] for i in order], centres[order], radii[order], np.argsort(order)[of_cell]
    )


def _connected_parts(mesh: Mesh) -> tuple[int, npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Number of parts that share no nodes, and the part of each local node and cell. Collective."""
    nodes, index_map = cell_nodes(mesh), mesh.geometry.index_map()
    n, size = index_map.size_local + index_map.num_ghosts, nodes.shape[1]
    count, part = _parts(np.repeat(nodes[:, 0], size), nodes.ravel(), n)
    part = part + (mesh.comm.exscan(count) or 0)
    # What a ghost node belongs to here and on its owner is one part.
    owners = la.vector(index_map, 1, dtype=np.float64)
    owners.array[:] = part
    owners.scatter_forward()
    same = np.column_stack((part, owners.array.astype(part.dtype)))
    same = np.concatenate(mesh.comm.allgather(np.unique(same[index_map.size_local :], axis=0)))
    n_parts, united = _parts(same[:, 0], same[:, 1], mesh.comm.allreduce(count))
    of_node = united[part]
    return n_parts, of_node, of_node[nodes[:, 0]]


def _parts(
    a: npt.NDArray[np.integer], b: npt.NDArray[np.integer], n: int
) -> tuple[int, npt.NDArray[np.intp]]:
    """Connected parts of n points with edges from a to b."""
    edges = scipy.sparse.coo_array((np.ones(a.size), (a, b)), shape=(n, n))
    count, part = connected_components(edges, directed=False)
    return count, part.astype(np.intp)


def _cells_of(
    mesh: Mesh, domain: Domain, name: str, entity_maps: Sequence[Any]
) -> npt.NDArray[np.int32]:
    """Local cells of a mesh, the domain's or one of a part of it, in a body of the domain."""
    cells = domain.cells(name)
    topology = mesh.topology._cpp_object
    if domain.mesh.topology._cpp_object is topology:
        return cells
    for entity_map in entity_maps:
        if entity_map.sub_topology._cpp_object is topology and entity_map.dim == 2:
            part = entity_map.sub_topology_to_topology(cells, inverse=True)
            return part[part >= 0]
    return cells[:0]


# --- trials and what they do --------------------------------------------------------------------


def _constants(space: fem.FunctionSpace, bodies: _Bodies) -> list[Float]:
    """The function 1 on each body, zero on others; each a local array."""
    one = _interpolated(space, lambda x: np.ones(x.shape[1]))
    return [np.where(inside, one, 0.0) for inside in _dofs_inside(space, bodies)]


def _rigid_motions(
    space: fem.FunctionSpace, bodies: _Bodies, displacement: Float | None = None
) -> list[Float]:
    """Both translations and the rotation about the centre, 1 at the radius, of each body."""
    along_x = _interpolated(space, lambda x: np.vstack((np.ones_like(x[0]), 0.0 * x[0])))
    along_y = _interpolated(space, lambda x: np.vstack((0.0 * x[0], np.ones_like(x[0]))))
    turn = _interpolated(space, lambda x: np.vstack((-x[1], x[0])))
    if displacement is not None:
        turn += (displacement.reshape(-1, 2)[:, ::-1] * (-1.0, 1.0)).ravel()
    trials = []
    for inside, (x, y), radius in zip(
        _dofs_inside(space, bodies), bodies.centres, bodies.radii, strict=True
    ):
        about_centre = (turn + y * along_x - x * along_y) / radius
        trials += [np.where(inside, v, 0.0) for v in (along_x, along_y, about_centre)]
    return trials


def _interpolated(space: fem.FunctionSpace, values: Callable[[Float], Float]) -> Float:
    function = fem.Function(space)
    function.interpolate(values)
    function.x.scatter_forward()
    return function.x.array.copy()


def _dofs_inside(space: fem.FunctionSpace, bodies: _Bodies) -> list[npt.NDArray[np.bool_]]:
    """Which local unknowns of a field belong to each body."""
    index_map, size = space.dofmap.index_map, space.dofmap.index_map_bs
    of_block = np.full(index_map.size_local + index_map.num_ghosts, -1)
    of_block[space.dofmap.list] = bodies.of_cell[:, None]
    of_dof = np.repeat(of_block, size)
    return [of_dof == body for body in range(len(bodies.labels))]


def _null_space(
    problem: ContactProblem, field: int, trials: Sequence[Float], tolerance: float
) -> Float:
    """Combinations of trials of a field that nothing resists; orthonormal columns. Collective."""
    layout, condensation, linear = problem.layout, problem.condensation, problem._system.linear
    assert linear is not None
    matrix = linear.matrix
    indptr, indices, values = matrix.getValuesCSR()
    absolute = PETSc.Mat().createAIJ(
        matrix.getSizes(), csr=(indptr, indices, np.abs(values)), comm=matrix.comm
    )
    x, y = matrix.createVecs()
    balance, terms = np.zeros((layout.owned.size, len(trials))), np.zeros(layout.owned.size)
    positions, which = condensation.local
    for j, trial in enumerate(trials):
        array = np.zeros(layout.n_local)
        layout.views(array)[field][:] = trial
        array[positions] = condensation.relative(array)[which]
        x.array[:] = array[layout.owned] / linear.scale
        matrix.mult(x, y)
        balance[:, j] = y.array
        x.array[:] = np.abs(x.array)
        absolute.mult(x, y)
        terms += y.array
    for petsc_object in (absolute, x, y):
        petsc_object.destroy()
    free = problem._system.free
    largest = problem.comm.allreduce(float(terms[free].max(initial=0.0)), MPI.MAX)
    # The row of a prescribed unknown is that of the identity, in its own unit.
    counts = terms > np.where(free, NOISE * largest, 0.0)
    factor = np.linalg.qr(balance[counts] / terms[counts, None], mode="r")
    factor = np.vstack([np.zeros((len(trials), len(trials))), *problem.comm.allgather(factor)])
    _, resistance, combinations = np.linalg.svd(factor)
    return combinations[resistance < tolerance].T


# --- words --------------------------------------------------------------------------------------


def _groups(null: Float, n_bodies: int) -> list[list[int]]:
    """Bodies that free motions move, those that do so only together in one group."""
    projector = (null @ null.T).reshape(n_bodies, -1, n_bodies, null.shape[0] // n_bodies)
    linked = np.linalg.norm(projector, axis=(1, 3)) > SAME
    one, other = np.nonzero(linked)
    _, group = _parts(one, other, n_bodies)
    moves = np.diag(linked)
    return [np.flatnonzero(group == g).tolist() for g in np.unique(group[moves])]


def _sentences(null: Float, bodies: _Bodies, group: list[int]) -> list[str]:
    """What the bodies of a group can do, each alone, and all of them."""
    identity = np.eye(null.shape[0])
    result, explained = [], [np.zeros((null.shape[0], 0))]
    for body in group:
        rows = slice(3 * body, 3 * body + 3)
        motions = _within(null, identity[:, rows])
        explained.append(motions)
        if motions.size:
            can = _can(motions[rows], bodies.centres[body], bodies.radii[body])
            lack = _lack(motions, "has", "is", "")
            result.append(f"{bodies.name([body])} {lack}: it can {can}")
    if len(group) > 1:
        centre = bodies.centres[group].mean(axis=0)
        radius = float(bodies.radii[group].max())
        rigid = np.zeros((null.shape[0], 3))
        for body in group:
            x, y = (bodies.centres[body] - centre) / radius
            rigid[3 * body : 3 * body + 3] = [
                (1.0, 0.0, -y),
                (0.0, 1.0, x),
                (0.0, 0.0, bodies.radii[body] / radius),
            ]
        motions = _within(null, np.linalg.qr(rigid)[0])
        explained.append(motions)
        if motions.size:
            can = _can(np.linalg.lstsq(rigid, motions)[0], centre, radius)
            lack = _lack(motions, "have", "are", " with others")
            result.append(f"{bodies.name(group)} together {lack}: they can {can}")
        of_group = _within(null, identity[:, [3 * b + i for b in group for i in range(3)]])
        if np.linalg.matrix_rank(np.hstack(explained), tol=SAME) < of_group.shape[1]:
            result.append(
                f"{bodies.name(group)} are not fully held: they can move against each other"
            )
    return result


def _lack(motions: Float, has: str, be: str, others: str) -> str:
    """What bodies lack that have these motions, with the verbs and the others they might touch."""
    if motions.shape[1] == 3:
        return f"{has} no support and no closed contact{others}"
    return f"{be} not fully held"


def _can(motions: Float, centre: Float, radius: float) -> str:
    """Words for motions (both translations, rotation times radius) of one body; shape (3, d)."""
    motions = np.linalg.qr(motions)[0]
    translations = _within(motions, np.eye(3)[:, :2])
    words = []
    if translations.shape[1] == 2:
        words.append("move along x and y")
    elif translations.shape[1] == 1:
        words.append(f"move along {_direction(translations[:2, 0])}")
    if motions.shape[1] > translations.shape[1]:
        about = ""
        if not words:
            t_x, t_y, turn = motions[:, 0]
            about = f" about {_point(centre + radius / turn * np.array((-t_y, t_x)), radius)}"
        words.append("turn" + about)
    return " and ".join(words)


def _within(motions: Float, span: Float) -> Float:
    """Combinations of motions that lie in a span; all with orthonormal columns."""
    _, distance, combinations = np.linalg.svd(motions - span @ (span.T @ motions))
    return motions @ combinations[distance < SAME].T


def _direction(t: Float) -> str:
    for axis, other in (("x", 1), ("y", 0)):
        if abs(t[other]) < SAME:
            return axis
    x, y = t if t[0] > 0.0 else -t
    return f"({x:.3f}, {y:.3f})"


def _point(point: Float, size: float) -> str:
    """Coordinates to about a thousandth of a size."""
    decimals = max(0, 2 - int(np.floor(np.log10(size))))
    x, y = np.round(point, decimals) + 0.0
    return f"({x:.{decimals}f}, {y:.{decimals}f})"


def _listed(labels: Sequence[str]) -> str:
    *first, last = labels
    return f"{', '.join(first)} and {last}" if first else last
