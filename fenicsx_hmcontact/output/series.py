# SPDX-License-Identifier: LGPL-3.0-or-later
"""Series of frames that ParaView plays, each on a mesh of its own."""

from __future__ import annotations

import base64
import struct
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from .fields import check_names, gather_mesh, gather_values
from .root import on_root, write_whole

TYPES = {"<f8": "Float64", "<i8": "Int64", "|u1": "UInt8"}
"""Names of numbers in NumPy and in VTK."""

TRIANGLE = 5
"""Number of this kind of cell in VTK."""

type Float = npt.NDArray[np.float64]
type Int = npt.NDArray[np.int64]
type Grid = tuple[Int, Float, Int]


@dataclass(frozen=True, eq=False)
class Frame:
    """Fields on triangles at one time.

    Attributes:
        time: Time [s].
        points: Where the nodes are then [m]; shape (N, 2).
        cells: Triangles by rows of points; shape (M, 3).
        nodal: Values at nodes by name, nan where there are none; shapes (N,), or (N, components).
        cellwise: Values in triangles likewise; shapes (M,), or (M, components).

    Note:
        Vectors have three components and tensors nine, as in all files of VTK.
    """

    time: float
    points: Float
    cells: Int
    nodal: dict[str, Float]
    cellwise: dict[str, Float]


class Series:
    """Frames of a run, on meshes that move and change, in files that ParaView plays.

    ``run.pvd`` lists the frames, ``run/0000.vtu``, ``run/0001.vtu``, ... hold them. Both are whole
    after each frame, so a run that stops leaves what it has written. Rank 0 writes, in the order of
    the input of the mesh, so that the files do not depend on the number of ranks.

    Attributes:
        path: The file to open.
    """

    def __init__(self, path: str | Path, comm: MPI.Comm, *, start: float | None = None) -> None:
        """Begin a series, or go on with one. Collective.

        Args:
            path: File ``.pvd``; the suffix may be left out.
            comm: Communicator.
            start: Time [s] that a restarted run goes on from; the frames there are up to it stay.
                Without it the first frame replaces what there is.

        Raises:
            ValueError: If the suffix is another one, or the file is no series.
            OSError: If the directory cannot be made, or there is no series to go on with.
        """
        path = Path(path)
        if path.suffix not in ("", ".pvd"):
            raise ValueError(f"{path}: a series is written to .pvd, not {path.suffix!r}")
        self.path = path.with_suffix(".pvd")
        self._comm = comm
        self._folder = path.with_suffix("")
        frames: list[tuple[float, str]] = []

        def begin() -> None:
            if start is not None:
                frames.extend(frame for frame in _listed(self.path) if frame[0] <= start)
            self._folder.mkdir(parents=True, exist_ok=True)

        on_root(comm, begin)
        self._frames = comm.bcast(frames)

    def write(
        self,
        time: float,
        functions: Sequence[fem.Function],
        displacement: fem.Function | tuple[fem.Function, fem.Function] | None = None,
    ) -> None:
        """Append a frame. Collective.

        Args:
            time: Time [s], later than that of the frame before.
            functions: As of `gather_frame`.
            displacement: Likewise.

        Raises:
            ValueError: If the time is not later, or as of `gather_frame`.
            OSError: If the files cannot be written.
        """
        last = self._frames[-1][0] if self._frames else -np.inf
        if not last < time < np.inf:
            raise ValueError(f"{self.path}: no frame at {time:g} can follow one at {last:g}")
        frame = gather_frame(time, functions, displacement)
        name = f"{self._folder.name}/{len(self._frames):04d}.vtu"
        frames = [*self._frames, (float(time), name)]

        def append() -> None:
            assert frame is not None
            _replace(self.path.parent / name, _vtu(frame))
            _replace(self.path, _pvd(frames))

        on_root(self._comm, append)
        self._frames = frames


