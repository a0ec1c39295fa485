# SPDX-License-Identifier: LGPL-3.0-or-later
"""Films of a run by matplotlib: a field on a mesh that moves and changes."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt

from .figures import _labelled, _limits, _outline, style
from .root import on_root
from .series import Frame, read_series

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

EMPTY = "#e6e6e6"
"""Colour of triangles without a value."""

PARTS = 4
"""Parts of the side of a triangle between whose ends colours blend."""

DPI = 100
"""Pixels an inch."""

MARGIN = 0.12
"""White around a picture [inch]."""

type Float = npt.NDArray[np.float64]
type Box = tuple[tuple[float, float], tuple[float, float]]


def film(
    series: str | Path | Iterable[Frame | None],
    path: str | Path,
    *,
    field: str,
    unit: str,
    label: str = "",
    scale: float = 1.0,
    component: int | None = None,
    clim: tuple[float, float] | None = None,
    cmap: str = "viridis",
    edges: bool = False,
    fps: int = 10,
    title: Callable[[float], str] = "t = {:.4g} s".format,
    length_unit: str = "m",
    limits: Box | None = None,
    comm: MPI.Comm = MPI.COMM_WORLD,
) -> Path:
    """Draw a field over a run, each frame on its own mesh. Collective.

    Rank 0 draws. Colours and view are the same in all pictures; triangles without a value are grey.

    Args:
        series: File ``.pvd`` of a `Series`, or frames from `gather_frame`.
        path: File ``.gif``, or ``.mp4`` where there is ffmpeg.
        field: Name of the function to draw.
        unit: Unit of the colours; empty for a pure number.
        label: Quantity; ``field`` by default.
        scale: What values are multiplied by, such as 1e-3 for a pressure in kPa.
        component: Component of a vector or tensor; its norm by default.
        clim: Smallest and largest value of the colours, scaled; those in sight by default.
        cmap: Colour map.
        edges: Whether to draw the triangles.
        fps: Frames a second.
        title: Makes the title of a frame from its time [s].
        length_unit: Unit of the points.
        limits: Smallest and largest x, and y, to be seen; all of the run by default.
        comm: Communicator.

    Returns:
        The file.

    Raises:
        ValueError: If the suffix is unknown, the frame rate is out of range, a frame has no such
            field or component, or no frame has a value in sight.
        RuntimeError: If there is no ffmpeg for an ``.mp4``.
        OSError: If a file cannot be read or written.
    """
    path = Path(path)
    if path.suffix not in (".gif", ".mp4"):
        raise ValueError(f"{path}: a film is written to .gif or .mp4, not {path.suffix!r}")
    if not 1 <= fps <= 100:
        raise ValueError(f"{path}: a film has 1 to 100 frames a second, not {fps:g}")
    kept = [] if isinstance(series, str | Path) else [f for f in series if f is not None]

    def pictures() -> Iterator[_Picture]:
        for frame in read_series(series) if isinstance(series, str | Path) else kept:
            values, nodal = _values(frame, field, component)
            yield _Picture(frame.points, frame.cells, scale * values, nodal, title(frame.time))

    def draw() -> None:
        ffmpeg = _ffmpeg(path) if path.suffix == ".mp4" else ""
        box, in_sight, longest = _survey(pictures(), limits, field)
        low, high = clim or _limits(in_sight)
        colors = {"cmap": cmap, "vmin": low, "vmax": high}
        names = f"x [{length_unit}]", f"y [{length_unit}]", _labelled(label or field, unit)
        path.parent.mkdir(parents=True, exist_ok=True)
        with style():
            figure, axes = _stage(box, colors, names, longest)
            drawn = _draw(axes, pictures(), colors, edges)
            if ffmpeg:
                _write_mp4(figure, drawn, path, fps, ffmpeg)
            else:
                _write_gif(figure, drawn, path, fps, cmap)

    on_root(comm, draw)
    return path


@dataclass(frozen=True, eq=False)
class _Picture:
    """One component of a field.

    Attributes:
        points: Points; shape (N, 2).
        cells: Triangles by rows of points; shape (M, 3).
        values: Values at points, shape (N,), or in triangles, shape (M,).
        nodal: Whether they are at points.
        title: Title.
    """

    points: Float
    cells: npt.NDArray[np.int64]
    values: Float
    nodal: bool
    title: str

    @property
    def in_cells(self) -> Float:
        """Values by triangle; shape (M, 3) or (M, 1)."""
        return self.values[self.cells] if self.nodal else self.values[:, None]


def _values(frame: Frame, field: str, component: int | None) -> tuple[Float, bool]:
    """One component of a field, or its norm, and whether it is at nodes."""
    known = frame.nodal | frame.cellwise
    if field not in known:
        raise ValueError(
            f"the frame at {frame.time:g} has no field {field!r}; it has "
            f"{', '.join(map(repr, known))}"
        )
    array, nodal = known[field], field in frame.nodal
    columns = array.reshape(len(array), -1)
    if component is None:
        return (np.linalg.norm(columns, axis=1) if array.ndim > 1 else array), nodal
    if not 0 <= component < columns.shape[1]:
        raise ValueError(f"{field!r} has {columns.shape[1]} components, none is {component}")
    return columns[:, component], nodal


def _survey(
    pictures: Iterable[_Picture], limits: Box | None, field: str
) -> tuple[Float, Float, str]:
    """Find what the view must hold.

    Returns:
        Smallest and largest x, and y, shape (2, 2); smallest and largest value in sight; the
        longest title.
    """
    view = np.array([[-np.inf, np.inf]] * 2 if limits is None else limits, dtype=np.float64)
    box, ends, longest = np.array([[np.inf, -np.inf]] * 2), np.array([np.inf, -np.inf]), ""
    for picture in pictures:
        corners = picture.points[picture.cells]
        low, high = corners.min(axis=1), corners.max(axis=1)
        values = picture.in_cells[np.all((high >= view[:, 0]) & (low <= view[:, 1]), axis=1)]
        values = values[np.isfinite(values)]
        ends = np.array([values.min(initial=ends[0]), values.max(initial=ends[1])])
        box[:, 0] = np.minimum(box[:, 0], low.min(axis=0))
        box[:, 1] = np.maximum(box[:, 1], high.max(axis=0))
        longest = max(longest, picture.title, key=len)
    if not np.isfinite(ends).all():
        raise ValueError(f"no frame has a value of {field!r} in sight")
    if limits is not None:
        return view, ends, longest
    # Lines on the edge of the view would be cut in half.
    return box + 0.01 * np.ptp(box, axis=1).max() * np.array([-1.0, 1.0]), ends, longest


# --- drawing --------------------------------------------------------------------------------------


def _stage(
    box: Float, colors: dict[str, Any], names: tuple[str, str, str], title: str
) -> tuple[Figure, Axes]:
    """An empty figure for all frames: axes of equal scale, colour bar, no more white than needed.

    Args:
        box: Limits of x and y; shape (2, 2).
        colors: Colour map and its ends.
        names: What is along x, y and the colour bar.
        title: The longest title.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    extent = np.ptp(box, axis=1)
    inch = np.min(np.array([7.5, 5.5]) / np.maximum(extent, 1e-12 * extent.max()))
    size = np.maximum(inch * extent, (1.2, 1.6))
    limits = box.mean(axis=1)[:, None] + 0.5 * size[:, None] / inch * np.array([-1.0, 1.0])

    figure = Figure(figsize=tuple(size), dpi=DPI)
    figure.set_layout_engine("none")
    places = np.array([[0.0, 0.0, *size], [size[0] + 0.15, 0.0, 0.18, size[1]]])
    axes, side = (figure.add_axes(tuple(place / np.tile(size, 2))) for place in places)
    axes.set(xlim=limits[0], ylim=limits[1], xlabel=names[0], ylabel=names[1])
    axes.set_title(title, loc="left")
    axes.grid(False)
    shades = ScalarMappable(Normalize(colors["vmin"], colors["vmax"]), colors["cmap"])
    # No power of ten above the bar, where the title may be.
    bar = figure.colorbar(shades, cax=side, label=names[2], format="{x:.4g}")
    bar.outline.set_visible(False)

    # The figure grows around axes that keep their size; films want even numbers of pixels.
    low, high = figure.get_tightbbox().get_points()
    whole = 2 * np.ceil((high - low + 2 * MARGIN) * DPI / 2) / DPI
    places[:, :2] += MARGIN - low
    figure.set_size_inches(*whole)
    for part, place in zip((axes, side), places, strict=True):
        part.set_position(tuple(place / np.tile(whole, 2)))
    return figure, axes


