# SPDX-License-Identifier: LGPL-3.0-or-later
"""Contact for a model of one's own: spaces, UFL residual and conditions stay the user's."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse
import ufl
from dolfinx import fem

from . import _compat
from .contact import Condensation, ContactPair
from .coupling import Coupling, InterfaceState
from .model import CompiledBlock, CompiledModel, compile_model
from .smoothing import SmoothedTerm, create_node_cells
from .solvers import (
    FieldLayout,
    LinearSolver,
    LocalMatrix,
    NewtonOptions,
    NewtonResult,
    solve_newton,
)


class ContactProblem:
    """A nonlinear problem in UFL with contact between surfaces that need not match.

    Terms on the measure `dc` are smoothed over node cells, all others go through DOLFINx. Pairs act
    on vector fields as displacements and, where they have a flow law, on scalar fields as pore
    pressures; the equation of the latter must be the volume of water per step (`water_balance`).

    Args:
        residual: The residual F in F(u) = 0: one form, with test functions of a
            `ufl.MixedFunctionSpace` where there are several fields, or one form a field. Or the
            ``model`` of a problem on another mesh, to use its compiled forms again.
        unknowns: The function, or the functions in the order of the residual's test functions.
        bcs: Dirichlet conditions. Which unknowns they prescribe must not change; values may.
        pairs: Contact pairs.
        time_step: Length of the step [s]; needed where water flows through a gap of given aperture.
        newton: When Newton's method stops.
        petsc_options: Options of the linear solver, without prefix; MUMPS where None.
        entity_maps: Maps to submeshes that functions in the residual live on.
        replace: With a compiled model: what takes the place of its functions, constants and tags;
            its unknowns and their spaces are replaced by themselves.

    Attributes:
        model: The compiled forms.
        condensation: How secondary unknowns depend on others.
        node_cells: Node cells of the mesh, None where nothing is smoothed.

    Raises:
        ValueError: If forms, fields, pairs and conditions do not fit together; the message names
            what.

    Note:
        Collective.
    """

    def __init__(
        self,
        residual: ufl.Form | Sequence[ufl.Form] | CompiledModel,
        unknowns: fem.Function | Sequence[fem.Function],
        *,
        bcs: Sequence[fem.DirichletBC] = (),
        pairs: Sequence[ContactPair] = (),
        time_step: fem.Constant | float | None = None,
        newton: NewtonOptions = NewtonOptions(),
        petsc_options: Mapping[str, Any] | None = None,
        entity_maps: Sequence[Any] | None = None,
        replace: Mapping[Any, Any] | None = None,
    ) -> None:
        self.unknowns = [unknowns] if isinstance(unknowns, fem.Function) else list(unknowns)
        self.bcs = list(bcs)
        self.newton = newton
        self.comm = self.unknowns[0].function_space.mesh.comm
        self.field_names = [u.name for u in self.unknowns]
        self.layout = FieldLayout([u.function_space for u in self.unknowns])
        self._time_step = time_step
        self._petsc_options = petsc_options
        if isinstance(residual, CompiledModel):
            self.model = residual
        else:
            self.model = compile_model(residual, self.unknowns, entity_maps)
        self._bind(self.model, self.model.successor(self.unknowns, replace or {}))

        self._constrained = self._prescribed_unknowns()
        self._couple(pairs)

        self._raw = np.zeros(self.layout.n_local)
        self._condensed = np.zeros(self.layout.n_local)
        self._linear: LinearSolver | None = None
        self._tangent_inputs: list[npt.NDArray[np.float64]] | None = None

    # --- what a user calls ------------------------------------------------------------------

    def solve(self) -> NewtonResult:
        """Solve for the unknowns, from their current values. Collective.

        Returns:
            Iterations and residuals.

        Raises:
            ConvergenceError: If Newton's method does not converge.
            RuntimeError: If a linear system cannot be solved.
        """
        return solve_newton(self, self.newton)

    @property
    def n_unknowns(self) -> dict[str, int]:
        """Number of unknowns of each field, on all ranks."""
        return {
            u.name: u.function_space.dofmap.index_map.size_global
            * u.function_space.dofmap.index_map_bs
            for u in self.unknowns
        }

    @property
    def n_factorisations(self) -> int:
        """How often the tangent has been assembled and factorised."""
        return 0 if self._linear is None else self._linear.n_factorisations

    def reactions(self, unknown: fem.Function) -> fem.Function:
        """Return what the supports do: the residual at prescribed unknowns, zero elsewhere.

        For a displacement these are the forces of the supports [N], for a pore pressure the change
        of water volume in the step: negative where water leaves [m^3]. Both per metre thickness, of
        the state last solved for.

        Args:
            unknown: One of the unknowns.
        """
        field = self._field(unknown)
        values = np.where(self._constrained, self._condensed, 0.0)
        result = fem.Function(unknown.function_space, name=f"{unknown.name}_reaction")
        result.x.array[:] = self.layout.views(values)[field]
        return result

    def interface(self, pair: ContactPair) -> InterfaceState:
        """Tractions and pore pressures between the surfaces of a pair (Eq. 71). Collective.

        Args:
            pair: One of the problem's pairs.

        Raises:
            ValueError: If the pair is none of this problem's.
        """
        for coupling in self._couplings:
            if coupling.pair is pair:
                current = np.concatenate([u.x.array for u in self.unknowns])
                return coupling.state(current, self._raw)
        raise ValueError(f"pair {pair.name} is none of this problem's")

    # --- building ---------------------------------------------------------------------------

    def _bind(self, model: CompiledModel, successor: Callable[[Any], Any]) -> None:
        """Give the compiled forms the mesh and data of the unknowns."""
        mesh = self.unknowns[0].function_space.mesh
        node_cells = self.node_cells = create_node_cells(mesh) if model.is_smoothed else None
        n = len(self.unknowns)
        spaces = [u.function_space for u in self.unknowns]

        def terms(block: CompiledBlock, *arguments: fem.FunctionSpace) -> list[SmoothedTerm]:
            return [
                SmoothedTerm(form.replaced(successor), compiled, node_cells, list(arguments))
                for form, compiled in block.smoothed
                if node_cells is not None
            ]

        def rest(block: CompiledBlock) -> fem.Form | None:
            if block.rest is None:
                return None
            return _compat.bind_form(block.rest, mesh, successor, model.entity_maps)

        residual, tangent = model.residual, model.tangent
        self._vector_terms = [terms(residual[i], spaces[i]) for i in range(n)]
        self._vector_forms = [rest(block) for block in residual]
        self._matrix = LocalMatrix(
            self.layout,
            [[rest(block) for block in row] for row in tangent],
            [[terms(tangent[i][j], spaces[i], spaces[j]) for j in range(n)] for i in range(n)],
        )
        self._tangent_coefficients = [successor(f) for f in model.tangent_coefficients]

    def _prescribed_unknowns(self) -> npt.NDArray[np.bool_]:
        """Which local unknowns Dirichlet conditions prescribe; shape (n_local,)."""
        marks = np.zeros(self.layout.n_local)
        views = self.layout.views(marks)
        self._bc_fields = []
        for bc in self.bcs:
            field = next(
                (
                    f
                    for f, u in enumerate(self.unknowns)
                    if u.function_space._cpp_object.contains(bc.function_space)
                ),
                None,
            )
            if field is None:
                raise ValueError(
                    "a Dirichlet condition prescribes none of the fields "
                    + ", ".join(self.field_names)
                )
            self._bc_fields.append(field)
            views[field][bc.dof_indices()[0]] = 1.0
        self.layout.add_ghosts_to_owners(marks)
        return marks > 0.0

    def _couple(self, pairs: Sequence[ContactPair]) -> None:
        """Put the pairs on the mesh and build the condensation and the films."""
        self._couplings = [
            Coupling(pair, self.unknowns, self.layout, self._constrained) for pair in pairs
        ]
        for coupling in self._couplings:
            if coupling.aperture > 0.0 and self._time_step is None:
                raise ValueError(
                    f"pair {coupling.pair.name} has water in a gap of given aperture: the problem "
                    "needs time_step"
                )
        dependences = [d for coupling in self._couplings for d in coupling.dependences()]
        self.condensation = Condensation(dependences, self.layout)
        unknowns = self.condensation.unknowns
        self._film = scipy.sparse.csr_matrix((unknowns.size, unknowns.size))
        for coupling in self._couplings:
            self._film = self._film + coupling.film(unknowns)

    # --- the equations, as Newton's method sees them ------------------------------------------

    def residual(self) -> None:
        """Assemble the residual at the current state, as it is and condensed. Collective."""
        self._raw[:] = 0.0
        for view, form, terms in zip(
            self.layout.views(self._raw), self._vector_forms, self._vector_terms, strict=True
        ):
            if form is not None:
                fem.assemble_vector(view, form)
            for term in terms:
                term.add_to_vector(view)
        self.layout.add_ghosts_to_owners(self._raw)
        sums = [float(view.sum()) for view in self.layout.views(self._raw)]
        for name, total in zip(self.field_names, self.comm.allreduce(np.array(sums)), strict=True):
            if not np.isfinite(total):
                raise FloatingPointError(f"the residual of {name} is not a number")
        self._condensed[:] = self._raw
        if self._couplings:
            current = np.concatenate([u.x.array for u in self.unknowns])
            self._condense(self._condensed, self.condensation.relative(current))

    def increment(self) -> npt.NDArray[np.float64]:
        """Assemble the tangent where it has changed, solve, and add the increment. Collective.

        Returns:
            Increment of the owned condensed unknowns.
        """
        self._update_tangent()
        linear = self._linear
        assert linear is not None
        prescribed = self._dirichlet_increment()
        lifted = self._condensed.copy()
        moved = prescribed.copy()
        if self.comm.allreduce(bool(np.any(moved))):
            if self._couplings:
                self.condensation.expand(moved)
            change = self._matrix.multiply(moved)
            self.layout.add_ghosts_to_owners(change)
            if self._couplings:
                self._condense(change, self.condensation.gather(prescribed))
            lifted += change
        owned = self.layout.owned
        b = np.where(self._free, -lifted[owned], prescribed[owned])
        increment = linear.solve(b)
        full = np.zeros(self.layout.n_local)
        full[owned] = increment
        self.layout.update_ghosts(full)
        if self._couplings:
            self.condensation.expand(full)
        for u, view in zip(self.unknowns, self.layout.views(full), strict=True):
            u.x.array[:] += view
        return increment

    def scaled_residuals(self) -> list[float]:
        """Norm of the scaled residual of each field, free unknowns only. Collective."""
        assert self._linear is not None
        r = np.where(self._free, self._linear.scale * self._condensed[self.layout.owned], 0.0)
        squares = np.bincount(self.layout.field_of_owned(), r**2, len(self.unknowns))
        return [float(x) for x in np.sqrt(self.comm.allreduce(squares))]

    def scaled_norms(self, increment: npt.NDArray[np.float64]) -> tuple[float, float]:
        """Norms of a scaled increment and of the scaled unknowns, free ones only. Collective."""
        assert self._linear is not None
        current = np.concatenate([u.x.array for u in self.unknowns])[self.layout.owned]
        pair = np.array(
            [np.sum((x / self._linear.scale)[self._free] ** 2) for x in (increment, current)]
        )
        size, state = np.sqrt(self.comm.allreduce(pair))
        return float(size), float(state)

    def _condense(self, array: npt.NDArray[np.float64], relative: npt.NDArray[np.float64]) -> None:
        """Turn a local residual into T^T r and add the film's flow at condensed unknowns."""
        self.condensation.condense(array)
        if self._film.nnz:
            positions, which = self.condensation.local
            array[positions] += self._dt() * (self._film @ relative)[which]

    def _dt(self) -> float:
        step: Any = getattr(self._time_step, "value", self._time_step)
        return float(step)

    def _dirichlet_increment(self) -> npt.NDArray[np.float64]:
        """What Dirichlet conditions still ask for; local array, zero at other unknowns."""
        result = np.zeros(self.layout.n_local)
        views = self.layout.views(result)
        for field, bc in zip(self._bc_fields, self.bcs, strict=True):
            bc.set(views[field], self.unknowns[field].x.array)
        return result

    def _update_tangent(self) -> None:
        """Assemble and factorise, unless nothing the tangent depends on has changed."""
        inputs = [
            np.array(f.x.array if isinstance(f, fem.Function) else f.value, float).ravel()
            for f in self._tangent_coefficients
        ]
        if self._film.nnz:
            inputs.append(np.array([self._dt()]))
        same = self._tangent_inputs is not None and all(
            np.array_equal(a, b) for a, b in zip(inputs, self._tangent_inputs, strict=True)
        )
        if self.comm.allreduce(not same):
            self._tangent_inputs = inputs
            if self._linear is None:
                self._build_linear_solver()
            self._matrix.assemble()
            self._set_condensed_values()
            assert self._linear is not None
            self._linear.set_values(self._matrix.values)

    def _build_linear_solver(self) -> None:
        """Lay out the condensed matrix: entries of K, of condensation, of films and identity."""
        layout, condensation = self.layout, self.condensation
        touched = condensation.gather(self._constrained.astype(float)) > 0.0
        fixed = touched | condensation.closed
        rows, columns = self._matrix.entries()
        source, factor, extra_rows, extra_columns = condensation.matrix_entries(
            rows, columns, self._constrained, fixed
        )
        keep = ~(self._constrained | condensation.secondary_mask())
        dropped = ~(keep[rows] & keep[columns])
        rows, columns = layout.global_index[rows], layout.global_index[columns]
        rows[dropped] = -1
        columns[dropped] = -1

        film = self._film.tocoo()
        free_entry = ~(fixed[film.row] | fixed[film.col])
        free_entry &= layout.owns(condensation.unknowns[film.row])
        film_rows = condensation.unknowns[film.row[free_entry]]
        film_columns = condensation.unknowns[film.col[free_entry]]

        self._free = ~self._constrained[layout.owned]
        closed = condensation.unknowns[condensation.closed]
        closed = closed[layout.owns(closed)]
        self._free[closed - layout.first] = False
        identity = layout.first + np.flatnonzero(~self._free)

        self._extra = (source, factor, film.data[free_entry], identity.size)
        self._matrix.reserve(source.size + film_rows.size + identity.size)
        self._linear = LinearSolver(
            self.comm,
            layout.owned.size,
            np.concatenate((rows, extra_rows, film_rows, identity)).astype(np.int32),
            np.concatenate((columns, extra_columns, film_columns, identity)).astype(np.int32),
            self._petsc_options,
        )

    def _set_condensed_values(self) -> None:
        source, factor, film, n_identity = self._extra
        first = self._matrix.n_entries
        values = self._matrix.values
        values[first : first + source.size] = factor * values[source]
        first += source.size
        if film.size:
            values[first : first + film.size] = self._dt() * film
        first += film.size
        values[first : first + n_identity] = 1.0

    def _field(self, unknown: fem.Function) -> int:
        for field, u in enumerate(self.unknowns):
            if u is unknown:
                return field
        raise ValueError(f"{unknown.name} is none of the unknowns {', '.join(self.field_names)}")
