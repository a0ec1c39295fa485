# SPDX-License-Identifier: LGPL-3.0-or-later
"""Creases of a boundary, filled before it folds onto itself."""

from __future__ import annotations

import numpy as np

from fenicsx_hmcontact.remeshing.body import Body
from fenicsx_hmcontact.remeshing.edges import Edges, Floats, Ints
from fenicsx_hmcontact.remeshing.triangulation import directed_edges


def creases(body: Body, edges: Edges) -> tuple[Ints, Floats]:
    """Nodes where one surface turns in on itself.

    Returns:
        The node before, the node, and the node after, counterclockwise around the body, shape
        (n, 3), the sharpest first; and the angles between the edges, outside of the body [degrees].
    """
    directed, _ = directed_edges(body.cells, body.groups, edges)
    outer = directed[_outer(directed, edges)]
    before = np.full(len(body.points), -1)
    after = before.copy()
    after[outer[:, 0]], before[outer[:, 1]] = outer[:, 1], outer[:, 0]
    starts, counts = np.unique(outer[:, 0], return_counts=True)
    nodes = starts[(counts == 1) & (before[starts] >= 0) & ~body.held[starts]]
    surface = np.append(body.tags, -1)[edges.facet]
    a, b = before[nodes], after[nodes]
    sides = [
        [edges.find(int(i), int(n)) for i, n in zip(end, nodes, strict=True)] for end in (a, b)
    ]
    one, two = surface[np.array(sides, np.int64).reshape(2, -1)]
    to, on = body.points[nodes] - body.points[a], body.points[b] - body.points[nodes]
    turn = np.arctan2(to[:, 0] * on[:, 1] - to[:, 1] * on[:, 0], (to * on).sum(axis=1))
    fit = (turn < 0.0) & (one == two) & (one >= 0)
    angle = 180.0 + np.degrees(turn[fit])
    order = np.argsort(angle, kind="stable")
    return np.column_stack([a, nodes, b])[fit][order], angle[order]


def fill_creases(body: Body) -> int:
    """Fill creases with a triangle, until none is sharp; their nodes are inside then.

    Soil and water that fill them are booked as those of removed nodes are.
    """
    total, limit = 0, body.options.fill_creases
    while limit > 0.0:
        found, angle = creases(body, body.edges())
        if not (angle < limit).any():
            break
        a, node, b = (int(i) for i in found[0])
        beside = ((body.cells == a) | (body.cells == node)).sum(axis=1) == 2
        group = int(body.groups[beside][0])
        sides = (body.facets == node).any(axis=1) & np.isin(body.facets, (a, b)).any(axis=1)
        x, y = body.points[[node, b]] - body.points[a]
        area = 0.5 * float(y[0] * x[1] - y[1] * x[0])
        body.merges.append(((node, a, b), group, area))
        body.cells = np.vstack([body.cells, [a, b, node]])
        body.groups = np.append(body.groups, group)
        tag = body.tags[sides][:1]
        body.facets = np.vstack([body.facets[~sides], [a, b]])
        body.tags = np.append(body.tags[~sides], tag)
        total += 1
    if total:
        body.retriangulate()
    return body.count("filled", total)


def _outer(directed: Ints, edges: Edges) -> np.ndarray:
    """Which directed edges have nothing beyond them; others separate layers."""
    at = [edges.find(int(a), int(b)) for a, b in directed]
    return edges.cells[at, 1] < 0
