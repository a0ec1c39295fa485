# SPDX-License-Identifier: LGPL-3.0-or-later
"""Creases of a boundary, filled before it folds onto itself."""

from __future__ import annotations

import numpy as np

from fenicsx_hmcontact.remeshing.body import Body
from fenicsx_hmcontact.remeshing.edges import Bools, Edges, Floats, Ints


def creases(body: Body, edges: Edges) -> tuple[Ints, Floats]:
    """Nodes where one surface turns in on itself.

    Returns:
        The node before, the node, and the node after, counterclockwise around the body, shape
        (n, 3), the sharpest first; and the angles between the edges, outside of the body [degrees].
    """
    outer, number = _outer(body, edges)
    starts, counts = np.unique(outer[:, 0], return_counts=True)
    into, out = np.full((2, len(body.points)), -1)
    out[outer[:, 0]], into[outer[:, 1]] = np.arange(len(outer)), np.arange(len(outer))
    # Where two outlines touch, neither turns.
    nodes = starts[(counts == 1) & (into[starts] >= 0) & ~body.held[starts]]
    surface = np.append(body.tags, -1)[edges.facet[number]]
    one, two = surface[into[nodes]], surface[out[nodes]]
    a, b = outer[into[nodes], 0], outer[out[nodes], 1]
    to, on = body.points[nodes] - body.points[a], body.points[b] - body.points[nodes]
    turn = np.arctan2(_cross(to, on), (to * on).sum(axis=1))
    fit = (turn < 0.0) & (one == two) & (one >= 0)
    angle = 180.0 + np.degrees(turn[fit])
    order = np.argsort(angle, kind="stable")
    return np.column_stack([a, nodes, b])[fit][order], angle[order]


def fill_creases(body: Body) -> int:
    """Fill creases with a triangle, until none is sharp; their nodes are inside then.

    Soil and water that fill them are booked as those of removed nodes are. A crease that another
    part of the body has come into stays.
    """
    total, limit = 0, body.options.fill_creases
    while limit > 0.0:
        edges = body.edges()
        found, angle = creases(body, edges)
        outer, _ = _outer(body, edges)
        free = (crease for crease in found[angle < limit] if _is_empty(body.points, outer, crease))
        crease = next(free, None)
        if crease is None:
            break
        a, node, b = (int(i) for i in crease)
        beside = ((body.cells == a) | (body.cells == node)).sum(axis=1) == 2
        group = int(body.groups[beside][0])
        sides = (body.facets == node).any(axis=1) & np.isin(body.facets, (a, b)).any(axis=1)
        x, y, z = body.points[[a, b, node]]
        body.merges.append(((node, a, b), group, 0.5 * float(_cross(y - x, z - x))))
        body.cells = np.vstack([body.cells, [a, b, node]])
        body.groups = np.append(body.groups, group)
        tag = body.tags[sides][:1]
        body.facets = np.vstack([body.facets[~sides], [a, b]])
        body.tags = np.append(body.tags[~sides], tag)
        total += 1
    if total:
        body.retriangulate()
    return body.count("filled", total)


def _outer(body: Body, edges: Edges) -> tuple[Ints, Ints]:
    """Edges of the outline, counterclockwise around the body, shape (n, 2), and their numbers."""
    cell, opposite = np.nonzero(edges.beyond < 0)
    ends = [body.cells[cell, (opposite + k) % 3] for k in (1, 2)]
    return np.column_stack(ends), edges.of_cell[cell, opposite]


def _is_empty(points: Floats, outer: Ints, crease: Ints) -> bool:
    """Whether nothing of the outline lies in the triangle that fills a crease, or across it."""
    a, node, b = points[crease]
    nodes = np.setdiff1d(outer, crease)
    within = [_cross(y - x, points[nodes] - x) >= 0.0 for x, y in ((a, b), (b, node), (node, a))]
    apart = outer[~np.isin(outer, crease[[0, 2]]).any(axis=1)]
    p, q = points[apart[:, 0]], points[apart[:, 1]]
    across = _between(_cross(b - a, p - a), _cross(b - a, q - a))
    across &= _between(_cross(q - p, a - p), _cross(q - p, b - p))
    joined = np.isin(outer, crease[[0, 2]]).all(axis=1)
    return not (np.all(within, axis=0).any() or across.any() or joined.any())


def _between(one: Floats, other: Floats) -> Bools:
    """Whether two points lie on different sides of a line."""
    result: Bools = np.minimum(one, other) < 0.0
    return result & (np.maximum(one, other) > 0.0)


def _cross(a: Floats, b: Floats) -> Floats:
    """Component of a x b out of the plane."""
    result: Floats = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return result
