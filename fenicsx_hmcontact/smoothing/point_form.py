# SPDX-License-Identifier: LGPL-3.0-or-later
"""From a UFL form to its integrand at a smoothing point.

Fields and their gradients become slots of one array, so that FFCx compiles the integrand as a form
on a single triangle with constant coefficients. The integrand knows neither mesh nor patch; the
assembly multiplies with the smoothed gradients of the shape functions.

`ufl.cell_avg` of an expression is its mean over the triangles of the node cell, weighted as in
Eq. 32 and not smoothed. It has a slot of its own, and an integrand of its own on the triangle; its
first and second variations have slots along test and trial field.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable, Iterable, Iterator, Sequence
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
    CellAvg,
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
from ufl.domain import extract_unique_domain

from .measure import METADATA_KEY, Enhancement, check_enhancement
from .point_function import PointFunction

UNUSED = -1


@dataclass
class FieldSlots:
    """Where a field's values at a smoothing point stand in the integrand's array.

    Attributes:
        shape: UFL shape of the field.
        value: First slot of the value, one slot a component.
        gradient: First slot of the gradient, two slots a component.
        divergence: Slot of the cell's mean divergence.
        average: First slot of variations of cell averages by this argument alone.
        n_averages: Number of them.
        pair: First slot of variations by both arguments.
        n_pairs: Number of them.
    """

    shape: tuple[int, ...]
    value: int = UNUSED
    gradient: int = UNUSED
    divergence: int = UNUSED
    average: int = UNUSED
    n_averages: int = 0
    pair: int = UNUSED
    n_pairs: int = 0

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

    def allocate_averages(self, first: int, n_averages: int, n_pairs: int) -> int:
        """Give slots to variations of cell averages; return the next free slot."""
        self.average, self.n_averages = first, n_averages
        self.pair, self.n_pairs = first + n_averages, n_pairs
        return first + n_averages + n_pairs

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
        coefficients: Slots of the functions in it: P1, constant on triangles, at points.
        position: Slots of the node's coordinates, if used.
        first_cell: First slot of what is constant on a cell: means of functions that are constant
            on triangles, then cell averages.
        first_point: First slot of what has values at points.
        n_coefficients: Length of the kernel's coefficient array.
        constants: Constants in it, in the kernel's order.
        averages: Integrands of cell averages on a triangle, by the numbers of their arguments.
    """

    form: Form
    enhancement: Enhancement
    subdomain: tuple[int, ...]
    subdomain_data: Any
    arguments: list[FieldSlots]
    argument_sizes: list[int]
    coefficients: dict[Coefficient, FieldSlots]
    position: FieldSlots | None
    first_cell: int
    first_point: int
    n_coefficients: int
    constants: list[Constant] = field(default_factory=list)
    averages: dict[tuple[int, ...], list[PointForm]] = field(default_factory=dict)

    @property
    def sources(self) -> list[Form]:
        """What must be compiled: the integrand, then those of its averages."""
        return [self.form, *(a.form for group in self.averages.values() for a in group)]

    def replaced(self, successor: Callable[[Any], Any]) -> PointForm:
        """Return the integrand for other functions, constants and tags."""
        return replace(
            self,
            subdomain_data=successor(self.subdomain_data),
            coefficients={successor(f): s for f, s in self.coefficients.items()},
            constants=[successor(c) for c in self.constants],
            averages={
                reach: [average.replaced(successor) for average in group]
                for reach, group in self.averages.items()
            },
        )

    def fields(self, kind: Callable[[Coefficient], bool]) -> list[Coefficient]:
        """Functions of a kind, in the order of their slots."""
        return [f for f in self.coefficients if kind(f)]


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
            constant on triangles), or a geometric quantity other than the coordinates, or a
            function at smoothing points stands in any other term.
    """
    integrals, rest = split_by_measure(form)
    for f in rest.coefficients() if rest is not None else ():
        if isinstance(f, PointFunction):
            raise ValueError(f"{f.name} lives at smoothing points: its term must be on dc")
    for integral in integrals:
        enhancement = integral.metadata()[METADATA_KEY]
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
            if isinstance(expression, PointFunction):
                if expression.enhancement != enhancement:
                    raise ValueError(
                        f"{expression.name} lives at the points of "
                        f"node_cells_measure({expression.enhancement!r}), its term is on "
                        f"node_cells_measure({enhancement!r})"
                    )
            elif isinstance(expression, (Argument, Coefficient)):
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
        data_id, ids = id(integral.subdomain_data()), subdomain_ids(integral.subdomain_id())
        groups.setdefault((integral.metadata()[METADATA_KEY], data_id, ids), []).append(integral)
    return [
        _transform([i.integrand() for i in group], enhancement, ids, group[0].subdomain_data())
        for (enhancement, _, ids), group in groups.items()
    ]


def point_expression(expressions: Sequence[Expr], measure: ufl.Measure) -> PointForm:
    """Transform expressions, to be evaluated at smoothing points.

    Args:
        expressions: Scalars.
        measure: Measure over node cells: the enhancement, and where.

    Returns:
        An integrand whose vector holds the values.

    Raises:
        ValueError: If they hold what has no meaning there.
    """
    vector = ufl.as_vector(list(expressions))
    domain = extract_unique_domain(vector)
    check_smoothable(sum(expressions) * measure(domain=domain))
    values = Argument(_constant_space(domain, len(expressions)), 0)
    (point_form,) = point_forms(ufl.inner(vector, values) * measure(domain=domain))
    return point_form


def unite_subdomains(form: Form) -> Form:
    """Undo what UFL makes of dc((1, 2)), one integral an id: a node cell may lie in both.

    Such integrals have equal integrands as long as no derivative is taken; signs and blocks of
    forms make copies of them.
    """
    united: list[tuple[Integral, list[int]]] = []
    for integral in form.integrals():
        ids = []
        if METADATA_KEY in integral.metadata():
            ids = list(subdomain_ids(integral.subdomain_id()))
        for other, its_ids in united if ids else ():
            if (
                other.integrand() == integral.integrand()
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


def subdomain_ids(subdomain_id: Any) -> tuple[int, ...]:
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


@dataclass
class _Uses:
    """What stands in expressions, in the order of a deterministic walk."""

    values: dict[Expr, None] = field(default_factory=dict)
    gradients: dict[Expr, None] = field(default_factory=dict)
    averages: dict[Expr, None] = field(default_factory=dict)

    def of(self, kind: type[Expr]) -> list[Expr]:
        """Terminals of a kind whose values or gradients are used."""
        return [e for e in self.values | self.gradients if isinstance(e, kind)]


def _uses(expressions: Iterable[Expr]) -> _Uses:
    """Terminals whose values, those whose gradients, and cell averages that stand there."""
    uses = _Uses()
    seen = set()
    stack = list(expressions)
    while stack:
        e = stack.pop()
        if e in seen:
            continue
        seen.add(e)
        if isinstance(e, CellAvg):
            uses.averages[e] = None
        elif isinstance(e, Grad):
            uses.gradients[e.ufl_operands[0]] = None
        elif not e.ufl_operands:
            uses.values[e] = None
        else:
            stack.extend(e.ufl_operands)
    return uses


def is_at_points(f: Coefficient) -> bool:
    """Whether a function has values at smoothing points."""
    return isinstance(f, PointFunction)


def is_on_triangles(f: Coefficient) -> bool:
    """Whether a function is constant on triangles."""
    return not is_at_points(f) and f.ufl_element().degree == 0


def is_nodal(f: Coefficient) -> bool:
    """Whether a function is P1."""
    return not is_at_points(f) and f.ufl_element().degree > 0


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
    """Replace fields, their gradients and cell averages by slots of the integrand's arrays."""

    expr = MultiFunction.reuse_if_untouched

    def __init__(
        self,
        slots: dict[Expr, tuple[FieldSlots, Expr]],
        constants: dict[Expr, Expr],
        averages: dict[Expr, Expr],
    ):
        super().__init__()
        self.slots = slots
        self.constants = constants
        self.averages = averages

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

    def cell_avg(self, o: Expr) -> Expr:
        return self.averages[o]


