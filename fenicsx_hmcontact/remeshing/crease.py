# SPDX-License-Identifier: LGPL-3.0-or-later
"""Creases of a boundary, filled before it folds onto itself."""

from __future__ import annotations

import numpy as np

from fenicsx_hmcontact.remeshing.body import Body
from fenicsx_hmcontact.remeshing.edges import Bools, Edges, Floats, Ints

TOUCHING = 2e-2
"""Length by which another body may be in a crease and only touches it [h]."""


def creases(body: Body, edges: Edges) -> tuple[Ints, Floats]:
    """Nodes where one surface turns in on itself.

    Where it turns by more than a node that may be removed, its short edges do not hide how narrow
    its mouth is: then the angle is that of edges of the target size with this mouth, if smaller.

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
    mouth = np.hypot(*(body.points[b] - body.points[a])[fit].T) / body.targets[nodes][fit]
    of_mouth = 2.0 * np.degrees(np.arcsin(np.minimum(0.5 * mouth, 1.0)))
    turned = angle < 180.0 - body.options.merge_turn
    angle = np.where(turned, np.minimum(angle, of_mouth), angle)
    order = np.argsort(angle, kind="stable")
    return np.column_stack([a, nodes, b])[fit][order], angle[order]


def fill_creases(body: Body) -> int:
    """Fill creases with a triangle, until none is sharp; their nodes are inside then.

    Soil and water that fill them are booked as those of removed nodes are. A crease that another
    body, or another part of this one, has come into stays.
    """
    total, limit = 0, body.options.fill_creases
    while limit > 0.0:
        edges = body.edges()
        found, angle = creases(body, edges)
        outer, _ = _outer(body, edges)
        free = (crease for crease in found[angle < limit] if _is_empty(body, outer, crease))
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


def _is_empty(body: Body, outer: Ints, crease: Ints) -> bool:
    """Whether nothing of any outline lies in the triangle that fills a crease, or across it."""
    triangle = body.points[crease]
    if np.isin(outer, crease[[0, 2]]).all(axis=1).any():
        return False
    nodes = body.points[np.setdiff1d(outer, crease)]
    apart = body.points[outer[~np.isin(outer, crease[[0, 2]]).any(axis=1)]]
    if _enters(nodes, apart, triangle):
        return False
    # Bodies that only touch the corners or the sides have not come in.
    inside = _shrunk(triangle, TOUCHING * body.targets[crease[1]])
    return inside is None or not _enters(body.others.reshape(-1, 2), body.others, inside)


def _shrunk(triangle: Floats, length: float) -> Floats | None:
    """Triangle whose sides lie inside by a length [m]; None where nothing is left of it."""
    opposite = np.hypot(*(triangle[[1, 2, 0]] - triangle[[2, 0, 1]]).T)
    one, other = triangle[1:] - triangle[0]
    radius = abs(_cross(one, other)) / opposite.sum()
    if radius <= length:
        return None
    middle: Floats = opposite @ triangle / opposite.sum()
    return triangle + length / radius * (middle - triangle)


def _enters(points: Floats, edges: Floats, triangle: Floats) -> bool:
    """Whether points lie in a triangle, or edges cross its side between first and last corner."""
    a, _, b = triangle
    corners = zip(triangle[[0, 2, 1]], triangle[[2, 1, 0]], strict=True)
    within = [_cross(y - x, points - x) >= 0.0 for x, y in corners]
    p, q = edges[:, 0], edges[:, 1]
    across = _between(_cross(b - a, p - a), _cross(b - a, q - a))
    across &= _between(_cross(q - p, a - p), _cross(q - p, b - p))
    return bool(np.all(within, axis=0).any() or across.any())


def _between(one: Floats, other: Floats) -> Bools:
    """Whether two points lie on different sides of a line."""
    result: Bools = np.minimum(one, other) < 0.0
    return result & (np.maximum(one, other) > 0.0)


def _cross(a: Floats, b: Floats) -> Floats:
    """Component of a x b out of the plane."""
    result: Floats = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return result
