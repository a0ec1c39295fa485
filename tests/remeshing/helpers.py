# SPDX-License-Identifier: LGPL-3.0-or-later
"""Meshes, outlines and a flow past a footing for the tests of remeshing."""

from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve

from fenicsx_hmcontact.domain.mesh_arrays import MeshArrays
from fenicsx_hmcontact.remeshing import areas


def block(nx, ny=None, *, width=1.0, height=1.0, base=0.0, layers=1):
    """A rectangle of triangles in turning directions; on top, edges left of ``base`` are its own.

    Its layers are groups 1, 2, ... from the bottom; surfaces bottom, right, ground, left, base.
    """
    ny = ny or nx
    x, y = np.meshgrid(np.linspace(0.0, width, nx + 1), np.linspace(-height, 0.0, ny + 1))
    at = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (v.ravel() for v in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    turn = np.indices((ny, nx)).sum(axis=0).ravel() % 2 == 1
    cells = np.vstack(
        [
            np.column_stack([a, b, np.where(turn, d, c)]),
            np.column_stack([np.where(turn, b, a), c, d]),
        ]
    )
    group = 1 + np.repeat(np.arange(ny) * layers // ny, nx)
    k = int(np.sum(x[-1] < base))
    sides = dict(bottom=at[0], right=at[:, -1], ground=at[-1, k:], left=at[:, 0])
    sides |= dict(base=at[-1, : k + 1])
    chains = [np.column_stack([nodes[:-1], nodes[1:]]) for nodes in sides.values()]
    return MeshArrays(
        np.column_stack([x.ravel(), y.ravel(), 0.0 * x.ravel()]),
        cells,
        np.tile(group, 2).astype(np.int32),
        np.concatenate(chains),
        np.repeat(np.arange(1, 6), [len(chain) for chain in chains]).astype(np.int32),
        {f"layer_{i}" if layers > 1 else "soil": i for i in range(1, layers + 1)},
        {name: i for i, name in enumerate(sides, 1)},
    )


def moved(arrays, shift):
    """The mesh with its nodes moved by ``shift(x, y)``."""
    points = arrays.points.copy()
    points[:, :2] += np.column_stack(np.broadcast_arrays(*shift(*points[:, :2].T)))
    return replace(arrays, points=points)


def side_by_side(one, other):
    """Two meshes of one body each in one; their names get the endings _0 and _1."""
    n, tags = len(one.points), max(one.surfaces.values())
    return MeshArrays(
        np.vstack([one.points, other.points]),
        np.vstack([one.cells, other.cells + n]),
        np.concatenate([one.cell_groups, other.cell_groups + 1]),
        np.vstack([one.facets, other.facets + n]),
        np.concatenate([one.facet_groups, other.facet_groups + tags]),
        {"soil_0": 1, "soil_1": 2},
        {f"{name}_0": tag for name, tag in one.surfaces.items()}
        | {f"{name}_1": tag + tags for name, tag in other.surfaces.items()},
    )


def body_area(arrays):
    """Area of all triangles."""
    return float(areas(arrays.points, arrays.cells).sum())


def loop(first, n):
    """Directed edges around a chain of nodes."""
    nodes = first + np.arange(n)
    return np.column_stack([nodes, np.roll(nodes, -1)])


def star(rng, n, roughness):
    """Corners of a polygon around the origin, whose radii fall below one by up to ``roughness``."""
    angle = (np.arange(n) + rng.uniform(0.1, 0.9, n)) * 2 * np.pi / n
    radius = 1.0 - roughness * rng.uniform(size=n)
    return radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])


def inside(points, outline):
    """Whether points are in a polygon: a ray to the right crosses it an odd number of times."""
    odd = np.zeros(len(points), bool)
    for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        across = (a[1] > points[:, 1]) != (b[1] > points[:, 1])
        at = a[0] + (points[:, 1] - a[1]) / np.where(across, b[1] - a[1], 1.0) * (b[0] - a[0])
        odd ^= across & (points[:, 0] < at)
    return odd


def flow_past_footing(arrays, sweeps=8):
    """Velocity of a nearly incompressible, perfectly plastic ground under a base that sinks.

    A viscosity that falls with the rate makes the flow as localised as below a real footing.
    """
    x, cells, n = arrays.points[:, :2], arrays.cells, len(arrays.points)
    area = areas(x, cells)
    edge = x[np.roll(cells, -1, axis=1)] - x[np.roll(cells, 1, axis=1)]
    gx, gy = edge[..., 1] / (2 * area[:, None]), -edge[..., 0] / (2 * area[:, None])
    strain = np.zeros((len(cells), 3, 6))
    strain[:, 0, 0::2] = strain[:, 2, 1::2] = gx
    strain[:, 1, 1::2] = strain[:, 2, 0::2] = gy
    stiffness = np.array([[11.0, 9.0, 0.0], [9.0, 11.0, 0.0], [0.0, 0.0, 1.0]])
    dofs = (2 * cells[..., None] + [0, 1]).reshape(-1, 6)
    rows, columns = np.repeat(dofs, 6, axis=1).ravel(), np.tile(dofs, 6).ravel()

    velocity, fixed = np.zeros(2 * n), np.zeros(2 * n, bool)
    for name, tag in arrays.surfaces.items():
        nodes = np.unique(arrays.facets[arrays.facet_groups == tag])
        fixed[2 * nodes] |= name != "ground"
        fixed[2 * nodes + 1] |= name in ("base", "bottom")
        if name == "base":
            velocity[2 * nodes + 1] = -1.0
    viscosity = np.ones(len(cells))
    for _ in range(sweeps):
        blocks = np.einsum("eia,ij,ejb->eab", strain, stiffness, strain)
        blocks *= (area * viscosity)[:, None, None]
        matrix = coo_array((blocks.ravel(), (rows, columns)), shape=(2 * n, 2 * n)).tocsc()
        known = np.where(fixed, velocity, 0.0)
        velocity[~fixed] = spsolve(matrix[~fixed][:, ~fixed], -(matrix @ known)[~fixed])
        rate = np.einsum("eia,ea->ei", strain, velocity[dofs])
        shear = np.hypot(rate[:, 0] - rate[:, 1], rate[:, 2])
        viscosity = 1.0 / (shear / shear.max() + 1e-3)
    return velocity.reshape(-1, 2)
