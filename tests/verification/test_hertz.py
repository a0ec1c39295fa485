# SPDX-License-Identifier: LGPL-3.0-or-later
"""Disc pressed on a plane, and pushed along it, against Hertz, Cattaneo and Mindlin."""

from mpi4py import MPI

import numpy as np
import pytest

import demos.verification.hertz as demo
import fenicsx_hmcontact as hm
from fenicsx_hmcontact.contact.analytic import stick_half_width

COARSE = ["--h-over-a", "0.2", "--growth", "0.2"]


def disc(*words, comm=MPI.COMM_WORLD):
    """Disc of the demo with given words on its command line, coarse."""
    options, _ = demo.parse([*COARSE, *words])
    return demo.Disc(options, comm)


@pytest.mark.mpi
@pytest.mark.parametrize("smoothing", ["deviatoric", "triangles"])
@pytest.mark.parametrize("secondary", ["cylinder", "plane"])
def test_pressure_and_half_width_are_hertz(secondary, smoothing):
    model = disc("--secondary", secondary, "--smoothing", smoothing)
    iterations, state = model.press()
    assert iterations <= 8
    contact = demo.Contact(model, state)
    assert contact.load == pytest.approx(model.load, rel=1e-10)
    errors = contact.errors()
    assert abs(errors["peak_pressure_error"]) < 0.015
    assert abs(errors["half_width_error"]) < 0.015
    assert errors["pressure_error"] < (0.025 if smoothing != "triangles" else 0.05)
    assert np.abs(contact.q).max() < 1e-8 * contact.p0
    # Closed where it presses, and nowhere beyond the facet that holds the rim
    np.testing.assert_array_equal(state.pressure > 1e-9 * contact.p0, state.closed)
    assert np.all(np.abs(contact.x[contact.p > 1e-9 * contact.p0]) < 1.2 * contact.a)


@pytest.mark.mpi
def test_pressure_on_a_rigid_plane_is_hertz():
    model = disc("--rigid-plane")
    contact = demo.Contact(model, model.press()[1])
    assert contact.load == pytest.approx(model.load, rel=1e-10)
    errors = contact.errors()
    assert abs(errors["peak_pressure_error"]) < 0.02 and abs(errors["half_width_error"]) < 0.015
    assert errors["pressure_error"] < 0.03


def test_error_of_a_small_contact_falls_with_the_mesh():
    # At a/R = 0.0125 half spaces and parabolas are no longer what limits the figures.
    widths = []
    for h_over_a in ("0.2", "0.1"):
        model = disc("--half-width", "0.1", "--h-over-a", h_over_a, "--smoothing", "full")
        errors = demo.Contact(model, model.press()[1]).errors()
        widths.append(abs(errors["half_width_error"]))
    assert widths[1] < 0.004 and widths[1] < 0.5 * widths[0]


@pytest.mark.mpi
@pytest.mark.parametrize("secondary", ["cylinder", "plane"])
def test_pushed_disc_sticks_in_the_middle_and_slips_at_the_rim(secondary):
    mu, part = 0.3, 0.5
    model = disc("--secondary", secondary, "--mu", str(mu), "--h-over-a", "0.1")
    push = part * mu * demo.Contact(model, model.press()[1]).load
    iterations, state = model.push(push)
    assert iterations <= 8
    contact = demo.Contact(model, state, mu)
    # The disc moves along the plane only: equal bodies press as before.
    assert contact.shear_load == pytest.approx(push, rel=1e-4)
    assert contact.load == pytest.approx(model.load, rel=1e-4)
    errors = contact.shear_errors()
    assert errors["shear_error"] < 0.03 and abs(errors["stick_half_width_error"]) < 0.015

    order = np.argsort(state.points[:, 0])
    x, shear, kind = state.points[order, 0], -state.shear[order], state.state[order]
    bound = mu * state.pressure[order]
    slips, sticks = kind == hm.NodeState.SLIPPING, kind == hm.NodeState.STICKING
    np.testing.assert_allclose(shear[slips], bound[slips], rtol=1e-7)
    assert np.all(shear[sticks] < bound[sticks]) and np.all(shear[sticks] > 0.0)
    c = stick_half_width(contact.load, contact.a, contact.shear_load, mu)
    x -= 0.5 * (x[sticks][0] + x[sticks][-1])
    edge = 0.1 * model.options.half_width
    assert np.all(np.abs(x[sticks]) < c + edge) and np.all(np.abs(x[slips]) > c - edge)


@pytest.mark.mpi
def test_where_the_disc_starts_does_not_matter(monkeypatch):
    pressures = []
    for approach in (0.3, 1.2):
        monkeypatch.setattr(demo, "APPROACH", approach)
        model = disc()
        pressures.append(demo.Contact(model, model.press()[1]).p)
    np.testing.assert_allclose(*pressures, rtol=0, atol=1e-7 * pressures[0].max())


@pytest.mark.mpi
def test_same_answer_on_any_number_of_ranks(comm):
    runs = []
    for c in (comm, MPI.COMM_SELF):
        model = disc("--mu", "0.3", comm=c)
        load = demo.Contact(model, model.press()[1]).load
        runs.append(demo.Contact(model, model.push(0.15 * load)[1], 0.3))
    together, alone = runs
    np.testing.assert_allclose(together.p, alone.p, rtol=0, atol=1e-8 * alone.p0)
    np.testing.assert_allclose(together.q, alone.q, rtol=0, atol=1e-8 * alone.p0)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--rigid-plane", "--secondary", "plane"], "cylinder must be secondary"),
        (["--rigid-plane", "--mu", "0.3"], "equal material"),
        (["--mu", "-0.3"], "zero or positive"),
        (["--mu", "0.3", "--push", "1.0"], "between 0 and 1"),
    ],
)
def test_what_has_no_exact_solution_is_refused(comm, words, reason, capsys):
    with pytest.raises(SystemExit):
        demo.parse(words)
    # Rank 0 alone prints.
    assert comm.rank > 0 or reason in capsys.readouterr().err
