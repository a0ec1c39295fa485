# SPDX-License-Identifier: LGPL-3.0-or-later
"""From a UFL form to its integrand at a smoothing point.

Fields and their gradients become slots of one array, so that FFCx compiles the integrand as a form
on a single triangle with constant coefficients. The integrand knows neither mesh nor patch; the
assembly multiplies with the smoothed gradients of the shape functions.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import basix
import basix.ufl
import numpy as np
import ufl
from ufl.algorithms import expand_derivatives
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.map_integrands import map_integrand_dags
from ufl.classes import (
    Argument,
    Coefficient,
    Constant,
    Expr,
    Form,
    FormArgument,
    GeometricQuantity,
    Grad,
    Integral,
    SpatialCoordinate,
    ZeroBaseForm,
)
from ufl.corealg.multifunction import MultiFunction

from .measure import METADATA_KEY, Enhancement, check_enhancement

UNUSED = -1


@dataclass
class FieldSlots:
    """Where a field's values at a smoothing point stand in the integrand's array.

    Attributes:
        shape: UFL shape of the field.
        value: First slot of the value, one slot a component.
        gradient: First slot of the gradient, two slots a component.
        divergence: Slot of the cell's mean divergence.
    """

    shape: tuple[int, ...]
    value: int = UNUSED
    gradient: int = UNUSED
    divergence: int = UNUSED

    @property
    def components(self) -> int:
        """Number of scalar components."""
        return math.prod(self.shape)

    def allocate(self, first: int, value: bool, gradient: bool, divergence: bool) -> int:
        """Give slots to what is used, from ``first`` on; return the next free slot."""
        if value:
            self.value, first = first, first + self.components
        if gradient:
            self.gradient, first = first, first + 2 * self.components
        if gradient and divergence and self.shape == (2,):
            self.divergence, first = first, first + 1
        return first

    def value_in(self, array: Expr) -> Expr:
        """Return the field's value as an expression of the integrand's array."""
        if not self.shape:
            return array[self.value]
        return self._tensor(self.shape, lambda i: array[self.value + i])

    def gradient_in(self, array: Expr) -> Expr:
        """Return the field's (enhanced) gradient as an expression of the integrand's array."""
        gradient = self._tensor((*self.shape, 2), lambda i: array[self.gradient + i])
        if self.divergence == UNUSED:
            return gradient
        excess = array[self.divergence] - array[self.gradient] - array[self.gradient + 3]
        return gradient + 0.5 * excess * ufl.Identity(2)

    @staticmethod
    def _tensor(shape: tuple[int, ...], entry: Callable[[int], Expr]) -> Expr:
        flat = np.empty(math.prod(shape), dtype=object)
        for i in range(flat.size):
            flat[i] = entry(i)
        return ufl.as_tensor(flat.reshape(shape).tolist())


@dataclass
class PointForm:
    """Integrand of one block of a form at a smoothing point.

    Attributes:
        form: The integrand as a UFL form on the reference triangle.
        enhancement: How the gradient is enhanced.
        subdomain: Ids of the cells it is restricted to; empty for everywhere.
        subdomain_data: The mesh tags the ids belong to.
        arguments: Slots of test and, for a tangent, trial field.
        argument_sizes: Lengths of the kernel's array along them.
        coefficients: Slots of the functions in it.
        position: Slots of the node's coordinates, if used.
        n_coefficients: Length of the kernel's coefficient array.
        constants: Constants in it, in the kernel's order.
    """

    form: Form
    enhancement: Enhancement
    subdomain: tuple[int, ...]
    subdomain_data: Any
    arguments: list[FieldSlots]
    argument_sizes: list[int]
    coefficients: dict[Coefficient, FieldSlots]
    position: FieldSlots | None
    n_coefficients: int
    constants: list[Constant] = field(default_factory=list)

    def replaced(self, successor: Callable[[Any], Any]) -> PointForm:
        """Return the integrand for other functions, constants and tags."""
        return replace(
            self,
            subdomain_data=successor(self.subdomain_data),
            coefficients={successor(f): s for f, s in self.coefficients.items()},
            constants=[successor(c) for c in self.constants],
        )


def split_by_measure(form: Form | None) -> tuple[list[Integral], Form | None]:
    """Split a form into its integrals over node cells and the rest.

    Args:
        form: A form, or None.

    Returns:
        Integrals over node cells, and the form of all other terms (None if there is none).

    Raises:
        ValueError: If a facet term asks for node cells, or the enhancement has no such name.
    """
    if form is None or isinstance(form, ZeroBaseForm):
        return [], None
    smoothed, rest = [], []
    for integral in form.integrals():
        if METADATA_KEY not in integral.metadata():
            rest.append(integral)
            continue
        check_enhancement(integral.metadata()[METADATA_KEY])
        if integral.integral_type() == "cell":
            smoothed.append(integral)
        else:
            raise ValueError(
                f"{integral.integral_type()} terms cannot be smoothed over node cells: use ds or dS"
            )
    return smoothed, (Form(rest) if rest else None)


def check_smoothable(form: Form) -> None:
    """Refuse what has no meaning on node cells, by name, before derivatives hide it.

    Raises:
        ValueError: If a smoothed term holds a second derivative, a field that is not P1 (or
            constant on triangles), or a geometric quantity other than the coordinates.
    """
    integrals, _ = split_by_measure(form)
    for integral in integrals:
        for expression in _unique(apply_algebra_lowering(integral.integrand())):
            if isinstance(expression, Grad) and any(
                isinstance(e, Grad) for e in _unique(expression.ufl_operands[0])
            ):
                names = ", ".join(
                    str(e) for e in _unique(expression) if isinstance(e, FormArgument)
                )
                raise ValueError(
                    f"a second derivative (of {names}) cannot be smoothed over node cells: "
                    "put its term on dx, or lower its order"
                )
            if isinstance(expression, (Argument, Coefficient)):
                _check_element(expression)
            if isinstance(expression, GeometricQuantity) and not isinstance(
                expression, SpatialCoordinate
            ):
                raise ValueError(
                    f"{type(expression).__name__} has no meaning on a node cell: "
                    "put the term on dx, or give its value as a function"
                )


def point_forms(form: Form | None) -> list[PointForm]:
    """Transform the smoothed terms of a linear or bilinear form.

    Args:
        form: A block of the residual or of the tangent, Gateaux derivatives allowed.

    Returns:
        One integrand for each enhancement and subdomain.
    """
    if form is None:
        return []
    integrals, _ = split_by_measure(expand_derivatives(unite_subdomains(form)))
    groups: dict[tuple[Enhancement, int, tuple[int, ...]], list[Integral]] = {}
    for integral in integrals:
        data_id, ids = id(integral.subdomain_data()), _ids(integral.subdomain_id())
        groups.setdefault((integral.metadata()[METADATA_KEY], data_id, ids), []).append(integral)
    return [
        _transform([i.integrand() for i in group], enhancement, ids, group[0].subdomain_data())
        for (enhancement, _, ids), group in groups.items()
    ]


def unite_subdomains(form: Form) -> Form:
    """Undo what UFL makes of dc((1, 2)), one integral an id: a node cell may lie in both.

    Such integrals share one integrand, the same object, as long as no derivative is taken.
    """
    united: list[tuple[Integral, list[int]]] = []
    for integral in form.integrals():
        ids = []
        if METADATA_KEY in integral.metadata():
            ids = list(_ids(integral.subdomain_id()))
        for other, its_ids in united if ids else ():
            if (
                other.integrand() is integral.integrand()
                and other.subdomain_data() is integral.subdomain_data()
                and other.metadata() == integral.metadata()
                and its_ids
                and set(its_ids).isdisjoint(ids)
            ):
                its_ids.extend(ids)
                break
        else:
            united.append((integral, ids))
    return Form([i.reconstruct(subdomain_id=tuple(sorted(ids))) if ids else i for i, ids in united])


def _ids(subdomain_id: Any) -> tuple[int, ...]:
    """Ids of the cells that an integral is restricted to; empty for everywhere."""
    if subdomain_id == "everywhere":
        return ()
    ids = subdomain_id if isinstance(subdomain_id, tuple) else (subdomain_id,)
    if not all(isinstance(i, numbers.Integral) for i in ids):
        raise ValueError(f"dc({subdomain_id!r}): node cells are restricted by cell tags, numbers")
    return tuple(sorted(int(i) for i in ids))


def _unique(expression: Expr) -> Iterator[Expr]:
    seen = set()
    stack = [expression]
    while stack:
        e = stack.pop()
        if e in seen:
            continue
        seen.add(e)
        yield e
        stack.extend(e.ufl_operands)


def _uses(expressions: Iterable[Expr]) -> tuple[set[Expr], set[Expr]]:
    """Terminals whose values, and those whose gradients, stand in the expressions."""
    values, gradients = set(), set()
    seen = set()
    stack = list(expressions)
    while stack:
        e = stack.pop()
        if e in seen:
            continue
        seen.add(e)
        if isinstance(e, Grad):
            gradients.add(e.ufl_operands[0])
        elif not e.ufl_operands:
            values.add(e)
        else:
            stack.extend(e.ufl_operands)
    return values, gradients


def _check_element(f: Argument | Coefficient) -> None:
    element = f.ufl_element()
    family = getattr(element, "element_family", None)
    lagrange = family == basix.ElementFamily.P and element.num_sub_elements in (
        0,
        element.block_size,
    )
    p1 = lagrange and element.degree == 1 and not element.discontinuous
    on_triangles = lagrange and element.degree == 0 and isinstance(f, Coefficient)
    if getattr(element, "is_symmetric", False) or not (p1 or on_triangles):
        raise ValueError(
            f"{f} lives on {element}; node cells smooth continuous P1 fields "
            "(and take coefficients constant on triangles): put its terms on dx"
        )


class _AtPoint(MultiFunction):
    """Replace fields and their gradients by slots of the integrand's arrays."""

    expr = MultiFunction.reuse_if_untouched

    def __init__(self, slots: dict[Expr, tuple[FieldSlots, Expr]], constants: dict[Expr, Expr]):
        super().__init__()
        self.slots = slots
        self.constants = constants

    def terminal(self, o: Expr) -> Expr:
        if o in self.constants:
            return self.constants[o]
        if o in self.slots:
            slots, array = self.slots[o]
            return slots.value_in(array)
        return o

    def grad(self, o: Expr) -> Expr:
        slots, array = self.slots[o.ufl_operands[0]]
        return slots.gradient_in(array)


