# SPDX-License-Identifier: LGPL-3.0-or-later
"""When a body is remeshed, and what its triangles are to look like."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from fenicsx_hmcontact.domain.mesh_arrays import MeshArrays


@dataclass(frozen=True)
class Remeshing:
    """Options of remeshing.

    Lengths are relative to the target size h of the nodes, which is the mean edge length around
    them in the first mesh. The limits that fire a remesh (``fire_...``) are wider than those that
    it works towards, so that one remesh lasts several steps.

    Attributes:
        fire_angle: Remesh when a triangle has a smaller angle than this [degrees]. Raise it towards
            `smallest_angle` for better triangles and more remeshes.
        fire_boundary_edge: Remesh when an edge of the boundary is longer [h].
        fire_edge: Remesh when an edge inside of a body is longer [h].
        fire_short_edge: Remesh when an edge that can be removed is shorter [h].
        fire_area_ratio: Remesh when the area of a triangle, relative to the one at the start of the
            step, leaves this range [-]. Narrow it for materials that compact a lot.
        smallest_angle: Triangles with a smaller angle get a node more or less [degrees]. Above 25
            the pass may find no end.
        longest_boundary_edge: Longer edges of the boundary are halved [h].
        longest_edge: Longer edges inside are halved [h]. Lower it for finer triangles where
            the body is stretched.
        shortest_edge: Shorter edges are removed [h].
        nearest_to_boundary: Nodes inside that are closer to an edge of the boundary are removed
            [h].
        merge_turn: A node of the boundary is only removed where the boundary turns by less
            [degrees]. Lower it to keep the shape of curved surfaces.
        merge_area: A node of the boundary is only removed if this changes the area by less [h^2].
        fill_creases: Where a surface turns in on itself, and the angle outside of the body gets
            smaller than this, or the mouth narrower than that of edges of h at this angle, the
            crease is filled [degrees]; 0 never fills. Set it, to 60 say, where a slide or heave
            rolls over the ground beside it, or soil closes in behind a body that leaves.
        rounds: Most rounds of a remesh [-]. Raise it if a remesh reports that it has not settled.
        every: Remesh every so many steps as well [-]; None for no fixed rhythm.
        rule: A rule of your own: called with the mesh after every step, remeshes on True.
        size: Target size [m] as a function of positions [m] of shape (n, 2); where it is below the
            size that the nodes carry, it counts. Give one to refine near a corner.
        keep: Names of surfaces whose nodes and edges never change, such as the one under a rigid
            base with prescribed displacements.
    """

    fire_angle: float = 15.0
    fire_boundary_edge: float = 1.6
    fire_edge: float = 2.0
    fire_short_edge: float = 0.35
    fire_area_ratio: tuple[float, float] = (0.5, 2.0)
    smallest_angle: float = 20.0
    longest_boundary_edge: float = 1.5
    longest_edge: float = 1.6
    shortest_edge: float = 0.5
    nearest_to_boundary: float = 0.35
    merge_turn: float = 30.0
    merge_area: float = 2e-2
    fill_creases: float = 0.0
    rounds: int = 10
    every: int | None = None
    rule: Callable[[MeshArrays], bool] | None = None
    size: Callable[[npt.NDArray[np.float64]], npt.NDArray[np.float64]] | None = None
    keep: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse values that make no sense."""

        def within(name: str, low: float, high: float, unit: str) -> None:
            value = getattr(self, name)
            if not low < value <= high:
                raise ValueError(
                    f"{name} is {value} {unit}; it must be above {low:g} and at most {high:g}"
                )

        within("smallest_angle", 0.0, 30.0, "degrees")
        within("fire_angle", 0.0, self.smallest_angle, "degrees")
        within("merge_turn", 0.0, 90.0, "degrees")
        within("merge_area", 0.0, 0.5, "h^2")
        if not 0.0 <= self.fill_creases <= 90.0:
            raise ValueError(
                f"fill_creases is {self.fill_creases} degrees; it must lie between 0 and 90"
            )
        within("shortest_edge", 0.0, 0.7, "h")
        within("fire_short_edge", 0.0, self.shortest_edge, "h")
        within("nearest_to_boundary", 0.0, self.shortest_edge, "h")
        # Halves of an edge must not be short enough to be removed again.
        for name in ("longest_boundary_edge", "longest_edge"):
            within(name, 2.0 * self.shortest_edge, np.inf, "h")
        for name, target in (
            ("fire_boundary_edge", self.longest_boundary_edge),
            ("fire_edge", self.longest_edge),
        ):
            if not getattr(self, name) >= target:
                raise ValueError(
                    f"{name} is {getattr(self, name)} h; it must be at least {target:g} h, "
                    "the length that a remesh works towards"
                )
        low, high = self.fire_area_ratio
        if not 0.0 <= low < 1.0 < high:
            raise ValueError(
                f"fire_area_ratio is {self.fire_area_ratio}; it must enclose 1 and not be negative"
            )
        if self.rounds < 1:
            raise ValueError(f"rounds is {self.rounds}; it must be at least 1")
        if self.every is not None and self.every < 1:
            raise ValueError(f"every is {self.every}; it must be at least 1, or None")
        for name in ("rule", "size"):
            value = getattr(self, name)
            if value is not None and not callable(value):
                raise ValueError(f"{name} is {value!r}; it must be a function, or None")
        if isinstance(self.keep, str):
            raise ValueError(f"keep is '{self.keep}'; it must be a tuple of names of surfaces")

    def described(self) -> dict[str, Any]:
        """All options as JSON can hold them; functions by their names."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return {
            name: getattr(value, "__qualname__", repr(value)) if callable(value) else value
            for name, value in values.items()
        }
