# SPDX-License-Identifier: LGPL-3.0-or-later
"""Weak forms of consolidation at small strain: displacement u and pore pressure p (Section 2.1).

Stress is positive in tension, pore pressure in compression: sigma = sigma' - p I. The second form
is a volume of water in a step, so its residual has the unit m^3 per metre thickness.
"""

from __future__ import annotations

from typing import Any

import ufl
from ufl.core.expr import Expr
from ufl.domain import extract_unique_domain

from ..smoothing import dc


def darcy_flux(
    p: Expr,
    permeability: Any,
    unit_weight: float | Expr,
    gravity: Expr | None = None,
) -> Expr:
    """Darcy's flux [m/s], q = -(k/gamma_f)(grad p + gamma_f grad h) (Eq. 3).

    Args:
        p: Pore pressure [Pa].
        permeability: k [m/s]; a number, or a (2, 2) tensor for anisotropy.
        unit_weight: gamma_f [N/m^3].
        gravity: Direction of gravity as a unit vector, -grad h; None without gravity.
    """
    return flux_of(ufl.grad(p), permeability, unit_weight, gravity)


def flux_of(
    pressure_gradient: Expr, permeability: Any, unit_weight: Any, gravity: Expr | None
) -> Expr:
    """Darcy's flux [m/s] of a gradient of the pore pressure [Pa/m], as `darcy_flux`."""
    head = pressure_gradient / unit_weight
    if gravity is not None:
        head = head - gravity
    return -ufl.dot(permeability, head) if _is_tensor(permeability) else -permeability * head


def equilibrium(
    effective_stress: Expr,
    p: Expr | None,
    v: Expr,
    *,
    body_force: Expr | None = None,
    smoothed: ufl.Measure = dc,
    triangles: ufl.Measure = ufl.dx,
) -> ufl.Form:
    """Virtual work of total stress and body force (Eq. 11), without tractions.

    Args:
        effective_stress: sigma' [Pa] as UFL expression of the displacement; shape (2, 2).
        p: Pore pressure [Pa]; None for a dry body.
        v: Test function of the displacement.
        body_force: Weight of the whole, solid and water [N/m^3].
        smoothed: Measure of the effective stress.
        triangles: Measure of pore pressure and weight.
    """
    form = ufl.inner(effective_stress, ufl.grad(v)) * smoothed
    if p is not None:
        form -= p * ufl.div(v) * triangles
    if body_force is not None:
        form -= ufl.dot(body_force, v) * triangles
    return form


def water_balance(
    u: Expr,
    u_n: Expr,
    p: Expr,
    q: Expr,
    dt: Any,
    *,
    permeability: Any,
    unit_weight: float | Expr,
    gravity: Expr | None = None,
    smoothed: ufl.Measure = dc,
    triangles: ufl.Measure = ufl.dx,
) -> ufl.Form:
    """Water balance of one step by backward Euler (Eq. 12), without prescribed fluxes.

    A flux qbar [m/s] out of a boundary adds ``dt*qbar*q*ds`` (Eq. 6; outflow is positive).

    Args:
        u: Displacement at the end of the step [m].
        u_n: Displacement at its start [m].
        p: Pore pressure at the end of the step [Pa].
        q: Test function of the pore pressure.
        dt: Length of the step [s].
        permeability: k [m/s]; a number, or a (2, 2) tensor for anisotropy.
        unit_weight: gamma_f [N/m^3].
        gravity: Direction of gravity as a unit vector; None without gravity.
        smoothed: Measure of the flow.
        triangles: Measure of the volume change; water is conserved exactly only on triangles.
    """
    flux = darcy_flux(p, permeability, unit_weight, gravity)
    return ufl.div(u - u_n) * q * triangles - dt * ufl.dot(flux, ufl.grad(q)) * smoothed


def pressure_projection(
    p: Expr,
    p_n: Expr,
    q: Expr,
    shear_modulus: float | Expr,
    *,
    tau: Any = 1.0,
    triangles: ufl.Measure = ufl.dx,
) -> ufl.Form:
    """Polynomial pressure projection on the step's pressure increment (Eqs. 52-54).

    The stabilisation of equal-order interpolation, int tau/(2G) (q - Pq) (dp - Pdp) with P the mean
    on a triangle, for P1 fields: there q - Pq is the gradient times the distance to the centroid,
    whose second moments are those of the reference triangle, mapped. It never adds water.

    Args:
        p: Pore pressure at the end of the step [Pa].
        p_n: Pore pressure at its start [Pa]; with 0 instead, water would leak in every step.
        q: Test function of the pore pressure.
        shear_modulus: G [Pa].
        tau: Amount [-]; 1 removes the oscillation over the body, 3 to 5 also most of the overshoot
            under a drained face in very short steps. 0 for stable pairs such as Taylor-Hood.
        triangles: Measure on triangles.
    """
    J = ufl.Jacobian(extract_unique_domain(q))
    moments = ufl.as_matrix(((2.0, -1.0), (-1.0, 2.0))) / 36.0
    increment, test = ufl.dot(ufl.grad(p - p_n), J), ufl.dot(ufl.grad(q), J)
    return tau / (2.0 * shear_modulus) * ufl.dot(test, ufl.dot(moments, increment)) * triangles


def _is_tensor(permeability: Any) -> bool:
    return bool(getattr(permeability, "ufl_shape", ()))
