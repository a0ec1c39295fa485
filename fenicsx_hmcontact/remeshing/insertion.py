# SPDX-License-Identifier: LGPL-3.0-or-later
"""New nodes: midpoints of long edges and circumcentres of triangles with small angles."""

from __future__ import annotations

import numpy as np

from fenicsx_hmcontact.remeshing.body import Body
from fenicsx_hmcontact.remeshing.cavity import remove_nodes
from fenicsx_hmcontact.remeshing.edges import Bools, Edges, Floats, Ints
from fenicsx_hmcontact.remeshing.quality import angles, areas, edge_lengths
from fenicsx_hmcontact.remeshing.removal import distance_to_segment, newest_free

NEAREST_NODE = 0.55
"""A node closer to another than this [h] is not inserted."""

NEAREST_LINE = 0.4
"""A node closer to a fixed edge than this [h] is not inserted."""

SHORT_SIDE = 0.8
"""A triangle with a small angle loses a node if its shortest edge is shorter [h]."""

ON_EDGE = 0.05
"""A point with a smaller barycentric coordinate is moved to the edge of its triangle [-]."""


def split_edges(body: Body, edges: Edges, at: Ints, lengths: Floats, longest: float) -> int:
    """Put nodes at the midpoints of edges, the longest first, and at most one into a triangle.

    Args:
        body: Changed in place; its edges are no longer ``edges``.
        edges: Its edges.
        at: Edges that may be split.
        lengths: Their lengths [h].
        longest: Length above which they are split [h].

    Returns:
        Number of new nodes.
    """
    long = lengths > longest
    at = at[long][np.lexsort((at[long], -lengths[long]))]
    busy = np.zeros(len(body.cells) + 1, bool)
    chosen = []
    for edge in at:
        if not busy[edges.cells[edge]].any():
            busy[edges.cells[edge]] = True
            busy[-1] = False
            chosen.append(edge)
    if not chosen:
        return 0
    _cut(body, edges, np.array(chosen, np.int64), np.full((len(chosen), 2), 0.5))
    return len(chosen)


def split_long_edges_inside(body: Body) -> int:
    """Halve long edges that are not fixed, until there are none where a node has room."""
    options = body.options
    total = 0
    while True:
        edges = body.edges()
        at, length = lengths_inside(body, edges)
        long = length > options.longest_edge
        at, length = at[long], length[long]
        middle = body.points[edges.nodes[at]].mean(axis=1)
        sizes = body.targets[edges.nodes[at]].mean(axis=1)
        fit = _has_room(body, edges, middle, sizes, edges.cells[at, 0])
        # A small angle would have the new node removed again.
        fit &= (length > options.fire_edge) | (
            _angle_when_halved(body, edges, at, middle) > options.smallest_angle
        )
        split = split_edges(body, edges, at[fit], length[fit], options.longest_edge)
        if split == 0:
            return body.count("inserted", total)
        total += split
        body.retriangulate()


def _angle_when_halved(body: Body, edges: Edges, at: Ints, middle: Floats) -> Floats:
    """Smallest angle [degrees] of the triangles at edges inside once these are halved."""
    own = body.cells[edges.cells[at]]
    smallest = np.full(len(at), np.inf)
    for end in edges.nodes[at].T:
        is_end = (own == end[:, None, None])[..., None]
        corners = np.where(is_end, middle[:, None, None], body.points[own]).reshape(-1, 2)
        halves = angles(corners, np.arange(len(corners)).reshape(-1, 3))
        smallest = np.minimum(smallest, halves.reshape(len(at), 6).min(axis=1))
    return smallest


def lengths_inside(body: Body, edges: Edges) -> tuple[Ints, Floats]:
    """Edges that are not fixed, and their lengths [h]."""
    at = np.flatnonzero(~edges.fixed)
    return at, edges.lengths(body.points)[at] / body.targets[edges.nodes[at]].mean(axis=1)


