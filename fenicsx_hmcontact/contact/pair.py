# SPDX-License-Identifier: LGPL-3.0-or-later
"""A pair of contact surfaces and the laws between them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from dolfinx.mesh import MeshTags

from .mortar import MortarOptions

if TYPE_CHECKING:
    from ..gap_flow import GapFlow


@dataclass(frozen=True)
class Tied:
    """The surfaces move together: neither parting nor sliding."""


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
        name: Name of the pair in messages; "secondary/primary" tags where empty.

    Raises:
        ValueError: If both surfaces are the same.
    """

    facet_tags: MeshTags
    secondary: int
    primary: int
    friction: Tied = field(default_factory=Tied)
    flow: GapFlow | None = None
    mortar: MortarOptions = field(default_factory=MortarOptions)
    name: str = ""

    def __post_init__(self) -> None:
        """Refuse a surface paired with itself, and give the pair a name."""
        if self.secondary == self.primary:
            raise ValueError(
                f"secondary and primary surface are the same (tag {self.primary}); a body that "
                "touches itself needs two surfaces"
            )
        if not self.name:
            object.__setattr__(self, "name", f"{self.secondary}/{self.primary}")
