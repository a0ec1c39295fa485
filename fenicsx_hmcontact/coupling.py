# SPDX-License-Identifier: LGPL-3.0-or-later
"""A contact pair on the mesh of a problem: its surfaces, its operators, and what acts between."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse
from dolfinx import fem

from .contact import (
    ContactPair,
    Dependence,
    InterfaceState,
    MortarOperator,
    NodeState,
    Segments,
    Surface,
    check_idle_edges,
    covered_mass,
    gather_surface,
    mortar_operator,
    mortar_segments,
    sees_only_backs,
    surface_dofs,
)
from .gap_flow import film_conductance
from .solvers import FieldLayout


@dataclass(frozen=True)
class _Component:
    """Coupling of one field component.

    Attributes:
        field: Number of the field.
        component: Direction of a displacement; 0 for a pore pressure.
        is_pressure: Whether the field is a pore pressure.
        operator: Weights of primary and dropped nodes.
        secondary: Global numbers of the secondary unknowns; (n_s,).
        primary: Global numbers of the primary unknowns; (n_m,).
        prescribed: Which secondary unknowns are prescribed; (n_s,).
    """

    field: int
    component: int
    is_pressure: bool
    operator: MortarOperator
    secondary: npt.NDArray[np.int64]
    primary: npt.NDArray[np.int64]
    prescribed: npt.NDArray[np.bool_]

    @property
    def tied(self) -> npt.NDArray[np.bool_]:
        """Secondary nodes whose unknown is the relative one; (n_s,)."""
        return self.operator.kept & ~self.prescribed


class Coupling:
    """A contact pair on the mesh of a problem. Its data are the same on all ranks.

    Args:
        pair: The pair.
        unknowns: Fields of the problem.
        layout: Their numbering.
        constrained: Which local unknowns are prescribed.

    Attributes:
        pair: The pair.
        aperture: Aperture of the film [m]; zero where the pore pressure is continuous.

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
    ) -> None:
        self.pair = pair
        flow = pair.flow
        aperture = None if flow is None else flow.aperture
        if callable(aperture):
            raise ValueError(
                f"pair {pair.name}: tied surfaces have no gap that an aperture could follow; give "
                "a constant aperture"
            )
        self.aperture = aperture or 0.0
        self._layout = layout
        displacements = [u for u, n in zip(unknowns, layout.block_sizes, strict=True) if n == 2]
        mesh = (displacements or unknowns)[0].function_space.mesh
        self._secondary = gather_surface(mesh, pair.facet_tags, pair.secondary, str(pair.secondary))
        self._primary = gather_surface(mesh, pair.facet_tags, pair.primary, str(pair.primary))
        self._segments: Segments = mortar_segments(self._secondary, self._primary, pair.mortar)
        self._components = [
            part
            for field, u in enumerate(unknowns)
            if layout.block_sizes[field] == 2 or flow is not None
            for part in self._couple(field, u, constrained.astype(float))
        ]
        self._check()

    def numbers(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Global numbers of the unknowns on the secondary and on the primary surface."""
        secondary = np.concatenate([part.secondary for part in self._components])
        primary = np.concatenate([part.primary for part in self._components])
        return secondary, primary

    @property
    def dependences(self) -> list[Dependence]:
        """How the secondary unknowns depend on others (Eq. 64)."""
        return [
            Dependence(
                np.concatenate((part.secondary, part.primary)),
                np.flatnonzero(part.tied),
                scipy.sparse.hstack((-part.operator.C, part.operator.H)).tocsr()[part.tied],
                np.full(int(part.tied.sum()), not (part.is_pressure and self.aperture > 0.0)),
            )
            for part in self._components
        ]

    def film(self, unknowns: npt.NDArray[np.int64]) -> scipy.sparse.csr_matrix:
        """Flow in the gap per unit of the condensed unknowns.

        Args:
            unknowns: Global numbers, ascending, of all that condensation touches; (n,).

        Returns:
            Matrix [m^3/(Pa s) per metre thickness]; shape (n, n).
        """
        film = scipy.sparse.csr_matrix((unknowns.size, unknowns.size))
        if self.pair.flow is None or self.aperture == 0.0:
            return film
        part = self._pressure
        conductance = film_conductance(
            self.pair.flow,
            self.aperture,
            self._secondary,
            self._segments,
            part.operator,
            part.prescribed,
        ).tocoo()
        at = np.searchsorted(unknowns, np.concatenate((part.secondary, part.primary)))
        return scipy.sparse.csr_matrix(
            (conductance.data, (at[conductance.row], at[conductance.col])), film.shape
        )

    def state(
        self, current: npt.NDArray[np.float64], residual: npt.NDArray[np.float64]
    ) -> InterfaceState:
        """Tractions and pore pressures between the surfaces (Eq. 71). Collective.

        Args:
            current: Local array of the unknowns.
            residual: Local array of the residual with what surfaces pass on to each other.
        """
        surface: Surface = self._secondary
        normals = surface.normals
        mean, jump, water = np.zeros((3, len(normals)))
        if self.pair.flow is not None:
            part = self._pressure
            operator = part.operator
            secondary = self._layout.gather(part.secondary, current)
            primary = self._layout.gather(part.primary, current)
            jump = operator.kept * (secondary + operator.C @ secondary - operator.H @ primary)
            mean = secondary - 0.5 * jump * ~part.prescribed
            mass = covered_mass(surface, self._segments, operator.kept)
            np.divide(mass @ mean, operator.D, out=water, where=operator.kept)
        traction = np.full((len(normals), 2), np.nan)
        forces, opposite = np.zeros((len(normals), 2)), np.zeros((len(self._primary.nodes), 2))
        of_water = np.zeros_like(forces)
        paired = np.zeros(len(normals), bool)
        for part in self._components:
            if part.is_pressure:
                continue
            # The residual is internal less external force: what the primary does to the secondary,
            # solid and water together.
            operator, axis = part.operator, part.component
            total = np.where(operator.kept, self._layout.gather(part.secondary, residual), 0.0)
            np.divide(total, operator.D, out=traction[:, axis], where=operator.kept)
            traction[:, axis] -= water * normals[:, axis]
            forces[:, axis] = total + operator.C.T @ total
            pressed = np.where(operator.kept, water * operator.D * normals[:, axis], 0.0)
            of_water[:, axis] = pressed + operator.C.T @ pressed
            opposite[:, axis] = -(operator.H.T @ total)
            paired |= operator.kept
        unpaired = np.where(paired, 0.0, np.nan)
        return InterfaceState(
            surface.points,
            normals,
            _along(traction, normals),
            _along(traction, np.column_stack((normals[:, 1], -normals[:, 0]))),
            mean,
            jump,
            self.aperture + unpaired,
            np.zeros(len(normals)),
            np.where(paired, NodeState.STICKING, NodeState.UNPAIRED).astype(np.int8),
            self._components[0].operator.D,
            forces,
            float(self.aperture * self._components[0].operator.D.sum()),
            self._primary.points,
            opposite,
            of_water,
        )

    @property
    def _pressure(self) -> _Component:
        return next(part for part in self._components if part.is_pressure)

    def _couple(
        self, field: int, u: fem.Function, marks: npt.NDArray[np.float64]
    ) -> list[_Component]:
        space, layout = u.function_space, self._layout
        if space.element.basix_element.degree != 1:
            raise ValueError(
                f"pair {self.pair.name}: contact needs P1 fields, {u.name} is of degree "
                f"{space.element.basix_element.degree}"
            )
        is_pressure = layout.block_sizes[field] == 1
        blocks = [surface_dofs(surface, space) for surface in (self._secondary, self._primary)]
        for surface, dofs in zip((self._secondary, self._primary), blocks, strict=True):
            if dofs.min() < 0:
                remedy = ": leave flow out, or let its body be porous" if is_pressure else ""
                raise ValueError(
                    f"pair {self.pair.name}: surface {surface.name} carries no {u.name}{remedy}"
                )
        on_secondary, on_primary = (layout.global_of_blocks(field, dofs) for dofs in blocks)
        parts = []
        for component, (secondary, primary) in enumerate(
            zip(on_secondary.T, on_primary.T, strict=True)
        ):
            prescribed = layout.gather(secondary, marks) > 0.0
            # A prescribed displacement is taken out of the coupling, a prescribed pressure is only
            # not tied: its film still sees it.
            dropped = None if is_pressure else prescribed
            operator = mortar_operator(
                self._secondary, self._primary, self._segments, dropped, self.pair.mortar
            )
            parts.append(
                _Component(field, component, is_pressure, operator, secondary, primary, prescribed)
            )
        return parts

    def _check(self) -> None:
        name = self.pair.name
        displacements = [part for part in self._components if not part.is_pressure]
        if not displacements:
            raise ValueError(f"pair {name}: there is no displacement to couple")
        for part in displacements:
            if not part.operator.kept.any():
                reason = (
                    "is prescribed at all its nodes; swap secondary and primary"
                    if part.prescribed.all()
                    else "turns its back on the primary surface"
                    if sees_only_backs(self._secondary, self._primary, self.pair.mortar)
                    else "faces no primary edge within the search radius"
                )
                raise ValueError(f"pair {name}: the secondary surface {reason}")
            check_idle_edges(name, self._secondary, part.operator, part.prescribed)
        for part in self._components:
            if part.is_pressure and self.aperture == 0.0 and not part.tied.any():
                raise ValueError(
                    f"pair {name}: the pore pressure is prescribed on the whole secondary surface, "
                    "so that nothing ties it; swap secondary and primary"
                )
        n_pressures = len(self._components) - len(displacements)
        if self.pair.flow is not None and n_pressures != 1:
            raise ValueError(
                f"pair {name} has a flow law, which needs one scalar field, the pore pressure; "
                f"there are {n_pressures}"
            )


def _along(
    force: npt.NDArray[np.float64], direction: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Component of a force along a direction; an unknown component across it does not matter."""
    return np.sum(np.where(direction == 0.0, 0.0, force * direction), axis=1)