def _draw(
    axes: Axes, pictures: Iterable[_Picture], colors: dict[str, Any], edges: bool
) -> Iterator[None]:
    """Draw one picture after the other; each is taken away when the next is asked for."""
    from matplotlib.collections import PolyCollection
    from matplotlib.tri import Triangulation

    for picture in pictures:
        x, cells = picture.points, picture.cells
        known = np.isfinite(picture.in_cells).all(axis=1)
        empty: Any = x[cells[~known]]
        artists: list[Any] = [
            axes.add_collection(PolyCollection(empty, facecolors=EMPTY, antialiaseds=False))
        ]
        if known.any():
            if picture.nodal:
                points, values, parts = _divided(x, picture.values, cells[known])
                mesh = Triangulation(points[:, 0], points[:, 1], parts)
                filled = axes.tripcolor(mesh, values, shading="gouraud", **colors)
            else:
                mesh = Triangulation(x[:, 0], x[:, 1], cells[known])
                filled = axes.tripcolor(mesh, facecolors=picture.values[known], **colors)
            artists.append(filled)
        if edges:
            sides = _gapped(x[corners] for corners in cells[:, [0, 1, 2, 0]])
            artists += axes.plot(*sides, color="black", linewidth=0.3, alpha=0.4)
        outline = _gapped(x[loop] for loop in _loops(_outline(cells)))
        artists += axes.plot(*outline, color="black", linewidth=1.0)
        axes.set_title(picture.title, loc="left")
        yield
        for artist in artists:
            artist.remove()


