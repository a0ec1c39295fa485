# SPDX-License-Identifier: LGPL-3.0-or-later
"""Pictures of a run: curves and fields by matplotlib, rendered fields by pyvista.

Nothing here is collective: draw on rank 0, from what :py:func:`gather_nodal
<fenicsx_hmcontact.output.fields.gather_nodal>` collects there.
"""

from __future__ import annotations

import functools
import json
import logging
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from ..contact import InterfaceState, NodeState

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

log = logging.getLogger(__name__)

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Colours of curves, told apart by colour-blind eyes too (Okabe and Ito, 2008)."""

MARKERS: dict[NodeState, dict[str, Any]] = {
    NodeState.OPEN: {"marker": "o", "color": "black", "markerfacecolor": "white"},
    NodeState.STICKING: {"marker": "s", "color": "black", "markerfacecolor": "#E69F00"},
    NodeState.SLIPPING: {"marker": "^", "color": "black", "markerfacecolor": "#CC79A7"},
}
"""How secondary nodes are marked; unpaired ones are not."""

FLAT = 1e-6
"""Gaps below this part of the surface's size are drawn as closed: they are round-off."""

MANY = 4
"""A longer legend stands beside the curves, not among them."""

RENDER_LIMIT = 300.0
"""Longest time [s] that one rendered picture may take."""


@contextmanager
def style() -> Iterator[None]:
    """Draw with matplotlib in the one plain style of all figures."""
    import matplotlib as mpl
    from cycler import cycler

    settings: dict[Any, Any] = {
        "figure.figsize": (6.4, 4.4),
        "figure.constrained_layout.use": True,
        "savefig.dpi": 150,
        "savefig.bbox": "tight",
        "font.size": 11,
        "axes.titlesize": 12,
        "axes.prop_cycle": cycler(color=COLORS),
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "axes.axisbelow": True,
        "grid.color": "#dddddd",
        "lines.linewidth": 1.6,
        "lines.markersize": 5,
        "legend.frameon": False,
    }
    with mpl.rc_context(settings):
        yield


def save(figure: Figure, path: str | Path) -> Path:
    """Save a matplotlib figure, making its directory.

    Args:
        figure: Figure.
        path: File, in the format of its suffix.

    Returns:
        The file.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with style():
        figure.savefig(path)
    return path


def curves(
    series: Mapping[str, tuple[npt.ArrayLike, npt.ArrayLike]],
    *,
    x: tuple[str, str],
    y: tuple[str, str],
    reference: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]] = (),
    reference_label: str = "exact",
    scale: tuple[Literal["linear", "log"], Literal["linear", "log"]] = ("linear", "linear"),
    title: str = "",
) -> Figure:
    """Draw computed curves, over the known answer where there is one.

    Args:
        series: Abscissas and ordinates by label; shapes (n,).
        x: Quantity and unit of the abscissa; no unit for a pure number.
        y: Quantity and unit of the ordinate.
        reference: Known curves, dashed and black; shapes (n,).
        reference_label: Their one entry in the legend.
        scale: Scales of abscissa and ordinate.
        title: Title.

    Returns:
        Figure for ``save``.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with style():
        figure = Figure()
        axes = figure.subplots()
        colours = len(mpl.rcParams["axes.prop_cycle"])
        for k, (name, (abscissa, ordinate)) in enumerate(series.items()):
            again = k // colours % 2
            marker = "os"[again] if np.size(abscissa) <= 40 else ""
            axes.plot(abscissa, ordinate, ("-", ":")[again], marker=marker, label=name)
        for i, (abscissa, ordinate) in enumerate(reference):
            label = reference_label if i == 0 else None
            axes.plot(abscissa, ordinate, "--", color="black", linewidth=1.2, label=label)
        axes.set(xscale=scale[0], yscale=scale[1], title=title)
        axes.set(xlabel=_labelled(*x), ylabel=_labelled(*y))
        names = len(series) + bool(reference)
        if names > MANY:
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
        elif names > 1:
            axes.legend()
    return figure


def _labelled(quantity: str, unit: str) -> str:
    return f"{quantity} [{unit}]" if unit else quantity


