# SPDX-License-Identifier: LGPL-3.0-or-later
"""A footing is pulled out: suction holds it if fast, water comes in if slow."""

import json
import sys

import numpy as np
import pytest

from demos import footing_uplift as demo
from fenicsx_hmcontact.output.report import Report

FAST, SLOW, DRAINED = "200", "0.25", "0.001"


@pytest.fixture(scope="module")
def runs():
    """Three velocities and the push-down, half of the way: options and histories."""
    options, _ = demo.parse(["--quick", "--velocities", FAST, SLOW, DRAINED])
    return options, demo.run(options, Report("footing_uplift", demo.comm, {}))


def test_all_runs_reach_the_end(runs):
    options, histories = runs
    assert list(histories) == [FAST, SLOW, DRAINED, demo.PUSH_DOWN]
    figures = demo.figures_of(histories)
    assert figures["failed_steps"] == 0 and figures["ended_early"] == {}
    assert figures["newton_median"] <= 6.0
    for history in histories.values():
        assert history.uplift[-1] == pytest.approx(options.uplift, rel=1e-12)


def test_resistance_grows_with_the_velocity(runs):
    found = demo.figures_of(runs[1])["resistance"]
    assert found[FAST] > 2.0 * found[SLOW] > 0.0
    assert 0.0 < found[DRAINED] < 0.01 * found[FAST]


def test_fast_uplift_meets_the_undrained_resistance_of_the_push_down(runs):
    _, histories = runs
    up, down = histories[FAST], histories[demo.PUSH_DOWN]
    assert up.resistance[-1] == pytest.approx(down.resistance[-1], rel=0.05)
    # Deeper than a strip on the ground: more than (2 + pi) c per width.
    options = runs[0]
    strip = (2.0 + np.pi) * options.c * 2.0 * options.half_width
    assert strip < up.resistance[-1] < 1.3 * strip


def test_soil_follows_a_fast_base_and_leaves_a_slow_one(runs):
    options, histories = runs
    assert histories[FAST].gap[-1] < 0.15 * options.uplift
    assert histories[SLOW].gap[-1] > 0.9 * options.uplift
    assert (np.diff(histories[SLOW].gap) > 0.0).all()


def test_suction_carries_the_resistance(runs):
    _, histories = runs
    for name in (FAST, SLOW):
        history = histories[name]
        assert 0.7 * history.resistance[-1] < history.suction[-1] < history.resistance[-1]


def test_water_into_the_gap_is_its_volume(runs):
    options, histories = runs
    for name, history in histories.items():
        # Where pressures are next to nothing, so is the flow that Newton's method measures by.
        assert history.lost < (1e-3 if name == DRAINED else 1e-7) * history.moved
        # With what leaves at the ends, also over remeshes.
        held = history.taken_up + history.swept + history.remeshed
        assert history.volume == pytest.approx(held, rel=1e-9)
        assert history.taken_up > 0.0
    slow = histories[SLOW]
    # The mouth loses little of what a base that parts draws in.
    assert abs(slow.swept) < 0.01 * slow.volume
    assert demo.gap_balance(slow) < 1e-8
    assert slow.volume == pytest.approx(options.half_width * options.uplift, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "words", [("--h-corner", "0.1"), ("--h-corner", "0.025"), ("--h", "0.5", "--h-corner", "0.025")]
)
def test_trench_below_the_corner_is_filled_on_any_mesh(words):
    options, _ = demo.parse(words)
    scene, history = demo.move(options, float(FAST), Report("footing_uplift", demo.comm, {}))
    assert history.failure == "" and history.uplift[-1] == pytest.approx(options.uplift, rel=1e-12)
    assert any(record.counts["soil"].get("filled", 0) for record in scene.simulation.records)
    # Undrained, at its depth: 6 c per width.
    undrained = 6.0 * options.c * 2.0 * options.half_width
    assert history.resistance[-1] == pytest.approx(undrained, rel=0.03)


@pytest.mark.slow
def test_soil_that_snaps_to_another_equilibrium_creeps_there():
    reached = []
    for more in ([], ["--relaxation", "0"]):
        options, _ = demo.parse(["--h-corner", "0.1", *more])
        _, history = demo.move(options, float(FAST), Report("footing_uplift", demo.comm, {}))
        reached.append(history.uplift[-1])
    assert reached[0] == pytest.approx(options.uplift, rel=1e-12)
    assert reached[1] < 0.95 * options.uplift and history.failure


def test_run_that_ends_early_has_no_resistance():
    early = demo.History(failure="no convergence")
    early.uplift, early.resistance, early.iterations = [0.1], [9e3], [4]
    early.gap, early.suction = [0.0], [8e3]
    figures = demo.figures_of({FAST: early})
    assert figures["failed_steps"] == 1 and figures["resistance"] == {}
    assert figures["ended_early"] == {FAST: {"reached": 0.1, "resistance": 9.0, "mean_gap": 0.0}}
    assert figures["fastest_to_push_down"] is None


def test_wrong_options_are_refused_by_name(capsys):
    for words in (["--velocities", "-1"], ["--uplift", "0"]):
        with pytest.raises(SystemExit):
            demo.parse(words)
        if demo.comm.rank == 0:
            assert words[0] in capsys.readouterr().err


def test_demo_writes_report_and_pictures(comm, shared_tmp_path, monkeypatch):
    report = shared_tmp_path / "report.json"
    words = ["--velocities", SLOW, "--uplift", "0.02", "--steps", "2", "--no-push-down"]
    where = ["--out", str(shared_tmp_path), "--report", str(report)]
    monkeypatch.setattr(sys, "argv", ["footing_uplift.py", *words, *where])
    demo.main()
    comm.barrier()
    figures = json.loads(report.read_text())["figures"]
    assert list(figures["resistance"]) == [SLOW] and figures["push_down_capacity"] is None
    for name in ("fig12_resistance.png", "fig13_pore_pressure.png", f"{SLOW}.gif"):
        assert (shared_tmp_path / name).stat().st_size > 10_000
