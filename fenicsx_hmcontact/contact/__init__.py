# SPDX-License-Identifier: LGPL-3.0-or-later
"""Contact surfaces, mortar coupling and condensation."""

from .active_set import ContactStatus, complementarity
from .condensation import Condensation, Dependence
from .friction import CoulombFriction, FrictionLaw, Frictionless, HeldBound, Tied, tangential_law
from .interface import InterfaceState, NodeState
from .kinematics import Kinematics, turned
from .linearisation import GeometryDerivatives, geometry_derivatives
from .mortar import (
    MortarOperator,
    MortarOptions,
    Segments,
    check_idle_edges,
    covered_gradients,
    covered_mass,
    covered_products,
    covered_shapes,
    covered_stiffness,
    mortar_operator,
    mortar_segments,
    sees_only_backs,
    unseen_values,
)
from .pair import ContactPair
from .surface import Surface, gather_surface, surface_dofs
from .trace import surface_values

__all__ = [
    "Condensation",
    "ContactPair",
    "ContactStatus",
    "CoulombFriction",
    "Dependence",
    "FrictionLaw",
    "Frictionless",
    "GeometryDerivatives",
    "HeldBound",
    "InterfaceState",
    "Kinematics",
    "MortarOperator",
    "MortarOptions",
    "NodeState",
    "Segments",
    "Surface",
    "Tied",
    "check_idle_edges",
    "complementarity",
    "covered_gradients",
    "covered_mass",
    "covered_products",
    "covered_shapes",
    "covered_stiffness",
    "gather_surface",
    "geometry_derivatives",
    "mortar_operator",
    "mortar_segments",
    "sees_only_backs",
    "surface_dofs",
    "surface_values",
    "tangential_law",
    "turned",
    "unseen_values",
]
