# SPDX-License-Identifier: LGPL-3.0-or-later
"""What calls for a remesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fenicsx_hmcontact.remeshing.body import Body
from fenicsx_hmcontact.remeshing.boundary import lengths_on_lines, mergeable
from fenicsx_hmcontact.remeshing.crease import creases
from fenicsx_hmcontact.remeshing.edges import Floats
from fenicsx_hmcontact.remeshing.insertion import curable_angles, lengths_inside
from fenicsx_hmcontact.remeshing.options import Remeshing
from fenicsx_hmcontact.remeshing.quality import areas
from fenicsx_hmcontact.remeshing.removal import removable

WORSE = 0.9
"""What a remesh could not cure fires again when it is worse by this factor [-]."""


@dataclass(frozen=True)
class Quality:
    """The worst of a body, of what a remesh may change; infinite where there is nothing.

    Attributes:
        smallest_area: Smallest signed area of a triangle [m^2]; of all of them.
        smallest_angle: Smallest angle that is not between two fixed edges [degrees].
        shortest_edge: Shortest edge that can be removed [h].
        longest_boundary_edge: Longest edge of a fixed line that can be halved [h].
        longest_edge: Longest other edge [h].
        sharpest_crease: Smallest angle outside of the body between edges of one surface [degrees].
    """

    smallest_area: float
    smallest_angle: float
    shortest_edge: float
    longest_boundary_edge: float
    longest_edge: float
    sharpest_crease: float = np.inf

    @classmethod
    def of(cls, body: Body) -> Quality:
        """Measure a body."""
        edges = body.edges()
        short = np.append(removable(body, edges)[1], mergeable(body, edges)[1])
        return cls(
            float(areas(body.points, body.cells).min()),
            float(curable_angles(body, edges).min()),
            float(short.min(initial=np.inf)),
            float(lengths_on_lines(body, edges)[1].max(initial=-np.inf)),
            float(lengths_inside(body, edges)[1].max(initial=-np.inf)),
            float(creases(body, edges)[1].min(initial=np.inf)),
        )


NOTHING = Quality(np.inf, np.inf, np.inf, -np.inf, -np.inf)
"""Of a body that has nothing a remesh may change."""


def reasons(
    quality: Quality,
    options: Remeshing,
    *,
    area_ratios: Floats | None = None,
    after_last: Quality | None = None,
) -> list[str]:
    """Why a body calls for a remesh.

    Args:
        quality: Of the body as it is.
        options: The limits.
        area_ratios: Area of triangles relative to that at the start of the step [-].
        after_last: Of the body right after its last remesh. What that could not cure counts only
            once it is clearly worse; otherwise it would fire in every step.

    Returns:
        One sentence for each limit that is passed.
    """
    left = after_last or NOTHING
    found = []
    if quality.smallest_area <= 0.0:
        found.append(f"a triangle is inverted, its area is {quality.smallest_area:.3g} m^2")
    for name, limit, unit in (
        ("smallest_angle", options.fire_angle, "degrees"),
        ("shortest_edge", options.fire_short_edge, "h"),
        ("sharpest_crease", options.fill_creases, "degrees"),
    ):
        value = getattr(quality, name)
        if value < min(limit, WORSE * getattr(left, name)):
            found.append(f"{name.replace('_', ' ')} {value:.3g} < {limit:g} {unit}")
    for name, limit in (
        ("longest_boundary_edge", options.fire_boundary_edge),
        ("longest_edge", options.fire_edge),
    ):
        value = getattr(quality, name)
        if value > max(limit, getattr(left, name) / WORSE):
            found.append(f"{name.replace('_', ' ')} {value:.3g} > {limit:g} h")
    if area_ratios is not None and len(area_ratios):
        low, high = options.fire_area_ratio
        least, most = float(np.min(area_ratios)), float(np.max(area_ratios))
        if least < low or most > high:
            found.append(f"area ratios {least:.3g} to {most:.3g} leave {low:g} to {high:g}")
    return found
