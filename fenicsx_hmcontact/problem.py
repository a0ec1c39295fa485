# SPDX-License-Identifier: LGPL-3.0-or-later
"""Contact for a model of one's own: spaces, UFL residual and conditions stay the user's."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse
import ufl
from dolfinx import fem

from . import _compat
from .contact import (
    Condensation,
    ContactPair,
    Dependence,
    MortarOperator,
    Segments,
    Surface,
    covered_mass,
    gather_surface,
    mortar_operator,
    mortar_segments,
    surface_dofs,
)
from .gap_flow import film_conductance
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


@dataclass(frozen=True)
class InterfaceState:
    """What acts between the surfaces of a pair, at the nodes of the secondary surface.

    Attributes:
        points: Coordinates of the nodes [m]; shape (n, 2).
        normals: Unit normals, from primary to secondary; shape (n, 2).
        pressure: Effective contact pressure [Pa], compression positive; nan at dropped nodes; (n,).
        shear: Shear traction on the secondary surface along the tangent (n_y, -n_x) [Pa]; (n,).
        pore_pressure: Mean pore pressure of both faces [Pa], zero without water; (n,).
        jump: Pore pressure of the secondary less that of the primary face [Pa]; (n,).
    """

    points: npt.NDArray[np.float64]
    normals: npt.NDArray[np.float64]
    pressure: npt.NDArray[np.float64]
    shear: npt.NDArray[np.float64]
    pore_pressure: npt.NDArray[np.float64]
    jump: npt.NDArray[np.float64]


@dataclass
class _Coupling:
    """One pair on the mesh: surfaces, segments, and an operator for each field component."""

    pair: ContactPair
    secondary: Surface
    primary: Surface
    segments: Segments
    operators: dict[tuple[int, int], MortarOperator]
    secondary_dofs: dict[tuple[int, int], npt.NDArray[np.int64]]
    primary_dofs: dict[tuple[int, int], npt.NDArray[np.int64]]
    prescribed: dict[tuple[int, int], npt.NDArray[np.bool_]]


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
        self._couplings = [self._couple(pair) for pair in pairs]
        self._check_pairs()
        self.condensation = Condensation(self._dependences(), self.layout)
        self._film = self._assemble_film()

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
        coupling = next((c for c in self._couplings if c.pair is pair), None)
        if coupling is None:
            raise ValueError(f"pair {pair.name} is none of this problem's")
        normals = coupling.secondary.normals
        n = len(normals)
        mean, jump = np.zeros(n), np.zeros(n)
        film_force = np.zeros(n)
        current = np.concatenate([u.x.array for u in self.unknowns])
        force = np.full((n, 2), np.nan)
        for key, operator in coupling.operators.items():
            if self.layout.block_sizes[key[0]] == 1:
                secondary = self.layout.gather(coupling.secondary_dofs[key], current)
                primary = self.layout.gather(coupling.primary_dofs[key], current)
                jump = operator.kept * (secondary + operator.C @ secondary - operator.H @ primary)
                mean = secondary - 0.5 * jump * ~coupling.prescribed[key]
                mass = covered_mass(coupling.secondary, coupling.segments, operator.kept)
                with np.errstate(invalid="ignore"):
                    film_force = np.where(operator.kept, (mass @ mean) / operator.D, 0.0)
        for (field, component), operator in coupling.operators.items():
            if self.layout.block_sizes[field] == 2:
                r = self.layout.gather(coupling.secondary_dofs[field, component], self._raw)
                with np.errstate(invalid="ignore", divide="ignore"):
                    traction = np.where(operator.kept, r / operator.D, np.nan)
                # The residual is internal less external force: what the primary does to the
                # secondary, solid and water together.
                force[:, component] = traction - film_force * normals[:, component]
        tangents = np.column_stack((normals[:, 1], -normals[:, 0]))
        return InterfaceState(
            coupling.secondary.points,
            normals,
            np.sum(force * normals, axis=1),
            np.sum(force * tangents, axis=1),
            mean,
            jump,
        )

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

    def _couple(self, pair: ContactPair) -> _Coupling:
        mesh = self.unknowns[0].function_space.mesh
        secondary = gather_surface(mesh, pair.facet_tags, pair.secondary, str(pair.secondary))
        primary = gather_surface(mesh, pair.facet_tags, pair.primary, str(pair.primary))
        segments = mortar_segments(secondary, primary, pair.mortar)
        coupling = _Coupling(pair, secondary, primary, segments, {}, {}, {}, {})
        marks = self._constrained.astype(float)
        for field, u in enumerate(self.unknowns):
            components = self.layout.block_sizes[field]
            if components == 1 and pair.flow is None:
                continue
            space = u.function_space
            if space.element.basix_element.degree != 1:
                raise ValueError(
                    f"pair {pair.name}: contact needs P1 fields, {u.name} is of degree "
                    f"{space.element.basix_element.degree}"
                )
            on_secondary = self.layout.global_of_blocks(field, surface_dofs(secondary, space))
            on_primary = self.layout.global_of_blocks(field, surface_dofs(primary, space))
            for component in range(components):
                key = (field, component)
                coupling.secondary_dofs[key] = on_secondary[:, component]
                coupling.primary_dofs[key] = on_primary[:, component]
                prescribed = self.layout.gather(on_secondary[:, component], marks) > 0.0
                coupling.prescribed[key] = prescribed
                # A prescribed displacement is taken out of the coupling, a prescribed pressure is
                # only not tied: its film still sees it.
                coupling.operators[key] = mortar_operator(
                    secondary,
                    primary,
                    segments,
                    prescribed if components > 1 else None,
                    pair.mortar,
                )
        return coupling

    def _check_pairs(self) -> None:
        for coupling in self._couplings:
            name = coupling.pair.name
            displacements = [k for k in coupling.operators if self.layout.block_sizes[k[0]] == 2]
            if not displacements:
                raise ValueError(f"pair {name}: there is no displacement to couple")
            for key in displacements:
                if not coupling.operators[key].kept.any():
                    reason = (
                        "is prescribed at all its nodes; swap secondary and primary"
                        if coupling.prescribed[key].all()
                        else "faces no primary edge within the search radius"
                    )
                    raise ValueError(f"pair {name}: the secondary surface {reason}")
                idle = coupling.secondary.edges[coupling.operators[key].idle_edges]
                if coupling.prescribed[key][idle].all(axis=1).any():
                    raise ValueError(
                        f"pair {name}: neighbouring nodes of the secondary surface are prescribed, "
                        "so that nothing ties the edge between them; swap secondary and primary"
                    )
            n_pressures = len(coupling.operators) - len(displacements)
            if coupling.pair.flow is not None and n_pressures != 1:
                raise ValueError(
                    f"pair {name} has a flow law, which needs one scalar field, the pore pressure; "
                    f"there are {n_pressures}"
                )
            if _aperture(coupling.pair) > 0.0 and self._time_step is None:
                raise ValueError(
                    f"pair {name} has water in a gap of given aperture: the problem needs time_step"
                )

    def _dependences(self) -> list[Dependence]:
        dependences = []
        for coupling in self._couplings:
            for key, operator in coupling.operators.items():
                is_pressure = self.layout.block_sizes[key[0]] == 1
                rows = operator.kept & ~coupling.prescribed[key]
                coefficients = scipy.sparse.hstack((-operator.C, operator.H)).tocsr()[rows]
                open_film = is_pressure and _aperture(coupling.pair) > 0.0
                dependences.append(
                    Dependence(
                        coupling.secondary_dofs[key][rows],
                        np.concatenate((coupling.secondary_dofs[key], coupling.primary_dofs[key])),
                        coefficients,
                        np.full(int(rows.sum()), not open_film),
                    )
                )
        return dependences

    def _assemble_film(self) -> scipy.sparse.csr_matrix:
        """Flow in all gaps of given aperture per unit of the touched condensed unknowns."""
        unknowns = self.condensation.unknowns
        film = scipy.sparse.csr_matrix((unknowns.size, unknowns.size))
        for coupling in self._couplings:
            flow, aperture = coupling.pair.flow, _aperture(coupling.pair)
            if flow is None or aperture == 0.0:
                continue
            for key, operator in coupling.operators.items():
                if self.layout.block_sizes[key[0]] != 1:
                    continue
                conductance = film_conductance(
                    flow,
                    aperture,
                    coupling.secondary,
                    coupling.segments,
                    operator,
                    coupling.prescribed[key],
                ).tocoo()
                dofs = np.concatenate((coupling.secondary_dofs[key], coupling.primary_dofs[key]))
                at = np.searchsorted(unknowns, dofs)
                film = film + scipy.sparse.csr_matrix(
                    (conductance.data, (at[conductance.row], at[conductance.col])), film.shape
                )
        return film.tocsr()

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


def _aperture(pair: ContactPair) -> float:
    """Aperture of a pair's film [m]; zero for a tied pair without a given one."""
    return 0.0 if pair.flow is None or pair.flow.aperture is None else pair.flow.aperture