def contact_plot(
    state: InterfaceState,
    path: str | Path,
    *,
    along: npt.ArrayLike,
    x: tuple[str, str] = ("arc length", "m"),
    reference: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]] = (),
    reference_label: str = "exact",
    title: str = "",
) -> Path:
    """Draw contact pressure and shear along the secondary surface, and the gap below.

    Markers say which nodes are open, sticking and slipping. The pore pressure is drawn where there
    is one.

    Args:
        state: What acts between the surfaces.
        path: File, in the format of its suffix.
        along: Where the nodes are along the surface, as from :py:func:`arc_length
            <fenicsx_hmcontact.output.fields.arc_length>`; shape (n,).
        x: Quantity and unit of this place.
        reference: Known tractions [Pa] by place, dashed and black; shapes (k,).
        reference_label: Their one entry in the legend.
        title: Title.

    Returns:
        The file.

    Raises:
        ValueError: If there is not one finite place a node.
    """
    from matplotlib.figure import Figure

    place = np.asarray(along, dtype=np.float64)
    if place.shape != state.gap.shape or not np.isfinite(place).all():
        raise ValueError(f"along needs {len(state.gap)} finite numbers, one a secondary node")
    order = np.argsort(place, kind="stable")
    tractions = {"contact pressure": state.pressure, "shear": state.shear}
    if state.pore_pressure.any():
        tractions["pore pressure"] = state.pore_pressure
    with style():
        figure = Figure(figsize=(8.0, 5.6))
        upper, lower = figure.subplots(2, sharex=True, height_ratios=(3, 1))
        for name, values in tractions.items():
            upper.plot(place[order], values[order], label=name)
        for i, (s, known) in enumerate(reference):
            label = reference_label if i == 0 else None
            upper.plot(s, known, "--", color="black", linewidth=1.2, label=label)
        lower.plot(place[order], state.gap[order], color="black")
        for axes, ordinates in (
            (upper, (state.pressure, state.shear)),
            (lower, (state.gap,)),
        ):
            of_node = np.column_stack(ordinates)
            _mark(axes, state.state, np.repeat(place[:, None], len(ordinates), axis=1), of_node)
        upper.set(ylabel="traction [Pa]", title=title)
        upper.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
        lower.set(xlabel=_labelled(*x), ylabel="gap [m]")
        size = float(np.ptp(state.points, axis=0).max())
        low, high = np.nanmin(state.gap, initial=0.0), np.nanmax(state.gap, initial=FLAT * size)
        margin = 0.1 * (high - low)
        lower.set_ylim(low - margin, high + margin)
    return save(figure, path)


def _mark(
    axes: Axes,
    states: npt.NDArray[np.int8],
    x: npt.NDArray[np.float64],
    y: npt.NDArray[np.float64],
) -> None:
    """Mark points of nodes by their state; states of shape (n,), points (n, ...)."""
    for kind, marker in MARKERS.items():
        here = states == kind
        if here.any():
            points = x[here].ravel(), y[here].ravel()
            axes.plot(*points, linestyle="", label=kind.name.lower(), **marker)