def _transform(
    integrands: list[Expr], enhancement: Enhancement, ids: tuple[int, ...], data: Any
) -> PointForm:
    uses = _uses(integrands)
    deviatoric = enhancement == "deviatoric"
    fields = sorted(uses.of(Coefficient), key=lambda f: f.count())
    averages: dict[tuple[int, ...], list[Expr]] = {}
    for average in uses.averages:
        averages.setdefault(_reach(average), []).append(average)
    on_triangle = {reach: [_on_triangle(o) for o in group] for reach, group in averages.items()}
    reached = {v for average in uses.averages for v in _uses(average.ufl_operands).of(Argument)}
    arguments = sorted(reached.union(uses.of(Argument)), key=lambda v: v.number())
    # Coordinates of a mesh and of a submesh are the same.
    positions = [e for e in uses.values if isinstance(e, SpatialCoordinate)]
    constants = sorted(uses.of(Constant), key=lambda c: c.count())

    domain = ufl.Mesh(basix.ufl.element("P", "triangle", 1, shape=(2,)))
    slots: dict[Expr, FieldSlots] = {}
    size = 0
    for f in filter(is_nodal, fields):
        slots[f] = FieldSlots(f.ufl_shape)
        size = slots[f].allocate(size, f in uses.values, f in uses.gradients, deviatoric)
    position_slots = None
    if positions:
        position_slots = FieldSlots((2,))
        size = position_slots.allocate(size, True, False, False)
    first_cell = size
    for f in filter(is_on_triangles, fields):
        slots[f] = FieldSlots(f.ufl_shape)
        size = slots[f].allocate(size, True, False, False)
    first_average, size = size, size + len(averages.get((), ()))
    first_point = size
    for f in filter(is_at_points, fields):
        slots[f] = FieldSlots(f.ufl_shape)
        size = slots[f].allocate(size, True, False, False)
    array = Coefficient(_constant_space(domain, max(size, 1)))
    standins = {f: (its_slots, array) for f, its_slots in slots.items()}
    if position_slots is not None:
        standins |= dict.fromkeys(positions, (position_slots, array))
    average_standins = {o: array[first_average + i] for i, o in enumerate(averages.get((), ()))}
    argument_slots, argument_sizes, directions = [], [], []
    for number, v in enumerate(arguments):
        its_slots = FieldSlots(v.ufl_shape)
        length = its_slots.allocate(0, v in uses.values, v in uses.gradients, deviatoric)
        alone, both = averages.get((v.number(),), []), averages.get((0, 1), [])
        length = its_slots.allocate_averages(length, len(alone), len(both))
        direction = Argument(_constant_space(domain, length), number)
        average_standins |= {o: direction[its_slots.average + i] for i, o in enumerate(alone)}
        standins[v] = (its_slots, direction)
        directions.append(direction)
        argument_slots.append(its_slots)
        argument_sizes.append(length)
    for i, o in enumerate(averages.get((0, 1), ())):
        test, trial = (a[s.pair + i] for a, s in zip(directions, argument_slots, strict=True))
        average_standins[o] = test * trial

    at_point = _AtPoint(
        standins, {c: Constant(domain, c.ufl_shape) for c in constants}, average_standins
    )
    measure = ufl.Measure("dx", domain=domain, metadata={"quadrature_degree": 0})
    form = sum(map_integrand_dags(at_point, integrand) for integrand in integrands) * measure
    return PointForm(
        form,
        enhancement,
        ids,
        data,
        argument_slots,
        argument_sizes,
        slots,
        position_slots,
        first_cell,
        first_point,
        size,
        constants,
        on_triangle,
    )