def _divided(
    x: Float, values: Float, cells: npt.NDArray[np.int64]
) -> tuple[Float, Float, npt.NDArray[np.int64]]:
    """Divide triangles evenly: within each colours blend, and blends of far ones are in no map.

    Returns:
        Points [m], shape (n, 2), values there, shape (n,), and triangles, shape (m, 3).
    """
    whole = range(PARTS + 1)
    lattice = {
        (i, j): k for k, (i, j) in enumerate((i, j) for i in whole for j in whole[: PARTS + 1 - i])
    }
    i, j = np.array(list(lattice)).T
    weights = np.column_stack([PARTS - i - j, i, j]) / PARTS
    up = [((i, j), (i + 1, j), (i, j + 1)) for i, j in lattice if i + j < PARTS]
    down = [((i + 1, j), (i + 1, j + 1), (i, j + 1)) for i, j in lattice if i + j < PARTS - 1]
    parts = np.array([[lattice[corner] for corner in part] for part in up + down])
    n = len(weights)
    triangles = n * np.arange(len(cells))[:, None, None] + parts
    points = np.einsum("kc,ncd->nkd", weights, x[cells]).reshape(-1, 2)
    return points, (values[cells] @ weights.T).ravel(), triangles.reshape(-1, 3)


def _loops(edges: npt.NDArray[np.int64]) -> Iterator[list[int]]:
    """Walk along the edges of outlines, which drawn one by one make dotted lines."""
    ends: dict[int, list[int]] = {node: [] for node in edges.ravel().tolist()}
    for a, b in edges.tolist():
        ends[a].append(b)
        ends[b].append(a)
    for start in ends:
        while ends[start]:
            loop = [start]
            while ends[loop[-1]]:
                loop.append(ends[loop[-1]].pop())
                ends[loop[-1]].remove(loop[-2])
            yield loop


def _gapped(lines: Iterable[Float]) -> Float:
    """Points of lines one after the other, with gaps between; shape (2, n)."""
    gap = np.full((1, 2), np.nan)
    return np.concatenate([part for line in lines for part in (line, gap)]).T


def _write_gif(figure: Figure, drawn: Iterable[None], path: Path, fps: int, cmap: str) -> None:
    """Write GIF. One palette for all frames: colours of its own make each of them flicker."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    canvas = FigureCanvasAgg(figure)
    palette = Image.new("P", (1, 1))
    palette.putpalette(_palette(cmap).tobytes())
    images = []
    for _ in drawn:
        canvas.draw()
        image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
        images.append(image.quantize(palette=palette, dither=Image.Dither.NONE))
    first, *others = images
    first.save(path, save_all=True, append_images=others, duration=round(1000 / fps), loop=0)


def _palette(cmap: str) -> npt.NDArray[np.uint8]:
    """Colours of the map, the same under thin lines, and greys; shape (256, 3)."""
    import matplotlib as mpl

    def shades(number: int) -> Float:
        return mpl.colormaps[cmap](np.linspace(0.0, 1.0, number))[:, :3]

    greys = np.linspace(0.0, 1.0, 40)[:, None].repeat(3, axis=1)
    light = shades(136), 0.85 * shades(50), 0.5 * shades(29)
    empty = np.full((1, 3), int(EMPTY[1:3], 16) / 255)
    return np.round(255 * np.concatenate((*light, greys, empty))).astype(np.uint8)


def _write_mp4(figure: Figure, drawn: Iterable[None], path: Path, fps: int, ffmpeg: str) -> None:
    """Write MP4."""
    import matplotlib as mpl
    from matplotlib.animation import FFMpegWriter

    writer = FFMpegWriter(fps=fps, codec="h264")
    with mpl.rc_context({"animation.ffmpeg_path": ffmpeg}), writer.saving(figure, path, DPI):
        for _ in drawn:
            writer.grab_frame()


def _ffmpeg(path: Path) -> str:
    """The program that writes MP4."""
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        return get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        program = shutil.which("ffmpeg")
    if program is None:
        raise RuntimeError(
            f"{path}: there is no ffmpeg; pip install 'fenicsx_hmcontact[film]', or write a .gif"
        )
    return program