def field_plot(
    points: npt.ArrayLike,
    cells: npt.ArrayLike,
    values: npt.ArrayLike,
    path: str | Path,
    *,
    label: str,
    unit: str,
    title: str = "",
    cmap: str = "viridis",
    clim: tuple[float, float] | None = None,
    edges: bool = False,
    length_unit: str = "m",
    displacement: npt.ArrayLike | None = None,
    states: Sequence[InterfaceState] = (),
    limits: tuple[tuple[float, float], tuple[float, float]] | None = None,
) -> Path:
    """Draw a field on triangles with matplotlib.

    Args:
        points: Points; shape (N, 2).
        cells: Triangles by rows of points; shape (M, 3).
        values: Values at points, shape (N,) or (N, 1), or in triangles, shape (M,) or (M, 1).
        path: File, in the format of its suffix.
        label: Quantity.
        unit: Its unit; empty for a pure number.
        title: Title.
        cmap: Colour map.
        clim: Smallest and largest value of the colours; those of the field in sight by default.
        edges: Whether to draw the triangles.
        length_unit: Unit of the points.
        displacement: Of the points, to draw them where they have moved; shape (N, 2).
        states: Contact pairs whose secondary nodes are marked by state, where they are now.
        limits: Smallest and largest x, and y, to be seen; all of the field by default.

    Returns:
        The file.

    Raises:
        ValueError: If shapes do not fit, a number is not finite, or limits hold no triangle.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure
    from matplotlib.tri import Triangulation

    x, triangles, field = _checked(points, cells, values, label)
    if displacement is not None:
        moved = np.asarray(displacement, dtype=np.float64)
        if moved.shape != x.shape or not np.isfinite(moved).all():
            raise ValueError(f"{label}: displacements need {len(x)} finite pairs of numbers")
        x = x + moved
    box = np.array([x.min(axis=0), x.max(axis=0)]).T if limits is None else np.array(limits, float)
    low, high = clim or _limits(_in_sight(x, triangles, field, box, label))
    colors: dict[str, Any] = {"cmap": cmap, "vmin": low, "vmax": high}
    mesh = Triangulation(x[:, 0], x[:, 1], triangles)
    # Room for labels and bar around a field that keeps its aspect.
    size = np.ptp(box, axis=1)
    size = np.maximum(size, 1e-12 * size.max())
    width, height = np.maximum(size * min(7.5 / size[0], 5.5 / size[1]), (1.2, 1.6))
    with style():
        figure = Figure(figsize=(width + 2.4, height + 1.1))
        axes = figure.subplots()
        drawn: Any
        if len(field) == len(x):
            drawn = axes.tripcolor(mesh, field, shading="gouraud", **colors)
        else:
            drawn = axes.tripcolor(mesh, facecolors=field, **colors)
        if edges:
            axes.triplot(mesh, color="black", linewidth=0.3, alpha=0.4)
        outline = x[_outline(triangles)]
        axes.add_collection(LineCollection(list(outline), colors="black", linewidths=1.0))
        if states:
            nodes = np.concatenate([state.points for state in states])
            _mark(axes, np.concatenate([state.state for state in states]), *nodes.T)
            if axes.get_legend_handles_labels()[0]:
                figure.legend(loc="outside lower center", ncols=len(MARKERS))
        if limits is not None:
            axes.set(xlim=box[0], ylim=box[1])
        bar = figure.colorbar(drawn, ax=axes, label=_labelled(label, unit), pad=0.03)
        bar.outline.set_visible(False)
        axes.set(aspect="equal", title=title)
        axes.set(xlabel=f"x [{length_unit}]", ylabel=f"y [{length_unit}]")
        axes.grid(False)
    return save(figure, path)


def render_field(
    points: npt.ArrayLike,
    cells: npt.ArrayLike,
    values: npt.ArrayLike,
    path: str | Path,
    *,
    label: str,
    unit: str,
    title: str = "",
    cmap: str = "viridis",
    clim: tuple[float, float] | None = None,
    edges: bool = False,
) -> Path | None:
    """Render a field on triangles with pyvista, off screen and in a process of its own.

    Args:
        points: Points; shape (N, 2).
        cells: Triangles by rows of points; shape (M, 3).
        values: Values at points, shape (N,) or (N, 1), or in triangles, shape (M,) or (M, 1).
        path: PNG file.
        label: Quantity.
        unit: Its unit; empty for a pure number.
        title: Title.
        cmap: Colour map.
        clim: Smallest and largest value of the colours; those of the field by default.
        edges: Whether to draw the triangles.

    Returns:
        The file, or None where this machine cannot render; then the log says what is missing.

    Raises:
        ValueError: If shapes do not fit or a number is not finite.
        RuntimeError: If this machine can render, but not this picture.
    """
    path = Path(path)
    x, triangles, field = _checked(points, cells, values, label)
    missing = renderer_missing()
    if missing:
        log.warning("no picture %s: %s", path, missing)
        return None
    options = {
        "name": _labelled(label, unit),
        "title": title,
        "cmap": cmap,
        "clim": clim or _limits(field),
        "edges": edges,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    error = _render(x, triangles, field, options, path)
    if error:
        raise RuntimeError(f"the picture {path} failed: {error}")
    return path


@functools.cache
def renderer_missing() -> str:
    """Find out once, by a trial picture, whether pyvista can render here.

    Returns:
        What to install; empty where rendering works.
    """
    triangle = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    options = {"name": "", "title": "", "cmap": "viridis", "clim": (0.0, 2.0), "edges": False}
    with tempfile.TemporaryDirectory() as directory:
        trial = Path(directory) / "trial.png"
        error = _render(triangle, np.array([[0, 1, 2]]), np.arange(3.0), options, trial)
    if not error:
        return ""
    if "ModuleNotFoundError" in error:
        return f"{error}; pip install 'fenicsx_hmcontact[plot]'"
    return f"pyvista cannot render here ({error}); apt install libegl1 libgl1-mesa-dri"


def _render(
    points: npt.NDArray[np.float64],
    cells: npt.NDArray[np.int64],
    values: npt.NDArray[np.float64],
    options: dict[str, Any],
    path: Path,
) -> str:
    """Run the drawing process; returns what went wrong, empty if nothing did."""
    # A process that finds the variables of mpirun would take itself for one of its ranks.
    launcher = re.compile(r"PMI|HYD|MPI|OMPI|PRTE")
    environment = {k: v for k, v in os.environ.items() if not launcher.match(k)}
    with tempfile.TemporaryDirectory() as directory:
        data = Path(directory) / "field.npz"
        outline = _outline(cells)
        np.savez(
            data,
            points=points,
            cells=cells,
            values=values,
            outline=outline,
            options=json.dumps(options),
        )
        script = Path(__file__).with_name("_render.py")
        try:
            done = subprocess.run(
                [sys.executable, "-P", script, data, path],
                env=environment,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                timeout=RENDER_LIMIT,
            )
        except subprocess.TimeoutExpired:
            return f"no picture within {RENDER_LIMIT:g} s"
    if done.returncode < 0:
        return signal.Signals(-done.returncode).name
    if done.returncode == 0 and path.exists():
        return ""
    return (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]


def _outline(cells: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Edges of one triangle only, the outlines of the bodies; shape (num_edges, 2)."""
    edges = np.sort(cells[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    return unique[count == 1]


def _limits(field: npt.NDArray[np.float64]) -> tuple[float, float]:
    """Ends of the colour scale: round-off shown as zero, a constant in the middle."""
    low, high = float(field.min()), float(field.max())
    largest = max(abs(low), abs(high))
    low, high = (0.0 if abs(end) < 1e-12 * largest else end for end in (low, high))
    if low == high:
        margin = 0.1 * largest or 1.0
        return low - margin, high + margin
    return low, high


def _in_sight(
    x: npt.NDArray[np.float64],
    triangles: npt.NDArray[np.int64],
    field: npt.NDArray[np.float64],
    box: npt.NDArray[np.float64],
    label: str,
) -> npt.NDArray[np.float64]:
    """Values of triangles that lie at least partly between the limits of x and y; box (2, 2)."""
    corners = x[triangles]
    seen = (corners.max(axis=1) >= box[:, 0]) & (corners.min(axis=1) <= box[:, 1])
    inside = seen.all(axis=1)
    if not inside.any():
        raise ValueError(f"{label}: no triangle lies within the limits {box.tolist()}")
    return field[triangles[inside]] if len(field) == len(x) else field[inside]


def _checked(
    points: npt.ArrayLike, cells: npt.ArrayLike, values: npt.ArrayLike, label: str
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Arrays of a picture, with values of shape (N,) or (M,)."""
    x = np.asarray(points, dtype=np.float64)
    triangles = np.asarray(cells, dtype=np.int64)
    field = np.asarray(values, dtype=np.float64)
    if x.ndim != 2 or x.shape[1] != 2 or triangles.ndim != 2 or triangles.shape[1] != 3:
        raise ValueError(f"{label}: points and triangles have shapes {x.shape}, {triangles.shape}")
    if field.shape[1:] not in ((), (1,)) or len(field) not in (len(x), len(triangles)):
        raise ValueError(
            f"{label}: values of shape {field.shape} fit neither {len(x)} points nor "
            f"{len(triangles)} triangles; a picture shows one component"
        )
    if not (np.isfinite(x).all() and np.isfinite(field).all()):
        raise ValueError(f"{label}: not all points and values are finite")
    return x, triangles, field.ravel()
