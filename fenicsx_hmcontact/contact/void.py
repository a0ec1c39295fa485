# SPDX-License-Identifier: LGPL-3.0-or-later
"""The void between two surfaces, by nodes: strips where they face each other, and pools.

Strips and pools add up to all that lies between the mouths of the void, and what they grow by to
what that grows by, however far the surfaces slide.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from .linearisation import GeometryDerivatives
from .mortar import MortarOperator, Segments
from .pools import Mouths, Pools, joints, mouths, open_ends, swept
from .strips import Strips, strip_ends
from .surface import Surface

Float = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]


class Void:
    """Volumes between two surfaces at the secondary nodes, per metre of thickness.

    Args:
        now: Both surfaces, where segments and coupling see them.
        before: Both at the start of the step.
        segments: Where they face each other.
        operator: Coupling of the displacements.
        wet: Secondary nodes that have a part, among them all that the coupling keeps; shape (n_s,).
        opening: Gap of each secondary node at the start of the step [m], by which pools are shared;
            shape (n_s,). None if pools do not belong to the void: other water stands there.
        derivatives: Derivatives of the coupling; None where no derivative is asked for.

    Attributes:
        volumes: Part of each node [m^2]; shape (n_s,).
        growth: What it grew by in the step; shape (n_s,).
        of_points: Derivative of the volumes with respect to the coordinates of both surfaces where
            the points that face each other stay [m]; shape (n_s, 2 n_s + 2 n_m).
        pressing: Forces of the water on the nodes of both surfaces per unit of the nodes'
            pressures, transposed [m]. It is the same but at mouths, beyond which other water
            presses.
    """

    def __init__(
        self,
        now: tuple[Surface, Surface],
        before: tuple[Surface, Surface],
        segments: Segments,
        operator: MortarOperator,
        wet: Bool,
        opening: Float | None,
        derivatives: GeometryDerivatives | None,
    ) -> None:
        self._now, self._before = now, before
        ends = self._ends = strip_ends(now, segments, wet)
        between = [] if opening is None else joints(now, ends)
        self._open = open_ends(ends, between)
        strips = Strips(now, before, ends, self._open, segments, operator, wet, derivatives)
        self._parts: list[Strips | Pools] = [strips]
        if opening is not None and between:
            self._parts.append(Pools(now, before, ends, between, strips, wet, opening))
        self.volumes: Float = np.sum([part.volumes for part in self._parts], axis=0)
        self.growth: Float = np.sum([part.growth for part in self._parts], axis=0)
        self.of_points = _total([part.of_points for part in self._parts])
        self.pressing = _total([part.pressing for part in self._parts])

    @cached_property
    def mouths(self) -> Mouths:
        """Where it ends."""
        return mouths(self._now, self._ends, self._open)

    def swept(self, mouths: Mouths) -> float | None:
        """Volume that it took in at its mouths where surfaces slid past each other [m^2].

        Args:
            mouths: Those at the start of the step.

        Returns:
            The volume; None if it has other mouths now.
        """
        return swept(self._before, mouths, self.mouths)

    def growth_derivative(self) -> csr_array:
        """Derivative of the growth with respect to the coordinates; shape as `of_points`."""
        return _total([part.growth_derivative() for part in self._parts])

    def force_derivative(self, pressures: Float) -> csr_array:
        """Derivative of the forces of water of given pressures, pressing^T p, by the coordinates.

        Args:
            pressures: At the secondary nodes [Pa]; shape (n_s,).

        Returns:
            Matrix [Pa]; shape (2 n_s + 2 n_m, 2 n_s + 2 n_m).
        """
        return _total([part.force_derivative(pressures) for part in self._parts])


def _total(matrices: list[csr_array]) -> csr_array:
    first, *others = matrices
    return csr_array(sum(others, start=first))
