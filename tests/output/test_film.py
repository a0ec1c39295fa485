# SPDX-License-Identifier: LGPL-3.0-or-later
import sys

import numpy as np
import pytest
import scipy.ndimage
from dolfinx import fem
from dolfinx.mesh import create_unit_square

from fenicsx_hmcontact.output.film import EMPTY, film
from fenicsx_hmcontact.output.series import Series, gather_frame
from tests.models import stack

pytest.importorskip("matplotlib")
Image = pytest.importorskip("PIL.Image")

pytestmark = pytest.mark.mpi

LOW, HIGH = (0, 0, 255), (255, 0, 0)
"""Ends of the colour map "bwr", whose middle is white."""


def pictures(path):
    """Colours of all frames; shape (num_frames, height, width, 3)."""
    with Image.open(path) as file:
        frames = []
        for k in range(file.n_frames):
            file.seek(k)
            frames.append(np.asarray(file.convert("RGB"), dtype=int))
    return np.array(frames)


def patch(picture, color):
    """Rows and columns of the largest patch of one colour; empty if there is none."""
    patches, count = scipy.ndimage.label(np.abs(picture - color).max(axis=2) <= 4)
    if not count:
        return slice(0, 0), slice(0, 0)
    return scipy.ndimage.find_objects(patches)[np.bincount(patches.ravel())[1:].argmax()]


def extent(box):
    return np.array([side.stop - side.start for side in box])


def constant(comm, value, shift=0.0, n=4, element=("DG", 0)):
    """Frame of one value on a square of another mesh each, shifted to the right."""
    mesh = create_unit_square(comm, n, n)
    f = fem.Function(fem.functionspace(mesh, element), name="strain")
    u = fem.Function(fem.functionspace(mesh, ("P", 1, (2,))))
    f.x.array[:] = value
    u.x.array[::2] = shift
    return gather_frame(n, [f], u)


@pytest.mark.parametrize("element", [("DG", 0), ("P", 1)])
def test_colours_and_view_hold_for_the_whole_film(comm, shared_tmp_path, element):
    options = [(0.0, 0.0, 4), (3.0, 0.5, 5), (3.0, 1.0, 7)]
    frames = [constant(comm, value, shift, n, element) for value, shift, n in options]
    path = shared_tmp_path / "new" / "run.gif"
    assert film(frames, path, field="strain", unit="-", cmap="bwr", fps=5, comm=comm) == path
    if comm.rank > 0:
        return
    with Image.open(path) as file:
        assert (file.n_frames, file.info["duration"]) == (3, 200)
    shots = pictures(path)
    assert shots.shape[1] % 2 == 0 and shots.shape[2] % 2 == 0
    boxes = [patch(shots[0], LOW), patch(shots[1], HIGH), patch(shots[2], HIGH)]
    for box in boxes:
        rows, columns = extent(box)
        assert rows > 200 and rows / columns == pytest.approx(1, rel=0.02)
        assert box[0] == boxes[0][0]
    shifts = [(box[1].start - boxes[0][1].start) / extent(boxes[0])[1] for box in boxes]
    assert shifts == pytest.approx([0, 0.5, 1], abs=0.02)
    # Nothing but body and title changes: axes and colour bar stand still.
    moving = np.ptp(shots, axis=0).max(axis=2) > 0
    body = slice(boxes[0][0].start - 3, boxes[0][0].stop + 3)
    bar = boxes[2][1].stop + 10
    assert moving[body, boxes[0][1]].any() and not moving[body, bar:].any()
    assert not moving[body.stop :].any()


