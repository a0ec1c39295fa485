# SPDX-License-Identifier: LGPL-3.0-or-later
"""A footing pushed deep: what remeshes keep, what they change, and what they book."""

import json
import sys

import numpy as np
import pytest

import fenicsx_hmcontact as hm
from demos.verification import remeshing as demo
from fenicsx_hmcontact.output.report import Report

pytestmark = pytest.mark.mpi


def run(comm, folder, *words):
    """Figures of a quick run of the demo."""
    options, _ = demo.parse(["--quick", "--out", str(folder), *words])
    report = Report("remeshing", comm, {})
    demo.CASES[options.case](options, report)
    return report.figures


@pytest.fixture(scope="module")
def pushed():
    """A quick push with remeshing: options, run and curve."""
    options, _ = demo.parse(["--quick"])
    return options, *demo.penetrate(options, Report("remeshing", demo.comm, {}))


def test_footing_is_pushed_with_sound_triangles(pushed):
    options, simulation, curve = pushed
    assert not curve.failure and curve.depth[-1] == pytest.approx(options.settlement, rel=1e-14)
    assert simulation.records and curve.inverted == 0
    assert all(record.smallest_angle[1] > 20.0 for record in simulation.records)
    assert curve.balance < 1e-13
    assert sum(record.merged_total for record in simulation.records) < 5e-4 * options.width**2
    assert abs(simulation.drifts()["stress kappa"]) < 0.03


def test_load_of_a_footing_pushed_deep(pushed):
    options, _, curve = pushed
    assert 0 < len(curve.jumps) + curve.left_out and max(curve.jumps) < 0.08
    loads = demo.loads_of(curve, options)
    assert list(loads) == ["0.25"]
    # Between a footing on the surface and one embedded, which the mesh overestimates.
    assert demo.embedded(0.0, options) == pytest.approx(2.0 + np.pi)
    corrected = loads["0.25"] / (1.0 + demo.wider(options))
    assert 2.0 + np.pi < corrected < 1.05 * demo.embedded(0.5, options)


def test_twins_leave_the_run_as_it_is(comm, pushed):
    options, watched, curve = pushed
    alone = hm.Simulation(
        lambda domain: demo.Footing(domain, options),
        demo.ground(options),
        hm.Remeshing(keep=("base",), fire_angle=options.fire_angle),
    )
    other = demo.push(alone, options, "")
    assert [r.step for r in alone.records] == [r.step for r in watched.records]
    tolerance = 0.0 if comm.size == 1 else 1e-11
    np.testing.assert_allclose(other.load, curve.load, rtol=tolerance)


def test_without_remeshing_loads_are_the_same_until_triangles_turn_over(comm, pushed):
    options, simulation, curve = pushed
    plain = demo.penetrate(options, Report("remeshing", comm, {}), remeshing=False)[1]
    first = simulation.records[0].step
    difference = np.abs(np.array(plain.load[1 : first + 2]) / curve.load[1 : first + 2] - 1.0)
    assert difference[:first].max() <= (0.0 if comm.size == 1 else 1e-11)
    assert difference[first] > 1e-4
    assert "turned inside out" in plain.failure and plain.depth[-1] < options.settlement


def test_remesh_in_place_changes_nothing(comm, shared_tmp_path):
    figures = run(comm, shared_tmp_path, "--case", "identity")
    assert figures["plastic_strain_max"] > 0.5
    assert figures["history_change"] == 0.0
    assert figures["residual_change"] <= (0.0 if comm.size == 1 else 1e-12)
    # New cells, not the remesh, leave a residual that steps without load take away.
    assert figures["residual_at_start"] > 1e-4
    assert figures["residual_relaxed"] <= 1e-8


def test_any_change_of_a_state_is_seen():
    state = np.array([1.0, np.nan, 2.0])
    assert demo.difference(state, state.copy()) == 0.0
    assert demo.difference(state, np.nextafter(state, 3.0)) > 0.0
    assert demo.difference(state, np.array([1.0, 1.0, 2.0])) == np.inf
    assert demo.difference(state, state[:2]) == np.inf


def test_water_is_kept_over_remeshes(comm, shared_tmp_path):
    figures = run(comm, shared_tmp_path, "--case", "consolidation")
    assert figures["failed_steps"] == 0 and figures["remeshes"] >= 5
    assert figures["water_balance"] < 1e-9
    # Merges have changed the volume by far more: they are booked.
    assert abs(figures["merged_water"]) > 1e-3 * figures["outflow"] > 0.0


def test_block_leaves_its_base(comm, shared_tmp_path):
    words = "--case", "crossing", "--steps", "20"
    figures = run(comm, shared_tmp_path, *words)
    assert figures["failed_steps"] == 0 and figures["remeshes"] > 0
    curve = {name: np.array(values) for name, values in figures["curve"].items()}
    assert abs(curve["down"][-1]) < 1e-6 * curve["down"].max()
    slides = (curve["drag"] > 0.1) & (curve["drag"] < 0.6)
    ratio = curve["along"][slides] / curve["down"][slides]
    assert np.abs(ratio - 0.3).max() < 0.03


def test_demo_writes_report_and_pictures(comm, shared_tmp_path, monkeypatch):
    words = ["--quick", "--settlement", "0.1", "--steps", "2"]
    where = ["--out", str(shared_tmp_path), "--report", str(shared_tmp_path / "report.json")]
    monkeypatch.setattr(sys, "argv", ["remeshing.py", *words, *where])
    demo.main()
    comm.Barrier()
    report = json.loads((shared_tmp_path / "report.json").read_text())
    assert report["ranks"] == comm.size and report["steps"] == 2
    assert report["figures"]["remeshes"] == 0 and report["figures"]["load_jump_max"] is None
    for name in ("load.png", "plastic_strain.png", "plastic_strain.gif"):
        assert (shared_tmp_path / name).stat().st_size > 0


def test_options_that_make_no_sense_are_refused(monkeypatch, capsys):
    for words in (["--h", "-1"], ["--case", "none"], ["--steps", "0"]):
        with pytest.raises(SystemExit, match="2"):
            demo.parse(words)