def gather_frame(
    time: float,
    functions: Sequence[fem.Function],
    displacement: fem.Function | tuple[fem.Function, fem.Function] | None = None,
) -> Frame | None:
    """Collect functions on rank 0, on one mesh in the order of its input. Collective.

    The mesh is the largest of the functions. Others may be on submeshes of it, and are nan
    elsewhere.

    Args:
        time: Time [s].
        functions: Functions, each under its own ``name``: continuous ones by their values at the
            nodes of the mesh, others constant in each cell.
        displacement: What takes the nodes from where the mesh stands to where they are shown [m]: a
            continuous vector function, or two of them, ``(u, u_n)`` for ``u - u_n``.

    Returns:
        The same frame on rank 0 for any number of ranks, None on the other ranks.

    Raises:
        ValueError: If there is no function, two have one name, one is discontinuous without being
            constant in each cell or on a mesh that is no part of the largest, or the displacement
            is no vector at the nodes of this.
    """
    functions = list(functions)
    check_names("frame", functions)
    pair = displacement if isinstance(displacement, tuple) else (displacement, None)
    moving = [f for f in pair if f is not None]
    # No set: all ranks must gather in the same order.
    meshes = {id(f.function_space.mesh): f.function_space.mesh for f in (*moving, *functions)}
    largest = max(meshes.values(), key=lambda mesh: mesh.topology.index_map(2).size_global)
    for f in moving:
        space = f.function_space
        if space.mesh is not largest or space.value_shape != (2,) or not _is_nodal(f):
            raise ValueError(
                f"the displacement {f.name!r} is no continuous vector function on the whole mesh "
                "of the frame"
            )
    grids = dict(zip(meshes, _present(map(gather_mesh, meshes.values())), strict=False))
    values = _present(map(gather_values, functions))
    steps = _present(map(gather_values, moving))
    frames: list[Frame] = []

    def compose() -> None:
        whole = grids[id(largest)]
        nodes, points, cells = whole
        if steps:
            points = points + (steps[0] - steps[1] if steps[1:] else steps[0])
        frame = Frame(float(time), points, np.searchsorted(nodes, cells), {}, {})
        rows = {key: _rows(grid, whole) for key, grid in grids.items()}
        for f, array in zip(functions, values, strict=True):
            found = rows[id(f.function_space.mesh)]
            if found is None:
                raise ValueError(
                    f"the function {f.name!r} is on another mesh, which is no part of that of the "
                    "frame"
                )
            nodal = _is_nodal(f)
            everywhere = np.full((len(nodes if nodal else cells), array.shape[1]), np.nan)
            everywhere[found[0 if nodal else 1]] = array
            target = frame.nodal if nodal else frame.cellwise
            target[f.name] = _spatial(everywhere, f.function_space.value_shape)
        frames.append(frame)

    on_root(largest.comm, compose)
    return frames[0] if frames else None


def read_series(path: str | Path) -> Iterator[Frame]:
    """Read what `Series` wrote, frame by frame. Not collective.

    Args:
        path: File ``.pvd``.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it was written by others.
    """
    path = Path(path)
    for time, name in _listed(path):
        yield _read_frame(path.parent / name, time)


def _present[T](values: Iterable[T | None]) -> list[T]:
    """What was gathered; nothing on ranks other than 0."""
    return [value for value in values if value is not None]


def _is_nodal(function: fem.Function) -> bool:
    return not function.function_space.ufl_element().discontinuous


def _rows(part: Grid, whole: Grid) -> tuple[Int, Int] | None:
    """Rows of a part's nodes and triangles in the whole; None if it is no part."""
    row = {tuple(cell): i for i, cell in enumerate(np.sort(whole[2]).tolist())}
    cells = [row.get(tuple(cell), -1) for cell in np.sort(part[2]).tolist()]
    return None if -1 in cells else (np.searchsorted(whole[0], part[0]), np.array(cells))