def _transform(
    integrands: list[Expr], enhancement: Enhancement, ids: tuple[int, ...], data: Any
) -> PointForm:
    values, gradients = _uses(integrands)
    deviatoric = enhancement == "deviatoric"
    fields = sorted(
        {e for e in values | gradients if isinstance(e, Coefficient)}, key=lambda f: f.count()
    )
    arguments = sorted(
        {e for e in values | gradients if isinstance(e, Argument)}, key=lambda f: f.number()
    )
    # Coordinates of a mesh and of a submesh are the same.
    positions = [e for e in values if isinstance(e, SpatialCoordinate)]
    constants = sorted((e for e in values if isinstance(e, Constant)), key=lambda c: c.count())

    domain = ufl.Mesh(basix.ufl.element("P", "triangle", 1, shape=(2,)))
    coefficient_slots: dict[Coefficient, FieldSlots] = {}
    size = 0
    for f in fields:
        slots = FieldSlots(f.ufl_shape)
        size = slots.allocate(size, f in values, f in gradients, deviatoric)
        coefficient_slots[f] = slots
    position_slots = None
    if positions:
        position_slots = FieldSlots((2,))
        size = position_slots.allocate(size, True, False, False)
    standins: dict[Expr, tuple[FieldSlots, Expr]] = {}
    if size:
        array = Coefficient(_constant_space(domain, size))
        standins |= {f: (slots, array) for f, slots in coefficient_slots.items()}
        if position_slots is not None:
            standins |= dict.fromkeys(positions, (position_slots, array))
    argument_slots, argument_sizes = [], []
    for v in arguments:
        slots = FieldSlots(v.ufl_shape)
        length = slots.allocate(0, v in values, v in gradients, deviatoric)
        standins[v] = (slots, Argument(_constant_space(domain, length), v.number()))
        argument_slots.append(slots)
        argument_sizes.append(length)

    at_point = _AtPoint(standins, {c: Constant(domain, c.ufl_shape) for c in constants})
    measure = ufl.Measure("dx", domain=domain, metadata={"quadrature_degree": 0})
    form = sum(map_integrand_dags(at_point, integrand) for integrand in integrands) * measure
    return PointForm(
        form,
        enhancement,
        ids,
        data,
        argument_slots,
        argument_sizes,
        coefficient_slots,
        position_slots,
        size,
        constants,
    )


def _constant_space(domain: ufl.Mesh, size: int) -> ufl.FunctionSpace:
    return ufl.FunctionSpace(domain, basix.ufl.element("DG", "triangle", 0, shape=(size,)))
