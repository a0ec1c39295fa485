# SPDX-License-Identifier: LGPL-3.0-or-later
import logging

import numpy as np
import pytest
import scipy.ndimage

from fenicsx_hmcontact.output import figures
from fenicsx_hmcontact.output.root import on_root

pytest.importorskip("matplotlib")

POINTS = np.array([[0, 0], [2, 0], [2, 1], [0, 1], [0, 2], [2, 2.0]])
CELLS = np.array([[0, 1, 2], [0, 2, 3], [3, 2, 5], [3, 5, 4]])


@pytest.fixture(autouse=True)
def fresh_trial():
    """Forget whether this machine renders: tests hide the renderer."""
    figures.renderer_missing.cache_clear()
    yield
    figures.renderer_missing.cache_clear()


def largest_patch(path, grey):
    """Bounding box of the largest patch of one grey, and the size of the picture [px]."""
    from matplotlib.image import imread

    picture = imread(path)[:, :, :3]
    patches, _ = scipy.ndimage.label(np.all(np.abs(picture - grey) < 0.006, axis=2))
    largest = np.bincount(patches.ravel())[1:].argmax()
    box = scipy.ndimage.find_objects(patches)[largest]
    return box, picture.shape


def check_lower_half(path):
    """The lower half, 2 m by 1 m, is one grey patch of that shape, inside the picture."""
    (rows, columns), (height, width, _) = largest_patch(path, 0.75)
    assert (columns.stop - columns.start) / (rows.stop - rows.start) == pytest.approx(2, rel=0.02)
    assert height / 2 < (rows.start + rows.stop) / 2 and rows.stop < height
    assert 0 < columns.start and columns.stop < width


def hide_renderers(monkeypatch, directory):
    """Put broken libraries in front of those that render."""
    for name in ("EGL.so", "EGL.so.1", "OSMesa.so", "OSMesa.so.6", "OSMesa.so.8"):
        (directory / f"lib{name}").write_text("broken")
    monkeypatch.setenv("LD_LIBRARY_PATH", str(directory))
    monkeypatch.delenv("DISPLAY", raising=False)


def replace_pyvista(monkeypatch, directory, text):
    (directory / "pyvista.py").write_text(text)
    monkeypatch.setenv("PYTHONPATH", str(directory))


def test_curves():
    t = np.array([1.0, 10, 100])
    figure = figures.curves(
        {"coarse": (t, 2 * t), "fine": (np.arange(50.0), np.arange(50.0))},
        x=("time", "s"),
        y=("degree of consolidation", ""),
        reference=[(t, t), (t, 3 * t)],
        scale=("log", "linear"),
        title="Column",
    )
    (axes,) = figure.axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("time [s]", "degree of consolidation")
    assert (axes.get_xscale(), axes.get_yscale(), axes.get_title()) == ("log", "linear", "Column")
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels == ["coarse", "fine", "exact"]
    coarse, fine, known, also_known = axes.get_lines()
    np.testing.assert_array_equal(coarse.get_xydata(), np.column_stack((t, 2 * t)))
    np.testing.assert_array_equal(also_known.get_xydata(), np.column_stack((t, 3 * t)))
    assert (coarse.get_marker(), fine.get_marker()) == ("o", "")
    assert (known.get_color(), known.get_linestyle()) == ("black", "--")
    assert (coarse.get_color(), fine.get_color()) == figures.COLORS[:2]


def test_one_curve_needs_no_legend():
    figure = figures.curves({"column": ([0, 1], [0, 1])}, x=("time", "s"), y=("gap", "m"))
    assert figure.axes[0].get_legend() is None


def test_style_leaves_no_trace():
    import matplotlib as mpl

    before = mpl.rcParams.copy()
    with figures.style():
        assert mpl.rcParams["axes.grid"] and not before["axes.grid"]
    assert mpl.rcParams == before


def test_save_makes_the_directory(tmp_path):
    figure = figures.curves({"column": ([0, 1], [0, 1])}, x=("time", "s"), y=("gap", "m"))
    path = figures.save(figure, tmp_path / "new" / "curve.png")
    assert path.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("by", ["point", "triangle"])
def test_field_plot(tmp_path, by):
    # Triangles: lower half at 0.75, upper at 0. Points: 0.75 but for a ramp in the upper half.
    values = [0.75, 0.75, 0, 0] if by == "triangle" else [[0.75]] * 4 + [[0.0]] * 2
    path = figures.field_plot(
        POINTS,
        CELLS,
        values,
        tmp_path / "field.png",
        label="pore pressure",
        unit="kPa",
        cmap="gray",
        clim=(0, 1),
    )
    check_lower_half(path)