def open_small_angles(body: Body) -> int:
    """Remove a node of triangles with a small angle and a short edge, or else insert one."""
    edges = body.edges()
    smallest = curable_angles(body, edges).min(axis=1)
    bad = np.flatnonzero(smallest < body.options.smallest_angle)
    bad = bad[np.lexsort((bad, smallest[bad]))]
    free = body.free_nodes(edges)
    lengths = edge_lengths(body.points, body.cells[bad])
    shortest = edges.of_cell[bad, np.argmin(lengths, axis=1)]
    short = lengths.min(axis=1) < SHORT_SIDE * body.targets[body.cells[bad]].mean(axis=1)
    nodes = newest_free(free, edges.nodes[shortest])
    closing = short & (nodes >= 0)
    changed = body.count("removed", remove_nodes(body, edges, nodes[closing]))
    if changed == 0:
        changed = body.count("inserted", _insert_circumcentres(body, edges, bad[~closing]))
    if changed:
        body.retriangulate()
    return changed


def curable_angles(body: Body, edges: Edges) -> Floats:
    """Angles of the triangles [degrees], 90 where both sides are fixed; shape (n_cells, 3)."""
    fixed = edges.fixed[edges.of_cell]
    between = np.roll(fixed, -1, axis=1) & np.roll(fixed, 1, axis=1)
    return np.where(between, 90.0, angles(body.points, body.cells))


def _insert_circumcentres(body: Body, edges: Edges, bad: Ints) -> int:
    """Insert the circumcentres of triangles, the first ones first, where there is room.

    A fixed edge that hides a circumcentre is halved instead, if it is long enough (Ruppert 1995).
    """
    beyond, fixed = edges.beyond, edges.fixed[edges.of_cell]
    targets, held = body.targets, body.held
    busy = np.zeros(len(body.points), bool)
    inside, on_edge = [], []
    for cell in bad:
        centre = _circumcentre(body.points[body.cells[cell]])
        radius = np.linalg.norm(centre - body.points[body.cells[cell, 0]])
        around, k = _cell_at(body, beyond, fixed, cell, centre)
        own = body.cells[around]
        if k >= 0:
            a, b = ends = own[[(k + 1) % 3, (k + 2) % 3]]
            weights = np.where(np.arange(3) == k, 0.0, 0.5)
            length = np.linalg.norm(body.points[a] - body.points[b])
            room = length > 2.0 * NEAREST_NODE * targets[ends].mean() and not held[ends].all()
        else:
            weights = _barycentric(body.points[own], centre)
            h = weights @ targets[own]
            room = (
                radius > NEAREST_NODE * h
                and _has_room(body, edges, centre[None], np.array([h]), np.array([around])).all()
            )
        neighbours = beyond[around][beyond[around] >= 0]
        nodes = body.cells[np.append(neighbours, [around, cell])]
        if not room or busy[nodes].any():
            continue
        busy[nodes] = True
        if weights.min() < ON_EDGE:
            on_edge.append((around, int(np.argmin(weights)), weights))
        else:
            inside.append((around, weights))
    return _cut_at(body, edges, on_edge) + _cut_cells(body, inside)


def _circumcentre(corners: Floats) -> Floats:
    a, b = corners[1:] - corners[0]
    twice = 2.0 * (a[0] * b[1] - a[1] * b[0])
    aa, bb = a @ a, b @ b
    return corners[0] + np.array([b[1] * aa - a[1] * bb, a[0] * bb - b[0] * aa]) / twice


def _barycentric(corners: Floats, point: Floats) -> Floats:
    parts = np.stack([corners] * 3)
    parts[[0, 1, 2], [0, 1, 2]] = point
    weights = np.maximum(areas(parts.reshape(-1, 2), np.arange(9).reshape(3, 3)), 0.0)
    return weights / weights.sum()


