# SPDX-License-Identifier: LGPL-3.0-or-later
"""The model that a scene makes on a domain."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import ufl
from dolfinx import fem, la
from dolfinx.mesh import EntityMap

from .. import _compat
from ..contact import ContactPair, InterfaceState
from ..domain import Domain
from ..materials import MaterialStress
from ..materials.kinematics import Kinematics, check_kinematics
from ..model import CompiledModel
from ..poromechanics import finite_strain, small_strain
from ..problem import ContactProblem
from ..smoothing import Smoothing, cells_of, node_cells_measure
from ..solvers import NewtonOptions, TransientModel
from ..solvers.time_stepping import History
from .statements import Contact, Float, InSpace, Prescribed, Statements, at_points


@dataclass(frozen=True)
class ModelOptions:
    """How a scene is computed.

    Attributes:
        kinematics: ``"small"`` strain; or ``"finite"``, where the mesh follows the bodies.
        smoothing: Enhancement of the smoothed gradient, see `node_cells_measure`, or
            ``"triangles"``; where None ``"deviatoric"`` at small and ``"full"`` at finite strain.
        newton: When Newton's method stops.
        petsc_options: Options of the linear solver; MUMPS where None.

    Raises:
        ValueError: If kinematics or smoothing are unknown, or do not go together.
    """

    kinematics: Kinematics = "small"
    smoothing: Smoothing | None = None
    newton: NewtonOptions = field(default_factory=NewtonOptions)
    petsc_options: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        """Refuse values that make no sense."""
        check_kinematics(self.kinematics, self.measure())

    def measure(self, **options: Any) -> ufl.Measure:
        """Measure of the effective stress."""
        usual: Smoothing = "full" if self.kinematics == "finite" else "deviatoric"
        return node_cells_measure(self.smoothing or usual, **options)


@dataclass(frozen=True, eq=False)
class Compiled:
    """Forms of a scene, to be used again on another mesh.

    Attributes:
        forms: The compiled forms.
        data: Functions, constants, tags and stresses that they were compiled from.
    """

    forms: CompiledModel
    data: list[Any]


class SceneModel(TransientModel):
    """A scene on a domain, ready to be stepped. Made by `Scene.build`.

    Attributes:
        domain: Mesh, bodies and surfaces.
        u: Displacement [m].
        u_n: Displacement at the start of the step [m].
        p: Pore pressure [Pa], in porous bodies alone; None where there are none.
        p_n: Pore pressure at the start of the step [Pa], likewise.
        porous: Domain of the porous bodies, that of `p`; None where there are none.
        stresses: Effective stress of each body.
        pairs: Contact pairs by the names of the contacts.
        problem: The problem of a step.
        compiled: The forms, for another mesh.

    Note:
        Collective, as are all methods.
    """

    problem: ContactProblem

    def __init__(
        self,
        statements: Statements,
        domain: Domain,
        options: ModelOptions = ModelOptions(),
        compiled: Compiled | None = None,
    ) -> None:
        statements.check(domain)
        self.domain, self._said, mesh = domain, statements, domain.mesh
        self._finite = options.kinematics == "finite"
        tagged = {"domain": mesh, "subdomain_data": domain.cell_tags}
        self._dc, self._dx = options.measure(**tagged), ufl.Measure("dx", **tagged)
        self._ds = ufl.Measure("ds", domain=mesh, subdomain_data=domain.facet_tags)
        self._time, step = fem.Constant(mesh, 0.0), fem.Constant(mesh, 1.0)
        self._data: list[Any] = [step, domain.cell_tags, domain.facet_tags]
        self._histories: list[History] = []

        V = fem.functionspace(mesh, ("P", 1, (2,)))
        self.u, self.u_n = self._fields(V, "displacement")
        self.p = self.p_n = self.porous = None
        self._map: EntityMap | None = None
        names = statements.porous
        if names:
            self.porous = domain
            if len(names) < len(statements.bodies):
                self.porous, self._map = domain.submesh(*names)
            Q = fem.functionspace(self.porous.mesh, ("P", 1))
            self.p, self.p_n = self._fields(Q, "pore pressure")
            v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))
        else:
            v, q = ufl.TestFunction(V), None
        self.stresses: dict[str, MaterialStress] = {}
        form = sum(self._bulk(name, options, v, q, step) for name in statements.bodies)
        self._tractions: dict[str, fem.Function] = {}
        form += self._loads(v) + self._inflows(q, step)
        self._set_initial_state()
        self._supports: dict[tuple[str, int], Any] = {}
        conditions = self._held() + self._drained()
        self.pairs = {name: self._pair(name, c) for name, c in statements.contacts.items()}
        self._data += self.stresses.values()
        self.problem = ContactProblem(
            form if compiled is None else compiled.forms,
            [self.u] if self.p is None else [self.u, self.p],
            bcs=conditions,
            pairs=list(self.pairs.values()),
            time_step=step,
            newton=options.newton,
            petsc_options=options.petsc_options,
            entity_maps=[] if self._map is None else [self._map],
            domain=domain,
            replace=None if compiled is None else dict(zip(compiled.data, self._data, strict=True)),
        )
        self.compiled = compiled or Compiled(self.problem.model, self._data)
        previous = [] if self._finite else [(self.u_n, self.u)]
        if self.p is not None:
            previous.append((self.p_n, self.p))
        super().__init__(
            self.problem,
            step,
            previous,
            time=self._time,
            histories=self._histories,
            saved={f"traction on {name}": held for name, held in self._tractions.items()},
            follow=self._move_meshes if self._finite else None,
        )

    # --- what a user asks -------------------------------------------------------------------

    def force(self, surface: str) -> Float:
        """Force of the supports of a surface on the body [N/m]; shape (2,).

        In directions in which it is fixed or moved, zero in others. A corner of two such surfaces
        counts for both.

        Args:
            surface: A fixed or moved surface.

        Raises:
            ValueError: If it is neither.
        """
        components = [i for name, i in self._supports if name == surface]
        if not components:
            raise ValueError(f"surface '{surface}' is neither fixed nor moved, nothing holds it")
        reactions = self.problem.reactions(self.u).x.array
        result = np.zeros(2)
        for i in components:
            result[i] = reactions[self._supports[surface, i]].sum()
        total: Float = self.comm.allreduce(result)
        return total

    def outflow(self, surface: str | None = None) -> float:
        """Water that left the bodies in the last step [m^3/m], negative where it came in.

        Args:
            surface: A surface of a porous body; all where None, prescribed inflow included.

        Raises:
            ValueError: If there is no such surface, or no pore pressure on it.
        """
        if self.p is None or self.porous is None:
            raise ValueError("all bodies are dry: there is no water that could leave")
        space = self.p.function_space
        dofs = np.arange(space.dofmap.index_map.size_local)
        if surface is not None:
            facets = self.porous.facet_tags.find(self.porous.surface(surface))
            dofs = np.intersect1d(dofs, fem.locate_dofs_topological(space, 1, facets))
        left = -self.comm.allreduce(float(self.problem.reactions(self.p).x.array[dofs].sum()))
        for name, flux in self._fluxes.items():
            if surface in (None, name):
                ds = self._ds(self.domain.surface(name))
                length = fem.assemble_scalar(fem.form(fem.Constant(self.domain.mesh, 1.0) * ds))
                left -= float(self.dt.value * flux.value) * self.comm.allreduce(length)
        return float(left)

    def water_balance(self) -> tuple[float, float]:
        """Water that appeared in the last step, which must be none, and what moved. Collective.

        Grains and water are incompressible: what the porous bodies grow by, what gaps took from
        them and what left them cancel out. To be asked in the loop over the steps of a run: after
        it the step is accepted, and its displacements are those of the next one's start.

        Returns:
            The sum of the three and the largest of them [m^3/m].

        Raises:
            ValueError: If all bodies are dry.
        """
        left = self.outflow()
        moved = ufl.grad(self.u - self.u_n)
        growth = ufl.det(ufl.Identity(2) + moved) - 1.0 if self._finite else ufl.tr(moved)
        tags = tuple(tag for body in self._said.porous for tag in self.domain.tags(body))
        grown = self.domain.mesh.comm.allreduce(
            fem.assemble_scalar(fem.form(growth * self._dx(tags)))
        )
        parts = float(grown), sum(self.contact(name).taken_up for name in self.pairs), left
        return sum(parts), max(map(abs, parts))

    def contact(self, name: str) -> InterfaceState:
        """Tractions, gaps and water of a contact.

        Args:
            name: Its name; "secondary/primary" where none was given.

        Raises:
            ValueError: If there is none of that name.
        """
        if name not in self.pairs:
            known = ", ".join(self.pairs) or "none"
            raise ValueError(f"unknown contact '{name}'; known: {known}")
        return self.problem.interface(self.pairs[name])

    def nodal_stress(self) -> fem.Function:
        """Effective stress xx, yy, zz, xy at the nodes [Pa], the mean of the points around each."""
        return self._nodal("stress", {n: s.values() for n, s in self.stresses.items()}, 4)

    def nodal_history(self, name: str = "kappa") -> fem.Function:
        """A history of the materials at the nodes, the mean of the points around each.

        Args:
            name: Its name, "kappa" being the equivalent plastic strain. Bodies whose material
                knows none of that name get zero.

        Raises:
            ValueError: If no material knows it.
        """
        known = {n: s for n, s in self.stresses.items() if name in s.material.history_names}
        if not known:
            raise ValueError(f"no material has a history '{name}'")
        return self._nodal(name, {n: s.history(name)[..., None] for n, s in known.items()}, 1)

    # --- stages -----------------------------------------------------------------------------

    def hold(self, surface: str) -> None:
        """Let tractions balance the forces on a surface, whose unloading begins. Collective.

        Args:
            surface: A surface that a neighbour was removed from.
        """
        traction, unit = self._tractions[surface], fem.Constant(self.domain.mesh, np.ones(2))
        lengths = fem.assemble_vector(
            fem.form(
                ufl.dot(unit, ufl.TestFunction(traction.function_space)) * self._lumped(surface)
            )
        )
        lengths.scatter_reverse(la.InsertMode.add)
        traction.x.array[:] = 0.0
        forces, n = self.problem.bulk_forces(self.u), len(traction.x.array)
        there = lengths.array[:n] > 0.0
        traction.x.array[there] = forces.x.array[there] / lengths.array[:n][there]
        traction.x.scatter_forward()

    # --- building ---------------------------------------------------------------------------

    def _fields(self, space: fem.FunctionSpace, name: str) -> tuple[fem.Function, fem.Function]:
        """A field at the end and at the start of the step."""
        end, start = fem.Function(space, name=name), fem.Function(space, name=f"{name} before")
        self._data.append(start)
        return end, start

    def _constant(self, value: Any) -> fem.Constant:
        """A number that stands in a form."""
        constant = fem.Constant(self.domain.mesh, np.asarray(value, float))
        self._data.append(constant)
        return constant

    def _in_time(self, prescribed: Prescribed) -> fem.Constant:
        """A constant that follows what is prescribed."""
        constant = self._constant(np.zeros(len(prescribed.values)).squeeze())
        self._histories.append((constant, prescribed))
        return constant

    def _bulk(self, name: str, options: ModelOptions, v: Any, q: Any, step: fem.Constant) -> Any:
        """Equilibrium and water balance of a body."""
        said, body, tags = self._said, self._said.bodies[name], tuple(self.domain.tags(name))
        first = next(iter(self.stresses.values()), None)
        stress = self.stresses[name] = MaterialStress(
            body.material,
            self.u,
            self.u_n,
            self._dc(tags),
            kinematics=options.kinematics,
            node_cells=None if first is None else first.node_cells,
            name=f"stress of {name}",
        )
        p = self.p if body.porous else None
        where = {"smoothed": stress.measure, "triangles": self._dx(tags)}
        down = None if said.gravity is None else ufl.as_vector(said.gravity)
        weight = None
        if down is not None and body.unit_weight:
            weight = self._constant(body.unit_weight) * down
        if self._finite:
            deformed = stress.deformation, self.u, self.u_n
            form = finite_strain.equilibrium(
                stress.stress, *deformed, p, v, body_force=weight, **where
            )
        else:
            form = small_strain.equilibrium(stress.stress, p, v, body_force=weight, **where)
        if p is None:
            return form
        balance = finite_strain.water_balance if self._finite else small_strain.water_balance
        form += balance(
            *(self.u, self.u_n, p, q, step),
            permeability=self._constant(body.permeability),
            unit_weight=self._constant(said.water),
            gravity=down,
            **where,
        )
        if body.tau > 0.0:
            form += small_strain.pressure_projection(
                *(p, self.p_n, q, self._constant(body.shear_modulus)),
                tau=self._constant(body.tau),
                triangles=where["triangles"],
            )
        return form

    def _loads(self, v: Any) -> Any:
        """Virtual work of the loads, to be added."""
        form: Any = 0
        for surface, load in self._said.loads.items():
            value, ds = self._in_time(load), self._ds(self.domain.surface(surface))
            if load.kind == "pressure" and self._finite:
                form += finite_strain.pressure_load(value, self.u, self.u_n, v, ds)
            elif load.kind == "pressure":
                form += value * ufl.dot(ufl.FacetNormal(self.domain.mesh), v) * ds
            elif self._finite:
                form -= finite_strain.dead_load(value, self.u_n, v, ds)
            else:
                form -= ufl.dot(value, v) * ds
        for surface, part in self._said.unloadings.items():
            held = fem.Function(self.u.function_space, name=f"traction held on {surface}")
            self._data.append(held)
            self._tractions[surface] = held
            form -= self._in_time(part) * ufl.dot(held, v) * self._lumped(surface)
        return form

    def _lumped(self, surface: str) -> ufl.Measure:
        """Measure on a surface of which each node has its own part."""
        vertices = {"quadrature_rule": "vertex", "quadrature_degree": 1}
        return self._ds(self.domain.surface(surface), metadata=vertices)

    def _inflows(self, q: Any, step: fem.Constant) -> Any:
        """Water that comes in through surfaces, to be added."""
        form: Any = 0
        self._fluxes = {s: self._in_time(flux) for s, flux in self._said.inflows.items()}
        for surface, flux in self._fluxes.items():
            form -= step * flux * q * self._ds(self.domain.surface(surface))
        return form

    def _held(self) -> list[fem.DirichletBC]:
        """Conditions on the displacement."""
        conditions = []
        V = self.u.function_space
        for (surface, i), prescribed in self._said.supports.items():
            facets = self.domain.facet_tags.find(self.domain.surface(surface))
            dofs = fem.locate_dofs_topological(V.sub(i), 1, facets)
            self._supports[surface, i] = dofs[dofs < 2 * V.dofmap.index_map.size_local]
            conditions.append(fem.dirichletbc(self._in_time(prescribed), dofs, V.sub(i)))
        return conditions

    def _drained(self) -> list[fem.DirichletBC]:
        """Conditions on the pore pressure; surfaces in contact have free water outside instead."""
        conditions: list[fem.DirichletBC] = []
        if self.p is None or self.porous is None:
            return conditions
        Q = self.p.function_space
        for surface in self._said.drains:
            if self._said.contacts_of(surface):
                continue
            value = fem.Function(Q)
            facets = self.porous.facet_tags.find(self.porous.surface(surface))
            dofs = fem.locate_dofs_topological(Q, 1, facets)
            self._histories.append((value, partial(partial, self._said.drain(surface))))
            conditions.append(fem.dirichletbc(value, dofs))
        return conditions

    def _pair(self, name: str, contact: Contact) -> ContactPair:
        """Contact pair with the gravity and the free water of the scene."""
        options = contact.options | {"friction": contact.friction}
        flow, drained = options.get("flow"), self._said.outside(contact)
        if flow is not None and not contact.tied:
            flow = replace(flow, gravity=self._said.gravity)
        if flow is not None and drained is not None:
            pressure, time = self._said.drain(drained), self._time

            def outside(x: Float) -> Float:
                """Pressure of the free water at the end of the step."""
                values: Float = pressure(float(time.value), np.pad(x, ((0, 0), (0, 1))).T)
                return values

            flow = replace(flow, outside=outside)
        surfaces = self.domain.surface(contact.secondary), self.domain.surface(contact.primary)
        return ContactPair(
            self.domain.facet_tags, *surfaces, **options | {"flow": flow, "name": name}
        )

    def _set_initial_state(self) -> None:
        """Effective stresses and pore pressures to start from."""
        for name, stress in self._said.stresses.items():
            self.stresses[name].set_stress(stress)
        self.set_pressure(self._said.pressures)

    def set_pressure(self, pressures: Mapping[str, InSpace | float]) -> None:
        """Give porous bodies a pore pressure to start from.

        Args:
            pressures: By body, a number or from coordinates [m], shape (3, n), to pressures [Pa],
                shape (n,).

        Raises:
            ValueError: If a body is unknown or dry.
        """
        self._said.check_pressures(pressures)
        if self.p is None or self.p_n is None or self.porous is None:
            return
        tags = self.porous.cell_tags
        for name, pressure in pressures.items():
            words = f"the initial pore pressure of body '{name}'"
            cells = tags.indices[np.isin(tags.values, self.domain.tags(name))]
            self.p.interpolate(partial(at_points, pressure, words), cells0=cells)
        self.p.x.scatter_forward()
        self.p_n.x.array[:] = self.p.x.array

    def _move_meshes(self) -> None:
        """Let the mesh follow the step, and that of the porous bodies with it."""
        self.problem.move_mesh(self.u, self.u_n)
        if self._map is None or self.porous is None:
            return
        mesh, part = self.domain.mesh, self.porous.mesh
        cells = _compat.cells_of_part(mesh, part, [self._map])
        inside = cells >= 0
        nodes = _compat.cell_nodes(part)[cells[inside]]
        part.geometry.x[nodes] = mesh.geometry.x[_compat.cell_nodes(mesh)[inside]]

    def _nodal(self, name: str, values: dict[str, Float], size: int) -> fem.Function:
        """Nodal field of values at the points of each body, (cells, points a cell, size)."""
        mesh = self.domain.mesh
        space = fem.functionspace(mesh, ("P", 1) if size == 1 else ("P", 1, (size,)))
        result, dofmap = fem.Function(space, name=name), space.dofmap
        array = result.x.array.reshape(-1, size)
        weights = fem.Function(fem.functionspace(mesh, ("P", 1)))
        for body, found in values.items():
            means, cells = found.mean(axis=1), self.stresses[body].node_cells
            if cells is not None:
                mine = cells_of(tuple(self.domain.tags(body)), self.domain.cell_tags, cells)
                array[cells.block_dofs(space)[mine]] = means
                continue
            owned = self.domain.cells(body)
            x = mesh.geometry.x[_compat.cell_nodes(mesh)[owned]]
            areas = 0.5 * np.abs(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])[:, 2])
            np.add.at(array, dofmap.list[owned], (areas[:, None] * means)[:, None])
            np.add.at(weights.x.array, dofmap.list[owned], areas[:, None])
        if not self.problem.model.is_smoothed:
            for f in (result, weights):
                f.x.scatter_reverse(la.InsertMode.add)
            array /= np.where(weights.x.array > 0.0, weights.x.array, 1.0)[:, None]
        result.x.scatter_forward()
        return result
