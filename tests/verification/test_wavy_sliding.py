# SPDX-License-Identifier: LGPL-3.0-or-later
"""A block that slides over waves: every step converges, forces and moments balance."""

import json
import sys

from mpi4py import MPI

import numpy as np
import pytest

from demos.verification import wavy_sliding
from fenicsx_hmcontact.output.report import Report

pytestmark = pytest.mark.mpi


def run(comm, **options):
    """Figures of the demo, and what lay between the surfaces after each step."""
    words = [w for name, value in options.items() for w in (f"--{name.replace('_', '-')}", value)]
    report = Report("wavy_sliding", comm, {})
    arguments = wavy_sliding.parser().parse_args(list(map(str, words)))
    _, _, states = wavy_sliding.solve(arguments, report)
    return report.figures, states


@pytest.mark.parametrize("amplitude", [0.0, 0.02])
@pytest.mark.parametrize("slip_per_step", [0.5, 2.0])
def test_forces_and_moments_balance(comm, amplitude, slip_per_step):
    figures, states = run(comm, amplitude=amplitude, slip_per_step=slip_per_step)
    assert figures["failed_steps"] == 0 and figures["newton_max"] <= 12
    assert figures["force_imbalance"] < 1e-11
    # Facets follow the waves to second order only.
    assert figures["moment_imbalance"] < (1e-3 if amplitude else 1e-6)
    curve = figures["curve"]
    assert curve["slide"][-1] == pytest.approx(0.8)
    # On the slide all that touches slides: the reactions follow from the pressures.
    np.testing.assert_allclose(curve["resistance"][1:], curve["law"][1:], rtol=1e-8)
    assert all(np.nanmin(state.gap) > -1e-9 for state in states)
    if amplitude:
        assert states[0].closed.all() and not states[-1].closed.all()
    else:
        assert all(state.closed.all() for state in states)


@pytest.mark.parametrize(("secondary", "primary", "smoothing"), [(5, 13, "none"), (11, 20, "full")])
def test_other_meshes_and_smoothing(comm, secondary, primary, smoothing):
    figures, _ = run(
        comm, secondary=secondary, primary=primary, smoothing=smoothing, rows=3, slip_per_step=1.0
    )
    assert figures["failed_steps"] == 0 and figures["newton_max"] <= 12
    assert figures["moment_imbalance"] < 1e-3


def test_same_answer_on_one_rank(comm, monkeypatch):
    together, _ = run(comm, slip_per_step=1.0)
    monkeypatch.setattr(wavy_sliding, "comm", MPI.COMM_SELF)
    alone, _ = run(MPI.COMM_SELF, slip_per_step=1.0)
    assert together["newton_max"] == alone["newton_max"]
    for name in ("resistance", "law"):
        np.testing.assert_allclose(together["curve"][name], alone["curve"][name], rtol=1e-8)


def test_demo_writes_report_and_pictures(comm, shared_tmp_path, monkeypatch):
    where = ["--out", str(shared_tmp_path), "--report", str(shared_tmp_path / "report.json")]
    monkeypatch.setattr(sys, "argv", ["wavy_sliding.py", "--slip-per-step", "2", *where])
    wavy_sliding.main()
    comm.Barrier()
    report = json.loads((shared_tmp_path / "report.json").read_text())
    assert report["ranks"] == comm.size and report["steps"] == 5
    assert report["newton_iterations"] == round(5 * report["figures"]["newton_mean"])
    for name in ("resistance", "pressure", "gap", "stress"):
        assert (shared_tmp_path / f"{name}.png").stat().st_size > 0


@pytest.mark.parametrize("words", [["--press", "0"], ["--slip-per-step", "9"]])
def test_wrong_options_are_refused(monkeypatch, words):
    monkeypatch.setattr(sys, "argv", ["wavy_sliding.py", *words])
    with pytest.raises(SystemExit, match="2"):
        wavy_sliding.main()
