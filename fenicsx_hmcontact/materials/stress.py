# SPDX-License-Identifier: LGPL-3.0-or-later
"""The stress of a material as something that stands in a weak form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from ufl.algorithms import expand_derivatives
from ufl.core.expr import Expr

from .. import _compat
from .._kernels import rotation as kernels
from .._kernels.node_cells import inverted_triangles
from ..domain import NodalState
from ..smoothing import NodeCells, dc
from .interface import Bool, Float, Material
from .kinematics import (
    Kinematics,
    check_kinematics,
    midpoint_increment,
    step_deformation,
    strain_increment,
)
from .points import create_points

AT_REST = 1e2 * float(np.finfo(np.float64).eps)
"""Strain that is round-off of means over node cells."""

IN_PLANE = [0, 1, 3]
"""Components of a stress xx, yy, zz, xy that do work in the plane."""


@dataclass(frozen=True)
class PointState:
    """What the n points of a material hold.

    Attributes:
        stress: Effective stress xx, yy, zz, xy [Pa]; shape (n, 4).
        history: Histories; shape (n, m).
        tangent: Derivative of xx, yy, xy by the increments; shape (n, 3, 3 or 4).
        turned: Angle that the material has turned by in the step [rad]; shape (n,).
        flagged: Points where the law had no solution; shape (n,).
        reason: Why.
        by_law: Whether the tangent is the law's; not in a state that was given.
    """

    stress: Float
    history: Float
    tangent: Float
    turned: Float
    flagged: Bool
    reason: str = ""
    by_law: bool = False


class MaterialStress:
    """Effective stress of a material in a body, with its state at the points of the body.

    A term with `stress` in it, on `measure`, makes a `ContactProblem` follow the material: it finds
    the stress before each residual, adds the material's tangent to that of the form, and takes the
    end of a step that converged for the start of the next. Between two steps ``u_n`` must be given
    the values of ``u`` (`ContactProblem.move_mesh` does so).

    Args:
        material: Anything with the methods of `Material`.
        u: Displacement, the unknown.
        u_n: Displacement at the start of the step.
        measure: Where: `node_cells_measure` or ``dx`` without a degree; ``dc(1)`` for a body.
        kinematics: ``"small"``, or ``"finite"``: the mesh then stands at the start of the step, on
            node cells with the measure ``"full"``, where the gradient is F-bar.
        node_cells: Node cells of the mesh; needed where another stress has some.
        name: Name in messages.

    Attributes:
        stress: Effective (Cauchy) stress at the end of the step [Pa]; UFL, shape (2, 2).
        deformation: Deformation of the step, for the weak form of finite strain.
        measure: Measure of terms with the stress; has the degree of the points where it is ``dx``.
        start: State at the start of the step.
        end: State at the end of the step, as of the last residual.
        strained: Largest increment of strain or spin on this rank in it [-].
        booked: Sum over all steps of the integrals of what the histories grew by, on this rank;
            shape (m,).

    Raises:
        ValueError: If kinematics and measure do not go together.

    Note:
        Collective.
    """

    def __init__(
        self,
        material: Material,
        u: fem.Function,
        u_n: fem.Function,
        measure: ufl.Measure = dc,
        *,
        kinematics: Kinematics = "small",
        node_cells: NodeCells | None = None,
        name: str = "stress",
    ) -> None:
        check_kinematics(kinematics, measure)
        self.material, self.u, self.u_n, self.name = material, u, u_n, name
        self.finite = kinematics == "finite"
        self._points = create_points(u, measure, node_cells)
        self.measure, self.node_cells = self._points.measure, self._points.node_cells
        self.deformation = step_deformation(u, u_n, measure)
        self._increments = (
            midpoint_increment(self.deformation.F_bar) if self.finite else strain_increment(u, u_n)
        )
        self._evaluate = self._points.expression(self._increments)
        self._value = self._points.function((3,), name)
        self._tangent = self._points.function((3, len(self._increments)), f"tangent of {name}")
        self._value.operator = self
        xx, yy, xy = (self._value[i] for i in range(3))
        self.stress = ufl.as_matrix(((xx, xy), (xy, yy)))
        n = self._points.n_cells * self._points.n_points
        history = material.initial_history(n)
        tangent = np.zeros((n, 3, len(self._increments)))
        self.start = PointState(
            np.zeros((n, 4)), history, tangent, np.zeros(n), np.zeros(n, np.bool_)
        )
        self.booked = np.zeros(history.shape[1])
        self._last: tuple[Float, Float] | None = None
        self._take(self.start)

    # --- what a user calls ------------------------------------------------------------------

    def set_stress(self, stress: Callable[[Float], Float]) -> None:
        """Give the material a stress to start from.

        At the points of a node cell it is that of the node: a stress that is linear in space then
        is in equilibrium with the weight that belongs to it.

        Args:
            stress: From coordinates, shape (3, n), to xx, yy, zz, xy [Pa], shape (4, n).

        Raises:
            ValueError: If it returns another shape.
        """
        x = np.pad(self._points.coordinates(), ((0, 0), (0, 1)))
        values = np.asarray(stress(x.T), float)
        if values.shape != (4, len(x)):
            raise ValueError(f"the stress of {len(x)} points must have shape (4, {len(x)})")
        self._start_from(values.T.copy(), self.start.history)

    def set_history(self, name: str, values: Callable[[Float], Float]) -> None:
        """Give the material a history to start from, as `set_stress`.

        Args:
            name: One of the material's ``history_names``.
            values: From coordinates, shape (3, n), to values, shape (n,).
        """
        x = np.pad(self._points.coordinates(), ((0, 0), (0, 1)))
        history = self.start.history.copy()
        history[:, self._history(name)] = values(x.T)
        self._start_from(self.start.stress, history)

    def values(self) -> Float:
        """Effective stress xx, yy, zz, xy at the end of the step; (cells, points a cell, 4)."""
        return self._by_cell(self.end.stress)

    def history(self, name: str) -> Float:
        """A history at the end of the step; shape (cells, points a cell)."""
        return self._by_cell(self.end.history)[:, :, self._history(name)]

    def integrals(self) -> dict[str, tuple[float, float]]:
        """Integral of each history over the body, and what the steps booked of it. Collective.

        The first is that of the values at the end of the step, in cells as they are now. The second
        is the sum of what each step added in the cells it began with, exact however nodes come and
        go since.

        Returns:
            Both by the name of the history [m^2], per metre thickness.
        """
        pairs = np.stack((self._integral(self.end.history), self.booked))
        sums = self.u.function_space.mesh.comm.allreduce(pairs)
        names = self.material.history_names
        return {name: (float(a), float(b)) for name, a, b in zip(names, *sums, strict=True)}

    # --- what a problem calls ---------------------------------------------------------------

    @property
    def value(self) -> ufl.Coefficient:
        """The coefficient that stands for xx, yy, xy of the stress."""
        return self._value

    @property
    def functions(self) -> tuple[ufl.Coefficient, ufl.Coefficient]:
        """Coefficients of the stress and of its tangent."""
        return self._value, self._tangent

    def variation(self, du: Expr) -> Expr:
        """Variation of xx, yy, xy by a displacement; UFL, shape (3,)."""
        increments = ufl.as_vector(self._increments)
        return ufl.dot(self._tangent, expand_derivatives(ufl.derivative(increments, self.u, du)))

    def begin(self) -> None:
        """Refuse to start a step whose increments would begin elsewhere than its stress.

        Raises:
            RuntimeError: If ``u_n`` has not followed ``u``, or the mesh not the material.
        """
        if self._last is None:
            return
        last_u, last_u_n = self._last
        stays = self.finite or np.array_equal(self.u_n.x.array, last_u_n)
        stays = stays and not np.array_equal(last_u, last_u_n)
        if self.u.function_space.mesh.comm.allreduce(stays):
            remedy = "call move_mesh(u, u_n)" if self.finite else "set u_n to u"
            raise RuntimeError(
                f"the step starts where the last one did, but not {self.name}: {remedy} after it"
            )

    def begin_elastic(self) -> None:
        """Begin the step with the law's tangent at rest, not with that of the last step's end."""
        self.start = replace(self.start, by_law=False)

    def update(self) -> None:
        """Find stress and tangent at the present displacement.

        Raises:
            FloatingPointError: If a triangle is inverted or the increments are not numbers; on this
                rank alone.
        """
        if self.finite:
            self._check_triangles()
        increments = self._evaluate()
        if not np.all(np.isfinite(increments)):
            raise FloatingPointError(f"the strain increments of {self.name} are not numbers")
        self.strained = float(np.abs(increments).max(initial=0.0))
        if self.start.by_law and self.strained <= AT_REST:
            # At rest all points are elastic: begin with the tangent that the last step ended on.
            self._take(replace(self.start, turned=np.zeros_like(self.start.turned)))
            return
        strain, start = increments[:, :3], self.start
        if not self.finite:
            result = self.material.update(start.stress, strain, start.history)
            stress, tangent = result.stress, result.by_strain[:, IN_PLANE]
            turned = start.turned
        else:
            spin = np.ascontiguousarray(increments[:, 3])
            start_stress = kernels.turned_stress(start.stress, spin)
            result = self.material.update(start_stress, strain, start.history)
            stress = kernels.turned_stress(result.stress, spin)
            tangent = kernels.turned_tangent(
                stress, start_stress, result.by_strain, result.by_stress, spin
            )
            turned = -2.0 * np.arctan(0.5 * spin)
        flagged = np.zeros(len(stress), np.bool_) if result.flagged is None else result.flagged
        self._take(
            PointState(stress, result.history, tangent, turned, flagged, result.reason, True)
        )

    def save(self) -> Any:
        """Return all that steps change, to go back to with `restore`."""
        return self.start, self.end, self._last, self.booked

    def restore(self, saved: Any) -> None:
        """Go back to what `save` returned, bit for bit."""
        self.start, end, self._last, self.booked = saved
        self._take(end)

    def commit(self) -> None:
        """Take the end of the step for the start of the next."""
        self.booked = self.booked + self._integral(self.end.history - self.start.history)
        self.start = self.end
        self._last = self.u.x.array.copy(), self.u_n.x.array.copy()

    def follow_mesh(self) -> None:
        """Turn the axes of the node cells by the mean turn of their points in the last step."""
        if self._last is not None and self.finite and self.node_cells is not None:
            self.node_cells.angles[self._points.cells] += self._by_cell(self.start.turned).mean(1)
        self._last = None

    def nodal_state(self) -> NodalState:
        """What the material holds at the end of the step, by the nodes of its cells. Collective.

        Raises:
            ValueError: If it lives on triangles, which do not outlive a remesh.
        """
        cells = self._points.node_cells
        if cells is None:
            raise ValueError(f"{self.name} lives on triangles; only node cells can be carried over")
        end, comm = self.end, self.u.function_space.mesh.comm
        arrays = {"stress": end.stress, "history": end.history, "tangent": end.tangent}
        nodal = {name: self._by_cell(array) for name, array in arrays.items()}
        booked = comm.allreduce(self.booked).tolist()
        values = {"by law": end.by_law, "booked": booked}
        return NodalState(cells.input_nodes[self._points.cells], nodal, values)

    def set_nodal_state(self, state: NodalState) -> None:
        """Start from a state that `nodal_state` returned, here or on another mesh.

        The displacement is that of the start of a step.
        """
        self.u_n.x.array[:] = self.u.x.array
        n = self._points.n_cells * self._points.n_points
        stress, history, tangent = (
            values.reshape(n, *values.shape[2:])
            for values in (state.nodal[name] for name in ("stress", "history", "tangent"))
        )
        self.start = PointState(
            stress, history, tangent, np.zeros(n), np.zeros(n, np.bool_), "", state.values["by law"]
        )
        # One rank keeps the sum of all.
        first = self.u.function_space.mesh.comm.rank == 0
        self.booked = np.array(state.values["booked"]) * first
        self._last = None
        self._take(self.start)

    def _integral(self, histories: Float) -> Float:
        """Integrals of histories over the cells of this rank; shape (m,)."""
        return np.asarray(self._points.areas() @ histories)

    def _take(self, state: PointState) -> None:
        """Take a state for that of the end of the step."""
        self.end = state
        self._points.write(self._value, state.stress[:, IN_PLANE])
        self._points.write(self._tangent, state.tangent.reshape(-1, 3 * len(self._increments)))

    def _check_triangles(self) -> None:
        """Refuse a displacement that turns a triangle inside out."""
        mesh = self.u.function_space.mesh
        cells, dofs = _compat.cell_nodes(mesh), self.u.function_space.dofmap.list
        step = (self.u.x.array - self.u_n.x.array).reshape(-1, 2)
        turned = np.flatnonzero(inverted_triangles(cells, mesh.geometry.x, dofs, step))
        if turned.size:
            x, y = mesh.geometry.x[cells[turned[0]], :2].mean(axis=0)
            raise FloatingPointError(
                f"{turned.size} triangles are turned inside out, one at x = {x:.6g}, y = {y:.6g}"
            )

    def _start_from(self, stress: Float, history: Float) -> None:
        start = self.start
        self.start = PointState(stress, history, start.tangent, start.turned, start.flagged)
        self._take(self.start)

    def _history(self, name: str) -> int:
        names = self.material.history_names
        if name not in names:
            raise ValueError(f"history {name!r} is none of {', '.join(names) or 'this material'}")
        return names.index(name)

    def _by_cell(self, values: Float) -> Float:
        return values.reshape(self._points.n_cells, self._points.n_points, *values.shape[1:])
