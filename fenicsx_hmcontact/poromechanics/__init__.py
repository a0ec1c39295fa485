# SPDX-License-Identifier: LGPL-3.0-or-later
"""Weak forms of consolidation, and analytic solutions."""

from . import finite_strain
from .small_strain import darcy_flux, equilibrium, pressure_projection, water_balance

__all__ = ["darcy_flux", "equilibrium", "finite_strain", "pressure_projection", "water_balance"]
