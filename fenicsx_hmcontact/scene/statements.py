# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a scene says, by names alone, and whether it makes sense on a domain."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..contact import CoulombFriction, Frictionless, Tied, tangential_law
from ..domain import Domain
from ..materials import Material

Float = npt.NDArray[np.float64]

type InTime = float | Callable[[float], float]
"""A number, or a function of time [s] that returns one."""

type InSpace = Callable[[Float], Any]
"""A function of coordinates [m], shape (3, n)."""


@dataclass(frozen=True, eq=False)
class Body:
    """A body of one material.

    Attributes:
        material: Law of the effective stress.
        permeability: k [m/s], a number or of shape (2, 2); None for a dry body.
        unit_weight: Weight of the whole per volume [N/m^3].
        tau: Amount of pressure stabilisation [-].
        shear_modulus: G of the stabilisation [Pa].
    """

    material: Material
    permeability: Float | None
    unit_weight: float
    tau: float
    shear_modulus: float

    @property
    def porous(self) -> bool:
        """Whether it has a pore pressure."""
        return self.permeability is not None


@dataclass(frozen=True, eq=False)
class Contact:
    """Two surfaces in contact, with options of `ContactPair`."""

    secondary: str
    primary: str
    options: dict[str, Any]

    @property
    def friction(self) -> Any:
        """Law between the solids; frictionless where it has no strength."""
        law = self.options.get("friction", Tied())
        if isinstance(law, CoulombFriction) and tangential_law(law) is None:
            return Frictionless()
        return law

    @property
    def tied(self) -> bool:
        """Whether the surfaces move together."""
        return isinstance(self.friction, Tied)


@dataclass(eq=False)
class Prescribed:
    """What is prescribed on a surface; stated anew, it takes new values.

    Attributes:
        words: What it is, for messages.
        kind: What is prescribed: "displacement", "pressure", "traction", "level", "field", "flux".
        values: Numbers or functions.
    """

    words: str
    kind: str
    values: tuple[Any, ...]

    def __post_init__(self) -> None:
        """Refuse what is neither a number nor a function."""
        for value in self.values:
            if not callable(value) and not (_is_number(value) and math.isfinite(value)):
                raise ValueError(f"{self.words} is {value!r}; it must be a number or a function")

    def __call__(self, t: float) -> Any:
        """Value at a time [s]: a number, or an array of several.

        Raises:
            ValueError: If a function of time returns something else.
        """
        found = [value(t) if callable(value) else value for value in self.values]
        if not all(_is_number(value) and math.isfinite(value) for value in found):
            raise ValueError(f"{self.words} is {found} at t = {t:g} s; it must be a number")
        return np.array(found, float) if len(found) > 1 else float(found[0])


