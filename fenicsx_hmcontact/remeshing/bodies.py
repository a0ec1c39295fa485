# SPDX-License-Identifier: LGPL-3.0-or-later
"""The mesh taken apart into bodies, and put together again."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from scipy.sparse import csr_array, vstack

from fenicsx_hmcontact.domain.mesh_arrays import MeshArrays, body_of_group
from fenicsx_hmcontact.remeshing.body import Body
from fenicsx_hmcontact.remeshing.edges import Bools, Floats, Ints
from fenicsx_hmcontact.remeshing.options import Remeshing
from fenicsx_hmcontact.remeshing.transfer import Merges, Transfer
from fenicsx_hmcontact.remeshing.triangulation import canonical


def separate(
    arrays: MeshArrays,
    sizes: Floats,
    options: Remeshing,
    held: Bools | None,
    layers: Mapping[str, Sequence[str]] | None,
) -> dict[str, Body]:
    """Each body in numbers of its own; arguments as of `remesh`."""
    keep = np.zeros(len(arrays.points), bool) if held is None else held.copy()
    for name in options.keep:
        if name not in arrays.surfaces:
            raise ValueError(
                f"keep names the surface '{name}'; known: {', '.join(arrays.surfaces) or 'none'}"
            )
        keep[arrays.facets[arrays.facet_groups == arrays.surfaces[name]]] = True
    tags: dict[str, list[int]] = {}
    for group, body in body_of_group(arrays.bodies, layers or {}, "remeshing").items():
        tags.setdefault(body, []).append(arrays.bodies[group])
    bodies = {}
    for name, groups in tags.items():
        rows = np.isin(arrays.cell_groups, groups)
        nodes, cells = np.unique(arrays.cells[rows], return_inverse=True)
        local = np.full(len(arrays.points), -1)
        local[nodes] = np.arange(nodes.size)
        own = (local[arrays.facets] >= 0).all(axis=1)
        bodies[name] = Body(
            points=arrays.points[nodes, :2],
            sizes=sizes[nodes],
            held=keep[nodes],
            cells=cells.reshape(-1, 3),
            groups=arrays.cell_groups[rows].astype(np.int64),
            facets=local[arrays.facets[own]],
            tags=arrays.facet_groups[own],
            options=options,
            first_nodes=nodes,
            others=arrays.points[arrays.facets[~own], :2],
        )
    return bodies


def gather(arrays: MeshArrays, bodies: Iterable[Body]) -> tuple[MeshArrays, Floats, Transfer]:
    """All bodies in one mesh: the kept nodes in their old order, then the inserted ones.

    Args:
        arrays: The mesh before.
        bodies: The bodies after.

    Returns:
        The mesh, target sizes of its nodes [m], and the way from old to new nodes.
    """
    n_old = len(arrays.points)
    used = [np.unique(body.cells) for body in bodies]
    kept = np.zeros(n_old, bool)
    for body, nodes in zip(bodies, used, strict=True):
        kept[body.first_nodes[nodes[nodes < len(body.first_nodes)]]] = True
    old = np.flatnonzero(kept)
    points, sizes, weights = [arrays.points[old]], [np.zeros(old.size)], []
    cells, groups, facets, tags = [], [], [], []
    first = old.size
    for body, nodes in zip(bodies, used, strict=True):
        inserted = nodes[nodes >= len(body.first_nodes)]
        stay = nodes[nodes < len(body.first_nodes)]
        new = np.full(len(body.points), -1)
        new[stay] = np.searchsorted(old, body.first_nodes[stay])
        new[inserted] = first + np.arange(inserted.size)
        first += inserted.size
        sizes[0][new[stay]] = body.sizes[stay]
        sizes.append(body.sizes[inserted])
        points.append(np.column_stack([body.points[inserted], np.zeros(inserted.size)]))
        weights.append(_widen(body.origins[inserted], body.first_nodes, n_old))
        body_cells, body_groups = new[body.cells], body.groups
        if body.changed:
            body_cells, body_groups = canonical(body_cells, body_groups)
        cells.append(body_cells)
        groups.append(body_groups)
        facets.append(new[body.facets])
        tags.append(body.tags)
    mesh = MeshArrays(
        np.concatenate(points),
        np.concatenate(cells),
        np.concatenate(groups).astype(np.int32),
        np.concatenate(facets),
        np.concatenate(tags).astype(np.int32),
        arrays.bodies,
        arrays.surfaces,
    )
    return mesh, np.concatenate(sizes), Transfer(old, vstack(weights, format="csr"))


def merges_of(bodies: Iterable[Body], n_old: int) -> Merges:
    """Areas that bodies gained or lost, with weights of the ``n_old`` nodes before."""
    areas, groups, places, weights = [], [], [], [csr_array((0, n_old))]
    for body in bodies:
        for corners, group, area in body.merges:
            areas.append(area)
            groups.append(group)
            places.append(body.points[list(corners)].mean(axis=0))
            mean = csr_array(body.origins[list(corners)].sum(axis=0)[None] / 3.0)
            weights.append(_widen(mean, body.first_nodes, n_old))
    return Merges(
        np.array(areas),
        np.array(groups, np.int32),
        np.array(places).reshape(-1, 2),
        vstack(weights, format="csr"),
    )


def _widen(weights: csr_array, nodes: Ints, n_old: int) -> csr_array:
    """Weights of the nodes of a body as weights of all nodes."""
    shape = (weights.shape[0], n_old)
    return csr_array((weights.data, nodes[weights.indices], weights.indptr), shape=shape)
