# SPDX-License-Identifier: LGPL-3.0-or-later
"""Pore water of a pair whose surfaces move: pressures of both faces and the film between them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse
from dolfinx import fem
from scipy.sparse import csr_array, diags_array

from .contact import ContactPair, Dependence, Kinematics, Surface, surface_dofs
from .gap_flow import GapFlow, GapPressure, MovingFilm, unseen_exchange
from .solvers import FieldLayout

Float = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]

NO_GAP = 4.0 * float(np.finfo(np.float64).eps)
"""Gap that is but round-off, relative to the coordinates: its leakage would swamp the matrix."""


class SlidingWater:
    """Pore water of a sliding pair. Its data are the same on all ranks.

    Args:
        pair: The pair, with a flow law.
        kinematics: Its surfaces.
        surfaces: The surfaces as gathered from the mesh.
        pressure: Pore pressure.
        field: Its number in the layout.
        layout: Numbering of the unknowns.
        constrained: Marks of the prescribed unknowns, as local array.
        taken: Marks of the secondary unknowns of other pairs, as local array.
        displacements: Global numbers of the displacements of both surfaces.
        time_step: Returns the length of the step [s].

    Attributes:
        numbers: Global numbers of the pore pressures of the secondary face and of the primary
            face; empty on a dry body.
        pressure: Pore pressures where the surfaces are.
        meeting: Secondary nodes that other pairs have too: their films meet; shape (n_s,).
        outside: Pressure of the free water around; None where faces and ends are sealed.
        free_ends: Secondary nodes that free water may wet as ends of the gap; shape (n_s,).
        covered: Nodes with a pore pressure that the other surface faces; shape (n_p,).
        ends: Those of them that free water wets as ends of the gap; shape (n_p,).
        film: The film between them; None before water flows.
        volume: Volume of the gap at the start of the step [m^3/m].
        taken_up: Water that the gap took from the bodies in the last step [m^3/m].
        swept: Water that came into or left it at its ends, with surfaces that move [m^3/m].

    Raises:
        ValueError: If both bodies are dry, one of the surfaces in part, or the aperture is zero.
    """

    def __init__(
        self,
        pair: ContactPair,
        kinematics: Kinematics,
        surfaces: tuple[Surface, Surface],
        pressure: fem.Function,
        field: int,
        layout: FieldLayout,
        constrained: Float,
        taken: Float,
        displacements: npt.NDArray[np.int64],
        time_step: Callable[[], float],
    ) -> None:
        assert pair.flow is not None
        self._flow: GapFlow = pair.flow
        self._kinematics, self._layout = kinematics, layout
        self._displacements, self._time_step = displacements, time_step
        self._edges, self._name = surfaces[0].edges, f"pair {pair.name}"
        dofs = [surface_dofs(surface, pressure.function_space) for surface in surfaces]
        wet = [bool((numbers >= 0).any()) for numbers in dofs]
        partly = any(w and bool((numbers < 0).any()) for w, numbers in zip(wet, dofs, strict=True))
        if partly or not any(wet):
            raise ValueError(
                f"pair {pair.name}: water in the gap needs a porous body on one side at least, and "
                f"each surface on porous or on dry bodies alone; {pressure.name} does not reach "
                + ("all of a surface" if partly else "either surface")
            )
        if pair.flow.aperture == 0.0:
            raise ValueError(
                f"pair {pair.name}: an aperture of zero is for tied pairs; between surfaces that "
                "slide the aperture is the gap: leave it out"
            )
        none = np.zeros(0, np.int64)
        self.numbers = tuple(
            layout.global_of_blocks(field, numbers).ravel() if w else none
            for w, numbers in zip(wet, dofs, strict=True)
        )
        self._prescribed, self._taken = (
            layout.gather(self.numbers[0], marks) > 0.0
            if wet[0]
            else np.zeros(len(surfaces[0].nodes), bool)
            for marks in (constrained, taken)
        )
        self.meeting = self._taken.copy()
        self.outside = self._flow.outside
        self.free_ends = np.full(len(surfaces[0].nodes), self.outside is not None and wet[0])
        self.film: MovingFilm | None = None
        self.taken_up = self.swept = 0.0

    volume: float
    pressure: GapPressure

    @property
    def unknowns(self) -> tuple[npt.NDArray[np.int64], ...]:
        """Global numbers of the displacements and the pore pressures of both surfaces."""
        return (self._displacements, *self.numbers)

    def place(self, current: Float) -> Dependence:
        """Follow the surfaces; say how the pore pressures depend on each other. Collective.

        Args:
            current: Local array of the unknowns.
        """
        self.film = None
        faces = [
            self._layout.gather(numbers, current) if numbers.size else None
            for numbers in self.numbers
        ]
        ends = self._open_ends()
        faced = self._kinematics.faced
        self.covered = np.concatenate((self._kinematics.pressures.kept, faced))
        self.ends = np.concatenate((ends, np.zeros_like(faced)))
        held = self._prescribed | ends
        free, inner = ~(held | self._taken), ~(held | self.meeting)
        water = self.pressure = GapPressure(self._kinematics, free, inner, *faces)
        self.covered, self.ends = (marks[water.faces] for marks in (self.covered, self.ends))
        operator, related = self._kinematics.pressures, water.related
        numbers = np.concatenate(self.unknowns)
        first = self._displacements.size
        secondary = (first + np.flatnonzero(related)).astype(np.intp)
        shape = secondary.size, numbers.size
        coefficients = csr_array(shape)
        if related.any():
            X = scipy.sparse.hstack((-operator.C, operator.H), format="csr")
            coefficients = placed(X[related], shape, column=first)
        return Dependence(numbers, secondary, coefficients, np.zeros(secondary.size, bool))

    def forces(self) -> Float:
        """Forces of the water on the nodes of both surfaces [N/m]; shape (2 n_s + 2 n_m,)."""
        forces: Float = self._kinematics.void.pressing.T @ self.pressure.mean
        return forces

    def fill(self, closed: Bool) -> None:
        """Put the film between the surfaces where they are.

        Args:
            closed: Nodes where the solids touch; shape (n_s,).
        """
        closed = self._closed_before if self._flow.lagged else self._without_gap(closed)
        faces, dt = (self._kinematics, self.pressure), self._time_step()
        self.film = MovingFilm(self._flow, *faces, closed, self._before, dt, self._unseen)

    def conditions(
        self, coupled: Dependence, residual: Float, diagonal: Float, moved: bool
    ) -> Dependence:
        """Write the water in the gap down; where nothing is between the faces there is no drop.

        Args:
            coupled: How the pore pressures depend on each other.
            residual: Local array of the residual with the water of all films, and with what
                surfaces pass on to each other.
            diagonal: Local array of the diagonal of the tangent.
            moved: Whether an increment has been made in this step.
        """
        assert self.film is not None
        film, water, first = self.film, self.pressure, self._displacements.size
        kinematics, n = self._kinematics, len(water.related)
        d, d_p = kinematics.derivatives, kinematics.pressure_derivatives
        if self._flow.lagged and not moved:
            # Through new apertures old pressures make floods; what surfaces on the move would pass
            # on of them is not to be foreseen.
            d = d_p = None
        of_volumes, of_leak = film.of_coordinates(d, d_p)
        m = first + of_volumes.shape[0]
        added = placed(of_volumes, (m, m), row=first)
        added = added + placed(film.of_pressures, (m, m), first, first)
        presses = kinematics.void.pressing.T
        added = added - placed(presses @ water.mean_weights, (m, m), column=first)
        if d is not None and d_p is not None:
            turning = kinematics.void.force_derivative(water.mean)
            added = added - placed(turning + presses @ water.mean_derivative(d_p), (m, m))
        related = water.related
        if not related.any():
            return replace(coupled, transmitted=added)
        stiffness = np.abs(self._layout.gather(self.numbers[0], diagonal))
        stiffness = np.where(film.watertight, stiffness, 0.0)
        rows = placed(of_leak, (n, m))
        if d_p is not None:
            rows = rows + placed(diags_array(stiffness) @ water.drop_derivative(d_p), (n, m))
            D, volumes = kinematics.pressures.D, self._layout.gather(self.numbers[0], residual)
            per_length = np.divide(volumes, D, out=np.zeros(n), where=related & (D > 0.0))
            added = added + placed(-d_p.forces(per_length[:, None]), (m, m), row=first)
        return replace(
            coupled,
            stiffness=stiffness[related],
            values=np.where(stiffness > 0.0, water.drop, film.leak)[related],
            derivative=rows[related],
            transmitted=added,
            relative=film.of_drops[related][:, related],
        )

    def begin(self, closed: Bool) -> None:
        """Let the next step start from where the surfaces are.

        Args:
            closed: Nodes where the solids touch; shape (n_s,).
        """
        self._closed_before = self._without_gap(closed)
        self._before, self.volume = self._covered_gap(), self.gap_volume()
        self._mouths, self._unseen = self._kinematics.void.mouths, self._exchange()

    def commit(self, closed: Bool) -> None:
        """Take the current state as the start of the next step; book the water of this one."""
        before, mouths = self.volume, self._mouths
        self.begin(closed)
        assert self.film is not None
        self.taken_up = float(self.film.volumes.sum())
        swept = self._kinematics.void.swept(mouths)
        # Where facets come into sight or go out of it, it is what is left of the change.
        self.swept = self.volume - before - self.taken_up if swept is None else swept

    def save(self) -> Any:
        """What the start of the step leaves to it; its arrays are never written to."""
        start = self._before, self._closed_before, self._mouths, self._unseen
        return start, (self.volume, self.taken_up, self.swept)

    def restore(self, state: Any) -> None:
        """Go back to a saved start of a step."""
        start, (self.volume, self.taken_up, self.swept) = state
        self._before, self._closed_before, self._mouths, self._unseen = start

    def values(self) -> dict[str, float]:
        """Water of the gap at the start of a step [m^3/m]."""
        return {"taken up": self.taken_up, "swept": self.swept}

    def set_values(self, values: dict[str, float], closed: Bool) -> None:
        """Start a step where the surfaces are; the water of the gap is what it holds there."""
        self.taken_up, self.swept = values["taken up"], values["swept"]
        self.begin(closed)

    def free_pressure(self) -> Float:
        """Pressure of the free water at the nodes with a pore pressure [Pa]; shape (n_p,)."""
        points = np.concatenate(self._kinematics.points)[self.pressure.faces]
        if not callable(self.outside):
            return np.full(len(points), self.outside)
        values = np.asarray(self.outside(points + self._kinematics.origin), float)
        if values.shape != (len(points),) or not np.isfinite(values).all():
            raise ValueError(f"outside of {self._name} must return one pressure a point")
        return values

    def _open_ends(self) -> Bool:
        """Nodes at the end of the film that no support holds; shape (n_s,)."""
        kinematics, edges = self._kinematics, self._edges
        kept = kinematics.pressures.kept
        goes_on = np.zeros(len(kept), int)
        for end in range(2):
            np.add.at(goes_on, edges[:, end], kept[edges[:, 1 - end]])
        return self.free_ends & kinematics.operator.kept & (goes_on < 2)

    def _covered_gap(self) -> Float:
        """Gap where there is a film, zero elsewhere; shape (n_s,)."""
        kinematics = self._kinematics
        return np.where(kinematics.operator.kept, kinematics.aperture(), 0.0)

    def _exchange(self) -> csr_array:
        """`unseen_exchange` for the pore pressures of both faces; shape (n_p, n_p)."""
        here, there = (numbers.size for numbers in self.numbers)
        shape = here + there, here + there
        if not (here and there):
            return csr_array(shape)
        return placed(unseen_exchange(self._flow, self._kinematics), shape, here, here)

    def gap_volume(self) -> float:
        """Volume of the gap now [m^3/m]."""
        return float(self._kinematics.volumes().sum())

    def _without_gap(self, closed: Bool) -> Bool:
        """Nodes that touch, but for round-off too, or prescribed beside one; shape (n_s,)."""
        kept = self._kinematics.operator.kept
        closed = closed & kept
        beside = np.zeros_like(closed)
        for end in range(2):
            beside[self._edges[closed[self._edges[:, end]], 1 - end]] = True
        size = max(float(np.abs(points).max()) for points in self._kinematics.points)
        return closed | (beside & ~kept) | (self._kinematics.aperture() <= NO_GAP * size)


def placed(matrix: csr_array, shape: tuple[int, int], row: int = 0, column: int = 0) -> csr_array:
    """Matrix of a larger shape with the entries from that row and column on."""
    entries = scipy.sparse.coo_array(matrix)
    return csr_array((entries.data, (entries.row + row, entries.col + column)), shape=shape)
