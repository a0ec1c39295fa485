# SPDX-License-Identifier: LGPL-3.0-or-later
"""Nodes inside of a body that are too close to others or to a fixed line."""

from __future__ import annotations

import numpy as np

from fenicsx_hmcontact.remeshing.body import Body
from fenicsx_hmcontact.remeshing.cavity import remove_nodes
from fenicsx_hmcontact.remeshing.edges import Bools, Edges, Floats, Ints


def removable(body: Body, edges: Edges) -> tuple[Ints, Floats]:
    """Edges of which one node can be removed, and their lengths [h]."""
    at = np.flatnonzero(body.free_nodes(edges)[edges.nodes].any(axis=1))
    return at, edges.lengths(body.points)[at] / body.targets[edges.nodes[at]].mean(axis=1)


def newest_free(free: Bools, ends: Ints) -> Ints:
    """The end of each edge that is to go: the free one, of two free ones the one added later."""
    return np.where(free[ends], ends, -1).max(axis=1)


def remove_close_nodes(body: Body) -> int:
    """Remove free nodes on short edges and close to fixed edges, until there are none."""
    total = 0
    while True:
        edges = body.edges()
        free = body.free_nodes(edges)
        at, length = removable(body, edges)
        short = length < body.options.shortest_edge
        nodes = newest_free(free, edges.nodes[at[short]])
        near, distance = _near_lines(body, edges, free)
        nodes, urgency = np.append(nodes, near), np.append(length[short], distance)
        nodes, first = np.unique(nodes[np.lexsort((nodes, urgency))], return_index=True)
        removed = remove_nodes(body, edges, nodes[np.argsort(first)])
        if removed == 0:
            return body.count("removed", total)
        total += removed
        body.retriangulate()


def _near_lines(body: Body, edges: Edges, free: Bools) -> tuple[Ints, Floats]:
    """Free nodes close to a fixed edge that they have a triangle with, and how close [h]."""
    cell, k = np.nonzero(edges.fixed[edges.of_cell] & free[body.cells])
    nodes = body.cells[cell, k]
    ends = body.points[edges.nodes[edges.of_cell[cell, k]]]
    distance = distance_to_segment(body.points[nodes], ends) / body.targets[nodes]
    near = distance < body.options.nearest_to_boundary
    return nodes[near], distance[near]


def distance_to_segment(points: Floats, ends: Floats) -> Floats:
    """Distances [m] of points (n, 2) to segments (n, 2, 2)."""
    along = ends[:, 1] - ends[:, 0]
    away = points - ends[:, 0]
    s = np.clip((away * along).sum(axis=1) / (along**2).sum(axis=1), 0.0, 1.0)
    return np.linalg.norm(away - s[:, None] * along, axis=1)
