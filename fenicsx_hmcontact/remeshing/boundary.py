# SPDX-License-Identifier: LGPL-3.0-or-later
"""Nodes on fixed lines: merges of short edges and midpoints of long ones.

A fixed line is the boundary, or what separates two layers of a body.
"""

from __future__ import annotations

import numpy as np

from fenicsx_hmcontact.remeshing.body import Body
from fenicsx_hmcontact.remeshing.cavity import remove_nodes
from fenicsx_hmcontact.remeshing.edges import Edges, Floats, Ints
from fenicsx_hmcontact.remeshing.insertion import split_edges


def mergeable(body: Body, edges: Edges) -> tuple[Ints, Floats]:
    """Nodes that a fixed line does without.

    Both edges at such a node are in the same surface and between the same layers, one of them is
    short, the edge that replaces them is not long, they hardly turn, and hardly any area is lost.

    Returns:
        The nodes, the one at the shortest edge first, and the length [h] of that edge.
    """
    options, x = body.options, body.points
    fixed = np.flatnonzero(edges.fixed)
    ends = edges.nodes[fixed]
    order = np.argsort(ends, axis=None, kind="stable")
    nodes, first, count = np.unique(ends.ravel()[order], return_index=True, return_counts=True)
    pair = count == 2
    nodes, at = nodes[pair], order[first[pair][:, None] + [0, 1]]
    one, two = fixed[at // 2].T
    a, b = ends[at // 2, 1 - at % 2].T

    h = body.targets[nodes]
    to, on = x[nodes] - x[a], x[b] - x[nodes]
    lengths = np.linalg.norm([to, on], axis=2)
    shortest = lengths.min(axis=0) / h
    cross = to[:, 0] * on[:, 1] - to[:, 1] * on[:, 0]
    surface = np.append(body.tags, -1)[edges.facet]
    fit = (
        ~body.held[nodes]
        & (surface[one] == surface[two])
        & (edges.groups[one] == edges.groups[two]).all(axis=1)
        & (shortest < options.shortest_edge)
        & (np.linalg.norm(x[b] - x[a], axis=1) < options.longest_boundary_edge * h)
        & ((to * on).sum(axis=1) > np.cos(np.radians(options.merge_turn)) * lengths.prod(axis=0))
        & (0.5 * abs(cross) < options.merge_area * h**2)
    )
    nodes, shortest = nodes[fit], shortest[fit]
    order = np.lexsort((nodes, shortest))
    return nodes[order], shortest[order]


def lengths_on_lines(body: Body, edges: Edges) -> tuple[Ints, Floats]:
    """Fixed edges that may be halved, and their lengths [h]."""
    at = np.flatnonzero(edges.fixed & ~body.held[edges.nodes].all(axis=1))
    return at, edges.lengths(body.points)[at] / body.targets[edges.nodes[at]].mean(axis=1)


def merge_short_edges(body: Body) -> int:
    """Remove nodes from fixed lines until no edge is short, never two neighbours at once."""
    total = 0
    while True:
        edges = body.edges()
        merged = remove_nodes(body, edges, mergeable(body, edges)[0])
        if merged == 0:
            return body.count("merged", total)
        total += merged
        body.retriangulate()


def split_long_edges(body: Body) -> int:
    """Put nodes at the midpoints of long edges of fixed lines, which changes no area."""
    total = 0
    while True:
        edges = body.edges()
        at, length = lengths_on_lines(body, edges)
        split = split_edges(body, edges, at, length, body.options.longest_boundary_edge)
        if split == 0:
            return body.count("split", total)
        total += split
        body.retriangulate()
