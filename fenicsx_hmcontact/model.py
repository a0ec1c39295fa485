# SPDX-License-Identifier: LGPL-3.0-or-later
"""Residual and tangent of a model, compiled once and bound to any mesh."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import ufl
from dolfinx import fem
from dolfinx.mesh import Mesh
from ufl.algorithms import expand_derivatives

from . import _compat
from .materials import MaterialStress
from .smoothing import (
    PointForm,
    check_smoothable,
    point_forms,
    split_by_measure,
    unite_subdomains,
)


@dataclass(frozen=True)
class CompiledBlock:
    """One block of the residual or of the tangent.

    Attributes:
        smoothed: Integrands at smoothing points, with the compiled `PointForm.sources`.
        rest: Terms on triangles and facets, compiled; None if there are none.
    """

    smoothed: list[tuple[PointForm, list[Any]]]
    rest: Any


@dataclass(frozen=True)
class CompiledModel:
    """Residual and tangent of a model.

    Attributes:
        unknowns: Unknowns of the forms it was compiled from.
        residual: One block a field.
        tangent: Blocks by test and trial field.
        tangent_coefficients: Functions and constants the tangent depends on.
        entity_maps: Maps to submeshes that functions live on.
        stresses: Stresses of materials that stand in the residual.
    """

    unknowns: list[fem.Function]
    residual: list[CompiledBlock]
    tangent: list[list[CompiledBlock]]
    tangent_coefficients: list[Any]
    entity_maps: Sequence[Any] | None
    stresses: list[MaterialStress]

    @property
    def is_smoothed(self) -> bool:
        """Whether any term of the residual is smoothed over node cells."""
        return any(block.smoothed for block in self.residual)

    def successor(
        self, unknowns: Sequence[fem.Function], replace: Mapping[Any, Any]
    ) -> Callable[[Any], Any]:
        """Say what takes the place of a function, space, constant or tags on another mesh.

        Args:
            unknowns: The new unknowns, in the old order.
            replace: Successors of everything else, stresses of materials included.

        Raises:
            ValueError: If the number of unknowns differs.
        """
        if len(unknowns) != len(self.unknowns):
            raise ValueError(
                f"the model has {len(self.unknowns)} unknowns, {len(unknowns)} were given"
            )
        # By identity: function spaces have no hash.
        known = {id(old): new for old, new in replace.items()}
        for old, new in replace.items():
            if isinstance(old, MaterialStress):
                known |= {id(f): g for f, g in zip(old.functions, new.functions, strict=True)}
        for old, new in zip(self.unknowns, unknowns, strict=True):
            known[id(old)] = new
            known[id(old.function_space)] = new.function_space
        return lambda old: known.get(id(old), old)


def compile_model(
    residual: ufl.Form | Sequence[ufl.Form],
    unknowns: Sequence[fem.Function],
    entity_maps: Sequence[Any] | None = None,
) -> CompiledModel:
    """Derive the tangent and compile everything in one module. Collective.

    Args:
        residual: The residual, as one form or one form a field.
        unknowns: The fields.
        entity_maps: Maps to submeshes that functions live on.

    Raises:
        ValueError: If the residual does not fit the unknowns, or a term cannot be smoothed.
    """
    forms = [unite_subdomains(form) for form in _blocks(residual, unknowns, entity_maps)]
    for form in forms:
        check_smoothable(form)
    trials = [ufl.TrialFunction(u.function_space) for u in unknowns]
    tangent = [
        [_derivative(form, u, du) for u, du in zip(unknowns, trials, strict=True)] for form in forms
    ]
    flat = forms + [form for row in tangent for form in row]
    smoothed = [point_forms(form) for form in flat]
    rest = [split_by_measure(form)[1] for form in flat]
    sources = [form for group in smoothed for p in group for form in p.sources]
    sources += [form for form in rest if form is not None]
    compiled = iter(_compat.compile_forms(unknowns[0].function_space.mesh.comm, sources))
    kernels = [[(p, [next(compiled) for _ in p.sources]) for p in group] for group in smoothed]
    blocks = [
        CompiledBlock(group, None if form is None else next(compiled))
        for group, form in zip(kernels, rest, strict=True)
    ]
    inputs: dict[Any, None] = {}
    for row in tangent:
        for form in row:
            if form.integrals():
                inputs |= dict.fromkeys([*form.coefficients(), *form.constants()])
    n = len(unknowns)
    return CompiledModel(
        list(unknowns),
        blocks[:n],
        [blocks[n + i * n : n + (i + 1) * n] for i in range(n)],
        list(inputs),
        entity_maps,
        list(dict.fromkeys(stress for form in forms for stress in _stresses(form))),
    )


def _stresses(form: ufl.Form) -> list[MaterialStress]:
    """Stresses of materials that stand in a form."""
    operators = (getattr(f, "operator", None) for f in form.coefficients())
    return [operator for operator in operators if operator is not None]


def _derivative(form: ufl.Form, u: fem.Function, du: ufl.Argument) -> ufl.Form:
    """Derivative of a form by a field, through stresses of materials too."""
    result = ufl.derivative(form, u, du)
    for stress in _stresses(form):
        if stress.u is u:
            result += ufl.derivative(form, stress.value, stress.variation(du))
    return expand_derivatives(result)


def integration_mesh(
    unknowns: Sequence[fem.Function], entity_maps: Sequence[Any] | None = None
) -> Mesh:
    """Mesh that a model is integrated over: that of which those of other unknowns are parts."""
    parts = [entity_map.sub_topology._cpp_object for entity_map in entity_maps or ()]
    return max(
        (u.function_space.mesh for u in unknowns),
        key=lambda mesh: (mesh.topology.dim, mesh.topology._cpp_object not in parts),
    )


def _blocks(
    residual: ufl.Form | Sequence[ufl.Form],
    unknowns: Sequence[fem.Function],
    entity_maps: Sequence[Any] | None,
) -> list[ufl.Form]:
    """One residual form a field, each with one test function of the field's space."""
    n_fields = len(unknowns)
    if isinstance(residual, ufl.Form):
        blocks = ufl.extract_blocks(residual) if n_fields > 1 else [residual]
    else:
        blocks = residual
    if not isinstance(blocks, (list, tuple)) or len(blocks) != n_fields:
        raise ValueError(
            f"{n_fields} unknowns need a residual with {n_fields} test functions: take them from a "
            "ufl.MixedFunctionSpace of the unknowns' spaces, or give one form an unknown"
        )
    mesh = integration_mesh(unknowns, entity_maps)._cpp_object
    for block, u in zip(blocks, unknowns, strict=True):
        if not isinstance(block, ufl.Form):
            raise ValueError(f"the residual has no equation for {u.name}")
        arguments = block.arguments()
        if len(arguments) != 1:
            raise ValueError(
                f"the equation of {u.name} has {len(arguments)} arguments: a residual has a test "
                "function and no trial function, its unknown is a function"
            )
        if arguments[0].ufl_function_space() != u.function_space:
            raise ValueError(
                f"the test function of the equation of {u.name} is of another space: give the "
                "unknowns in the order of the residual's test functions"
            )
        for integral in block.integrals():
            if integral.ufl_domain().ufl_cargo() is not mesh:
                raise ValueError(
                    f"a term in the equation of {u.name} is integrated over another mesh than the "
                    "unknowns live on; with a field on a submesh, measures need the domain of the "
                    "whole and entity_maps the way there"
                )
    return list(blocks)