@pytest.mark.mpi
def test_render_field(comm, shared_tmp_path, monkeypatch):
    missing = comm.bcast(figures.renderer_missing() if comm.rank == 0 else None)
    if missing:
        pytest.skip(missing)
    # What mpirun sets for a rank; a process with it set cannot start MPI.
    monkeypatch.setenv("PMI_FD", "99")

    def draw():
        path = figures.render_field(
            POINTS,
            CELLS,
            [0.75, 0.75, 0, 0],
            shared_tmp_path / "new" / "field.png",
            label="pore pressure",
            unit="kPa",
            cmap="gray",
            clim=(0, 1),
        )
        check_lower_half(path)
        # A closed gap everywhere, on a body of micrometres.
        path = shared_tmp_path / "gap.png"
        assert path == figures.render_field(
            POINTS * 1e-6, CELLS, np.zeros(6), path, label="gap", unit="m", edges=True
        )

    on_root(comm, draw)


def test_without_renderer_the_picture_is_skipped_and_the_log_says_so(tmp_path, monkeypatch, caplog):
    pytest.importorskip("pyvista")
    hide_renderers(monkeypatch, tmp_path)
    with caplog.at_level(logging.INFO):
        for name in ("a.png", "b.png"):
            path = tmp_path / name
            assert figures.render_field(POINTS, CELLS, range(6), path, label="p", unit="Pa") is None
            assert not path.exists()
    assert [record.getMessage() for record in caplog.records] == [
        f"no picture {tmp_path / name}: pyvista cannot render here (SIGSEGV); "
        "apt install libegl1 libgl1-mesa-dri"
        for name in ("a.png", "b.png")
    ]


def test_without_pyvista_the_log_says_what_to_install(tmp_path, monkeypatch, caplog):
    missing = "ModuleNotFoundError: No module named 'pyvista'"
    replace_pyvista(
        monkeypatch, tmp_path, "raise ModuleNotFoundError(\"No module named 'pyvista'\")"
    )
    path = tmp_path / "a.png"
    assert figures.render_field(POINTS, CELLS, range(6), path, label="p", unit="Pa") is None
    (record,) = caplog.records
    assert record.getMessage() == (
        f"no picture {path}: {missing}; pip install 'fenicsx_hmcontact[plot]'"
    )


def test_a_renderer_that_hangs_is_none(monkeypatch):
    monkeypatch.setattr(figures, "RENDER_LIMIT", 0.01)
    assert "no picture within 0.01 s" in figures.renderer_missing()


def test_the_drawing_process_sees_nothing_of_mpirun(tmp_path, monkeypatch):
    for name in ("PMI_RANK", "PMIX_RANK", "HYDI_CONTROL_FD", "MPI_LOCALRANKID", "OMPI_COMM_WORLD"):
        monkeypatch.setenv(name, "1")
    monkeypatch.setenv("KEPT_PMI", "1")
    replace_pyvista(monkeypatch, tmp_path, "import os; raise OSError(' '.join(os.environ))")
    monkeypatch.setattr(figures, "renderer_missing", lambda: "")
    with pytest.raises(RuntimeError) as error:
        figures.render_field(POINTS, CELLS, range(6), tmp_path / "a.png", label="p", unit="Pa")
    names = str(error.value).split()
    assert "KEPT_PMI" in names and "PATH" in names
    assert not [name for name in names if name.startswith(("PMI", "HYD", "MPI", "OMPI"))]


def test_a_picture_that_fails_is_an_error(tmp_path, monkeypatch):
    replace_pyvista(monkeypatch, tmp_path, "raise ValueError('no such colour map')")
    monkeypatch.setattr(figures, "renderer_missing", lambda: "")
    with pytest.raises(RuntimeError, match=r"a\.png failed: ValueError: no such colour map"):
        figures.render_field(POINTS, CELLS, range(6), tmp_path / "a.png", label="p", unit="Pa")


@pytest.mark.parametrize("draw", [figures.field_plot, figures.render_field])
@pytest.mark.parametrize(
    ("points", "cells", "values", "message"),
    [
        (POINTS, CELLS, [1.0, 2.0], "fit neither 6 points nor 4 triangles"),
        (POINTS, CELLS, np.ones((6, 2)), "a picture shows one component"),
        (POINTS, CELLS, [0, 1, np.nan, 0, 1, 2], "pore pressure: not all points and values"),
        (np.zeros((6, 3)), CELLS, range(6), "points and triangles have shapes"),
        (POINTS, CELLS[:, :2], range(6), "points and triangles have shapes"),
    ],
)
def test_wrong_arrays_are_refused(tmp_path, draw, points, cells, values, message):
    with pytest.raises(ValueError, match=message):
        draw(points, cells, values, tmp_path / "a.png", label="pore pressure", unit="Pa")
