# SPDX-License-Identifier: LGPL-3.0-or-later
"""A footing pushed into the ground above a cavity: water, closure, load and condition numbers."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from demos import footing_penetration as demo
from fenicsx_hmcontact.contact import NodeState
from fenicsx_hmcontact.output.report import Report

pytestmark = pytest.mark.mpi


def push(*words):
    """Push the footing in with the options of the command line; options, history and scene."""
    options, _ = demo.parse(["--quick", *words])
    water = demo.waters(options)[0]
    scene, history = demo.push(options, water, Report("footing_penetration", demo.comm, {}))
    return options, history, scene


@pytest.fixture(scope="module")
def pushed():
    """The quick run with water, until the centre of the cavity closes."""
    return push("--settlement", "0.4", "--steps", "8", "--duration", "1200")


def test_steps_converge_and_keep_the_water(pushed):
    options, history, _ = pushed
    assert not history.failure and len(history.load) == options.steps
    assert history.settlement[-1] == pytest.approx(options.settlement, rel=1e-12)
    assert np.median(history.iterations) <= 6
    assert 0.0 < history.lost < 1e-8 * history.moved


def test_cavity_is_squeezed_until_its_centre_closes(pushed):
    _, history, _ = pushed
    closed, gap = history.closure_step, np.array(history.gap)
    assert closed is not None and 4 <= closed <= 8
    assert np.all(np.diff(gap[: closed - 1]) < 0.0) and np.all(np.diff(history.volume) < 0.0)
    # Water is left beside the centre.
    assert abs(gap[-1]) < 1e-12 and 0.0 < history.volume[-1] < history.volume[0]
    assert history.jump["pressure_drop"] < 1e-12


def test_closure_does_not_hurt_the_condition_number(pushed):
    _, history, scene = pushed
    before = slice(0, history.closure_step - 1)
    assert max(history.condition) < 1e2 * max(history.condition[before])
    # A conventional element is singular once both its ends are closed.
    state = scene.model.contact("cavity")
    closed = replace(state, state=np.full_like(state.state, NodeState.STICKING))
    assert demo.conventional_condition(scene.model, closed) > 1e13
    assert max(history.conventional[before]) < 1e7


def test_load_is_that_of_a_strip_and_symmetric(pushed):
    options, history, scene = pushed
    strip = (2.0 + np.pi) * options.c * 2.0 * options.half_width
    assert np.all(np.diff(history.load) > -0.05 * strip)
    # The mesh widens the footing by half an edge on each side, and it is embedded.
    assert strip < history.load[-1] < 1.5 * strip
    assert abs(scene.model.force("footing_top")[0]) < 1e-2 * history.load[-1]
    assert max(history.asymmetry) < 1e-2


def test_trapped_water_holds_the_cavity_open(pushed):
    _, history, _ = pushed
    words = "--printed", "--settlement", "0.1", "--steps", "2", "--duration", "300"
    _, printed, _ = push(*words, "--h", "0.5")
    assert not printed.failure
    assert printed.gap[-1] > history.gap[1] and printed.volume[-1] > 1.1 * history.volume[1]
    assert printed.lost < 1e-8 * printed.moved


@pytest.mark.slow
def test_film_of_trapped_water_keeps_the_faces_apart_for_long():
    options, _ = demo.parse(["--h", "0.4", "--printed"])
    report = Report("footing_penetration", demo.comm, {})
    _, history = demo.push(options, "printed", report, conditions=False)
    assert not history.failure and len(history.load) == options.steps
    # With water they meet in step 5, and the cavity is empty at the end.
    assert history.closure_step >= 7
    assert history.volume[-1] > 0.85 * history.volume[0] > 0.1


def test_demo_writes_report_and_pictures(comm, shared_tmp_path, monkeypatch):
    report = shared_tmp_path / "report.json"
    words = ["--settlement", "0.05", "--steps", "1", "--duration", "150", "--h", "0.5"]
    where = ["--out", str(shared_tmp_path), "--report", str(report)]
    monkeypatch.setattr(sys, "argv", ["footing_penetration.py", "--quick", *words, *where])
    demo.main()
    comm.barrier()
    figures = json.loads(report.read_text())["figures"]
    assert len(figures["load_curve"]) == len(figures["condition_number_conventional"]) == 1
    assert figures["failed_steps"] == 0 and figures["closure_step"] == {"water": None}
    for name in ("fig8_condition_number", "fig9_pore_pressure_water", "fig10_shear_stress_water"):
        assert (shared_tmp_path / f"{name}.png").stat().st_size > 10_000
    assert (shared_tmp_path / "water.gif").stat().st_size > 10_000
