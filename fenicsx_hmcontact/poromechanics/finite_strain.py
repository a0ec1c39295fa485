# SPDX-License-Identifier: LGPL-3.0-or-later
"""Weak forms of consolidation at finite strain, on a mesh that stands at the start of the step.

The balances hold at the end of the step and are pulled back to its start. Displacements are total;
what deforms the mesh is u - u_n. Signs and units are those of small strain, whose
`pressure_projection` serves here as well.
"""

from __future__ import annotations

from typing import Any

import ufl
from ufl.core.expr import Expr
from ufl.domain import extract_unique_domain

from ..materials.kinematics import StepDeformation
from ..smoothing import node_cells_measure
from .small_strain import flux_of

_smoothed = node_cells_measure("full")


def equilibrium(
    effective_stress: Expr,
    deformation: StepDeformation,
    u: Expr,
    u_n: Expr,
    p: Expr | None,
    v: Expr,
    *,
    body_force: Expr | None = None,
    smoothed: ufl.Measure = _smoothed,
    triangles: ufl.Measure = ufl.dx,
) -> ufl.Form:
    """Virtual work of total stress and body force at the end of a step, without tractions.

    The pressure does its work on the triangles, whose volume `water_balance` books.

    Args:
        effective_stress: Cauchy's effective stress at the end of the step [Pa]; shape (2, 2).
        deformation: Deformation of the step that the stress works on, as `MaterialStress` has it.
        u: Displacement at the end of the step [m].
        u_n: Displacement at its start, where the mesh stands [m].
        p: Pore pressure [Pa]; None for a dry body.
        v: Test function of the displacement.
        body_force: Weight of the whole per volume at the start of the step [N/m^3].
        smoothed: Measure of the effective stress.
        triangles: Measure of pore pressure and weight.
    """
    F, J, J_b = deformation.F, deformation.J, deformation.J_b
    form = _work(effective_stress, F, v) * smoothed
    if J_b is not None:
        # The exact variation of F-bar: the deviator works on F, the mean stress on the cell's area.
        pressure = 0.5 * ufl.tr(effective_stress)
        deviator = effective_stress - pressure * ufl.Identity(2)
        volume = pressure * ufl.derivative(J_b, u, v)
        form = (J_b / J * _work(deviator, F, v) + volume) * smoothed
    if p is not None:
        form -= _work(p * ufl.Identity(2), _step(u, u_n), v) * triangles
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
    smoothed: ufl.Measure = _smoothed,
    triangles: ufl.Measure = ufl.dx,
) -> ufl.Form:
    """Water balance of one step by backward Euler (Eqs. 8, 12), without prescribed fluxes.

    The volume change is that of the triangles, exactly; the flow is that in the end configuration.

    Args:
        u: Displacement at the end of the step [m].
        u_n: Displacement at its start, where the mesh stands [m].
        p: Pore pressure at the end of the step [Pa].
        q: Test function of the pore pressure.
        dt: Length of the step [s].
        permeability: k [m/s]; a number, or a (2, 2) tensor for anisotropy in fixed axes.
        unit_weight: gamma_f [N/m^3].
        gravity: Direction of gravity as a unit vector; None without gravity.
        smoothed: Measure of the flow.
        triangles: Measure of the volume change; water is conserved exactly only on triangles.
    """
    F = _step(u, u_n)
    gradient = ufl.dot(ufl.inv(F).T, ufl.grad(p))
    flux = flux_of(gradient, permeability, unit_weight, gravity)
    through_start = ufl.dot(ufl.cofac(F).T, flux)
    return (ufl.det(F) - 1.0) * q * triangles - dt * ufl.dot(through_start, ufl.grad(q)) * smoothed


def pressure_load(pressure: Any, u: Expr, u_n: Expr, v: Expr, boundary: ufl.Measure) -> ufl.Form:
    """Virtual work of a pressure that follows a surface, to be added to `equilibrium`.

    It pushes along the normal of the end configuration on the length the surface has there, as
    water outside a body does (Nanson's formula). Its tangent is not symmetric.

    Args:
        pressure: Pressure on the surface [Pa], positive where it pushes.
        u: Displacement at the end of the step [m].
        u_n: Displacement at its start, where the mesh stands [m].
        v: Test function of the displacement.
        boundary: Measure on the surface, a ``ds``.
    """
    normal = ufl.FacetNormal(extract_unique_domain(v))
    return pressure * ufl.dot(ufl.dot(ufl.cofac(_step(u, u_n)), normal), v) * boundary


def dead_load(traction: Any, u_n: Expr, v: Expr, boundary: ufl.Measure) -> ufl.Form:
    """Virtual work of a traction that keeps direction and force, to be subtracted.

    The traction is per length at the start of the computation; the mesh has moved since, and with
    it the length that ``boundary`` measures.

    Args:
        traction: Force per length of the surface when ``u_n`` was zero [Pa]; shape (2,).
        u_n: Displacement at the start of the step, where the mesh stands [m].
        v: Test function of the displacement.
        boundary: Measure on the surface, a ``ds``.
    """
    normal = ufl.FacetNormal(extract_unique_domain(v))
    back = ufl.dot(ufl.cofac(ufl.Identity(2) - ufl.grad(u_n)), normal)
    return ufl.sqrt(ufl.dot(back, back)) * ufl.dot(traction, v) * boundary


def _work(stress: Expr, F: Expr, v: Expr) -> Expr:
    """Virtual work of Cauchy's stress, per volume at the start of the step."""
    return ufl.inner(ufl.dot(stress, ufl.cofac(F)), ufl.grad(v))


def _step(u: Expr, u_n: Expr) -> Expr:
    """Deformation gradient of the step."""
    return ufl.Identity(2) + ufl.grad(u - u_n)
