# SPDX-License-Identifier: LGPL-3.0-or-later
"""A pushed block resists with what the law of friction allows, to round-off."""

import json
import sys

import numpy as np
import pytest

from demos.verification import sliding_block
from fenicsx_hmcontact.output.report import Report

pytestmark = pytest.mark.mpi


def run(comm, **options):
    """Figures of the demo."""
    words = [w for name, value in options.items() for w in (f"--{name.replace('_', '-')}", value)]
    report = Report("sliding_block", comm, {})
    sliding_block.solve(sliding_block.parser().parse_args(list(map(str, words))), report)
    return report.figures


@pytest.mark.parametrize(
    ("mu", "cohesion", "water"),
    [(0.2, 0.0, 0.0), (0.5, 0.0, 0.4), (0.3, 0.05, 0.7), (0.8, 0.0, 0.0), (0.0, 0.0, 0.0)],
)
def test_resistance_is_that_of_the_effective_load(comm, mu, cohesion, water):
    figures = run(comm, mu=mu, cohesion=cohesion, water_pressure=water)
    assert figures["failed_steps"] == 0 and figures["sticks"] == 0
    assert figures["newton_mean"] <= 4.0
    assert figures["resistance_error"] < 1e-10
    # Load and length are 1, and no pressure is on the ramp of the cohesion.
    expected = mu * (1.0 - water) + cohesion
    assert figures["resistance"] == pytest.approx(expected, rel=0, abs=1e-10)


@pytest.mark.parametrize(
    ("mu", "cohesion", "water", "secondary", "primary"),
    [
        (1.0, 0.1, 0.0, 5, 41),
        (0.6, 0.05, 0.95, 7, 23),
        (0.3, 0.3, 0.9, 19, 13),
        (0.5, 0.2, 0.9, 19, 13),
    ],
)
@pytest.mark.parametrize("motion", ["small", "finite"])
def test_law_is_summed_over_closed_nodes_where_others_open(
    comm, motion, mu, cohesion, water, secondary, primary
):
    figures = run(
        comm,
        mu=mu,
        cohesion=cohesion,
        water_pressure=water,
        secondary=secondary,
        primary=primary,
        motion=motion,
    )
    assert figures["failed_steps"] == 0 and figures["open_nodes"] > 0
    assert figures["resistance_error"] < 1e-10
    # A law over all of the length would be another.
    assert abs(figures["resistance"] - (mu * (1.0 - water) + cohesion)) > 1e-3
    if motion == "small":
        assert figures["newton_mean"] <= 4.5


@pytest.mark.parametrize(("secondary", "primary"), [(7, 23), (16, 11)])
def test_block_slides_above_the_angle_of_friction_only(comm, secondary, primary):
    mesh = dict(secondary=secondary, primary=primary, mu=0.3)
    holds = run(comm, incline=0.299, **mesh)
    assert holds["failed_steps"] == 0 and holds["sticks"] == 1
    angle = np.arctan(0.299)
    # The spring carries what elastic blocks give way, no more.
    assert abs(holds["spring_force"]) < 5e-4
    assert np.sin(angle) - 5e-4 < holds["resistance"] < 0.3 * np.cos(angle)
    slides = run(comm, incline=0.301, **mesh)
    assert slides["failed_steps"] == 0 and slides["sticks"] == 0
    angle = np.arctan(0.301)
    expected = np.sin(angle) - 0.3 * np.cos(angle)
    assert slides["spring_force"] == pytest.approx(expected, rel=1e-8)
    assert slides["resistance_error"] < 1e-10


def test_demo_writes_report_and_pictures(comm, shared_tmp_path, monkeypatch):
    words = ["--mu", "0.5", "--water-pressure", "0.4", "--steps", "3"]
    where = ["--out", str(shared_tmp_path), "--report", str(shared_tmp_path / "report.json")]
    monkeypatch.setattr(sys, "argv", ["sliding_block.py", *words, *where])
    sliding_block.main()
    comm.Barrier()
    report = json.loads((shared_tmp_path / "report.json").read_text())
    assert report["ranks"] == comm.size and report["steps"] == 3
    assert report["unknowns"]["displacement"] == 2 * report["unknowns"]["pore pressure"]
    assert report["figures"]["resistance_error"] < 1e-10
    for name in ("resistance", "tractions", "gap", "stress"):
        assert (shared_tmp_path / f"{name}.png").stat().st_size > 0


def test_block_cannot_be_pushed_off_its_base(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["sliding_block.py", "--push", "0.6"])
    with pytest.raises(SystemExit, match="2"):
        sliding_block.main()
