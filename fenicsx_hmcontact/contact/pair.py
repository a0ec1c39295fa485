# SPDX-License-Identifier: LGPL-3.0-or-later
"""A pair of contact surfaces and the laws between them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from dolfinx.mesh import MeshTags

from .friction import FrictionLaw, Frictionless, Tied, tangential_law
from .mortar import MortarOptions

if TYPE_CHECKING:
    from ..gap_flow import GapFlow


@dataclass(frozen=True)
class ContactPair:
    """Two surfaces that meet, on meshes that need not match.

    Attributes:
        facet_tags: Tags of the facets of the mesh.
        secondary: Tag of the surface that carries multipliers and relative unknowns; the one with
            the finer mesh, as a rule.
        primary: Tag of the opposite surface.
        friction: Law between the solids.
        flow: Water between them; None where none passes.
        mortar: How the surfaces find each other.
        motion: Whether normals, segments and gaps follow the surfaces as they move ("finite"), or
            are those of the mesh ("small"): exact patch tests at small strain, no sliding beyond a
            small part of a facet. Tied pairs are small.
        close_gaps: Gaps and overlaps at the start up to this [m] count as touching: what faceted
            curves leave between bodies that are meant to touch.
        linearised: Whether the tangent follows normals, projections and segments as the surfaces
            move. Without it a step takes more iterations (8 to 20), to the same answer.
        name: Name of the pair in messages; "secondary/primary" tags where empty.

    Raises:
        ValueError: If both surfaces are the same, the friction is no law, the motion neither, or
            close_gaps negative.
    """

    facet_tags: MeshTags
    secondary: int
    primary: int
    friction: Tied | Frictionless | FrictionLaw = field(default_factory=Tied)
    flow: GapFlow | None = None
    mortar: MortarOptions = field(default_factory=MortarOptions)
    motion: Literal["finite", "small"] = "finite"
    close_gaps: float = 0.0
    linearised: bool = True
    name: str = ""

    def __post_init__(self) -> None:
        """Refuse a surface paired with itself, and give the pair a name."""
        if self.secondary == self.primary:
            raise ValueError(
                f"secondary and primary surface are the same (tag {self.primary}); a body that "
                "touches itself needs two surfaces"
            )
        if self.motion not in ("finite", "small"):
            raise ValueError(f'motion is {self.motion!r}; it must be "finite" or "small"')
        if not self.close_gaps >= 0.0:
            raise ValueError(f"close_gaps is {self.close_gaps}; it must be zero or positive")
        if not isinstance(self.friction, Tied):
            tangential_law(self.friction)
        if self.flow is not None and not hasattr(self.flow, "aperture"):
            raise ValueError(f"flow is {self.flow!r}; it must be a GapFlow, or None")
        if not self.name:
            object.__setattr__(self, "name", f"{self.secondary}/{self.primary}")
