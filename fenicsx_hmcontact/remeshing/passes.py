# SPDX-License-Identifier: LGPL-3.0-or-later
"""The remesh: when it is due, and rounds of merges, removals and insertions in every body."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fenicsx_hmcontact.domain.mesh_arrays import MeshArrays
from fenicsx_hmcontact.remeshing.bodies import gather, merges_of, separate
from fenicsx_hmcontact.remeshing.body import Body
from fenicsx_hmcontact.remeshing.boundary import merge_short_edges, split_long_edges
from fenicsx_hmcontact.remeshing.crease import fill_creases
from fenicsx_hmcontact.remeshing.edges import Bools, Floats
from fenicsx_hmcontact.remeshing.insertion import open_small_angles, split_long_edges_inside
from fenicsx_hmcontact.remeshing.options import Remeshing
from fenicsx_hmcontact.remeshing.quality import nodal_sizes
from fenicsx_hmcontact.remeshing.removal import remove_close_nodes
from fenicsx_hmcontact.remeshing.transfer import Merges, Transfer
from fenicsx_hmcontact.remeshing.triangulation import TriangulationError
from fenicsx_hmcontact.remeshing.trigger import Quality, reasons


@dataclass(frozen=True, eq=False)
class Remeshed:
    """What a remesh made.

    Attributes:
        arrays: The new mesh; the very same object if nothing changed.
        sizes: Target size of its nodes [m], for the next remesh; shape (n_new,).
        transfer: From old nodes to new ones.
        merges: Areas that bodies lost or gained.
        counts: For each body how often an operation was done.
        quality: Of the bodies that were remeshed, for the next `due`.
        unsettled: Bodies that would change further in more rounds.
    """

    arrays: MeshArrays
    sizes: Floats
    transfer: Transfer
    merges: Merges
    counts: dict[str, dict[str, int]]
    quality: dict[str, Quality]
    unsettled: list[str]

    @property
    def changed(self) -> bool:
        """Whether any triangle did."""
        return any(any(counts.values()) for counts in self.counts.values())


def target_sizes(arrays: MeshArrays) -> Floats:
    """Target size [m] of every node of the first mesh: the mean length of its edges."""
    return nodal_sizes(arrays.points, arrays.cells)


def due(
    arrays: MeshArrays,
    sizes: Floats,
    options: Remeshing,
    *,
    step: int = 1,
    after_last: Mapping[str, Quality] | None = None,
    area_ratios: Floats | None = None,
    held: Bools | None = None,
    layers: Mapping[str, Sequence[str]] | None = None,
) -> dict[str, list[str]]:
    """Bodies that call for a remesh after a step.

    Args:
        arrays: The mesh as it is.
        sizes: Target size of the nodes [m]; shape (n_points,).
        options: The limits.
        step: Number of the step, from 1 on, for ``options.every``.
        after_last: Quality of bodies right after their last remesh. What that could not cure fires
            only once it is clearly worse.
        area_ratios: Areas of the triangles relative to those at the start of the step [-]; shape
            (n_cells,).
        held: As of `remesh`.
        layers: As of `remesh`.

    Returns:
        The reasons for each of these bodies.
    """
    always = []
    if options.every is not None and step % options.every == 0:
        always.append(f"every {options.every} steps")
    if options.rule is not None and options.rule(arrays):
        always.append("the rule says so")
    found = {}
    for name, body in separate(arrays, sizes, options, held, layers).items():
        ratios = None
        if area_ratios is not None:
            ratios = area_ratios[np.isin(arrays.cell_groups, body.groups)]
        last = (after_last or {}).get(name)
        why = reasons(Quality.of(body), options, area_ratios=ratios, after_last=last)
        if why or always:
            found[name] = why + always
    return found


def remesh(
    arrays: MeshArrays,
    sizes: Floats,
    options: Remeshing,
    *,
    names: Collection[str] | None = None,
    held: Bools | None = None,
    layers: Mapping[str, Sequence[str]] | None = None,
) -> Remeshed:
    """Rebuild the triangles of bodies over their nodes, some of which come and go.

    Every body is triangulated by itself. Edges of its boundary and between its layers are never
    flipped; where they are halved or merged, their parts stay in their surface (Section 3.4).

    Args:
        arrays: The mesh as it is; every body has nodes of its own.
        sizes: Target size of the nodes [m]; shape (n_points,).
        options: What the triangles are to look like.
        names: Bodies to remesh; all if None.
        held: Nodes that stay, and with them the edges between two of them, in addition to those of
            the surfaces ``options.keep``; shape (n_points,).
        layers: Bodies that consist of several groups, with the names of these groups.

    Returns:
        The new mesh and how to get there. A second call with it changes nothing, unless it says
        that a body has not settled.

    Raises:
        TriangulationError: If a triangle is inverted and the boundary of its body crosses itself
            or has left nodes behind: then the step must be undone.
        ValueError: If there is no such body or surface.
    """
    bodies = separate(arrays, sizes, options, held, layers)
    for name in names or ():
        if name not in bodies:
            raise ValueError(f"unknown body '{name}'; known: {', '.join(bodies)}")
    quality, unsettled = {}, []
    for name, body in bodies.items():
        if names is None or name in names:
            try:
                if not _settle(body):
                    unsettled.append(name)
            except TriangulationError as error:
                raise TriangulationError(f"body '{name}': {error}") from error
            quality[name] = Quality.of(body)
    merges = merges_of(bodies.values(), len(arrays.points))
    mesh, new_sizes, transfer = arrays, sizes, Transfer.identity(len(arrays.points))
    if any(body.changed for body in bodies.values()):
        mesh, new_sizes, transfer = gather(arrays, list(bodies.values()))
    counts = {name: body.counts for name, body in bodies.items()}
    return Remeshed(mesh, new_sizes, transfer, merges, counts, quality, unsettled)


def _settle(body: Body) -> bool:
    """Repeat all operations until nothing changes; whether that was reached."""
    body.retriangulate()
    for _ in range(body.options.rounds):
        changed = fill_creases(body) + merge_short_edges(body) + split_long_edges(body)
        changed += remove_close_nodes(body)
        changed += split_long_edges_inside(body)
        changed += open_small_angles(body)
        if not changed:
            return True
    return False
