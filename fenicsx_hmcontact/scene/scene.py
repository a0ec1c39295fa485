# SPDX-License-Identifier: LGPL-3.0-or-later
"""A scene: what there is, said by the names of gmsh groups, and its runs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt

from ..contact import ContactPair
from ..domain import Domain
from ..materials import Material
from ..materials.kinematics import Kinematics
from ..output.root import on_root
from ..remeshing import Remeshing
from ..simulation import Simulation
from ..smoothing import Smoothing
from ..solvers import NewtonOptions, Step, StepOptions
from .model import Compiled, ModelOptions, SceneModel
from .statements import Body, Contact, InSpace, InTime, Prescribed, Statements
from .summary import describe

PAIR_OPTIONS = tuple(
    f.name
    for f in fields(ContactPair)
    if f.name not in ("facet_tags", "secondary", "primary", "name")
)
"""Options of a contact."""

DIRECTIONS = {"x": (0,), "y": (1,), "xy": (0, 1)}
"""Directions in which a surface can be fixed."""


class Scene:
    """Bodies, contacts, supports, loads and water of a model, by the names of gmsh groups.

    State things before a run and between two; what is stated anew about the same surface takes the
    place of the earlier statement. All methods are collective.

    Args:
        source: A gmsh file (.msh), or a `Domain`.
        comm: Communicator of a file.

    Attributes:
        simulation: What steps the scene in time; None before the first run.

    Raises:
        ValueError: As `Domain.read`.
    """

    def __init__(self, source: str | Path | Domain, comm: MPI.Intracomm = MPI.COMM_WORLD) -> None:
        self._domain = source if isinstance(source, Domain) else Domain.read(source, comm)
        self._said = Statements()
        self._options = ModelOptions()
        self._compiled: tuple[Any, Compiled] | None = None
        self._made_of: Any = None
        self._remesh: Remeshing | None = None
        self.simulation: Simulation | None = None

    @property
    def domain(self) -> Domain:
        """The mesh with its bodies and surfaces, as it is now."""
        return self._domain if self.simulation is None else self.model.domain

    @property
    def model(self) -> SceneModel:
        """The model of the run, as it is now.

        Raises:
            RuntimeError: If the scene has not been run.
        """
        if self.simulation is None:
            raise RuntimeError("the scene has no model before scene.run(...)")
        model: SceneModel = self.simulation.model  # type: ignore[assignment]
        return model

    # --- what there is ----------------------------------------------------------------------

    def body(
        self,
        name: str,
        material: Material,
        *,
        permeability: float | Sequence[Sequence[float]] | None = None,
        unit_weight: float = 0.0,
        tau: float = 1.0,
        shear_modulus: float | None = None,
    ) -> None:
        """Give a body its material.

        Args:
            name: Body group; or a body of several layers, which then have one material.
            material: Law of the effective stress.
            permeability: k [m/s], a number or symmetric tensor of shape (2, 2). None for a dry
                body, which gets no pore pressure.
            unit_weight: Weight of the whole, with its water, per volume [N/m^3]; needs `gravity`.
            tau: Amount of pressure stabilisation, see `pressure_projection` [-].
            shear_modulus: G of the stabilisation [Pa]; that of the material where None.

        Raises:
            ValueError: If there is no such body, or a value makes no sense.
        """
        self._not_running("a body")
        if name not in self.domain.body_names:
            known = ", ".join(self.domain.body_names)
            raise ValueError(f"{self.domain.name}: unknown body '{name}'; known: {known}")
        words = f"of body '{name}'"
        if isinstance(material, type) or not isinstance(material, Material):
            raise ValueError(f"the material {words} is {material!r}; it has no method update")
        k = None if permeability is None else np.array(permeability, float)
        if k is not None and not _is_permeability(k):
            raise ValueError(
                f"permeability {words} is {permeability}; it must be positive, a number or a "
                "symmetric tensor of shape (2, 2), or None where the body is dry"
            )
        for option, value in {"unit_weight": unit_weight, "tau": tau}.items():
            if not (value >= 0.0 and math.isfinite(value)):
                raise ValueError(f"{option} {words} is {value}; it must be zero or positive")
        stiff = getattr(material, "shear_modulus", None) if shear_modulus is None else shear_modulus
        if k is not None and tau > 0.0 and not (stiff is not None and stiff > 0.0):
            raise ValueError(
                f"the shear modulus {words} is {stiff}; stabilisation of the pore pressure needs "
                "one that is positive: give shear_modulus"
            )
        body = Body(material, k, float(unit_weight), float(tau), float(stiff or 0.0))
        self._said.state(self._said.bodies, name, body)

    def contact(self, secondary: str, primary: str, *, name: str = "", **options: Any) -> None:
        """Let two surfaces meet; the bodies may be one.

        Friction without strength is none. Gravity and free water of a `GapFlow` come from the
        scene (`gravity`, `drain`).

        Args:
            secondary: Surface that carries the tractions: the finer and softer one, as a rule.
            primary: The opposite surface.
            name: Name of the contact; "secondary/primary" where empty.
            options: ``friction`` (tied where left out), ``flow`` and others of `ContactPair`.

        Raises:
            ValueError: If a surface is unknown or lies on several bodies, or an option is unknown.
        """
        self._not_running("a contact")
        name = name or f"{secondary}/{primary}"
        if unknown := [option for option in options if option not in PAIR_OPTIONS]:
            raise ValueError(
                f"contact '{name}': unknown option '{unknown[0]}'; known: {', '.join(PAIR_OPTIONS)}"
            )
        tags = self.domain.surface(secondary), self.domain.surface(primary)
        if secondary == primary:
            raise ValueError(
                f"contact '{name}': surface '{secondary}' cannot meet itself; a body that touches "
                "itself needs two surfaces"
            )
        for surface in (secondary, primary):
            self.domain.body_of_surface(surface)
        try:
            ContactPair(self.domain.facet_tags, tags[0], tags[1], **options)
        except ValueError as error:
            raise ValueError(f"contact '{name}': {error}") from error
        self._said.state(self._said.contacts, name, Contact(secondary, primary, options))

    # --- supports and loads -----------------------------------------------------------------

    def fix(self, surface: str, directions: str = "xy") -> None:
        """Keep a surface where it was in the first mesh.

        Args:
            surface: Name of the surface.
            directions: "x", "y" or "xy".

        Raises:
            ValueError: If the surface or the directions are unknown.
        """
        if directions not in DIRECTIONS:
            raise ValueError(
                f'directions of surface \'{surface}\' are "x", "y" or "xy", not {directions!r}'
            )
        for i in DIRECTIONS[directions]:
            self._support(surface, i, 0.0)

    def move(self, surface: str, *, x: InTime | None = None, y: InTime | None = None) -> None:
        """Move a surface as a rigid one, in one or both directions.

        Of surfaces that share a corner and move alike in one direction only, the one that was
        named last moves the corner.

        Args:
            surface: Name of the surface.
            x: Displacement from where it was in the first mesh [m], a number or a function of
                time [s]; free where None.
            y: Likewise.

        Raises:
            ValueError: If the surface is unknown or no direction given.
        """
        if x is None and y is None:
            raise ValueError(f"surface '{surface}' is moved in no direction: give x or y")
        for i, value in enumerate((x, y)):
            if value is not None:
                self._support(surface, i, value)

    def load(
        self,
        surface: str,
        *,
        pressure: InTime | None = None,
        traction: tuple[InTime, InTime] | None = None,
    ) -> None:
        """Load a surface, all of it, where another surface covers it too.

        Args:
            surface: Name of the surface.
            pressure: Total pressure [Pa], positive where it pushes; at finite strain it turns and
                stretches with the surface. A number or a function of time [s].
            traction: Force per length [Pa] in x and y, numbers or functions of time; at finite
                strain a dead load, per length of the first mesh.

        Raises:
            ValueError: If the surface is unknown, or not one of both is given.
        """
        self.domain.surface(surface)
        if (pressure is None) == (traction is None):
            raise ValueError(
                f"the load on surface '{surface}' must be either a pressure or a traction"
            )
        if traction is not None and np.array(traction, object).shape != (2,):
            raise ValueError(
                f"the traction on surface '{surface}' needs two components, not {traction!r}"
            )
        kind = "pressure" if traction is None else "traction"
        values = (pressure,) if traction is None else tuple(traction)
        words = f"the {kind} on surface '{surface}'"
        self._said.state(self._said.loads, surface, Prescribed(words, kind, values))

    # --- water and gravity ------------------------------------------------------------------

    def drain(
        self,
        surface: str,
        pressure: InTime | None = None,
        *,
        level: InTime | None = None,
        field: InSpace | None = None,
    ) -> None:
        """Let free water stand at a surface of a porous body.

        Of a surface in contact, where nothing covers it and at the ends of the gap; the contact
        then needs a flow law. The water's weight on the surface is a `load` of its own.

        Args:
            surface: Name of the surface.
            pressure: Pore pressure [Pa], a number or a function of time [s]; 0 where nothing is
                given.
            level: Height of the water table [m], a number or a function of time: hydrostatic below
                it, no pressure above.
            field: Pore pressure [Pa] by coordinates [m], from shape (3, n) to (n,).

        Raises:
            ValueError: If the surface is unknown, or more than one of the three given.
        """
        self.domain.surface(surface)
        given = {"pressure": pressure, "level": level, "field": field}
        given = {kind: value for kind, value in given.items() if value is not None}
        if len(given) > 1:
            raise ValueError(
                f"the drain of surface '{surface}' has {' and '.join(given)}: give one"
            )
        ((kind, value),) = given.items() or {"pressure": 0.0}.items()
        if kind == "field" and not callable(value):
            raise ValueError(f"the field of pressures at surface '{surface}' must be a function")
        words = f"the {kind} of water at surface '{surface}'"
        self._said.state(self._said.drains, surface, Prescribed(words, kind, (value,)))

    def inflow(self, surface: str, flux: InTime) -> None:
        """Let water into a porous body through a surface, all of it.

        Args:
            surface: Name of the surface.
            flux: Darcy's flux into the body [m/s], a number or a function of time [s]; at finite
                strain per length at the start of the step.

        Raises:
            ValueError: If the surface is unknown.
        """
        self.domain.surface(surface)
        words = f"the inflow through surface '{surface}'"
        self._said.state(self._said.inflows, surface, Prescribed(words, "flux", (flux,)))

    def release(self, surface: str) -> None:
        """Take back all that was stated about a surface: supports, load, drain and inflow.

        Args:
            surface: Name of the surface.

        Raises:
            ValueError: If the surface is unknown, or nothing was stated.
        """
        self.domain.surface(surface)
        said, found = self._said, False
        for key in ((surface, 0), (surface, 1)):
            found |= said.supports.pop(key, None) is not None
        for table in (said.loads, said.drains, said.inflows):
            found |= table.pop(surface, None) is not None
        if not found:
            raise ValueError(f"nothing holds, loads or drains surface '{surface}'")
        said.version += 1

    def gravity(self, direction: tuple[float, float] = (0.0, -1.0)) -> None:
        """Let bodies weigh their ``unit_weight``, and water in pores and gaps its own.

        Args:
            direction: Direction in which things fall; its length does not matter.

        Raises:
            ValueError: If it is none.
        """
        length = math.hypot(*direction) if np.shape(direction) == (2,) else 0.0
        if not (length > 0.0 and math.isfinite(length)):
            raise ValueError(
                f"the direction of gravity is {direction}; it must have two components and a length"
            )
        self._said.gravity = (direction[0] / length, direction[1] / length)
        self._said.version += 1

    def water(self, unit_weight: float = 1e4) -> None:
        """Say what water weighs; 1e4 N/m^3 unless said otherwise.

        Args:
            unit_weight: gamma_f of Darcy's law [N/m^3].

        Raises:
            ValueError: If it is not positive.
        """
        if not (unit_weight > 0.0 and math.isfinite(unit_weight)):
            raise ValueError(f"the unit weight of water is {unit_weight}; it must be positive")
        self._said.water = float(unit_weight)
        self._said.version += 1

    def initial_stress(self, body: str, stress: InSpace) -> None:
        """Give a body an effective stress to start from, see `MaterialStress.set_stress`.

        Args:
            body: Name of the body.
            stress: From coordinates [m], shape (3, n), to xx, yy, zz, xy [Pa], shape (4, n).
        """
        self._not_running("an initial stress")
        self._said.state(self._said.stresses, body, stress)

    def initial_pressure(self, body: str, pressure: InSpace | float) -> None:
        """Give a porous body a pore pressure to start from.

        Args:
            body: Name of the body.
            pressure: A number, or from coordinates [m], shape (3, n), to pressures [Pa], (n,).
        """
        self._not_running("an initial pore pressure")
        self._said.state(self._said.pressures, body, pressure)

    # --- runs -------------------------------------------------------------------------------

    def build(
        self,
        domain: Domain | None = None,
        *,
        kinematics: Kinematics = "small",
        smoothing: Smoothing | None = None,
        newton: NewtonOptions = NewtonOptions(),
        petsc_options: Mapping[str, Any] | None = None,
    ) -> SceneModel:
        """Make the model of the scene on a mesh with the same groups, at its initial state.

        Args:
            domain: The mesh; that of the scene where None.
            kinematics: As `run`.
            smoothing: As `run`.
            newton: As `run`.
            petsc_options: As `run`.

        Raises:
            ValueError: If statements do not go together, or name what the mesh has not.
        """
        options = ModelOptions(kinematics, smoothing, newton, petsc_options)
        return self._build(domain or self.domain, options)

    def run(
        self,
        times: float | Sequence[float],
        dt: float,
        *,
        kinematics: Kinematics | None = None,
        smoothing: Smoothing | None = None,
        remesh: Remeshing | None = None,
        newton: NewtonOptions | None = None,
        petsc_options: Mapping[str, Any] | None = None,
        steps: StepOptions | None = None,
        start: float | None = None,
        bar: str = "",
    ) -> Iterator[Step]:
        """Go on to the asked times, and yield every step, see `TimeStepping.run`.

        A second run goes on where the first one ended, with what has been stated since; options
        left out are those of the first.

        Args:
            times: The end, or all times at which a step must end [s].
            dt: Length of a step [s].
            kinematics: ``"small"`` strain (the default), or ``"finite"``; the same in all runs.
            smoothing: Enhancement of the smoothed gradient, or ``"triangles"``; by the kinematics
                where None.
            remesh: When and how bodies are remeshed; never where None.
            newton: When Newton's method stops.
            petsc_options: Options of the linear solver; MUMPS where None.
            steps: How the length of steps follows failure and success.
            start: Time at the start of the first run [s].
            bar: What runs: shows a progress bar.

        Raises:
            ValueError: As `build`, or if a later run asks for what only the first can have.
        """
        options = self._changed(
            kinematics=kinematics, smoothing=smoothing, newton=newton, petsc_options=petsc_options
        )
        if self.simulation is None:
            self._options = options
            self._remesh = remesh
            self.simulation = Simulation(
                self._rebuild,
                self._domain,
                self._kept(remesh, options),
                options=steps or StepOptions(),
                start=start or 0.0,
            )
            return self.simulation.run(times, dt, bar=bar)
        if steps is not None or start is not None:
            raise ValueError("steps and start are those of the first run")
        if options.kinematics != self._options.kinematics:
            raise ValueError(
                f"kinematics is {options.kinematics!r}, but the first run was of "
                f"{self._options.kinematics!r} strain: it is the same in all runs"
            )
        kept = self._kept(remesh or self._remesh, options)
        self.simulation.accept()
        if self._made_of != (self._said.version, options):
            self._go_on(options)
        self._remesh, self.simulation.remeshing = remesh or self._remesh, kept
        return self.simulation.run(times, dt, bar=bar)

    def summary(self) -> str:
        """Say in a few lines what the scene contains."""
        strain = None if self.simulation is None else self._options.kinematics
        return describe(self._said, self.domain, strain)

    # --- stages -----------------------------------------------------------------------------

    def remove(self, group: str, exposed: str, *, over: float = 0.0) -> None:
        """Take a body group out between two runs, as in an excavation. Collective.

        What was stated about surfaces that go with it is taken back. The surface that is laid bare
        can be drained, loaded or supported from then on.

        Args:
            group: A layer of a body, or a whole body.
            exposed: Name of the surface that is laid bare; a new one, or one there is.
            over: Time in which what the group carried falls on the rest, evenly [s]: steps that
                fail are cut, and their load with them. At zero it falls on the next step, all of
                it however short.

        Raises:
            RuntimeError: If the scene has not been run.
            ValueError: If there is no such group, nothing would be left or, over a time, laid bare,
                if the time is negative, or the rest is refused as in `build`. The statements then
                are as they were.
        """
        if not 0.0 <= over < math.inf:
            raise ValueError(f"the time in which '{group}' is removed is {over} s")
        simulation = self._running("remove")
        comm = self.model.comm
        domain, arrays, before = self.domain, self.domain.arrays(), self._said
        tag = domain.body(group)
        found = on_root(comm, lambda: list(arrays.without(group, exposed)[0].surfaces))
        left: list[str] = comm.bcast(found)
        if over > 0.0 and exposed not in left:
            raise ValueError(
                f"the removal of '{group}' lays no surface '{exposed}' bare that could be unloaded "
                "over a time"
            )
        bodies = [name for name in domain.body_names if domain.tags(name) == [tag]]
        self._said = before.copy()
        self._said.forget(bodies, set(domain.surfaces) - set(left))
        try:
            simulation.remove(group, exposed)
        except Exception:
            self._said = before
            raise
        if over > 0.0:
            begin = simulation.t
            part = Prescribed(
                f"the traction left on surface '{exposed}'",
                "part",
                (lambda t: max(1.0 - (t - begin) / over, 0.0),),
            )
            self._said.state(self._said.unloadings, exposed, part)
            self._go_on(self._options)
            self.model.hold(exposed)

    def reset_displacements(self, pressure: Mapping[str, InSpace | float] | None = None) -> None:
        """Go back to the design geometry between two runs; stresses stay. Collective.

        Args:
            pressure: Pore pressures of bodies from there on, as `initial_pressure`; they stay as
                they are in bodies that are not named.

        Raises:
            RuntimeError: If the scene has not been run.
            ValueError: If one of these bodies is unknown or dry.
        """
        simulation = self._running("reset_displacements")
        self._said.check_pressures(pressure or ())
        simulation.reset_displacements()
        if pressure:
            self.model.set_pressure(pressure)

    def write_checkpoint(self, path: str | Path) -> None:
        """Write all that the run needs to go on, see `Simulation.write_checkpoint`. Collective."""
        self._running("write_checkpoint").write_checkpoint(path)

    def restart(
        self,
        path: str | Path,
        *,
        kinematics: Kinematics | None = None,
        smoothing: Smoothing | None = None,
        remesh: Remeshing | None = None,
        newton: NewtonOptions | None = None,
        petsc_options: Mapping[str, Any] | None = None,
        steps: StepOptions | None = None,
    ) -> None:
        """Take the place of the first run by a checkpoint of the same scene. Collective.

        Options are those of `run`, as of the run that wrote it.

        Args:
            path: The file; written on any number of ranks.
            kinematics: As `run`.
            smoothing: As `run`.
            remesh: As `run`.
            newton: As `run`.
            petsc_options: As `run`.
            steps: As `run`.

        Raises:
            FileNotFoundError: If there is no such file.
            CheckpointError: If the run cannot go on from it, see `Simulation.restart`.
            RuntimeError: If the scene has been run.
        """
        if self.simulation is not None:
            raise RuntimeError("restart comes before the first run")
        self._options = self._changed(
            kinematics=kinematics, smoothing=smoothing, newton=newton, petsc_options=petsc_options
        )
        self._remesh = remesh
        self.simulation = Simulation.restart(
            path,
            self._rebuild,
            self._domain.mesh.comm,
            self._kept(remesh, self._options),
            options=steps or StepOptions(),
        )

    def _running(self, what: str) -> Simulation:
        """The simulation, for what comes after the first run."""
        if self.simulation is None:
            raise RuntimeError(f"{what} comes after the first run")
        return self.simulation

    # --- what it is made of -------------------------------------------------------------------

    def _support(self, surface: str, i: int, value: InTime) -> None:
        """Prescribe one component of the displacement of a surface."""
        self.domain.surface(surface)
        words = f"the displacement {'xy'[i]} of surface '{surface}'"
        prescribed = Prescribed(words, "displacement", (value,))
        self._said.state(self._said.supports, (surface, i), prescribed)

    def _not_running(self, what: str) -> None:
        """Refuse what can only be said before the first run."""
        if self.simulation is not None:
            raise ValueError(f"{what} must be stated before the first run")

    def _changed(self, **given: Any) -> ModelOptions:
        """Options of the runs before, with what is given for this one."""
        before = ModelOptions() if self.simulation is None else self._options
        return replace(before, **{k: v for k, v in given.items() if v is not None})

    def _kept(self, remesh: Remeshing | None, options: ModelOptions) -> Remeshing | None:
        """Options of remeshing that leave surfaces alone that supports hold in both directions."""
        if remesh is None:
            return None
        if options.kinematics != "finite":
            raise ValueError("remesh goes with finite strain: at small strain the mesh stays")
        if options.smoothing == "triangles":
            raise ValueError("remesh goes with smoothing: what triangles know is lost with them")
        surfaces = dict.fromkeys(surface for surface, _ in self._said.supports)
        held = [s for s in surfaces if self._said.components(s) == [0, 1]]
        return replace(remesh, keep=tuple(dict.fromkeys((*remesh.keep, *held))))

    def _build(self, domain: Domain, options: ModelOptions) -> SceneModel:
        """Make the model; its forms are compiled once for all meshes."""
        groups = domain.bodies, domain.surfaces, domain.layers
        key = self._said.version, options.kinematics, options.smoothing, groups
        compiled = None
        if self._compiled is not None and self._compiled[0] == key:
            compiled = self._compiled[1]
        model = SceneModel(self._said, domain, options, compiled)
        self._compiled = key, model.compiled
        return model

    def _rebuild(self, domain: Domain) -> SceneModel:
        """Make the model of the runs."""
        model = self._build(domain, self._options)
        self._made_of = self._said.version, self._options
        return model

    def _go_on(self, options: ModelOptions) -> None:
        """Build the model anew from what is stated now, at the state reached. Collective.

        Where that fails all is as it was.
        """
        assert self.simulation is not None
        simulation, old, before = self.simulation, self.model, (self._options, self._made_of)
        state = old.nodal_state()
        try:
            self._options = options
            simulation.model = model = self._rebuild(old.domain)
            simulation.prescribe(simulation.t, float(old.dt.value))
            model.set_nodal_state({**model.nodal_state(), **state})
        except Exception:
            simulation.model = old
            self._options, self._made_of = before
            raise


def _is_permeability(k: npt.NDArray[np.float64]) -> bool:
    """Whether it is a positive number or tensor."""
    if k.shape == ():
        return bool(k > 0.0 and np.isfinite(k))
    if k.shape != (2, 2) or not np.isfinite(k).all() or not np.array_equal(k, k.T):
        return False
    return bool(np.linalg.eigvalsh(k)[0] > 0.0)
