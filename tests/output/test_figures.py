# SPDX-License-Identifier: LGPL-3.0-or-later
import logging

import numpy as np
import pytest
import scipy.ndimage

from fenicsx_hmcontact import InterfaceState
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


# --- contact ------------------------------------------------------------------------------------

X = np.array([2.0, 0.0, 4.0, 1.0, 3.0])
KINDS = np.array([1, 0, -1, 2, 1], np.int8)


def contact(**values):
    """What acts on five nodes at X, in no order, the last of which along X is unpaired."""
    points = np.column_stack((X, np.zeros(5)))
    normals = np.tile((0.0, 1.0), (5, 1))
    pressure = np.where(KINDS == -1, np.nan, 10.0 * X)
    gap = np.where(KINDS == -1, np.nan, np.where(KINDS == 0, 0.5, 1e-17))
    zero = np.zeros(5)
    fields = dict(
        points=points,
        normals=normals,
        pressure=pressure,
        shear=-0.3 * pressure,
        pore_pressure=zero,
        jump=zero,
        gap=gap,
        slip=zero,
        state=KINDS,
        length=np.ones(5),
        forces=np.zeros((5, 2)),
        volume=0.0,
        primary_points=points,
        primary_forces=np.zeros((5, 2)),
        water_forces=np.zeros((5, 2)),
    )
    return InterfaceState(**(fields | values))


@pytest.fixture
def drawn(monkeypatch, tmp_path):
    """Figures that were saved."""
    result, save = [], figures.save
    monkeypatch.setattr(figures, "save", lambda f, path: (result.append(f), save(f, path))[1])
    return result


def lines(axes):
    """Data of lines with a label, of those with one label together, sorted."""
    result = {}
    for line in axes.get_lines():
        result.setdefault(line.get_label(), []).append(line.get_xydata())
    return {name: np.concatenate(parts) for name, parts in result.items()}


def test_contact_plot(tmp_path, drawn):
    reference = [([0, 5], [1, 1]), ([0, 5], [2, 2])]
    path = figures.contact_plot(
        contact(), tmp_path / "new" / "contact.png", along=X, reference=reference, title="Strip"
    )
    assert path.read_bytes().startswith(b"\x89PNG")
    upper, lower = drawn[0].axes
    assert upper.get_shared_x_axes().joined(upper, lower) and upper.get_title() == "Strip"
    labels = upper.get_ylabel(), lower.get_ylabel(), lower.get_xlabel()
    assert labels == ("traction [Pa]", "gap [m]", "arc length [m]")
    above, below = lines(upper), lines(lower)
    names = [text.get_text() for text in upper.get_legend().get_texts()]
    tractions = ["contact pressure", "shear", "exact"]
    assert names == [*tractions, "open", "sticking", "slipping"]
    s = np.arange(5.0)
    known = [0, 10, 20, 30, np.nan]
    np.testing.assert_array_equal(above["contact pressure"], np.column_stack((s, known)))
    np.testing.assert_allclose(above["shear"][:, 1], -0.3 * np.array(known))
    np.testing.assert_array_equal(above["sticking"], [[2, 20], [2, -6], [3, 30], [3, -9]])
    np.testing.assert_array_equal(above["slipping"], [[1, 10], [1, -3]])
    np.testing.assert_array_equal(below["open"], [[0, 0.5]])
    assert len(below["sticking"]) == 2 and len(below["slipping"]) == 1
    markers = {line.get_label(): line.get_marker() for line in upper.get_lines()}
    assert len({markers[name] for name in names[3:]}) == 3


def test_contact_plot_shows_the_pore_pressure_and_no_round_off(tmp_path, drawn):
    closed = contact(pore_pressure=np.full(5, 7.0), gap=np.linspace(-1e-16, 1e-16, 5))
    figures.contact_plot(closed, tmp_path / "a.png", along=X / 2.0, x=("x / a", ""))
    upper, lower = drawn[0].axes
    np.testing.assert_array_equal(lines(upper)["pore pressure"][:, 1], 7.0)
    low, high = lower.get_ylim()
    assert -1e-6 < low < 0.0 and 1e-7 < high < 1e-5
    assert lower.get_xlabel() == "x / a"


@pytest.mark.parametrize("along", [X[:-1], np.where(X == 0.0, np.nan, X), X[:, None]])
def test_contact_plot_needs_a_place_of_every_node(tmp_path, along):
    with pytest.raises(ValueError, match="along needs 5 finite numbers"):
        figures.contact_plot(contact(), tmp_path / "a.png", along=along)


def test_field_plot_of_what_has_moved(tmp_path, drawn):
    # The lower half becomes 2 m by 0.5 m, and its grey patch with it.
    displacement = np.column_stack((np.zeros(6), np.where(POINTS[:, 1] == 1.0, -0.5, 0.0)))
    path = figures.field_plot(
        POINTS,
        CELLS,
        [0.75, 0.75, 0, 0],
        tmp_path / "moved.png",
        label="p",
        unit="Pa",
        cmap="gray",
        clim=(0, 1),
        displacement=displacement,
        states=[contact()],
    )
    (rows, columns), _ = largest_patch(path, 0.75)
    assert (columns.stop - columns.start) / (rows.stop - rows.start) == pytest.approx(4, rel=0.05)
    marks = lines(drawn[0].axes[0])
    np.testing.assert_array_equal(marks["open"], [[0, 0]])
    np.testing.assert_array_equal(marks["sticking"], [[2, 0], [3, 0]])
    np.testing.assert_array_equal(marks["slipping"], [[1, 0]])
    (legend,) = drawn[0].legends
    assert [text.get_text() for text in legend.get_texts()] == ["open", "sticking", "slipping"]


@pytest.mark.parametrize("by", ["point", "triangle"])
def test_field_plot_of_a_part(tmp_path, drawn, by):
    values = [1, 2, 3, 4] if by == "triangle" else [1, 1, 2, 2, 5, 5]
    box = (0.5, 1.5), (1.5, 1.9)
    figures.field_plot(
        POINTS, CELLS, values, tmp_path / "part.png", label="p", unit="Pa", limits=box
    )
    axes = drawn[0].axes[0]
    assert (axes.get_xlim(), axes.get_ylim()) == box
    # Colours are those of the upper half, in sight.
    assert axes.collections[0].get_clim() == ((3, 4) if by == "triangle" else (2, 5))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"displacement": np.zeros((4, 2))}, "displacements need 6 finite pairs"),
        ({"displacement": np.full((6, 2), np.nan)}, "displacements need 6 finite pairs"),
        ({"limits": ((3, 4), (0, 1))}, "no triangle lies within the limits"),
    ],
)
def test_field_plot_refuses_what_does_not_fit(tmp_path, options, message):
    with pytest.raises(ValueError, match=f"pore pressure: {message}"):
        figures.field_plot(
            POINTS,
            CELLS,
            range(6),
            tmp_path / "a.png",
            label="pore pressure",
            unit="Pa",
            **options,
        )
