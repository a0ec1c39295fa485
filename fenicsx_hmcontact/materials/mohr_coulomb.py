# SPDX-License-Identifier: LGPL-3.0-or-later
"""Perfect plasticity of Tresca and Mohr-Coulomb."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .._kernels.return_mapping import return_to_planes
from .elastic_plastic import ElasticPlastic, ReturnMapping
from .interface import Float
from .yield_planes import YieldPlanes, mohr_coulomb_planes

NO_SOLUTION = "a non-associated flow rule has no solution beyond the apex"


@dataclass(frozen=True)
class Tresca(ElasticPlastic):
    """Undrained clay: the largest shear stress is c, whatever the mean stress.

    The out-of-plane stress may be the major, intermediate or minor one. The history ``kappa`` is
    the equivalent plastic strain, the sum of sqrt(2/3 de_p : de_p) over the steps.

    Attributes:
        E: Young's modulus [Pa].
        nu: Poisson's ratio [-].
        c: Undrained shear strength [Pa].
        tension_cutoff: Largest tensile stress [Pa]; None for no limit. Set it, to 0 say, where
            ground may crack.

    Raises:
        ValueError: If a value is out of its range.
    """

    c: float
    tension_cutoff: float | None = None

    def __post_init__(self) -> None:
        """Refuse values that make no sense."""
        super().__post_init__()
        if not (self.c > 0.0 and math.isfinite(self.c)):
            raise ValueError(f"c is {self.c}; the shear strength must be positive")
        _check_cutoff(self.tension_cutoff, math.inf)

    @cached_property
    def _planes(self) -> YieldPlanes:
        return mohr_coulomb_planes(self.nu, self.c, 0.0, 0.0, self.tension_cutoff)

    def return_mapping(self, trial: Float, history: Float) -> ReturnMapping:
        """Return trial stresses exactly, see `ElasticPlastic`."""
        return _return_mapping(self, self._planes, trial, history)


@dataclass(frozen=True)
class MohrCoulomb(ElasticPlastic):
    """Soil with cohesion and friction: (s1 - s3)/2 + (s1 + s3)/2 sin(phi) is at most c cos(phi).

    The out-of-plane stress may be the major, intermediate or minor one. The history ``kappa`` is
    the equivalent plastic strain, the sum of sqrt(2/3 de_p : de_p) over the steps.

    Attributes:
        E: Young's modulus [Pa].
        nu: Poisson's ratio [-].
        c: Cohesion [Pa].
        phi: Angle of friction [degrees].
        psi: Angle of dilation [degrees]; that of friction where None (associated flow). Another
            value makes the tangent unsymmetric; at 0 a stress beyond the apex has no solution
            unless there is a tension cut-off: the apex stands in and the point is flagged.
        tension_cutoff: Largest tensile stress [Pa], with associated flow; None for the apex,
            c cot(phi), alone. Set it, to 0 say, where ground may crack or psi is 0.

    Raises:
        ValueError: If a value is out of its range, or the tension cut-off not below the apex.
    """

    c: float
    phi: float
    psi: float | None = None
    tension_cutoff: float | None = None

    def __post_init__(self) -> None:
        """Refuse values that make no sense."""
        super().__post_init__()
        if not (self.c >= 0.0 and math.isfinite(self.c)):
            raise ValueError(f"c is {self.c}; the cohesion must be zero or positive")
        if not 0.0 <= self.phi < 90.0:
            raise ValueError(f"phi is {self.phi}; it must be from 0 to less than 90 degrees")
        if self.c == self.phi == 0.0:
            raise ValueError("c and phi are both 0; the material would have no strength")
        if self.psi is not None and not 0.0 <= self.psi <= self.phi:
            raise ValueError(f"psi is {self.psi}; it must be from 0 to phi, {self.phi} degrees")
        _check_cutoff(self.tension_cutoff, self.apex)

    @property
    def apex(self) -> float:
        """Largest stress equal in all directions, c cot(phi) [Pa]."""
        return self.c / math.tan(math.radians(self.phi)) if self.phi > 0.0 else math.inf

    @cached_property
    def _planes(self) -> YieldPlanes:
        psi = self.phi if self.psi is None else self.psi
        angles = math.radians(self.phi), math.radians(psi)
        return mohr_coulomb_planes(self.nu, self.c, *angles, self.tension_cutoff)

    def return_mapping(self, trial: Float, history: Float) -> ReturnMapping:
        """Return trial stresses exactly, see `ElasticPlastic`."""
        return _return_mapping(self, self._planes, trial, history)


def _check_cutoff(tension_cutoff: float | None, apex: float) -> None:
    """Refuse a tension cut-off that makes no sense or could never act."""
    if tension_cutoff is not None and not 0.0 <= tension_cutoff < apex:
        below = "" if math.isinf(apex) else f" and below c cot(phi), {apex}"
        raise ValueError(f"tension_cutoff is {tension_cutoff}; it must be zero or positive{below}")


def _return_mapping(
    material: ElasticPlastic, planes: YieldPlanes, trial: Float, history: Float
) -> ReturnMapping:
    n = len(trial)
    result = ReturnMapping(
        np.empty((n, 4)), np.empty((n, 1)), np.empty((n, 4, 4)), np.empty(n, bool), NO_SOLUTION
    )
    compliance = 0.5 / material.shear_modulus, material.nu / material.E
    kappa, kappa_new = history[:, 0], result.history[:, 0]
    out = result.stress, kappa_new, result.tangent, result.flagged
    return_to_planes(np.ascontiguousarray(trial), kappa, planes.arrays, compliance, *out)
    return result
