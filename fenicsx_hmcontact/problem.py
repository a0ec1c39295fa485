# SPDX-License-Identifier: LGPL-3.0-or-later
"""Contact for a model of one's own: spaces, UFL residual and conditions stay the user's."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import scipy.sparse
import ufl
from dolfinx import fem

from . import _compat
from .condensed import CondensedMatrix
from .contact import Condensation, ContactPair, Dependence, InterfaceState, Tied
from .coupling import Coupling
from .diagnosis import free_motions
from .domain import Domain, NodalState, function_state, set_function
from .free_water import FreeWater
from .materials import MaterialStress
from .model import CompiledBlock, CompiledModel, compile_model, integration_mesh
from .sliding import SlidingCoupling
from .smoothing import NodeCells, PointFunction, SmoothedTerm, create_node_cells
from .solvers import (
    ConvergenceError,
    FieldLayout,
    LinearSolver,
    LocalMatrix,
    NewtonOptions,
    NewtonResult,
    SingularSystemError,
    relax,
    solve_newton,
)
from .solvers.condition import condition_number
from .solvers.newton import System

SIDES = "secondary", "primary"
"""Surfaces of a pair."""

RUNAWAY = 10.0
"""Strain in a step that is none: beside such a change any residual of bounded forces is small."""


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
        time_step: Length of the step [s], the constant that stands in the residual; needed where
            water flows through a gap of given aperture.
        newton: When Newton's method stops.
        petsc_options: Options of the linear solver, without prefix; MUMPS where None.
        entity_maps: Maps to submeshes that functions in the residual live on, such as a pore
            pressure in porous bodies alone (`Domain.submesh`); with a compiled model those of the
            new meshes, its own where None.
        domain: Where the mesh comes from: errors then name its bodies.
        replace: With a compiled model: what takes the place of its functions, constants and tags;
            its unknowns and their spaces are replaced by themselves.

    Attributes:
        model: The compiled forms.
        entity_maps: Maps to submeshes.
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
        time_step: fem.Constant | None = None,
        newton: NewtonOptions = NewtonOptions(),
        petsc_options: Mapping[str, Any] | None = None,
        entity_maps: Sequence[Any] | None = None,
        domain: Domain | None = None,
        replace: Mapping[Any, Any] | None = None,
    ) -> None:
        self.unknowns = [unknowns] if isinstance(unknowns, fem.Function) else list(unknowns)
        self.bcs = list(bcs)
        self._domain = domain
        self.newton = newton
        if entity_maps is None and isinstance(residual, CompiledModel):
            entity_maps = residual.entity_maps
        self.entity_maps = tuple(entity_maps or ())
        self._mesh = integration_mesh(self.unknowns, self.entity_maps)
        self.comm = self._mesh.comm
        names = [u.name for u in self.unknowns]
        repeated = len(set(names)) < len(names)
        self.field_names = [f"{n} {i}" if repeated else n for i, n in enumerate(names)]
        self.layout = FieldLayout([u.function_space for u in self.unknowns])
        if time_step is not None and not isinstance(time_step, fem.Constant):
            raise ValueError("time_step must be the fem.Constant that stands in the residual")
        self._time_step = time_step
        self._points = self._mesh.geometry.x.copy()
        if isinstance(residual, CompiledModel):
            self.model = residual
        else:
            self.model = compile_model(residual, self.unknowns, self.entity_maps)
        self._bind(self.model, self.model.successor(self.unknowns, replace or {}))

        self._constrained = self._prescribed_unknowns()
        self._couple(pairs)

        self._raw = np.zeros(self.layout.n_local)
        self._diagonal = np.ones(self.layout.n_local)
        self._condensed = np.zeros(self.layout.n_local)
        self._petsc_options = petsc_options
        self._system = self._new_system()
        self._moved = self._damped = False
        self._tangent_inputs: list[npt.NDArray[np.float64]] | None = None

    # --- what a user calls ------------------------------------------------------------------

    def solve(self) -> NewtonResult:
        """Solve for the unknowns, from their current values. Collective.

        The end of a step that converged is the start of the next: sliding pairs measure slip from
        there. A step that failed leaves everything as it was.

        Returns:
            Iterations and residuals.

        Raises:
            ConvergenceError: If Newton's method does not converge. The unknowns are then as before.
            SingularSystemError: If nothing holds a body or a pore pressure; it says which.
            RuntimeError: If a linear system cannot be solved, the mesh has moved, or the start of
                the step has not followed the last one.
        """
        self._check_mesh()
        for stress in self._stresses:
            stress.begin()
        for u in self.unknowns:
            u.x.scatter_forward()
        state = self.save()
        self._start = self._current()
        try:
            result = self._attempt(state)
        except Exception:
            self.restore(state)
            raise
        for follower in self._followers:
            follower.commit()
        return result

    def move_mesh(self, u: fem.Function, u_n: fem.Function) -> None:
        """Let the mesh follow a step that converged: finite strain starts the next one there.

        The nodes move by ``u - u_n``, ``u_n`` takes the values of ``u``, and node cells are built
        anew on axes that have turned with the material. Collective.

        Args:
            u: Displacement, one of the unknowns; P1.
            u_n: Displacement at the start of the step.

        Raises:
            ValueError: If ``u`` is not P1 on the mesh.
            RuntimeError: If the mesh has been moved by others.
        """
        self._check_mesh()
        space = self.unknowns[self._field(u)].function_space
        if space.element.basix_element.degree != 1 or space.mesh != self._mesh:
            raise ValueError(f"the mesh follows a P1 displacement, {u.name} is none")
        u.x.scatter_forward()
        u_n.x.scatter_forward()
        nodes, dofs = _compat.cell_nodes(self._mesh).ravel(), space.dofmap.list.ravel()
        step = (u.x.array - u_n.x.array).reshape(-1, 2)
        points = self._points.copy()
        points[nodes, :2] = self._points[nodes, :2] + step[dofs]
        u_n.x.array[:] = u.x.array
        for stress in self._stresses:
            stress.follow_mesh()
        self._place_mesh(points)

    def save(self) -> Any:
        """Copy all that `solve` and `move_mesh` change but ``u_n``, to go back to by `restore`."""
        arrays = [u.x.array.copy() for u in self.unknowns]
        followers = [follower.save() for follower in self._followers]
        angles = None if self.node_cells is None else self.node_cells.angles.copy()
        return arrays, self._raw.copy(), self._condensed.copy(), followers, self._points, angles

    def restore(self, state: Any) -> None:
        """Go back to what `save` returned, bit for bit. Collective.

        Steps that have converged since are undone as well.

        Args:
            state: The saved state, of this problem.
        """
        arrays, self._raw[:], self._condensed[:], followers, points, angles = state
        for u, array in zip(self.unknowns, arrays, strict=True):
            u.x.array[:] = array
        for follower, saved in zip(self._followers, followers, strict=True):
            follower.restore(saved)
        self._place(self._current())
        if points is not self._points:
            if self.node_cells is not None:
                self.node_cells.angles[:] = angles
            self._place_mesh(points)

    def integrals(self) -> dict[str, tuple[float, float]]:
        """Integrals of all histories of materials, as `MaterialStress.integrals`. Collective."""
        return {
            f"{stress.name} {name}": pair
            for stress in self._stresses
            for name, pair in stress.integrals().items()
        }

    def nodal_state(self) -> dict[str, NodalState]:
        """What fields, materials and pairs hold between two steps, by nodes. Collective.

        It is all that the next step starts from, with the place of the mesh.

        Raises:
            ValueError: If a field is not P1, or a material lives on triangles.
        """
        states = {
            f"field {name}": function_state(u)
            for name, u in zip(self.field_names, self.unknowns, strict=True)
        }
        for name, stress in self._named("material", self._stresses).items():
            states[name] = stress.nodal_state()
        if self.node_cells is not None:
            angles = {"angle": self.node_cells.angles.copy()}
            states["axes"] = NodalState(self.node_cells.input_nodes, angles)
        for name, coupling in self._named("pair", self._sliding).items():
            sides = zip(SIDES, coupling.nodal_states(), strict=True)
            states |= {f"{name}, {side}": state for side, state in sides}
        return states

    def set_nodal_state(self, states: Mapping[str, NodalState]) -> None:
        """Start from what `nodal_state` returned, on this mesh or another. Collective.

        What decides on the last digits alone, as the order of elimination, begins anew: two
        problems with the same state go on alike.

        Args:
            states: The states at the nodes of this mesh, which stands at the start of a step.
        """
        for name, u in zip(self.field_names, self.unknowns, strict=True):
            set_function(u, states[f"field {name}"])
        for name, stress in self._named("material", self._stresses).items():
            stress.set_nodal_state(states[name])
        if self.node_cells is not None:
            self.node_cells.angles[:] = states["axes"].nodal["angle"]
            self.node_cells.follow()
        current = self._current()
        for name, coupling in self._named("pair", self._sliding).items():
            secondary, primary = (states[f"{name}, {side}"] for side in SIDES)
            coupling.set_nodal_states(secondary, primary, current)
        self._place(current)
        self._tangent_inputs = None
        if self._system.linear is not None:
            self._system = self._new_system()

    def gap_volumes(self) -> dict[str, float]:
        """Volume of the gap of each sliding pair with water, at the start of the step [m^3/m]."""
        return {
            coupling.pair.name: coupling.water.volume
            for coupling in self._sliding
            if coupling.water is not None
        }

    @property
    def settled(self) -> bool:
        """Whether the last residual was that of the same contact sets as the one before."""
        return all(coupling.settled for coupling in self._sliding)

    @property
    def sets(self) -> bytes:
        """The contact sets that the last residual belongs to."""
        return b"".join(coupling.status.signature for coupling in self._sliding)

    @property
    def n_unknowns(self) -> dict[str, int]:
        """Number of unknowns of each field, on all ranks."""
        maps = [u.function_space.dofmap for u in self.unknowns]
        return {
            name: dofmap.index_map.size_global * dofmap.index_map_bs
            for name, dofmap in zip(self.field_names, maps, strict=True)
        }

    @property
    def n_factorisations(self) -> int:
        """How often the tangent has been assembled and factorised."""
        return self._system.n_factorisations

    def condition_number(self) -> float:
        """Condition number, in the 2-norm, of the normalised matrix last solved with. Collective.

        After a step in which the solid crept it is that without dashpots, where the step ended.
        That of the free unknowns, scaled to unit diagonal (Eq. 95): exact up to some thousand
        unknowns, estimated to about 1 % beyond; infinite where the matrix is singular.

        Raises:
            RuntimeError: If no system has been solved yet, or the linear solver fails.
        """
        if self._system.linear is None:
            raise RuntimeError("the condition number is that of a system, and none has been solved")
        if self._damped:
            self._update_tangent()
        return condition_number(self._linear, self._free)

    def bulk_tangent(self) -> tuple[scipy.sparse.csr_array, npt.NDArray[np.bool_]]:
        """Tangent of the bodies alone at the current state, gathered, to look at. Collective.

        Returns:
            The matrix without contact and conditions, and which unknowns are prescribed, in the
            global numbering of the layout, on every rank; shapes (n, n) and (n,).
        """
        self._matrix.assemble()
        self._tangent_inputs = None
        numbers, n = self.layout.global_index, self.layout.n_global
        rows, columns = (numbers[k] for k in self._matrix.entries())
        values = self._matrix.values[: self._matrix.n_entries]
        mine = rows, columns, values, self._constrained[self.layout.owned]
        parts = zip(*self.comm.allgather(mine), strict=True)
        rows, columns, values, prescribed = (np.concatenate(part) for part in parts)
        return scipy.sparse.csr_array((values, (rows, columns)), shape=(n, n)), prescribed

    def reactions(self, unknown: fem.Function) -> fem.Function:
        """Return what the supports do: the residual at prescribed unknowns, zero elsewhere.

        For a displacement these are the forces of the supports [N], for a pore pressure the change
        of water volume in the step: negative where water leaves [m^3], through drained faces or
        into free water around a gap. Both per metre thickness, of the state last solved for.
        Collective.

        Args:
            unknown: One of the unknowns.
        """
        field = self._field(unknown)
        values = np.where(self._constrained, self._condensed, 0.0)
        wetted = self._free_water.numbers[self._free_water.wetted]
        if wetted.size:
            received = self._raw.copy()
            self.condensation.transmit(received)
            wet = np.isin(self.layout.global_index, wetted)
            values[wet] = received[wet]
        result = fem.Function(unknown.function_space, name=f"{unknown.name}_reaction")
        result.x.array[:] = self.layout.views(values)[field]
        return result

    def bulk_forces(self, unknown: fem.Function) -> fem.Function:
        """Return the residual of one balance at the present state, without contact. Collective.

        For a displacement these are the forces that hold the bodies as they are [N], beyond loads
        and weight.

        Args:
            unknown: One of the unknowns.
        """
        state = self.save()
        self._assemble_bodies()
        result = fem.Function(unknown.function_space, name=f"{unknown.name}_force")
        result.x.array[:] = self.layout.views(self._raw)[self._field(unknown)]
        self.restore(state)
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
                residual = self._raw.copy()
                self.condensation.transmit(residual)
                if isinstance(coupling, SlidingCoupling):
                    return coupling.state(residual)
                return coupling.state(self._current(), residual)
        raise ValueError(f"pair {pair.name} is none of this problem's")

    @property
    def _followers(self) -> list[SlidingCoupling | MaterialStress]:
        """What has a state at the start of the step."""
        return [*self._sliding, *self._stresses]

    def _place_mesh(self, points: npt.NDArray[np.float64]) -> None:
        """Put the nodes of the mesh somewhere; shape (n_nodes, 3)."""
        self._points = points
        self._mesh.geometry.x[:] = points
        if self.node_cells is not None:
            self.node_cells.follow()
        self._tangent_inputs = None

    def _check_mesh(self) -> None:
        """Refuse a mesh that others have moved."""
        moved = not np.array_equal(self._points, self._mesh.geometry.x)
        if self.comm.allreduce(moved):
            raise RuntimeError(
                "the mesh has moved since the problem was made: make a new one, "
                "ContactProblem(problem.model, ...), or move it by move_mesh"
            )

    # --- building ---------------------------------------------------------------------------

    @staticmethod
    def _named[P: (MaterialStress, SlidingCoupling)](kind: str, parts: list[P]) -> dict[str, P]:
        """Materials or pairs by their names, numbered where these repeat."""
        names = [p.name if isinstance(p, MaterialStress) else p.pair.name for p in parts]
        return {
            f"{kind} {name}" + (f" {i}" if names.count(name) > 1 else ""): part
            for i, (name, part) in enumerate(zip(names, parts, strict=True))
        }

    def _new_system(self) -> CondensedMatrix:
        """The matrix that is solved with, not laid out yet."""
        matrices = self._matrix, self.condensation
        return CondensedMatrix(self.layout, *matrices, self._constrained, self._petsc_options)

    def _bind(self, model: CompiledModel, successor: Callable[[Any], Any]) -> None:
        """Give the compiled forms the mesh and data of the unknowns."""
        mesh = self._mesh
        self._stresses: list[MaterialStress] = [successor(stress) for stress in model.stresses]
        node_cells = self.node_cells = self._common_node_cells(model)
        n = len(self.unknowns)
        spaces = [u.function_space for u in self.unknowns]

        def terms(block: CompiledBlock, *arguments: fem.FunctionSpace) -> list[SmoothedTerm]:
            return [
                SmoothedTerm(form.replaced(successor), compiled, node_cells, list(arguments))
                for form, compiled in block.smoothed
                if node_cells is not None
            ]

        def rest(block: CompiledBlock, *fields: int) -> fem.Form | None:
            if block.rest is None:
                return None
            names = [self.field_names[field] for field in fields]
            return _compat.bind_form(block.rest, mesh, successor, self.entity_maps, names)

        residual, tangent = model.residual, model.tangent
        self._vector_terms = [terms(residual[i], spaces[i]) for i in range(n)]
        self._vector_forms = [rest(residual[i], i) for i in range(n)]
        self._matrix = LocalMatrix(
            self.layout,
            [[rest(tangent[i][j], i, j) for j in range(n)] for i in range(n)],
            [[terms(tangent[i][j], spaces[i], spaces[j]) for j in range(n)] for i in range(n)],
        )
        self._tangent_coefficients = [successor(f) for f in model.tangent_coefficients]

    def _common_node_cells(self, model: CompiledModel) -> NodeCells | None:
        """Node cells of the mesh: those that stresses of materials live in, where there are any."""
        if not model.is_smoothed:
            return None
        given = {s.name: s.node_cells for s in self._stresses if s.node_cells is not None}
        if len({id(node_cells) for node_cells in given.values()}) > 1:
            raise ValueError(
                f"{' and '.join(given)} have node cells of their own: give all of them the "
                "node_cells of the first"
            )
        if not given:
            return create_node_cells(self._mesh, self.entity_maps)
        node_cells = next(iter(given.values()))
        node_cells.entity_maps[:] = self.entity_maps
        return node_cells

    def _prescribed_unknowns(self) -> npt.NDArray[np.bool_]:
        """Which local unknowns Dirichlet conditions prescribe; shape (n_local,)."""
        marks = np.zeros(self.layout.n_local)
        views = self.layout.views(marks)
        self._bc_fields = []
        for bc in self.bcs:
            fields = [
                f
                for f, u in enumerate(self.unknowns)
                if u.function_space._cpp_object.contains(bc.function_space)
            ]
            if not fields:
                raise ValueError(
                    "a Dirichlet condition prescribes none of the fields "
                    + ", ".join(self.field_names)
                )
            self._bc_fields.append(fields)
            for field in fields:
                views[field][bc.dof_indices()[0]] = 1.0
        self.layout.add_ghosts_to_owners(marks)
        return marks > 0.0

    def _couple(self, pairs: Sequence[ContactPair]) -> None:
        """Put the pairs on the mesh and build the condensation and the films."""
        self._wet: list[Dependence] = []
        arguments = self.unknowns, self.layout
        tied = [
            Coupling(pair, *arguments, self._constrained)
            for pair in pairs
            if isinstance(pair.friction, Tied)
        ]
        # A node on the secondary surfaces of two pairs is one in the first, and dropped in others.
        taken = np.zeros_like(self._constrained)
        for coupling in tied:
            taken |= np.isin(self.layout.global_index, coupling.numbers()[0])
        self._sliding = []
        for pair in pairs:
            if not isinstance(pair.friction, Tied):
                self._sliding.append(
                    SlidingCoupling(pair, *arguments, self._constrained, taken.copy(), self._dt)
                )
                taken |= np.isin(self.layout.global_index, self._sliding[-1].numbers()[0])
        self._couplings: list[Coupling | SlidingCoupling] = [*tied, *self._sliding]
        numbers = [coupling.numbers() for coupling in self._couplings]
        none = np.zeros(0, np.int64)
        secondary = np.concatenate([none, *(secondary for secondary, _ in numbers)])
        known, count = np.unique(secondary, return_counts=True)
        for water in (c.water for c in self._sliding if c.water is not None):
            meeting = np.isin(water.numbers[0], known[count > 1])
            water.meeting[: meeting.size] = meeting
        filled = [c.pair for c in tied if c.aperture > 0.0] + [c.pair for c in self._sliding]
        for pair in filled:
            if pair.flow is not None and self._time_step is None:
                raise ValueError(
                    f"pair {pair.name} has water in its gap: the problem needs time_step"
                )
        tied_numbers = [n for coupling in tied for n in coupling.numbers()]
        held = np.flatnonzero(self._constrained)
        self._free_water = FreeWater(
            [coupling.water for coupling in self._sliding if coupling.water is not None],
            np.concatenate([self._everywhere(held), *tied_numbers]),
            self.layout,
        )
        self.condensation = Condensation(
            np.concatenate([self._free_water.numbers, *(n for pair in numbers for n in pair)]),
            np.concatenate((self._free_water.numbers, secondary)),
            self.layout,
        )
        self.condensation.update(self._dependences)
        unknowns = self.condensation.unknowns
        self._film = scipy.sparse.csr_matrix((unknowns.size, unknowns.size))
        for coupling in tied:
            self._film = self._film + coupling.film(unknowns)

    @property
    def _dependences(self) -> list[Dependence]:
        """How the unknowns of all pairs depend on each other, at the current state of the pairs."""
        return [d for coupling in self._couplings for d in coupling.dependences] + self._wet

    def _everywhere(self, local: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Global numbers of the local unknowns of all ranks. Collective."""
        numbers = self.layout.global_index[local].astype(np.int64)
        return np.unique(np.concatenate(self.comm.allgather(numbers)))

    # --- the equations, as Newton's method sees them ------------------------------------------

    def residual(self, damped: bool = False) -> None:
        """Assemble the residual at the current state, as it is and condensed. Collective.

        Args:
            damped: Whether the last increment was not taken as a whole.

        Raises:
            FloatingPointError: If it is not a number, a contact surface is folded, or a triangle
                is inverted.
        """
        self._assemble_bodies()
        self._condensed[:] = self._raw
        if not self._couplings:
            return
        current, condensation = self._current(), self.condensation
        if self._sliding:
            self._assemble_tangent()
            try:
                self._place(current)
            except ValueError as error:
                raise FloatingPointError(str(error)) from error
            for coupling in self._sliding:
                numbers, forces = coupling.water_forces()
                self._add(numbers, -forces)
            transmitted = self._raw.copy()
            condensation.transmit(transmitted)
            for coupling in self._sliding:
                coupling.update(transmitted, self._diagonal, self._moved, damped)
            for coupling in self._sliding:
                self._add(*coupling.volumes())
            # Films of several pairs may feed the same node.
            transmitted = self._raw.copy()
            condensation.transmit(transmitted)
            for coupling in self._sliding:
                coupling.follow_water(transmitted, self._diagonal, self._moved)
            condensation.constrain(self._dependences)
        added = condensation.offset
        if self._film.nnz:
            added = added + self._dt() * (self._film @ condensation.relative(current))
        condensation.condense(self._condensed, added)

    def _assemble_bodies(self) -> None:
        """Assemble the residual of the bodies at the current state. Collective."""
        self._update_materials()
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

    def _place(self, current: npt.NDArray[np.float64]) -> None:
        """Couple the surfaces of sliding pairs where they are, and wet what they have left."""
        for coupling in self._sliding:
            coupling.place(current)
        self._wet = []
        if self._free_water.numbers.size:
            self._wet = [self._free_water.dependence(current, self._diagonal)]
        self.condensation.couple(self._dependences)

    def _update_materials(self) -> None:
        """Find the stresses of all materials at the current state. Collective."""
        message = ""
        for stress in self._stresses:
            try:
                stress.update()
            except FloatingPointError as error:
                message = message or str(error)
        if self._stresses:
            message = next(filter(None, self.comm.allgather(message)), "")
        if message:
            raise FloatingPointError(message)

    def _check_materials(self, history: list[float]) -> None:
        """Refuse a step that ends where a material has no solution, or runs away. Collective."""
        for stress in self._stresses:
            strained = self.comm.allreduce(stress.strained, MPI.MAX)
            if strained > RUNAWAY:
                message = f"nothing resists: {stress.name} would be strained by {strained:.1e}"
                raise ConvergenceError(message, history)
            flagged = self.comm.allreduce(int(stress.end.flagged.sum()))
            if flagged:
                raise ConvergenceError(
                    f"{flagged} points of {stress.name}: {stress.end.reason}", history
                )

    def _attempt(self, state: Any) -> NewtonResult:
        """Solve from the tangents of the last step, or from elastic ones where those mislead.

        Where both fail the solid creeps, if it may.
        """
        attempts = [(solve_newton, False)]
        if any(stress.start.by_law for stress in self._stresses):
            attempts.append((solve_newton, True))
        if self.newton.relaxation:
            if max(self.layout.block_sizes) == 1:
                raise ValueError(
                    "relaxation lets a solid creep: it needs a displacement, not only "
                    + ", ".join(self.field_names)
                )
            attempts.append((relax, False))
        *others, (method, elastic) = attempts
        for earlier, from_elastic in others:
            try:
                return self._iterate(earlier, from_elastic)
            except (ConvergenceError, SingularSystemError):
                self.restore(state)
        return self._iterate(method, elastic)

    def _iterate(
        self, method: Callable[[System, NewtonOptions], NewtonResult], elastic: bool
    ) -> NewtonResult:
        """Solve by a method, maybe from elastic tangents; a singular system names what is free."""
        if elastic:
            for stress in self._stresses:
                stress.begin_elastic()
        self._moved = False
        for coupling in self._sliding:
            coupling.reset()
        try:
            result = method(self, self.newton)
            self._check_materials([max(residuals) for residuals in result.history])
            return result
        except SingularSystemError as error:
            motions = free_motions(self, self._domain)
            raise SingularSystemError("; ".join(motions) or str(error)) from error

    def _add(self, numbers: npt.NDArray[np.int64], values: npt.NDArray[np.float64]) -> None:
        """Add what water does to the residual, at global numbers of unknowns."""
        mine = self.layout.owns(numbers)
        at = self.layout.owned[numbers[mine] - self.layout.first]
        # A node at the tip of a crack lies on both surfaces.
        np.add.at(self._raw, at, values[mine])
        np.add.at(self._condensed, at, values[mine])

    def increment(self, damping: float = 0.0) -> None:
        """Assemble the tangent where it has changed, solve, and add the increment. Collective.

        Args:
            damping: Resistance of dashpots at the nodes of the solid, relative to the scaled
                residual of its equilibrium [1/m].
        """
        self._update_tangent(damping)
        prescribed = self._dirichlet_increment()
        lifted = self._condensed.copy()
        moved = prescribed.copy()
        if self.comm.allreduce(bool(np.any(moved))):
            if self._couplings:
                self.condensation.expand(moved)
            change = self._matrix.multiply(moved)
            self.layout.add_ghosts_to_owners(change)
            if self._couplings:
                relative = self.condensation.gather(prescribed)
                self.condensation.condense(change, self._added_matrix() @ relative)
            lifted += change
        owned = self.layout.owned
        b = np.where(self._free, -lifted[owned], prescribed[owned])
        increment = self._linear.solve(b)
        full = np.zeros(self.layout.n_local)
        full[owned] = increment
        self.layout.update_ghosts(full)
        if self._couplings:
            self.condensation.expand(full)
        self._increment = full
        self.move(1.0)
        self._moved = True

    def move(self, part: float) -> None:
        """Add a part of the last increment once more; a negative one takes it back."""
        for u, view in zip(self.unknowns, self.layout.views(self._increment), strict=True):
            u.x.array[:] += part * view

    def scaled_residuals(self) -> list[float]:
        """Norm of the scaled residual of each field, free unknowns only. Collective."""
        r = np.where(self._free, self._linear.scale * self._condensed[self.layout.owned], 0.0)
        squares = np.bincount(self.layout.field_of_owned(), r**2, len(self.unknowns))
        return [float(x) for x in np.sqrt(self.comm.allreduce(squares))]

    def hold(self) -> None:
        """Hold the bounds of friction, after a move towards those of the present pressures."""
        for coupling in self._sliding:
            coupling.hold()

    def release(self) -> None:
        """Let the bounds of friction follow the pressures again."""
        for coupling in self._sliding:
            coupling.release()

    @property
    def farthest(self) -> float:
        """Longest move of a node along an axis in the last increment [m]."""
        moves = np.abs(self._increment[self.layout.owned][self._of_solid])
        return float(self.comm.allreduce(moves.max(initial=0.0), MPI.MAX))

    @property
    def reach(self) -> float:
        """Part of the last increment that moves no node of a sliding pair by more than a facet."""
        return min((coupling.reach(self._increment) for coupling in self._sliding), default=1.0)

    def violation(self, held: bool = True) -> float:
        """Norm of the scaled residual as a continuous function of the state, over all sets.

        Contact and friction count by what complements each other. Collective.

        Args:
            held: Whether held bounds of friction count, or those of the pressures.
        """
        residual = self._condensed[self.layout.owned]
        for coupling in self._sliding:
            numbers, values = coupling.violations(held)
            mine = self.layout.owns(numbers)
            residual[numbers[mine] - self.layout.first] = values[mine]
        r = np.where(self._free, self._linear.scale * residual, 0.0)
        return float(np.sqrt(self.comm.allreduce(np.sum(r**2))))

    def contacts(self) -> dict[str, dict[str, int]]:
        """Number of secondary nodes in each state, by pair; of pairs that are not tied."""
        return {coupling.pair.name: coupling.counts() for coupling in self._sliding}

    def scaled_norms(self) -> tuple[float, float]:
        """Norms of the scaled change in the step and of the scaled unknowns. Collective."""
        current = self._current()[self.layout.owned]
        change = current - self._start[self.layout.owned]
        pair = np.array(
            [np.sum((x / self._linear.scale)[self._free] ** 2) for x in (change, current)]
        )
        size, state = np.sqrt(self.comm.allreduce(pair))
        # What supports carry, in the units of scaled residuals: a state may be all stress.
        fields = self.layout.field_of_owned()
        reactions = np.where(self._free, 0.0, self._condensed[self.layout.owned])
        n = len(self.unknowns)
        sums = np.array(
            [
                np.bincount(fields, np.where(self._free, self._linear.scale, 0.0), n),
                np.bincount(fields, self._free.astype(float), n),
                np.bincount(fields, reactions**2, n),
            ]
        )
        scales, counts, squares = self.comm.allreduce(sums)
        forces = np.sqrt(squares) * scales / np.maximum(counts, 1.0)
        return float(size), max(float(state), float(forces.max()))

    @property
    def _free(self) -> npt.NDArray[np.bool_]:
        """Owned unknowns that are neither prescribed nor closed for good."""
        return self._system.free

    @property
    def _of_solid(self) -> npt.NDArray[np.bool_]:
        """Owned unknowns that are displacements."""
        return np.array(self.layout.block_sizes)[self.layout.field_of_owned()] > 1

    @property
    def _linear(self) -> LinearSolver:
        """Solver with the last tangent."""
        assert self._system.linear is not None
        return self._system.linear

    def _added_matrix(self) -> scipy.sparse.csr_array:
        """What contact and films add to the condensed matrix at the touched unknowns."""
        if self._film.nnz:
            return self.condensation.matrix + self._dt() * self._film
        return self.condensation.matrix

    def _current(self) -> npt.NDArray[np.float64]:
        """Unknowns as a local array."""
        return np.concatenate([u.x.array for u in self.unknowns])

    def _dt(self) -> float:
        assert self._time_step is not None
        step = float(self._time_step.value)
        if not step > 0.0:
            raise ValueError(f"time_step is {step}; it must be positive")
        return step

    def _dirichlet_increment(self) -> npt.NDArray[np.float64]:
        """What Dirichlet conditions still ask for; local array, zero at other unknowns."""
        result = np.zeros(self.layout.n_local)
        views = self.layout.views(result)
        for fields, bc in zip(self._bc_fields, self.bcs, strict=True):
            for field in fields:
                bc.set(views[field], self.unknowns[field].x.array)
        if self._couplings:
            # What is closed has no relative value, whatever the state the step starts from.
            relative = self.condensation.relative(self._current())
            positions, which = self.condensation.local
            closed = self.condensation.closed[which]
            result[positions[closed]] = -relative[which[closed]]
        return result

    def _assemble_tangent(self) -> bool:
        """Assemble the tangent, unless nothing it depends on has changed; say whether it has."""
        inputs = [np.array(_values(f), float).ravel() for f in self._tangent_coefficients]
        if self._film.nnz:
            inputs.append(np.array([self._dt()]))
        same = self._tangent_inputs is not None and all(
            np.array_equal(a.view(np.int64), b.view(np.int64))
            for a, b in zip(inputs, self._tangent_inputs, strict=True)
        )
        changed = bool(self.comm.allreduce(not same))
        if changed:
            self._tangent_inputs = inputs
            self._matrix.assemble()
            if self._sliding:
                self._diagonal = self._matrix.diagonal()
                self.layout.add_ghosts_to_owners(self._diagonal)
        return changed

    def _update_tangent(self, damping: float = 0.0) -> None:
        """Assemble and factorise, unless nothing the matrix depends on has changed."""
        changed, damped = self._assemble_tangent(), self._damped or damping > 0.0
        if changed or damped or self._sliding or self._system.linear is None:
            self._system.set_values(self._added_matrix())
        self._damped = damping > 0.0
        if self._damped:
            solid = self._of_solid
            residuals = self.scaled_residuals()
            largest = max(residuals[f] for f, n in enumerate(self.layout.block_sizes) if n > 1)
            self._linear.add_to_diagonal(
                np.where(solid & self._free, damping * largest * self._linear.scale, 0.0)
            )

    def _field(self, unknown: fem.Function) -> int:
        for field, u in enumerate(self.unknowns):
            if u is unknown:
                return field
        raise ValueError(f"{unknown.name} is none of the unknowns {', '.join(self.field_names)}")


def _values(f: fem.Function | fem.Constant | PointFunction) -> npt.NDArray[np.float64]:
    """Values of what stands in a form."""
    if isinstance(f, PointFunction):
        return f.values
    return f.x.array if isinstance(f, fem.Function) else f.value
