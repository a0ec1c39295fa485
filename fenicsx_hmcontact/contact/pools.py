# SPDX-License-Identifier: LGPL-3.0-or-later
"""Pools: parts of the void whose walls do not face each other, and their derivatives.

Between two strips that do not go on from each other, as at a corner or beyond the search radius,
lies a polygon of both surfaces. Its water is that of the nodes at both its mouths, as the squares
of their gaps at the start of the step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array, diags_array

from .mortar import assemble
from .strips import Ends, Strips
from .surface import Surface, cross

Float = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]
Index = npt.NDArray[np.integer]

type Mouths = dict[tuple[int, int, int, int], tuple[float, float]]
"""Places on secondary and primary surface; by the chains of both, the end and a number."""

SAME = 1e-9
"""Places on a chain that are closer are the same [edges]."""

NONE = 1e-6
"""Gaps below this share a pool alike, not by their round-off [edges]."""


class Chains:
    """Places on the chains of a surface, counted in edges from the first node of each.

    Args:
        surface: The surface.

    Attributes:
        number: Chain of each node; shape (n,).
        position: Position of each node on it; shape (n,).
        nodes: Nodes of each chain in order.
        closed: Whether the last node of each chain leads to the first.
    """

    def __init__(self, surface: Surface) -> None:
        self._surface, self.nodes = surface, surface.chains
        self.number, self.position = np.zeros((2, len(surface.nodes)), int)
        for k, nodes in enumerate(self.nodes):
            self.number[nodes], self.position[nodes] = k, np.arange(len(nodes))
        begins = np.isin(np.arange(len(surface.nodes)), surface.edges[:, 0])
        self.closed = [bool(begins[nodes[-1]]) for nodes in self.nodes]

    def places(self, edges: Index, local: Float) -> tuple[Index, Float]:
        """Chains of edges, shape (l,), and places of local coordinates on them, shape (l, 2)."""
        first = self._surface.edges[edges, 0]
        return self.number[first], self.position[first][:, None] + (local + 1.0) / 2.0

    def between(self, chain: int, start: float, stop: float) -> list[int]:
        """Nodes strictly between two places, in the order from the first to the second."""
        if start <= stop:
            steps = range(int(np.floor(start + SAME)) + 1, int(np.ceil(stop - SAME)))
        else:
            steps = range(int(np.ceil(start - SAME)) - 1, int(np.floor(stop + SAME)), -1)
        nodes = self.nodes[chain]
        return [int(nodes[k % len(nodes)]) for k in steps]

    def nearest(self, chain: int, start: float, stop: float) -> float:
        """The place ``stop``, on a closed chain counted on from ``start`` the shorter way."""
        if not self.closed[chain]:
            return stop
        n = len(self.nodes[chain])
        return start + (stop - start + n / 2.0) % n - n / 2.0

    def point(self, chain: int, place: float) -> Float:
        """Point at a place [m]; shape (2,)."""
        nodes = self.nodes[chain]
        first = int(np.floor(place))
        one, other = (self._surface.points[nodes[k % len(nodes)]] for k in (first, first + 1))
        point: Float = one + (place - first) * (other - one)
        return point


@dataclass(frozen=True)
class Joint:
    """Two ends of strips with a pool between them.

    Attributes:
        strips: The strip that ends and the one that begins; -1 at a node of both surfaces, where
            the pool closes.
        tip: This node on the secondary surface; -1 for none.
        walls: Bare nodes between them of the secondary surface, and of the primary one back.
    """

    strips: tuple[int, int]
    tip: int
    walls: tuple[list[int], list[int]]


def joints(surfaces: tuple[Surface, Surface], ends: Ends) -> list[Joint]:
    """Find where a pool lies between two ends of strips.

    Args:
        surfaces: Secondary and primary surface.
        ends: Of the strips.
    """
    here, there = (Chains(surface) for surface in surfaces)
    chain, along = here.places(ends.edges[:, 0], ends.places[..., 0])
    opposite, back = there.places(ends.edges[:, 1], ends.places[..., 1])
    same = {int(node): at for at, node in enumerate(surfaces[1].nodes)}
    found = []
    for number, nodes in enumerate(here.nodes):
        strips = np.flatnonzero(chain == number)
        strips = strips[np.argsort(along[strips, 0], kind="stable")].tolist()
        if not strips:
            continue
        pairs = list(pairwise(strips))
        if here.closed[number]:
            pairs.append((strips[-1], strips[0]))
        else:
            pairs += [(-1, strips[0]), (strips[-1], -1)]
        for a, b in pairs:
            known = [k for k in (a, b) if k >= 0]
            tip = -1 if len(known) == 2 else int(nodes[-1] if a >= 0 else nodes[0])
            at = same.get(int(surfaces[0].nodes[tip]), -1) if tip >= 0 else 0
            loose = (a < 0 or ends.loose[a, 1]) and (b < 0 or ends.loose[b, 0])
            if at < 0 or not loose or len({int(opposite[k]) for k in known}) > 1:
                continue
            other = int(opposite[known[0]])
            if tip >= 0 and there.number[at] != other:
                continue
            x = [along[a, 1] if a >= 0 else 0.0, along[b, 0] if b >= 0 else len(nodes) - 1.0]
            y = [back[k, e] if k >= 0 else there.position[at] for k, e in ((a, 1), (b, 0))]
            if x[1] < x[0]:
                x[1] += len(nodes)
            walls = (
                here.between(number, float(x[0]), float(x[1])),
                there.between(other, float(y[1]), there.nearest(other, float(y[1]), float(y[0]))),
            )
            found.append(Joint((a, b), tip, walls))
    return found


def open_ends(ends: Ends, joints: Sequence[Joint]) -> Bool:
    """Loose ends that no pool follows: the mouths of the void; shape (l, 2)."""
    result = ends.loose.copy()
    for joint in joints:
        for strip, end in zip(joint.strips, (1, 0), strict=True):
            if strip >= 0:
                result[strip, end] = False
    return result


def mouths(surfaces: tuple[Surface, Surface], ends: Ends, which: Bool) -> Mouths:
    """Where the void ends.

    Args:
        surfaces: Secondary and primary surface.
        ends: Of the strips.
        which: Those at which it does; shape (l, 2).
    """
    here, there = (Chains(surface) for surface in surfaces)
    chain, along = here.places(ends.edges[:, 0], ends.places[..., 0])
    opposite, back = there.places(ends.edges[:, 1], ends.places[..., 1])
    found: Mouths = {}
    for end in range(2):
        strips = np.flatnonzero(which[:, end])
        for strip in strips[np.argsort(along[strips, end], kind="stable")]:
            key = int(chain[strip]), int(opposite[strip]), end
            count = sum(known[:3] == key for known in found)
            found[*key, count] = float(along[strip, end]), float(back[strip, end])
    return found


def swept(surfaces: tuple[Surface, Surface], before: Mouths, now: Mouths) -> float | None:
    """Area between the mouths of the void before and now [m^2], positive where it was taken in.

    Args:
        surfaces: Both surfaces, where the area is measured.
        before: From `mouths`.
        now: The same, of the same surfaces elsewhere.

    Returns:
        The area; None if these are not the same mouths.
    """
    if before.keys() != now.keys():
        return None
    here, there = (Chains(surface) for surface in surfaces)
    total = 0.0
    for key, place in now.items():
        chain, other, end, _ = key
        (a, c), (b, d) = (before[key], place) if end else (place, before[key])
        b, c = here.nearest(chain, a, b), there.nearest(other, d, c)
        corners = [here.point(chain, a), *surfaces[0].points[here.between(chain, a, b)]]
        corners += [here.point(chain, b), there.point(other, d)]
        corners += [*surfaces[1].points[there.between(other, d, c)], there.point(other, c)]
        z = np.array(corners)
        total -= 0.5 * float(np.sum(cross(z, np.roll(z, -1, axis=0))))
    return total


class Pools:
    """Volumes of the pools between two surfaces, at the secondary nodes; as `Strips`.

    Args:
        now: Both surfaces.
        before: Both at the start of the step.
        ends: Ends of the strips.
        joints: Between which of them the pools lie.
        strips: The strips.
        wet: Secondary nodes that may have a part; shape (n_s,).
        opening: Gap of each secondary node at the start of the step [m]; shape (n_s,).

    Attributes:
        volumes: Part of each node [m^2]; shape (n_s,).
        growth: What it grew by in the step; shape (n_s,).
        of_points: Derivative of the volumes with respect to the coordinates of both surfaces where
            the ends of strips stay on their edges [m]; shape (n_s, 2 n_s + 2 n_m).
        pressing: Forces on the nodes of both surfaces per unit of the nodes' pressures, transposed
            [m]: the same.
    """

    def __init__(
        self,
        now: tuple[Surface, Surface],
        before: tuple[Surface, Surface],
        ends: Ends,
        joints: Sequence[Joint],
        strips: Strips,
        wet: Bool,
        opening: Float,
    ) -> None:
        n_s = len(now[0].nodes)
        n_x = 2 * (n_s + len(now[1].nodes))
        self._strips, self._n_x = strips, n_x
        corners = [_corners(now, ends, joint) for joint in joints]
        shares = [_shares(now[0], ends, joint, wet, opening) for joint in joints]
        sizes = np.array([len(polygon) for polygon in corners], int)
        firsts, n = np.cumsum(sizes) - sizes, int(sizes.sum())
        following = np.arange(1, n + 1)
        following[firsts + sizes - 1] = firsts
        # Corner, nodes of its edge; place on it; strip, end and surface, or strip -1
        table = np.array([row for polygon in corners for row in polygon]).reshape(-1, 6)
        self._nodes, self._strip = table[:, :2].astype(int), table[:, 3:].astype(int)
        shapes = np.column_stack([1.0 - table[:, 2], 1.0 + table[:, 2]]) / 2.0

        axes, at = np.arange(2), np.arange(n)
        rows, columns = 2 * at[:, None, None] + axes, 2 * self._nodes[..., None] + axes
        self._weights = assemble(shapes[..., None], rows, columns, (2 * n, n_x))
        # A side from a to b has half of (a_y - b_y, b_x - a_x) in the derivative at both its ends.
        turn = np.array([[0.5, -0.5], [-0.5, 0.5]])
        sides = np.stack([at, following], axis=1)
        halves = assemble(
            turn,
            2 * at[:, None, None] + axes[:, None],
            2 * sides[:, None, :] + (1 - axes)[:, None],
            (2 * n, 2 * n),
        )
        joins = assemble(
            np.ones((1, 1, 1)),
            2 * sides[:, :, None] + axes,
            2 * at[:, None, None] + axes,
            (2 * n, 2 * n),
        )
        self._slopes = joins @ halves
        # The parts of the nodes in the pool of every corner, once for each coordinate
        entries = [(k, *share) for k, some in enumerate(shares) for share in some]
        pool, node, share = np.array(entries).reshape(-1, 3).T
        of_pools = csr_array((share, (node.astype(int), pool.astype(int))), (n_s, len(corners)))
        self._parts = of_pools[:, np.repeat(np.arange(len(corners)), 2 * sizes)]
        states = [np.concatenate([s.points for s in both]) for both in (now, before)]
        self._states = [(x, self._weights @ x.ravel()) for x in states]
        areas = [self._parts @ (0.5 * z * (self._slopes @ z)) for _, z in self._states]
        self.volumes, self.growth = areas[0], areas[0] - areas[1]
        self._pushes = self._slopes @ self._states[0][1]
        self.of_points = self._at_nodes(self._pushes) @ self._weights
        self.pressing = self.of_points

    def growth_derivative(self) -> csr_array:
        """Derivative of the growth with respect to the coordinates; shape as `of_points`."""
        result = self.of_points
        for sign, (points, z) in zip((1.0, -1.0), self._states, strict=True):
            result = result + sign * self._at_nodes(self._slopes @ z) @ self._moved(points)
        return csr_array(result)

    def force_derivative(self, pressures: Float) -> csr_array:
        """Derivative of the forces of water of given pressures, pressing^T p, by the coordinates.

        Args:
            pressures: At the secondary nodes [Pa]; shape (n_s,).

        Returns:
            Matrix [Pa]; shape (2 n_s + 2 n_m, 2 n_s + 2 n_m).
        """
        p = diags_array(self._parts.T @ pressures)
        moving = self._weights + self._moved(self._states[0][0])
        result = self._weights.T @ p @ self._slopes @ moving
        at, columns, of_place = self._of_places()
        forces = (p @ self._pushes).reshape(-1, 2)[at]
        shift = np.array([-0.5, 0.5])[:, None, None] * forces[:, None, :, None]
        rows = 2 * self._nodes[at][..., None, None] + np.arange(2)[:, None]
        values = shift * of_place[:, None, None]
        return csr_array(
            result + assemble(values, rows, columns[:, None, None], (self._n_x, self._n_x))
        )

    def _at_nodes(self, values: Float) -> csr_array:
        """Values of both coordinates of all corners, shared among nodes; shape (n_s, 2 n)."""
        return csr_array(self._parts @ diags_array(values))

    def _moved(self, points: Float) -> csr_array:
        """Derivative of the corners through their places on edges, points [m] of both surfaces."""
        at, columns, of_place = self._of_places()
        first, second = points[self._nodes[at]].swapaxes(0, 1)
        rows = 2 * at[:, None, None] + np.arange(2)[:, None]
        values = 0.5 * (second - first)[..., None] * of_place[:, None]
        return assemble(values, rows, columns[:, None], self._weights.shape)

    def _of_places(self) -> tuple[Index, Index, Float]:
        """Corners that are ends of strips, what they depend on and how; (k,), (k, 16), (k, 16)."""
        at = np.flatnonzero(self._strip[:, 0] >= 0)
        strip, end, surface = self._strip[at].T
        return at, self._strips.columns[strip], self._strips.of_places[strip, end, surface]


def _corners(
    surfaces: tuple[Surface, Surface], ends: Ends, joint: Joint
) -> list[tuple[float, ...]]:
    """Corners of a pool, along the secondary surface and back along the primary one.

    Each has the nodes of its edge, those of the primary surface after the secondary ones, its place
    on it, and the strip, end and surface that it is an end of; a node twice, place -1 and strip -1.
    """
    n_s = len(surfaces[0].nodes)

    def end_of(strip: int, end: int, surface: int) -> tuple[float, ...]:
        one, other = surfaces[surface].edges[ends.edges[strip, surface]] + surface * n_s
        return one, other, ends.places[strip, end, surface], strip, end, surface

    def node(k: int) -> tuple[float, ...]:
        return k, k, -1.0, -1, 0, 0

    a, b = joint.strips
    first, second = joint.walls
    polygon = [end_of(a, 1, 0) if a >= 0 else node(joint.tip), *map(node, first)]
    polygon += [end_of(b, 0, 0), end_of(b, 0, 1)] if b >= 0 else [node(joint.tip)]
    polygon += [node(n_s + k) for k in second]
    return [*polygon, end_of(a, 1, 1)] if a >= 0 else polygon


def _shares(
    secondary: Surface, ends: Ends, joint: Joint, wet: Bool, opening: Float
) -> list[tuple[int, float]]:
    """Wet nodes next to the mouths of a pool, and their parts in it."""
    nodes, least = [], 0.0
    for strip, end in zip(joint.strips, (1, 0), strict=True):
        if strip >= 0:
            both = secondary.edges[ends.edges[strip, 0]]
            near, far = both[::-1] if ends.places[strip, end, 0] > 0.0 else both
            nodes.append(int(near if wet[near] else far))
            least += NONE * float(np.linalg.norm(np.diff(secondary.points[both], axis=0)))
    parts = np.maximum(opening[nodes], least) ** 2
    return list(zip(nodes, (parts / parts.sum()).tolist(), strict=True))