def _cell_at(body: Body, beyond: Ints, fixed: Bools, cell: int, point: Floats) -> tuple[int, int]:
    """Triangle with a point and -1, or the one in front of the fixed edge k on the way, and k."""
    while True:
        corners = body.points[body.cells[cell]]
        ahead, behind = np.roll(corners, -1, axis=0), np.roll(corners, 1, axis=0)
        side, to = behind - ahead, point - ahead
        outside = side[:, 0] * to[:, 1] - side[:, 1] * to[:, 0]
        k = int(np.argmin(outside))
        if outside[k] >= 0.0:
            return cell, -1
        if fixed[cell, k]:
            return cell, k
        cell = beyond[cell, k]


def _has_room(body: Body, edges: Edges, points: Floats, sizes: Floats, cells: Ints) -> Bools:
    """Whether points are not too close to the nodes and fixed edges of the triangles around them.

    Args:
        body: The body.
        edges: Its edges.
        points: Positions [m]; shape (n, 2).
        sizes: Target sizes there [m]; shape (n,).
        cells: Triangles with the points; shape (n,).
    """
    near = np.column_stack([cells, edges.beyond[cells]])
    near = np.where(near < 0, cells[:, None], near)
    nodes = body.cells[near].reshape(len(points), 12)
    limit = NEAREST_NODE * 0.5 * (sizes[:, None] + body.targets[nodes])
    room = (np.linalg.norm(body.points[nodes] - points[:, None], axis=2) > limit).all(axis=1)

    sides = edges.of_cell[near].reshape(len(points), 12)
    row, column = np.nonzero(edges.fixed[sides])
    ends = body.points[edges.nodes[sides[row, column]]]
    close = distance_to_segment(points[row], ends) < NEAREST_LINE * sizes[row]
    room[row[close]] = False
    return room


def _cut_cells(body: Body, places: list[tuple[int, Floats]]) -> int:
    """Cut triangles in three at points inside of them."""
    if not places:
        return 0
    at = np.array([cell for cell, _ in places])
    a, b, c = body.cells[at].T
    node = body.add_nodes(body.cells[at], np.array([weights for _, weights in places]))
    body.cells[at] = np.column_stack([a, b, node])
    body.cells = np.vstack(
        [body.cells, np.column_stack([b, c, node]), np.column_stack([c, a, node])]
    )
    body.groups = np.concatenate([body.groups, body.groups[at], body.groups[at]])
    return len(places)


def _cut_at(body: Body, edges: Edges, places: list[tuple[int, int, Floats]]) -> int:
    """Cut the triangles at an edge at a point next to it."""
    for cell, k, weights in places:
        edge = edges.of_cell[cell, k]
        ends = body.cells[cell, [(k + 1) % 3, (k + 2) % 3]]
        share = weights[[(k + 1) % 3, (k + 2) % 3]][np.argsort(ends)]
        _cut(body, edges, np.array([edge]), share[None] / share.sum())
    return len(places)


def _cut(body: Body, edges: Edges, at: Ints, weights: Floats) -> None:
    """Put nodes on edges that have no triangle in common, and cut these in two."""
    nodes = body.add_nodes(edges.nodes[at], weights)
    for side in (0, 1):
        inside = edges.cells[at, side] >= 0
        cell, node = edges.cells[at[inside], side], nodes[inside]
        k = np.argmax(edges.of_cell[cell] == at[inside, None], axis=1)
        o, p, q = (body.cells[cell, (k + i) % 3] for i in range(3))
        body.cells[cell] = np.column_stack([o, p, node])
        body.cells = np.vstack([body.cells, np.column_stack([o, node, q])])
        body.groups = np.append(body.groups, body.groups[cell])
    facet, node = edges.facet[at], nodes
    facet, node = facet[facet >= 0], node[facet >= 0]
    ends = body.facets[facet, 1]
    body.facets[facet, 1] = node
    body.facets = np.vstack([body.facets, np.column_stack([node, ends])])
    body.tags = np.append(body.tags, body.tags[facet])