def _reach(expression: Expr) -> tuple[int, ...]:
    """Numbers of the arguments in an expression."""
    return tuple(sorted(v.number() for v in _uses(expression.ufl_operands).of(Argument)))


def _on_triangle(average: CellAvg) -> PointForm:
    """Integrand of a cell average on a triangle.

    Raises:
        ValueError: If it is not a scalar, or holds anything but gradients of P1 fields, constants
            and functions that are constant on triangles.
    """
    (operand,) = average.ufl_operands
    if operand.ufl_shape or operand.ufl_free_indices:
        raise ValueError("cell_avg takes scalars: take the mean of a tensor by components")
    uses = _uses([operand])
    if uses.averages:
        raise ValueError("cell_avg of what holds another cell_avg has no meaning on node cells")
    for e in uses.values:
        constant = isinstance(e, Coefficient) and is_on_triangles(e)
        if isinstance(e, (FormArgument, SpatialCoordinate)) and not constant:
            name = getattr(e, "name", str(e))
            raise ValueError(
                f"cell_avg takes gradients and what is constant on triangles, not {name}"
            )
    return _transform([operand], "none", (), None)


def _constant_space(domain: ufl.Mesh, size: int) -> ufl.FunctionSpace:
    return ufl.FunctionSpace(domain, basix.ufl.element("DG", "triangle", 0, shape=(size,)))