@dataclass(eq=False)
class Statements:
    """All that a scene says.

    Attributes:
        bodies: By name.
        contacts: By name.
        supports: Displacements [m] by surface and component.
        loads: Pressures or tractions [Pa] by surface.
        drains: Pore pressures by surface.
        inflows: Fluxes into the body [m/s] by surface.
        unloadings: Part [-] of the traction of a removed neighbour that still acts, by surface.
        stresses: Effective stresses at the start, by body.
        pressures: Pore pressures at the start, by body.
        gravity: Its direction; None without.
        water: Unit weight of water [N/m^3].
        version: Grows with every statement that a model in hand cannot take.
    """

    bodies: dict[str, Body] = field(default_factory=dict)
    contacts: dict[str, Contact] = field(default_factory=dict)
    supports: dict[tuple[str, int], Prescribed] = field(default_factory=dict)
    loads: dict[str, Prescribed] = field(default_factory=dict)
    drains: dict[str, Prescribed] = field(default_factory=dict)
    inflows: dict[str, Prescribed] = field(default_factory=dict)
    unloadings: dict[str, Prescribed] = field(default_factory=dict)
    stresses: dict[str, InSpace] = field(default_factory=dict)
    pressures: dict[str, InSpace | float] = field(default_factory=dict)
    gravity: tuple[float, float] | None = None
    water: float = 1e4
    version: int = 0

    def state(self, table: dict[Any, Any], key: Any, what: Any) -> None:
        """Write a statement down, in the place of an earlier one about the same."""
        old = table.get(key)
        if isinstance(old, Prescribed) and old.kind == what.kind:
            old.values = what.values
        else:
            table[key] = what
            self.version += 1

    def copy(self) -> Statements:
        """The same statements, in tables of their own."""
        tables: dict[str, Any] = {
            key: dict(table) for key, table in vars(self).items() if isinstance(table, dict)
        }
        return replace(self, **tables)

    def forget(self, bodies: Collection[str], surfaces: Collection[str]) -> None:
        """Take back what was stated about bodies and surfaces that are no more."""
        for body in bodies:
            for table in (self.bodies, self.stresses, self.pressures):
                table.pop(body, None)
        for surface in surfaces:
            for name in self.contacts_of(surface):
                del self.contacts[name]
            for component in self.components(surface):
                del self.supports[surface, component]
            for statements in (self.loads, self.drains, self.inflows, self.unloadings):
                statements.pop(surface, None)
        self.version += 1

    @property
    def porous(self) -> list[str]:
        """Names of the porous bodies."""
        return [name for name, body in self.bodies.items() if body.porous]

    def components(self, surface: str) -> list[int]:
        """Directions in which a surface is fixed or moved."""
        return [i for i in (0, 1) if (surface, i) in self.supports]

    def contacts_of(self, surface: str) -> list[str]:
        """Names of the contacts that a surface takes part in."""
        return [n for n, c in self.contacts.items() if surface in (c.secondary, c.primary)]

    def drain(self, surface: str) -> Callable[[float, Float], Any]:
        """Pore pressure [Pa] of a drained surface, from time [s] and coordinates, shape (3, n)."""
        drain, water = self.drains[surface], self.water
        down = (0.0, -1.0) if self.gravity is None else self.gravity

        def pressure(t: float, x: Float) -> Float:
            if drain.kind == "field":
                return at_points(drain.values[0], drain.words, x)
            if drain.kind == "level":
                height = -(x[0] * down[0] + x[1] * down[1])
                return water * np.maximum(drain(t) - height, 0.0)
            return np.full(x.shape[1], drain(t))

        return pressure

    def outside(self, contact: Contact) -> str | None:
        """Drained surface of a contact, whose water stands around the gap."""
        return next((s for s in (contact.secondary, contact.primary) if s in self.drains), None)

    def check(self, domain: Domain) -> None:
        """Refuse statements that do not go together. Collective.

        Raises:
            ValueError: Naming body, surface or contact.
        """
        for name in domain.body_names:
            if name not in self.bodies:
                raise ValueError(f"body '{name}' has no material: scene.body('{name}', ...)")
        weights = any(body.unit_weight for body in self.bodies.values())
        if self.gravity is not None and not weights and not self.porous:
            raise ValueError("there is gravity, but no body has a unit_weight or is porous")
        if self.gravity is None and weights:
            raise ValueError("a body has a unit_weight, but there is no gravity: scene.gravity()")
        for surface in self.loads:
            if self.components(surface) == [0, 1]:
                raise ValueError(
                    f"the load on surface '{surface}' does nothing: it is fixed or moved in x and y"
                )
        for name, contact in self.contacts.items():
            self._check_contact(name, contact, domain)
        for surface, drain in self.drains.items():
            self._check_porous(surface, "drained", domain)
            self._check_drain(surface, drain)
        for surface in self.inflows:
            self._check_porous(surface, "given an inflow", domain)
            if surface in self.drains:
                raise ValueError(f"surface '{surface}' has both an inflow and a drain")
        for name in self.stresses:
            self._check_known(name)
        self.check_pressures(self.pressures)

    def check_pressures(self, bodies: Iterable[str]) -> None:
        """Refuse pore pressures of bodies that have none.

        Raises:
            ValueError: If a body is unknown or dry.
        """
        for name in bodies:
            self._check_known(name)
            if not self.bodies[name].porous:
                raise ValueError(f"body '{name}' is dry and has no initial pore pressure")

    def _check_known(self, body: str) -> None:
        """Refuse an initial state of a body that is not there."""
        if body not in self.bodies:
            raise ValueError(f"the initial state is that of body '{body}', which is unknown")

    def _check_contact(self, name: str, contact: Contact, domain: Domain) -> None:
        """Refuse a contact that cannot be."""
        on = [domain.body_of_surface(s) for s in (contact.secondary, contact.primary)]
        flow = contact.options.get("flow")
        if self.components(contact.secondary):
            raise ValueError(
                f"surface '{contact.secondary}' is fixed or moved and the secondary surface of "
                f"contact '{name}': swap secondary and primary"
            )
        if flow is None:
            return
        if not any(self.bodies[body].porous for body in on):
            raise ValueError(
                f"contact '{name}' has a flow law, but the bodies '{on[0]}' and '{on[1]}' are dry"
            )
        if flow.unit_weight != self.water:
            raise ValueError(
                f"water weighs {flow.unit_weight:g} N/m^3 in contact '{name}' and {self.water:g} in"
                " the bodies: give GapFlow and scene.water the same unit_weight"
            )
        if flow.gravity not in (None, self.gravity):
            raise ValueError(
                f"gravity in the gap of contact '{name}' is {flow.gravity}, that of the scene "
                f"{self.gravity}: leave it to scene.gravity()"
            )

    def _check_drain(self, surface: str, drain: Prescribed) -> None:
        """Refuse free water that cannot be."""
        if drain.kind == "level" and self.gravity is None:
            raise ValueError(f"the level of water at surface '{surface}' needs scene.gravity()")
        for name in self.contacts_of(surface):
            contact = self.contacts[name]
            flow = contact.options.get("flow")
            other = {contact.secondary, contact.primary} & set(self.drains) - {surface}
            if contact.tied:
                raise ValueError(
                    f"surface '{surface}' is drained and tied by contact '{name}': give what the "
                    "other surface does not cover a group of its own, and drain that"
                )
            if flow is None:
                raise ValueError(
                    f"surface '{surface}' is drained, but contact '{name}' has no flow law that "
                    "says what water does where it opens: give it flow=hm.GapFlow(...)"
                )
            if flow.outside is not None:
                raise ValueError(
                    f"contact '{name}' has free water outside twice: by the drain of '{surface}' "
                    "and by outside of its flow law; leave the latter out"
                )
            if other:
                raise ValueError(
                    f"both surfaces of contact '{name}' are drained; drain one, its water stands "
                    "around the gap"
                )

    def _check_porous(self, surface: str, what: str, domain: Domain) -> None:
        """Refuse water at a surface on a dry body. Collective."""
        on = domain.bodies_of_surface(surface)
        if dry := [name for name in on if not self.bodies[name].porous]:
            raise ValueError(
                f"surface '{surface}' is {what}, but body '{dry[0]}' is dry: it has no permeability"
            )


def at_points(value: InSpace | float, words: str, x: Float) -> Float:
    """Values [Pa] at coordinates, shape (3, n), of a function or number.

    Raises:
        ValueError: If a function returns another shape.
    """
    if not callable(value):
        return np.full(x.shape[1], float(value))
    found = np.asarray(value(x), float)
    if found.shape not in ((), (x.shape[1],)):
        raise ValueError(
            f"{words} must have shape ({x.shape[1]},) at {x.shape[1]} points, not {found.shape}"
        )
    return np.broadcast_to(found, x.shape[1])


def _is_number(value: Any) -> bool:
    return np.ndim(value) == 0 and isinstance(value, (int, float, np.number, np.ndarray))
