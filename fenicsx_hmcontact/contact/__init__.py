# SPDX-License-Identifier: LGPL-3.0-or-later
"""Contact surfaces, mortar coupling and condensation."""

from .condensation import Condensation, Dependence
from .mortar import (
    MortarOperator,
    MortarOptions,
    Segments,
    covered_mass,
    covered_stiffness,
    mortar_operator,
    mortar_segments,
)
from .pair import ContactPair, Tied
from .surface import Surface, gather_surface, surface_dofs
from .trace import surface_values

__all__ = [
    "Condensation",
    "ContactPair",
    "Dependence",
    "MortarOperator",
    "MortarOptions",
    "Segments",
    "Surface",
    "Tied",
    "covered_mass",
    "covered_stiffness",
    "gather_surface",
    "mortar_operator",
    "mortar_segments",
    "surface_dofs",
    "surface_values",
]
