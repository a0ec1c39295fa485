# SPDX-License-Identifier: LGPL-3.0-or-later
"""What is needed of gmsh: a session, quadrilaterals to draw with, and the arrays of a model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt

from fenicsx_hmcontact.domain.mesh_arrays import MeshArrays

_KINDS = {1: ("surface", "Line 2", 2), 2: ("body", "Triangle 3", 3)}

_DELAUNAY = 5


@contextmanager
def gmsh_session(name: str) -> Iterator[Any]:
    """Give the gmsh module with a new, empty model, and leave gmsh as it was found.

    Args:
        name: Name of the model.

    Raises:
        ImportError: If gmsh is not installed or lacks system libraries.
    """
    try:
        import gmsh
    except (ImportError, OSError) as raised:
        raise ImportError(
            f"gmsh cannot be imported ({raised}). Install it with "
            "pip install 'fenicsx_hmcontact[mesh]' and its system libraries, on Debian with "
            "apt install libgl1 libglu1-mesa libxrender1 libxcursor1 libxfixes3 libxft2 "
            "libxinerama1 libx11-6 libfontconfig1 libgomp1."
        ) from raised
    found_running = bool(gmsh.isInitialized())
    if not found_running:
        gmsh.initialize(readConfigFiles=False, interruptible=False)
    terminal, current = gmsh.option.getNumber("General.Terminal"), gmsh.model.getCurrent()
    own = f"fenicsx_hmcontact {name}"
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.add(own)
        yield gmsh
    finally:
        if found_running:
            gmsh.model.setCurrent(own)
            gmsh.model.remove()
            gmsh.model.setCurrent(current)
            gmsh.option.setNumber("General.Terminal", terminal)
        else:
            gmsh.finalize()


def check_sizes(h: float, finest: dict[str, float], growth: float, **lengths: float) -> None:
    """Refuse sizes of a mesh that make no sense, by name.

    Args:
        h: Longest edges [m].
        finest: Shortest edges [m], by the name of their option.
        growth: By how much edges grow per distance.
        lengths: Other lengths [m] and ratios.

    Raises:
        ValueError: If a length or ratio is not positive, growth negative, or the finest above h.
    """
    for name, value in ({"h": h} | finest | lengths).items():
        if not value > 0.0:
            raise ValueError(f"{name} must be positive, it is {value}.")
    if not growth >= 0.0:
        raise ValueError(f"growth must be zero or positive, it is {growth}.")
    for name, value in finest.items():
        if not value <= h:
            raise ValueError(f"{name} must be at most h, it is {value}.")


def add_quadrilateral(
    gmsh: Any,
    corners: Sequence[tuple[float, float]],
    edges: tuple[int, int, int, int],
    *,
    unstructured: bool = False,
) -> tuple[int, list[int]]:
    """Add a quadrilateral with given numbers of edges on its sides to the current gmsh model.

    Args:
        gmsh: The gmsh module, inside a session.
        corners: Corners [m], counterclockwise.
        edges: Mesh edges on the sides, the first side from the first to the second corner.
        unstructured: Triangulate by Delaunay; otherwise rows of triangles, diagonals all one way.

    Returns:
        Tags of the surface and of its four sides.
    """
    geo = gmsh.model.geo
    points = [geo.addPoint(x, y, 0.0) for x, y in corners]
    sides = [geo.addLine(points[i], points[(i + 1) % 4]) for i in range(4)]
    surface = geo.addPlaneSurface([geo.addCurveLoop(sides)])
    # Through geo, since the next synchronize forgets what is set through model.mesh.
    for side, number in zip(sides, edges, strict=True):
        geo.mesh.setTransfiniteCurve(side, number + 1)
    if unstructured:
        geo.mesh.setAlgorithm(2, surface, _DELAUNAY)
    else:
        geo.mesh.setTransfiniteSurface(surface, "Right", points)
    geo.synchronize()
    return surface, sides


def align_nodes(
    gmsh: Any,
    surface: int,
    corners: Sequence[tuple[float, float]],
    edges: tuple[int, int, int, int],
    *,
    jitter: float = 0.0,
    seed: int | Sequence[int] = 0,
) -> None:
    """Put the nodes of a meshed, structured quadrilateral with upright sides exactly on its grid.

    gmsh places nodes on a line to about 1e-12 only, too little where water flows along the rows
    many orders of magnitude more easily than across.

    Args:
        gmsh: The gmsh module, inside a session.
        surface: Tag of the quadrilateral.
        corners: Its corners [m], counterclockwise from the lower left.
        edges: Mesh edges on its sides, from the lower one on.
        jitter: Largest random shift of inner nodes, as a part of the cell.
        seed: Seed of the random shifts.
    """
    (x0, y0), (x1, y1), (_, y2), (_, y3) = corners
    nodes, points, _ = gmsh.model.mesh.getNodes(2, surface, includeBoundary=True)
    x, y, _ = points.reshape(-1, 3).T
    along = (x - x0) / (x1 - x0)
    low, high = y0 + along * (y1 - y0), y3 + along * (y2 - y3)
    size = np.array(edges[:2])
    grid = np.rint(np.column_stack([along, (y - low) / (high - low)]) * size)
    inner = ((grid > 0) & (grid < size)).all(axis=1)
    grid[inner] += jitter * np.random.default_rng(seed).uniform(-1.0, 1.0, (inner.sum(), 2))

    along, up = (grid / size).T
    low, high = y0 + along * (y1 - y0), y3 + along * (y2 - y3)
    moved = np.column_stack([x0 + along * (x1 - x0), (1 - up) * low + up * high, 0 * up])
    for node, point in zip(nodes, moved, strict=True):
        gmsh.model.mesh.setNode(node, point, [])


def extract(model: Any, source: str) -> MeshArrays:
    """Arrays of the bodies and surfaces of a meshed gmsh model.

    Args:
        model: ``gmsh.model``; its current model is read.
        source: File or model, for messages.

    Raises:
        ValueError: If groups are missing, empty or without name, cells are in no or in two groups,
            or elements are no straight-sided triangles and facets.
    """
    solids = model.mesh.getElementTypes(3)
    if len(solids):
        kind = model.mesh.getElementProperties(solids[0])[0]
        raise ValueError(f"{source}: the mesh is three-dimensional ('{kind}'); it must be plane.")
    if not model.getPhysicalGroups():
        raise ValueError(
            f"{source}: no physical groups. Name the bodies (2-D groups) and surfaces (1-D groups)."
        )
    if not len(model.mesh.getElementTypes(2)):
        raise ValueError(f"{source}: no triangles, the mesh holds nothing of two dimensions.")
    _refuse_wrong_groups(model, source)
    _refuse_cells_outside_one_group(model, source)

    node_tags, points, _ = model.mesh.getNodes()
    order = np.argsort(node_tags)
    cells, cell_groups, bodies = _elements(model, 2, source)
    facets, facet_groups, surfaces = _elements(model, 1, source)
    return MeshArrays(
        points.reshape(-1, 3)[order],
        np.searchsorted(node_tags, cells, sorter=order),
        cell_groups,
        np.searchsorted(node_tags, facets, sorter=order),
        facet_groups,
        bodies,
        surfaces,
    )


def _refuse_wrong_groups(model: Any, source: str) -> None:
    groups = model.getPhysicalGroups()
    for dim, tag in groups:
        name = model.getPhysicalName(dim, tag)
        if dim not in _KINDS:
            raise ValueError(
                f"{source}: physical group '{name or tag}' has dimension {dim}; only bodies (2-D) "
                "and surfaces (1-D) can be used."
            )
        if not name:
            raise ValueError(
                f"{source}: the {_KINDS[dim][0]} group with tag {tag} has no name (of its own)."
            )
    # gmsh does not list a group without entities, but it knows its name.
    highest = max(1000, *(tag for _, tag in groups))
    for dim, (kind, _, _) in _KINDS.items():
        for tag in range(1, highest + 1):
            name = model.getPhysicalName(dim, tag)
            if name and (dim, tag) not in groups:
                raise ValueError(
                    f"{source}: {kind} group '{name}' is empty; if it is not wanted, remove its "
                    "name as well (gmsh.model.removePhysicalName)."
                )


def _refuse_cells_outside_one_group(model: Any, source: str) -> None:
    for _, entity in model.getEntities(2):
        node_lists = model.mesh.getElements(2, entity)[2]
        tags = model.getPhysicalGroupsForEntity(2, entity)
        if len(tags) == 1 or not node_lists:
            continue
        x, y, _ = model.mesh.getNode(node_lists[0][0])[0]
        where = f"the cells of gmsh surface {entity} (one at ({x:.6g}, {y:.6g}))"
        names = " and ".join(f"'{model.getPhysicalName(2, tag)}'" for tag in tags)
        raise ValueError(
            f"{source}: {where} are in {f'the body groups {names}' if names else 'no body group'}; "
            "every cell must be in exactly one."
        )


def _elements(
    model: Any, dim: int, source: str
) -> tuple[npt.NDArray[np.uint64], npt.NDArray[np.int32], dict[str, int]]:
    """Node tags and group tags of all grouped elements of a dimension, and the groups by name."""
    group_kind, wanted, num_nodes = _KINDS[dim]
    nodes = [np.empty((0, num_nodes), dtype=np.uint64)]
    group_tags = [np.empty(0, dtype=np.int32)]
    names: dict[str, int] = {}
    for _, tag in model.getPhysicalGroups(dim):
        name = model.getPhysicalName(dim, tag)
        names[name], found = tag, 0
        for entity in model.getEntitiesForPhysicalGroup(dim, tag):
            element_types, _, node_lists = model.mesh.getElements(dim, entity)
            for element_type, node_list in zip(element_types, node_lists, strict=True):
                kind = model.mesh.getElementProperties(element_type)[0]
                if kind != wanted:
                    raise ValueError(
                        f"{source}: {group_kind} group '{name}' holds elements '{kind}'; only "
                        f"'{wanted}' can be used (first order, no recombination)."
                    )
                nodes.append(node_list.reshape(-1, num_nodes))
                group_tags.append(np.full(len(nodes[-1]), tag, dtype=np.int32))
                found += len(nodes[-1])
        if not found:
            raise ValueError(f"{source}: {group_kind} group '{name}' is empty, it has no elements.")
    return np.concatenate(nodes), np.concatenate(group_tags), names
