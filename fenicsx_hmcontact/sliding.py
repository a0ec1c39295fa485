# SPDX-License-Identifier: LGPL-3.0-or-later
"""A pair of surfaces that touch, stick, slide and part, over any distance (Section 4.1)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse
from dolfinx import fem
from scipy.sparse import csr_array

from .contact import (
    ContactPair,
    ContactStatus,
    Dependence,
    GeometryDerivatives,
    HeldBound,
    InterfaceState,
    Kinematics,
    MortarOperator,
    NodeState,
    check_idle_edges,
    complementarity,
    gather_surface,
    sees_only_backs,
    surface_dofs,
    tangential_law,
    turned,
)
from .contact.kinematics import HALF
from .domain import NodalState
from .gap_flow import GapPressure
from .sliding_water import SlidingWater, placed
from .solvers import FieldLayout

Float = npt.NDArray[np.float64]

SOFTER = 0.1
"""Complementarity constants relative to the stiffness of a single node: surfaces give together."""

TOUCHING = 1e-9
"""A gap below this part of a facet is closed at the start."""

RELAXATION = 0.5
"""Part by which held bounds of friction first move towards the present ones."""

ROUND_OFF = 1e2 * float(np.finfo(np.float64).eps)
"""Round-off of gaps and slips, relative to the coordinates."""


class SlidingCoupling:
    """A contact pair whose surfaces move. Its data are the same on all ranks.

    Args:
        pair: The pair.
        unknowns: Fields of the problem; one of them is the displacement.
        layout: Their numbering.
        constrained: Which local unknowns are prescribed.
        taken: Which local unknowns are secondary in other pairs.
        time_step: Returns the length of the step [s]; called where water flows in the gap.

    Attributes:
        pair: The pair.
        kinematics: Its surfaces at their current place.
        status: Closed and slipping nodes.
        settled: Whether the last update left the sets as they were.
        dependences: How secondary unknowns depend on others, and the conditions of contact.
        water: Pore water between the surfaces; None without flow.

    Raises:
        ValueError: If the pair fits neither the fields nor the conditions; it names the pair.

    Note:
        Collective.
    """

    def __init__(
        self,
        pair: ContactPair,
        unknowns: Sequence[fem.Function],
        layout: FieldLayout,
        constrained: npt.NDArray[np.bool_],
        taken: npt.NDArray[np.bool_],
        time_step: Callable[[], float],
    ) -> None:
        self.pair = pair
        self._law = tangential_law(pair.friction)
        self._lagged = self._law is not None and getattr(self._law, "lagged", False)
        self._layout = layout
        u = _field(pair, unknowns, layout, 2, "displacement")
        mesh = unknowns[u].function_space.mesh
        secondary, primary = self._surfaces = tuple(
            gather_surface(mesh, pair.facet_tags, tag, str(tag))
            for tag in (pair.secondary, pair.primary)
        )
        blocks = [surface_dofs(s, unknowns[u].function_space) for s in self._surfaces]
        for surface, numbers in zip(self._surfaces, blocks, strict=True):
            if np.any(numbers < 0):
                raise ValueError(
                    f"pair {pair.name}: surface {surface.name} has nodes without a displacement"
                )
        # Secondary and primary displacements
        self._dofs = [layout.global_of_blocks(u, numbers).ravel() for numbers in blocks]
        dropped = (
            layout.gather(self._dofs[0], (constrained | taken).astype(float))
            .reshape(-1, 2)
            .any(axis=1)
        )
        self._dropped = dropped
        if dropped.all():
            raise ValueError(
                f"pair {pair.name}: the secondary surface is prescribed at all its nodes, or that "
                "of another pair; swap secondary and primary"
            )
        if sees_only_backs(secondary, primary, pair.mortar):
            raise ValueError(
                f"pair {pair.name}: the surfaces turn their backs on each other; the bodies must "
                "lie on the far sides of them"
            )
        current = np.concatenate([v.x.array for v in unknowns])
        displacements = self._displacements(current)
        self.kinematics = Kinematics(pair, secondary, primary, dropped, displacements)
        self.water: SlidingWater | None = None
        if pair.flow is not None:
            p = _field(pair, unknowns, layout, 1, "pore pressure")
            self.water = SlidingWater(
                pair,
                self.kinematics,
                (secondary, primary),
                unknowns[p],
                p,
                layout,
                constrained.astype(float),
                taken.astype(float),
                np.concatenate(self._dofs),
                time_step,
            )
        self._numbers = np.concatenate(self._dofs if self.water is None else self.water.unknowns)
        gap, kept = self.kinematics.gap(), self.kinematics.operator.kept
        self._check_overlap(gap)
        self.status = ContactStatus.open(len(dropped))
        self.status.closed = kept & (gap <= TOUCHING * self._surfaces[0].lengths.max())
        if self.water is not None:
            self.water.begin(self.status.closed)
        self.settled = True
        self._bound = np.zeros(len(dropped))
        self._held = self._bound_at_start()
        self._last_slip = self.kinematics.slip()
        self._committed = self.status
        self.place(current)

    def numbers(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Global numbers of the unknowns on the secondary and on the primary surface."""
        secondary, primary = self._dofs
        if self.water is None:
            return secondary, primary
        of_secondary, of_primary = self.water.numbers
        return np.concatenate((secondary, of_secondary)), np.concatenate((primary, of_primary))

    def counts(self) -> dict[str, int]:
        """Number of open, sticking and slipping nodes."""
        closed, slipping = self.status.closed, self.status.slipping
        counts = {"open": int((self.kinematics.operator.kept & ~closed).sum())}
        if self._law is None:
            return counts | {"closed": int(closed.sum())}
        # Held friction acts on open nodes too; they count as open.
        return counts | {
            "sticking": int((closed & ~slipping).sum()),
            "slipping": int((closed & slipping).sum()),
        }

    def violations(self, held: bool) -> tuple[npt.NDArray[np.int64], Float]:
        """By how much contact and friction are violated, in place of the condensed residual.

        Args:
            held: Whether held bounds of friction count, or those of the pressures; lagged ones
                always do.

        Returns:
            Global numbers of the relative displacements, and forces [N/m]; shapes (2k,).
        """
        held = held or self._lagged
        kept = self.kinematics.operator.kept
        numbers = self._dofs[0].reshape(-1, 2)[kept]
        return numbers.ravel(), np.column_stack(self._violations[0 if held else 1])[kept].ravel()

    def reach(self, increment: Float) -> float:
        """Part of an increment that moves no node by more than a facet; at most 1. Collective.

        Args:
            increment: Local array.
        """
        moves = np.concatenate(self._displacements(increment))
        longest = float(np.hypot(*moves.T).max())
        facet = max(float(surface.lengths.max()) for surface in self._surfaces)
        return min(1.0, facet / longest) if longest > 0.0 else 1.0

    def hold(self) -> None:
        """Hold the bounds of friction, after a move towards those of the present pressures.

        Friction of given bounds has one solution, which Newton's method finds; the bounds follow
        with the relaxation of Aitken (Kuettler and Wall 2008).
        """
        if self._law is None or self._lagged:
            return
        bound = self._law.bound(np.maximum(self._pressure, 0.0))[0]
        if self._held is None:
            self._held, self._relaxation, self._missing = HeldBound(bound), RELAXATION, None
            return
        missing = bound - self._held.values
        if self._missing is not None and self.settled:
            change = missing - self._missing
            size = float(change @ change)
            if size > 0.0:
                ratio = -float(self._missing @ change) / size
                self._relaxation = float(np.clip(self._relaxation * ratio, 0.1, 1.0))
        self._missing = missing if self.settled else None
        self._held = HeldBound(self._held.values + self._relaxation * missing)

    def release(self) -> None:
        """Let the bounds of friction follow the pressures again, on closed nodes alone.

        Lagged ones never do.
        """
        if self._lagged:
            return
        self._held = None
        self.status = self.status.restricted(self.status.closed, self._law)

    def water_forces(self) -> tuple[npt.NDArray[np.int64], Float]:
        """What the water in the gap does to the surfaces, to subtract from the residual.

        Returns:
            Global numbers of displacements, and forces [N/m].
        """
        if self.water is None:
            return np.zeros(0, np.int64), np.zeros(0)
        return np.concatenate(self._dofs), self.water.forces()

    def volumes(self) -> tuple[npt.NDArray[np.int64], Float]:
        """Water that the film takes up or leads away in the step, to add to the residual.

        Returns:
            Global numbers of pore pressures, and volumes [m^3/m].
        """
        if self.water is None or self.water.film is None:
            return np.zeros(0, np.int64), np.zeros(0)
        return np.concatenate(self.water.numbers), self.water.film.volumes

    def commit(self) -> None:
        """Take the current state as the start of the next step."""
        self._last_slip = self.kinematics.slip()
        if self.water is not None:
            self.water.commit(self.status.closed)
        self.kinematics.start_step()
        if self._law is not None and self._lagged:
            bound = self._law.bound(np.maximum(self._pressure, 0.0))[0]
            self._bound = np.where(self.status.closed, bound, 0.0)
        self.release()
        self._committed = self.status

    def reset(self) -> None:
        """Go back to the sets of the start of the step."""
        self._held = self._bound_at_start()
        self.status = self._committed
        self.kinematics.restart_step()

    def save(self) -> Any:
        """What the start of the step leaves to it; its arrays are never written to."""
        water = None if self.water is None else self.water.save()
        return self._committed, self._last_slip, self._bound, self.kinematics.save(), water

    def restore(self, state: Any) -> None:
        """Go back to a saved start of a step; `place` is to follow."""
        self._committed, self._last_slip, self._bound, kinematics, water = state
        self.kinematics.restore(kinematics)
        if self.water is not None:
            self.water.restore(water)
        self.reset()

    def nodal_states(self) -> tuple[NodalState, NodalState]:
        """What the pair holds at the nodes of its surfaces at the start of a step."""
        secondary, primary = self.kinematics.nodal_states()
        status = self._committed
        secondary |= {
            "closed": status.closed.astype(float),
            "slipping": status.slipping.astype(float),
            "direction": status.direction,
            "last slip": self._last_slip,
            "bound": self._bound,
        }
        values = {"origin": self.kinematics.origin.tolist()}
        if self.water is not None:
            values |= self.water.values()
        nodes = [surface.input_nodes for surface in self._surfaces]
        return NodalState(nodes[0], secondary, values), NodalState(nodes[1], primary)

    def set_nodal_states(self, secondary: NodalState, primary: NodalState, current: Float) -> None:
        """Start a step from what `nodal_states` returned, here or on another mesh. Collective.

        Args:
            secondary: Of the secondary nodes.
            primary: Of the primary nodes.
            current: Local array of the unknowns; `place` is to follow.
        """
        nodal, values = secondary.nodal, secondary.values
        origin, displacements = np.array(values["origin"]), self._displacements(current)
        self.kinematics.set_nodal_states((nodal, primary.nodal), origin, displacements)
        closed, slipping = (nodal[name] > HALF for name in ("closed", "slipping"))
        direction = np.where(nodal["direction"] < 0.0, -1.0, 1.0)
        self._committed = ContactStatus(closed, slipping & closed, direction)
        self._last_slip, self._bound = nodal["last slip"], nodal["bound"]
        if self.water is not None:
            self.water.set_values(values, closed)
        self.reset()

    def place(self, current: Float) -> None:
        """Follow the surfaces, and couple them where they are. Collective.

        Args:
            current: Local array of the unknowns.
        """
        kinematics = self.kinematics
        kinematics.place(self._displacements(current))
        check_idle_edges(self.pair.name, kinematics.secondary, kinematics.operator, self._dropped)
        kept, numbers = kinematics.operator.kept, self._numbers
        X = _scalar_coupling(kinematics.operator, kept)
        at = _components(np.flatnonzero(kept), 2).ravel().astype(np.intp)
        rows, columns = (_components(entries, 2).ravel() for entries in X.coords)
        shape = at.size, numbers.size
        coefficients = csr_array((X.data.repeat(2), (rows, columns)), shape)
        self.dependences = [Dependence(numbers, at, coefficients, np.zeros(at.size, bool))]
        if self.water is not None:
            self.dependences.append(self.water.place(current))

    def update(
        self, residual: Float, diagonal: Float, new_sets: bool = True, damped: bool = False
    ) -> None:
        """Decide on the sets, and write the conditions down. Collective.

        Args:
            residual: Local array of the residual with what surfaces pass on to each other.
            diagonal: Local array of the diagonal of the tangent.
            new_sets: Whether the sets may change.
            damped: Whether the last step was not a whole one.
        """
        force, traction = self._tractions(residual)
        operator, normals = self.kinematics.operator, self.kinematics.secondary.normals
        kept, D = operator.kept, operator.D
        tangents = turned(normals)
        stiffness, opposite = (
            self._layout.gather(dofs, diagonal).reshape(-1, 2).mean(axis=1) for dofs in self._dofs
        )
        pressure, shear = _dot(traction, normals), _dot(traction, tangents)
        gap, slip = self.kinematics.gap(), _dot(self.kinematics.slip(), tangents)
        before, constant = self.status, SOFTER * self._bedding(stiffness, opposite)
        self._pressure = pressure
        law = self._law if self._held is None else self._held
        state = pressure, shear, gap, slip, (constant, constant)
        self._violations = [
            [kept * D * value for value in complementarity(*state, some)]
            for some in (law, self._law)
        ]
        if new_sets:
            self.status = before.updated(kept, *state, law, damped)
        else:
            self.status = before.restricted(kept, self._law)
        self.settled = self.status.same(before)
        # What closes just now has a pressure only on trial.
        trial_pressure = np.where(before.closed, pressure, pressure - constant * gap)
        self._constrain(force, np.maximum(trial_pressure, 0.0), stiffness)
        if self.water is not None:
            self.water.fill(self.status.closed)

    def follow_water(self, residual: Float, diagonal: Float, moved: bool) -> None:
        """Write the conditions of the water down, when all films are filled. Collective.

        Args:
            residual: Local array of the residual with the water of all films, and with what
                surfaces pass on to each other.
            diagonal: Local array of the diagonal of the tangent.
            moved: Whether an increment has been made in this step.
        """
        if self.water is not None:
            states = residual, diagonal, moved
            self.dependences[1] = self.water.conditions(self.dependences[1], *states)

    def state(self, residual: Float) -> InterfaceState:
        """What acts between the surfaces (Eq. 71). Collective.

        Args:
            residual: Local array of the residual with what surfaces pass on to each other.
        """
        kinematics, operator = self.kinematics, self.kinematics.operator
        force, traction = self._tractions(residual)
        normals, kept = kinematics.secondary.normals, operator.kept
        unpaired = np.where(kept, 0.0, np.nan)
        zero = np.zeros(len(kept))
        water = self._pressure_between
        on_secondary, on_primary = (np.zeros_like(points) for points in kinematics.points)
        volume = float(operator.D @ kinematics.gap())
        if self.water is not None:
            forces, volume = self.water.forces().reshape(-1, 2), self.water.gap_volume()
            on_secondary, on_primary = np.split(forces, [len(kept)])
        closed, slipping = self.status.closed & kept, self.status.slipping
        slides = slipping if self._law is not None else closed
        state = np.where(closed, np.where(slides, NodeState.SLIPPING, NodeState.STICKING), 0)
        return InterfaceState(
            kinematics.points[0] + kinematics.origin,
            normals,
            _dot(traction, normals) + unpaired,
            _dot(traction, turned(normals)) + unpaired,
            zero if water is None else water.mean,
            zero if water is None else water.drop,
            kinematics.aperture() + unpaired,
            _dot(self._last_slip, turned(normals)),
            np.where(kept, state, NodeState.UNPAIRED).astype(np.int8),
            operator.D,
            force + operator.C.T @ force + on_secondary,
            volume,
            kinematics.points[1] + kinematics.origin,
            on_primary - operator.H.T @ force,
            on_secondary,
            0.0 if self.water is None else self.water.taken_up,
            0.0 if self.water is None else self.water.swept,
        )

    # --- what acts ---------------------------------------------------------------------------

    def _displacements(self, current: Float) -> tuple[Float, Float]:
        secondary, primary = (
            self._layout.gather(dofs, current).reshape(-1, 2) for dofs in self._dofs
        )
        return secondary, primary

    @property
    def _pressure_between(self) -> GapPressure | None:
        return None if self.water is None else self.water.pressure

    def _tractions(self, residual: Float) -> tuple[Float, Float]:
        """Forces of the solid [N/m] and tractions [Pa] of kept nodes, zero at others; (n_s, 2)."""
        kept, D = self.kinematics.operator.kept, self.kinematics.operator.D
        # The residual is internal less external force, the water's among it: what the primary body
        # does to the secondary one.
        force = self._layout.gather(self._dofs[0], residual).reshape(-1, 2)
        force[~kept] = 0.0
        traction = np.zeros_like(force)
        np.divide(force, D[:, None], out=traction, where=kept[:, None])
        return force, traction

    def _bedding(self, secondary: Float, primary: Float) -> Float:
        """Stiffness of both surfaces in series [Pa/m], from that of single nodes [Pa]; (n_s,)."""
        operator, surface = self.kinematics.operator, self.kinematics.primary
        length = np.bincount(surface.edges.ravel(), np.repeat(surface.lengths / 2.0, 2))
        # Weights of dual shape functions may be negative; a mean must not be.
        weights = abs(operator.H)
        with np.errstate(divide="ignore", invalid="ignore"):
            give = operator.D / secondary
            give = give + weights @ (length / primary) / weights.sum(axis=1)
            return np.where(operator.kept & np.isfinite(give), 1.0 / give, 1.0)

    def _bound_at_start(self) -> HeldBound | None:
        """Bounds of lagged friction; None where they follow the pressures."""
        return HeldBound(self._bound) if self._lagged else None

    def _check_overlap(self, gap: Float) -> None:
        surface, operator = self._surfaces[0], self.kinematics.operator
        size = np.zeros(len(gap))
        for end in range(2):
            np.maximum.at(size, surface.edges[:, end], surface.lengths)
        deepest = int(np.argmin(np.where(operator.kept, gap / size, 0.0)))
        if operator.kept[deepest] and gap[deepest] < -size[deepest]:
            x, y = surface.points[deepest]
            raise ValueError(
                f"pair {self.pair.name}: the surfaces overlap by {-gap[deepest]:.3g} m at "
                f"({x:.6g}, {y:.6g}), more than a facet; move the bodies apart, lower "
                "MortarOptions.search_radius if that is another part of the body, or allow for it "
                "with close_gaps"
            )

    # --- conditions --------------------------------------------------------------------------

    def _constrain(self, force: Float, pressure: Float, stiffness: Float) -> None:
        """Rows of Eq. 69, corrected, in the relative displacements of the kept nodes."""
        kinematics, status = self.kinematics, self.status
        operator, normals = kinematics.operator, kinematics.secondary.normals
        tangents = turned(normals)
        bound, slope = np.zeros_like(pressure), np.zeros_like(pressure)
        law = self._law if self._held is None else self._held
        if law is not None:
            bound, slope = law.bound(pressure)
            if not (np.isfinite(bound).all() and np.isfinite(slope).all()):
                raise FloatingPointError(f"pair {self.pair.name}: the friction is not a number")
        sticking = status.sticking & (self._law is not None)
        sign = np.where(status.slipping, status.direction, 0.0)
        friction = sign * slope
        tests = tangents + friction[:, None] * normals
        # What the bound has beyond its slope at this pressure: cohesion.
        rest = sign * (bound - slope * pressure)

        gap, slip = _significant(kinematics, kinematics.gap(), _dot(kinematics.slip(), tangents))
        constraint = np.where(np.column_stack((status.closed, sticking)), stiffness[:, None], 0.0)
        values = np.column_stack(
            (
                np.where(status.closed, gap, 0.0),
                np.where(sticking, slip, rest * operator.D),
            )
        )
        kept = operator.kept
        self.dependences[0] = replace(
            self.dependences[0],
            frame=_blocks(normals[kept], tangents[kept]).T.tocsr(),
            test_frame=_blocks(normals[kept], tests[kept]).T.tocsr(),
            stiffness=constraint[kept].ravel(),
            values=values[kept].ravel(),
            derivative=self._row_derivative(constraint, friction, rest, force),
            transmitted=self._transmitted(kinematics.derivatives, operator.D, force),
        )

    def _row_derivative(
        self, constraint: Float, friction: Float, rest: Float, force: Float
    ) -> csr_array:
        """Derivative of the kept nodes' normal and tangential rows through geometry."""
        kinematics = self.kinematics
        normals, kept = kinematics.secondary.normals, np.repeat(kinematics.operator.kept, 2)
        shape = int(kept.sum()), self._numbers.size
        closed, stick = (constraint > 0.0).T
        k_n, k_t = constraint.T[..., None]
        free = np.where(stick, 0.0, friction)
        zero = np.zeros_like(normals)
        result = csr_array(shape)
        d = kinematics.derivatives
        if d is not None:
            between = kinematics.between(*kinematics.points)
            normal = k_n * between + np.where(closed[:, None], 0.0, force)
            # d tau . f = d n . f turned back
            tangential = np.where(stick[:, None], k_t * kinematics.slip(), force)
            tangential = _turned_back(tangential) + free[:, None] * force
            rows = _blocks(normal, tangential) @ d.normals
            rows += _blocks(k_n * normals, zero) @ d.relative(*kinematics.points)
            rows += _blocks(zero, k_t * turned(normals)) @ d.relative(*kinematics.moved)
            rows += _pairs(np.zeros_like(rest), rest) @ d.D
            result = placed(rows[kept], shape)
        return result

    def _transmitted(
        self, d: GeometryDerivatives | None, D: Float, force: Float
    ) -> csr_array | None:
        """Derivative of what secondary nodes pass on to others at fixed forces; shape (m, m)."""
        if d is None:
            return None
        per_length = np.divide(force.T, D, out=np.zeros_like(force.T), where=D > 0.0).T
        m = self._numbers.size
        return placed(-d.forces(per_length), (m, m))