def _spatial(values: Float, shape: tuple[int, ...]) -> Float:
    """Scalars of shape (n,), vectors and tensors with the third direction that VTK wants."""
    missing = [(0, 3 - size if size == 2 else 0) for size in shape]
    padded = np.pad(values.reshape(-1, *shape), [(0, 0), *missing])
    return padded.reshape(len(values), -1) if shape else padded


# --- files ----------------------------------------------------------------------------------------


def _replace(path: Path, content: ET.Element) -> None:
    """Write a file whole or not at all."""
    ET.indent(content)
    write_whole(path, ET.tostring(content, encoding="utf-8", xml_declaration=True))


def _pvd(frames: Sequence[tuple[float, str]]) -> ET.Element:
    file = ET.Element("VTKFile", type="Collection", version="1.0")
    collection = ET.SubElement(file, "Collection")
    for time, name in frames:
        ET.SubElement(collection, "DataSet", timestep=repr(time), part="0", file=name)
    return file


def _parse(path: Path) -> ET.Element:
    try:
        return ET.parse(path).getroot()
    except ET.ParseError as error:
        raise ValueError(f"{path} is no file of a Series: {error}") from error


def _listed(path: Path) -> list[tuple[float, str]]:
    """Times and files of the frames of a series."""
    entries = _parse(path).iterfind("Collection/DataSet")
    return [(float(entry.attrib["timestep"]), entry.attrib["file"]) for entry in entries]


def _vtu(frame: Frame) -> ET.Element:
    file = ET.Element(
        "VTKFile",
        type="UnstructuredGrid",
        version="1.0",
        byte_order="LittleEndian",
        header_type="UInt64",
    )
    n_points, n_cells = str(len(frame.points)), str(len(frame.cells))
    grid = ET.SubElement(file, "UnstructuredGrid")
    piece = ET.SubElement(grid, "Piece", NumberOfPoints=n_points, NumberOfCells=n_cells)
    topology: dict[str, npt.NDArray[Any]] = {
        "connectivity": frame.cells.ravel(),
        "offsets": 3 * np.arange(1, len(frame.cells) + 1),
        "types": np.full(len(frame.cells), TRIANGLE, np.uint8),
    }
    sections: dict[str, Mapping[str, npt.NDArray[Any]]] = {
        "PointData": frame.nodal,
        "CellData": frame.cellwise,
        "Points": {"Points": np.pad(frame.points, [(0, 0), (0, 1)])},
        "Cells": topology,
    }
    for section, arrays in sections.items():
        parent = ET.SubElement(piece, section)
        for name, array in arrays.items():
            _add_array(parent, name, array)
    return file


def _add_array(parent: ET.Element, name: str, array: npt.NDArray[Any]) -> None:
    array = array.astype(array.dtype.newbyteorder("<"))
    data = array.tobytes()
    element = ET.SubElement(
        parent,
        "DataArray",
        type=TYPES[array.dtype.str],
        Name=name,
        NumberOfComponents=str(array[:1].size if array.ndim > 1 else 1),
        format="binary",
    )
    element.text = base64.b64encode(struct.pack("<Q", len(data)) + data).decode()


def _read_frame(path: Path, time: float) -> Frame:
    piece = _parse(path).find("UnstructuredGrid/Piece")
    if piece is None:
        raise ValueError(f"{path} is no frame of a Series")
    sections = {
        section.tag: {array.attrib["Name"]: _array(array) for array in section} for section in piece
    }
    return Frame(
        time,
        sections["Points"]["Points"][:, :2],
        sections["Cells"]["connectivity"].reshape(-1, 3),
        sections["PointData"],
        sections["CellData"],
    )


def _array(element: ET.Element) -> npt.NDArray[Any]:
    data = base64.b64decode(element.text or "")
    kind = {vtk: numpy for numpy, vtk in TYPES.items()}[element.attrib["type"]]
    values = np.frombuffer(data, kind, offset=8)
    components = int(element.attrib["NumberOfComponents"])
    return values if components == 1 else values.reshape(-1, components)
