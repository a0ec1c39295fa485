# SPDX-License-Identifier: LGPL-3.0-or-later
"""Materials of the solid skeleton."""

from .elastic_plastic import ElasticPlastic, ReturnMapping
from .interface import Material, MaterialUpdate
from .linear_elastic import LinearElastic
from .mohr_coulomb import MohrCoulomb, Tresca
from .stress import MaterialStress

__all__ = [
    "ElasticPlastic",
    "LinearElastic",
    "Material",
    "MaterialStress",
    "MaterialUpdate",
    "MohrCoulomb",
    "ReturnMapping",
    "Tresca",
]
