# SPDX-License-Identifier: LGPL-3.0-or-later
"""Nodes taken out: the triangles around them go, and new ones fill the hole."""

from __future__ import annotations

import numpy as np

from fenicsx_hmcontact._kernels.ears import cut_ears
from fenicsx_hmcontact._kernels.predicates import orientation
from fenicsx_hmcontact.remeshing.body import Body
from fenicsx_hmcontact.remeshing.edges import Edges, Ints


def remove_nodes(body: Body, edges: Edges, nodes: Ints) -> int:
    """Remove nodes, the first ones first, as far as their triangles have no node in common.

    A node of a fixed line leaves a straight edge, whose facet is in the surface of the old ones.

    Args:
        body: Changed in place; its edges are no longer ``edges``.
        edges: Its edges.
        nodes: Nodes in order of urgency. Those on a fixed line must have two neighbours on it.

    Returns:
        Number of nodes that are removed.
    """
    if not len(nodes):
        return 0
    order = np.argsort(body.cells, axis=None, kind="stable")
    begin = np.searchsorted(body.cells.ravel()[order], [nodes, nodes + 1])
    busy = np.zeros(len(body.points), bool)
    gone = np.zeros(len(body.cells), bool)
    new_cells, new_groups, removed = [], [], 0
    for node, first, last in zip(nodes, *begin, strict=True):
        star = order[first:last] // 3
        if busy[body.cells[star]].any():
            continue
        filled = _fill(body, edges, node, star)
        if filled is None:
            continue
        busy[body.cells[star]] = True
        gone[star] = True
        removed += 1
        for triangles, group in filled:
            new_cells.append(triangles)
            new_groups.append(np.full(len(triangles), group))
    if removed == 0:
        return 0
    body.cells = np.concatenate([body.cells[~gone], *new_cells])
    body.groups = np.concatenate([body.groups[~gone], *new_groups])
    return removed


def _fill(body: Body, edges: Edges, node: int, star: Ints) -> list[tuple[Ints, int]] | None:
    """Triangles, by group, that fill the star of a node; None if there are no valid ones."""
    filled, merges = [], []
    chord = None
    for group in np.unique(body.groups[star]):
        ring = _ring(body.cells[star[body.groups[star] == group]], node)
        if ring is None:
            return None
        closed = ring[0] == ring[-1]
        if closed:
            ring = ring[:-1]
        else:
            chord = ring[0], ring[-1]
            start, end = body.points[ring[0]], body.points[ring[-1]]
            for x in body.points[ring[1:-1]]:
                if orientation(end, start, x) <= 0.0:
                    return None
            gained = -0.5 * orientation(body.points[node], start, end)
            merges.append(((node, *chord), int(group), gained))
            edge = edges.find(*chord)
            if edge >= 0 and (len(ring) > 2 or edges.fixed[edge]):
                return None
        triangles = cut_ears(body.points[ring])
        if len(triangles) < len(ring) - 2:
            return None
        filled.append((ring[triangles], int(group)))
    if chord is not None:
        body.merges += merges
        _join_facets(body, node, chord)
    return filled


def _ring(cells: Ints, node: int) -> Ints | None:
    """Nodes around a node in counterclockwise order, the first one again if they close a ring."""
    k = np.argmax(cells == node, axis=1)
    rows = np.arange(len(cells))
    after = dict(zip(cells[rows, (k + 1) % 3], cells[rows, (k + 2) % 3], strict=True))
    starts = set(after) - set(after.values())
    if len(starts) > 1:
        return None
    ring = [starts.pop() if starts else next(iter(after))]
    for _ in range(len(cells)):
        if ring[-1] not in after:
            return None
        ring.append(after[ring[-1]])
    return np.array(ring)


def _join_facets(body: Body, node: int, chord: tuple[int, int]) -> None:
    at = np.flatnonzero((body.facets == node).any(axis=1))
    if at.size:
        body.facets[at[0]] = chord
        body.facets = np.delete(body.facets, at[1:], axis=0)
        body.tags = np.delete(body.tags, at[1:])