def _field(
    pair: ContactPair,
    unknowns: Sequence[fem.Function],
    layout: FieldLayout,
    size: int,
    name: str,
) -> int:
    """Number of the one field of that size."""
    fields = [f for f, block_size in enumerate(layout.block_sizes) if block_size == size]
    if len(fields) != 1:
        reason = "contact" if size == 2 else "its flow law"
        raise ValueError(f"pair {pair.name}: {reason} needs one {name}, not {len(fields)}")
    u = unknowns[fields[0]]
    degree = u.function_space.element.basix_element.degree
    if degree != 1:
        raise ValueError(
            f"pair {pair.name}: contact needs P1 fields, {u.name} is of degree {degree}"
        )
    return fields[0]


def _significant(kinematics: Kinematics, *lengths: Float) -> list[Float]:
    """Gaps and slips without the round-off of the coordinates, which stiff bodies would feel."""
    size = max(float(np.abs(points).max()) for points in kinematics.points)
    return [np.where(np.abs(x) > ROUND_OFF * size, x, 0.0) for x in lengths]


def _components(numbers: npt.NDArray[np.integer], size: int) -> npt.NDArray[np.integer]:
    """Numbers of the components of blocks; shape (n, size)."""
    return size * numbers[:, None] + np.arange(size)


def _scalar_coupling(
    operator: MortarOperator, kept: npt.NDArray[np.bool_]
) -> scipy.sparse.coo_array:
    """Rows of X of some secondary nodes, columns of both surfaces' nodes; (k, n_s + n_m)."""
    return scipy.sparse.hstack((-operator.C, operator.H), format="csr")[kept].tocoo()


def _dot(a: Float, b: Float) -> Float:
    total: Float = np.einsum("ia,ia->i", a, b)
    return total


def _turned_back(vectors: Float) -> Float:
    """Vectors f' with tau . f = n . f'; shape (n, 2)."""
    return np.column_stack((-vectors[:, 1], vectors[:, 0]))


def _blocks(first: Float, second: Float) -> csr_array:
    """Block diagonal matrix whose blocks have the vectors as rows; shape (2n, 2n)."""
    n = len(first)
    data = np.stack((first, second), axis=1).ravel()
    columns = np.arange(2 * n).reshape(n, 2).repeat(2, axis=0).ravel()
    return csr_array((data, columns, np.arange(0, 4 * n + 1, 2)), shape=(2 * n, 2 * n))


def _pairs(first: Float, second: Float) -> csr_array:
    """Matrix with the numbers of node i in column i, rows 2i and 2i + 1; shape (2n, n)."""
    n = len(first)
    data = np.column_stack((first, second)).ravel()
    return csr_array((data, np.arange(n).repeat(2), np.arange(2 * n + 1)), shape=(2 * n, n))