def test_series_with_a_field_of_a_part(comm, shared_tmp_path):
    series = Series(shared_tmp_path / "run", comm)
    for k in range(3):
        domain = stack(comm, [2 + k, 3])
        part, _ = domain.submesh("block_0")
        u = fem.Function(fem.functionspace(domain.mesh, ("P", 1, (2,))), name="u")
        p = fem.Function(fem.functionspace(part.mesh, ("P", 1)), name="p")
        u.x.array[:] = 0.1 * k
        p.x.array[:] = 1e3
        series.write(k, [u, p], u)
    path = shared_tmp_path / "run.gif"
    film(series.path, path, field="p", unit="kPa", scale=1e-3, clim=(1, 3), cmap="bwr", comm=comm)
    if comm.rank > 0:
        return
    for shot in pictures(path):
        dry = patch(shot, tuple(int(EMPTY[i : i + 2], 16) for i in (1, 3, 5)))
        wet = patch(shot, LOW)
        np.testing.assert_allclose(extent(dry), extent(wet), atol=4)
        assert 0 <= wet[0].start - dry[0].stop < 5 and dry[1] == wet[1]


def test_norm_component_limits_edges_and_titles(comm, shared_tmp_path):
    frames, titles = [], []
    for t in (0.0, 86400.0):
        mesh = create_unit_square(comm, 2, 2)
        u = fem.Function(fem.functionspace(mesh, ("P", 1, (2,))), name="u")
        u.x.array[::2], u.x.array[1::2] = 3.0, -4.0
        frames.append(gather_frame(t, [u]))

    def title(t):
        titles.append(t)
        return f"day {t / 86400:g}"

    common = {"field": "u", "unit": "m", "cmap": "bwr", "clim": (-4.0, 5.0), "comm": comm}
    norm, component = shared_tmp_path / "norm.gif", shared_tmp_path / "component.gif"
    film(frames, norm, title=title, edges=True, **common)
    film(frames, component, component=1, limits=((0.25, 0.75), (0.0, 0.5)), **common)
    if comm.rank > 0:
        return
    assert set(titles) == {0.0, 86400.0}
    shots = pictures(norm)
    assert len(shots) == 2
    # The mesh of 2 x 2 squares cut in half: the largest triangle of one colour is half of one.
    triangle = extent(patch(shots[0], HIGH))
    assert triangle[0] == pytest.approx(triangle[1], abs=4)
    shot = pictures(component)[0]
    inside = patch(shot, LOW)
    assert extent(inside)[0] / extent(inside)[1] == pytest.approx(1, rel=0.02)
    assert extent(inside)[0] == pytest.approx(2 * triangle[0], rel=0.1)


def test_refusals(comm, shared_tmp_path):
    frames = [constant(comm, 1.0), constant(comm, np.nan)]
    options = {"field": "strain", "unit": "-", "comm": comm}
    path = shared_tmp_path / "run.gif"
    for series, change, message in (
        (frames, {"path": "run.avi"}, r"to \.gif or \.mp4, not '\.avi'"),
        (frames, {"fps": 0}, "1 to 100 frames a second, not 0"),
        (frames, {"field": "p"}, "the frame at 4 has no field 'p'; it has 'strain'"),
        (frames, {"component": 1}, "'strain' has 1 components, none is 1"),
        (frames[1:], {}, "no frame has a value of 'strain' in sight"),
        ([], {}, "no frame has a value of 'strain' in sight"),
        (frames, {"limits": ((2, 3), (2, 3))}, "no frame has a value of 'strain' in sight"),
    ):
        with pytest.raises(ValueError, match=message):
            film(series, **({"path": path} | options | change))
    with pytest.raises(FileNotFoundError):
        film(shared_tmp_path / "none.pvd", path, **options)
    comm.Barrier()
    assert not path.exists()


def test_mp4_without_ffmpeg(comm, shared_tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setenv("PATH", "")
    path = shared_tmp_path / "run.mp4"
    with pytest.raises(RuntimeError, match=r"there is no ffmpeg; pip .*\[film\]"):
        film([constant(comm, 1.0)], path, field="strain", unit="-", comm=comm)
    comm.Barrier()
    assert not path.exists()


def test_mp4(comm, shared_tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    frames = [constant(comm, value, n=n) for n, value in enumerate((0.0, 1.0, 2.0, 3.0), start=2)]
    path = shared_tmp_path / "run.mp4"
    film(frames, path, field="strain", unit="-", cmap="bwr", fps=5, comm=comm)
    if comm.rank == 0:
        assert ffmpeg.count_frames_and_secs(str(path)) == (4, pytest.approx(0.8))
