# SPDX-License-Identifier: LGPL-3.0-or-later
"""A grouped triangle mesh as plain arrays, and what makes it fit for bodies in contact."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

FLATTEST_CELL = 1e-6
"""Smallest height of a triangle relative to its longest edge."""

OUT_OF_PLANE = 1e-9
"""Largest distance of a node from the plane z = 0 relative to the size of the mesh."""


@dataclass(frozen=True, eq=False)
class MeshArrays:
    """Triangles and facets with the groups they belong to; held by rank 0.

    Attributes:
        points: Coordinates of the nodes [m], shape (num_points, 3); nodes without cell are allowed.
        cells: Nodes of the triangles, shape (num_cells, 3).
        cell_groups: Tag of the body group of each triangle, shape (num_cells,).
        facets: Nodes of the surface facets, shape (num_facets, 2).
        facet_groups: Tag of the surface group of each facet, shape (num_facets,).
        bodies: Names and tags of the body groups.
        surfaces: Names and tags of the surface groups.
    """

    points: npt.NDArray[np.float64]
    cells: npt.NDArray[np.int64]
    cell_groups: npt.NDArray[np.int32]
    facets: npt.NDArray[np.int64]
    facet_groups: npt.NDArray[np.int32]
    bodies: dict[str, int] = field(default_factory=dict)
    surfaces: dict[str, int] = field(default_factory=dict)

    @classmethod
    def empty(cls) -> MeshArrays:
        """Arrays of a rank that brings no part of the mesh."""
        none, tags = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int32)
        return cls(np.empty((0, 3)), none.reshape(0, 3), tags, none.reshape(0, 2), tags)

    def normalised(self) -> MeshArrays:
        """The same mesh without unused nodes and with all triangles counterclockwise."""
        used, cells = np.unique(self.cells, return_inverse=True)
        cells, points = cells.reshape(-1, 3), self.points[used]
        clockwise = _twice_area(points[cells]) < 0.0
        cells[clockwise] = cells[clockwise][:, [0, 2, 1]]
        facets = np.searchsorted(used, self.facets)
        return MeshArrays(
            points, cells, self.cell_groups, facets, self.facet_groups, self.bodies, self.surfaces
        )

    def without(self, group: str, exposed: str) -> tuple[MeshArrays, npt.NDArray[np.int64]]:
        """The mesh without the triangles of a group.

        Args:
            group: Name of the group.
            exposed: Name of the surface group of edges that have become boundary.

        Returns:
            The mesh, and the old numbers of its nodes; shape (n_left,).

        Raises:
            ValueError: If there is no such group, or nothing is left.
        """
        if group not in self.bodies:
            raise ValueError(f"unknown body '{group}'; known: {', '.join(self.bodies)}")
        gone = self.cell_groups == self.bodies[group]
        if gone.all():
            raise ValueError(f"without '{group}' nothing is left")
        left, taken = (_edges(self.cells[some]) for some in (~gone, gone))
        bare = left[_occurs(left, taken)]
        stays = _occurs(np.sort(self.facets, axis=1), left)
        surfaces = dict(self.surfaces)
        new = surfaces.setdefault(exposed, max(surfaces.values(), default=0) + 1)
        facets = np.concatenate([self.facets[stays], bare])
        facet_groups = np.append(self.facet_groups[stays], np.full(len(bare), new))
        remaining = set(facet_groups.tolist())
        kept, cells = np.unique(self.cells[~gone], return_inverse=True)
        return MeshArrays(
            self.points[kept],
            cells.reshape(-1, 3),
            self.cell_groups[~gone],
            np.searchsorted(kept, facets),
            facet_groups.astype(np.int32),
            {name: value for name, value in self.bodies.items() if name != group},
            {name: value for name, value in surfaces.items() if value in remaining},
        ), kept


def body_of_group(
    bodies: Iterable[str], layers: Mapping[str, Sequence[str]], source: str
) -> dict[str, str]:
    """Body that each body group belongs to: the one it is a layer of, or else itself.

    Args:
        bodies: Names of the body groups.
        layers: Bodies that consist of several groups, with the names of these groups.
        source: File or model, for messages.

    Raises:
        ValueError: If a layer is no group or in two bodies, or a body has no layer or a group's
            name.
    """
    groups = list(bodies)
    owner: dict[str, str] = {}
    for body, names in layers.items():
        if body in groups:
            raise ValueError(
                f"{source}: the layered body '{body}' has the name of a body group; "
                "give it a name of its own."
            )
        if not names:
            raise ValueError(f"{source}: the layered body '{body}' has no layers.")
        for name in names:
            if name not in groups:
                raise ValueError(
                    f"{source}: layer '{name}' of body '{body}' is no body group; "
                    f"known: {', '.join(groups)}."
                )
            if name in owner:
                raise ValueError(
                    f"{source}: group '{name}' is a layer of '{owner[name]}' and of '{body}'."
                )
            owner[name] = body
    return {group: owner.get(group, group) for group in groups}


def check(arrays: MeshArrays, source: str, layers: Mapping[str, Sequence[str]]) -> None:
    """Refuse a mesh that is not a set of separate, valid, plane bodies with surfaces on them.

    Args:
        arrays: The mesh.
        source: File or model, for messages.
        layers: Bodies that consist of several groups, with the names of these groups.

    Raises:
        ValueError: Naming source, group and place of what is wrong.
    """
    bodies = body_of_group(arrays.bodies, layers, source)
    body_names = {tag: name for name, tag in arrays.bodies.items()}
    surface_names = {tag: name for name, tag in arrays.surfaces.items()}

    _refuse_out_of_plane(arrays, source)
    if repeated := _repeated(arrays.cells):
        first, second = (body_names[int(arrays.cell_groups[i])] for i in repeated)
        raise ValueError(
            f"{source}: the cell at {_place(arrays, arrays.cells[repeated[0]])} occurs in body "
            f"group '{first}' and again in '{second}'; every cell must be in exactly one."
        )
    for tag, name in body_names.items():
        _refuse_bad_cells(arrays, arrays.cells[arrays.cell_groups == tag], name, source)
    _refuse_shared_nodes(arrays, {tag: bodies[name] for tag, name in body_names.items()}, source)
    if repeated := _repeated(arrays.facets):
        first, second = (surface_names[int(arrays.facet_groups[i])] for i in repeated)
        raise ValueError(
            f"{source}: the facet at {_place(arrays, arrays.facets[repeated[0]])} occurs in "
            f"surface group '{first}' and again in '{second}'; a facet can be in one only."
        )
    _refuse_facets_off_the_boundary(arrays, surface_names, source)


def _edges(cells: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Edges of triangles, lower node first; shape (3 n_cells, 2)."""
    return np.sort(cells[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)


def _occurs(edges: npt.NDArray[np.int64], others: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Which edges are among others, all with the lower node first."""
    n = int(max(edges.max(initial=0), others.max(initial=0))) + 1
    result: npt.NDArray[np.bool_] = np.isin(edges @ (n, 1), others @ (n, 1))
    return result


def _place(arrays: MeshArrays, nodes: npt.NDArray[np.integer]) -> str:
    x, y = arrays.points[nodes].reshape(-1, 3).mean(axis=0)[:2]
    return f"({x:.6g}, {y:.6g})"


def _twice_area(corners: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    a, b = (corners[:, i, :2] - corners[:, 0, :2] for i in (1, 2))
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _repeated(entities: npt.NDArray[np.integer]) -> tuple[int, int] | None:
    """Two entities with the same nodes, or None."""
    rows = np.sort(entities, axis=1)
    order = np.lexsort(rows.T[::-1])
    twice = np.flatnonzero((np.diff(rows[order], axis=0) == 0).all(axis=1))
    return (int(order[twice[0]]), int(order[twice[0] + 1])) if twice.size else None


def _refuse_out_of_plane(arrays: MeshArrays, source: str) -> None:
    nodes = np.unique(arrays.cells)
    points = arrays.points[nodes]
    if not np.isfinite(points).all():
        raise ValueError(f"{source}: the coordinates of some nodes are not finite.")
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    outside = np.flatnonzero(np.abs(points[:, 2]) > OUT_OF_PLANE * size)
    if outside.size:
        x, y, z = points[outside[0]]
        raise ValueError(
            f"{source}: {outside.size} nodes lie out of the plane z = 0, the first at "
            f"({x:.6g}, {y:.6g}, {z:.6g}); the mesh must be plane."
        )


def _refuse_bad_cells(
    arrays: MeshArrays, cells: npt.NDArray[np.int64], name: str, source: str
) -> None:
    corners = arrays.points[cells]
    twice_area = _twice_area(corners)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    flat = np.flatnonzero(np.abs(twice_area) <= FLATTEST_CELL * longest**2)
    if flat.size:
        raise ValueError(
            f"{source}: {flat.size} of {len(cells)} cells of body group '{name}' are degenerate "
            f"(no area), the first at {_place(arrays, cells[flat[0]])}."
        )
    positive = twice_area > 0.0
    minority = np.flatnonzero(positive != (2 * positive.sum() >= len(cells)))
    if minority.size:
        raise ValueError(
            f"{source}: {minority.size} of {len(cells)} cells of body group '{name}' are inverted "
            f"(they run round the other way), the first at {_place(arrays, cells[minority[0]])}. "
            "If whole gmsh surfaces of the group are oriented differently, reverse them."
        )


def _refuse_shared_nodes(arrays: MeshArrays, body_of_tag: Mapping[int, str], source: str) -> None:
    names = list(dict.fromkeys(body_of_tag.values()))
    used = np.zeros((len(names), len(arrays.points)), dtype=bool)
    for tag, name in body_of_tag.items():
        used[names.index(name), arrays.cells[arrays.cell_groups == tag]] = True
    shared = np.flatnonzero(used.sum(axis=0) > 1)
    if shared.size:
        node = shared[0]
        one, two = (names[i] for i in np.flatnonzero(used[:, node])[:2])
        at_node = np.unique(arrays.cell_groups[(arrays.cells == node).any(axis=1)])
        groups = ", ".join(f'"{name}"' for name, tag in arrays.bodies.items() if tag in at_node)
        raise ValueError(
            f"{source}: bodies '{one}' and '{two}' share nodes, one of them at "
            f"{_place(arrays, node)}. Bodies in contact need nodes of their own (do not fragment "
            "or merge their geometry); groups that are layers of one body are declared by "
            f'layers={{"name of the body": [{groups}]}}.'
        )


def _refuse_facets_off_the_boundary(
    arrays: MeshArrays, surface_names: Mapping[int, str], source: str
) -> None:
    edges = arrays.cells[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    both = np.sort(np.concatenate([edges, arrays.facets]), axis=1)
    _, key = np.unique(both[:, 0] * len(arrays.points) + both[:, 1], return_inverse=True)
    num_cells = np.bincount(key[: len(edges)], minlength=key.max() + 1)[key]

    branching = np.flatnonzero(num_cells > 2)
    if branching.size:
        raise ValueError(
            f"{source}: the edge at {_place(arrays, both[branching[0]])} belongs to "
            f"{num_cells[branching[0]]} cells; the cells overlap."
        )
    for tag, name in surface_names.items():
        of_group = len(edges) + np.flatnonzero(arrays.facet_groups == tag)
        for count, wrong in ((0, "are edges of no cell"), (2, "lie inside a body")):
            bad = of_group[num_cells[of_group] == count]
            if bad.size:
                raise ValueError(
                    f"{source}: {bad.size} of {of_group.size} facets of surface group '{name}' "
                    f"{wrong}, the first at {_place(arrays, both[bad[0]])}; "
                    "a surface must lie on the boundary of a body."
                )
