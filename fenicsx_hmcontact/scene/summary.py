# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a scene contains, in a few lines."""

from __future__ import annotations

import math
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from ..contact import Frictionless, Tied
from ..domain import Domain
from .statements import Prescribed, Statements


def describe(said: Statements, domain: Domain, strain: str | None) -> str:
    """Say in a few lines what a scene contains. Collective.

    Args:
        said: What it says.
        domain: The mesh.
        strain: Kinematics of its runs, None before the first.
    """
    nodes = {name: _count_nodes(domain, name) for name in said.bodies}
    lines = [domain.name + (f", {strain} strain" if strain else ""), "bodies"]
    for name, body in said.bodies.items():
        words = "dry"
        if body.permeability is not None:
            k = body.permeability
            words = f"porous, k = {k:g} m/s" if k.ndim == 0 else f"porous, k = {k.tolist()} m/s"
        weight = f", {body.unit_weight:g} N/m^3" if body.unit_weight else ""
        lines.append(f"  {name}: {words}{weight}; {_name(body.material)}; {nodes[name]} nodes")
    if said.contacts:
        lines.append("contacts")
    for name, contact in said.contacts.items():
        law, flow = contact.friction, contact.options.get("flow")
        rows = "no friction rows" if isinstance(law, Tied | Frictionless) else "with friction rows"
        water = "no flow" if flow is None else _name(flow)
        lines.append(f"  {name}: {_name(law)}, {rows}; {water}")
    wet = sum(nodes[name] for name in said.porous)
    water = f", pore pressure {wet}" if wet else ""
    lines.append(f"unknowns: displacement {2 * sum(nodes.values())}{water}")
    stated = [
        *(f"{surface}: {'xy'[i]} {_shown(p)} m" for (surface, i), p in said.supports.items()),
        *(f"{s}: {p.kind} {_shown(p)} Pa" for s, p in said.loads.items()),
        *(
            f"{s}: free water, {p.kind} {_shown(p)} {'m' if p.kind == 'level' else 'Pa'}"
            + (" outside the gap" if said.contacts_of(s) else "")
            for s, p in said.drains.items()
        ),
        *(f"{s}: inflow {_shown(p)} m/s" for s, p in said.inflows.items()),
    ]
    if said.gravity is not None:
        stated.append(f"gravity: ({said.gravity[0]:g}, {said.gravity[1]:g})")
    lines += ["prescribed", *(f"  {words}" for words in stated or ["nothing"])]
    return "\n".join(lines)


def _count_nodes(domain: Domain, body: str) -> int:
    """Number of nodes of a body. Collective."""
    topology = domain.mesh.topology
    cells = domain.cell_tags.indices[np.isin(domain.cell_tags.values, domain.tags(body))]
    vertices = np.unique(topology.connectivity(2, 0).array.reshape(-1, 3)[cells])
    owned = int(np.sum(vertices < topology.index_map(0).size_local))
    return int(domain.mesh.comm.allreduce(owned))


def _name(law: Any) -> str:
    """A law with those of its values that are numbers."""
    kind = type(law).__name__
    if not is_dataclass(law):
        return kind
    values = {f.name: getattr(law, f.name) for f in fields(law)}
    shown = [
        name if value is True else f"{name}={value:g}"
        for name, value in values.items()
        if isinstance(value, (int, float)) and math.isfinite(value) and value is not False
    ]
    return f"{kind}({', '.join(shown)})" if shown else kind


def _shown(prescribed: Prescribed) -> str:
    """Values, or that they vary."""
    shown = ["f(t)" if callable(value) else f"{value:g}" for value in prescribed.values]
    if prescribed.kind == "field":
        return "f(x)"
    return shown[0] if len(shown) == 1 else f"({', '.join(shown)})"
