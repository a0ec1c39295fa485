# SPDX-License-Identifier: LGPL-3.0-or-later
"""Demos of water in gaps and of a fracture against their known answers."""

import json
import sys

import numpy as np
import pytest

import demos.verification.fracture as fractures
import demos.verification.gap_flow as demo
from fenicsx_hmcontact.output.report import Report
from meshes.fracture import fracture


@pytest.fixture
def figures(monkeypatch):
    """Run a case of the demo with given words on its command line; its figures, no files."""
    monkeypatch.setattr(demo, "on_root", lambda comm, draw: None)
    monkeypatch.setattr(demo.Blocks, "write", lambda model, state: None)

    def run(case, *words):
        options = demo.parse(["--case", case, *map(str, words)])[case]
        return demo.run(case, options).figures

    return run


# --- gap_flow.py ---------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize(("secondary", "primary"), [(6, 6), (5, 7), (11, 3)])
def test_channel_flows_by_the_cubic_law(figures, secondary, primary):
    found = figures("channel", "--secondary", secondary, "--primary", primary)
    assert found["flow_error"] < 1e-8 and found["pressure_error"] < 1e-9


@pytest.mark.mpi
@pytest.mark.parametrize(("gap", "k_t"), [(1e-2, 1e-8), (1e-3, 1e-10), (1e-14, 1e-7)])
def test_gap_leaks_like_a_resistance_in_series(figures, gap, k_t):
    found = figures("leak-off", "--gap", gap, "--transverse-permeability", k_t)
    assert found["flow_error"] < 1e-7 and found["drop_error"] < 1e-7


QUICK = ["--rows", 8, "--secondary", 4, "--primary", 3, "--time-step", 800]


@pytest.mark.mpi
def test_squeezed_gap_closes_on_time_with_first_order(figures):
    fine = [*QUICK, "--rows", 16, "--time-step", 400]
    coarse, better = (figures("closure", *words) for words in (QUICK, fine))
    for found in (coarse, better):
        assert found["closing_time_error_steps"] <= 1
        assert found["mass_balance"] < 1e-10
    assert better["gap_error_max"] < 0.02
    assert better["gap_error_max"] < 0.6 * coarse["gap_error_max"]


def test_gap_that_stays_open_has_no_closing_time(figures):
    with pytest.raises(ValueError, match="not closed at --end 800 s"):
        figures("closure", *QUICK, "--end", 800)


@pytest.mark.mpi
@pytest.mark.parametrize(("body", "mesh"), [("block", (13, 7)), ("base", (7, 16))])
def test_no_water_is_lost_while_a_gap_opens_slides_and_closes(figures, body, mesh):
    o = demo.parse(["--case", "sliding"])["sliding"]
    found = figures("sliding", "--secondary-body", body, "--block", mesh[0], "--base", mesh[1])
    assert found["mass_balance"] < 1e-10 and found["ledger_error"] < 1e-12
    assert found["steps_closed"] >= 3 and found["newton_max"] <= 10
    assert found["volume_max"] == pytest.approx(o.gap * o.width, rel=0.01)
    # What the end of the base cuts off: a quarter of a metre, at gaps from 2.4 to 2.2e-4 m.
    assert found["swept"] == pytest.approx(-(0.05 * 2.6 + 0.1 * 2.4 + 0.1 * 2.2) * 1e-4, rel=0.05)


@pytest.mark.mpi
@pytest.mark.parametrize("dry", ["primary", "secondary"])
@pytest.mark.parametrize(("secondary", "primary"), [(5, 13), (13, 5)])
def test_porous_on_dry_keeps_a_uniform_state(figures, dry, secondary, primary):
    found = figures("dry-body", "--dry", dry, "--secondary", secondary, "--primary", primary)
    assert found["patch_error"] < 1e-10
    assert found["condition_number"] < 1e4
    assert found["closed_nodes"] == secondary


@pytest.mark.mpi
@pytest.mark.parametrize("words", [(), ("--tilt", -30, "--secondary", 11, "--primary", 7)])
def test_water_at_rest_stays_at_rest(figures, words):
    found = figures("hydrostatic", *words)
    assert found["spurious_flow"] < 1e-10
    assert found["drop"] > 0.1


@pytest.mark.mpi
def test_condition_is_bounded_where_that_of_an_element_blows_up(figures, monkeypatch):
    monkeypatch.setattr(demo, "APERTURES", (1e-2, 1e-12, 1e-14, 1e-16))
    found = figures("condition")
    ours, usual = found["condition_number"], found["condition_number_conventional"]
    assert set(ours) == set(usual) == set(map(str, demo.APERTURES))
    assert ours["1e-16"] < 100.0 and usual["1e-16"] > 1e12
    assert ours["0.01"] < 1e7 and found["condition_number_uncapped"]["0.01"] > 1e9
    assert usual["1e-14"] / usual["1e-12"] == pytest.approx(100.0, rel=0.02)


def test_exact_gap_waits_for_the_drained_side_and_then_falls_steadily():
    load, k, weight, modulus, height = 1e4, 1e-9, 1e4, 1e8, 0.5
    speed = k * load / (weight * height)
    lost = [-demo.exact_gap(t, 0.0, load, k, weight, modulus, height) for t in (400.0, 1e6)]
    # The diffusion time h^2 / cv is 25000 s.
    assert abs(lost[0]) < 1e-4 * speed * 400.0
    # Late: the steady flow, less what the block has not given yet.
    stored = load / modulus * height / 6.0
    assert lost[1] == pytest.approx(speed * 1e6 - stored, rel=1e-6)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--case", "closure", "--gap", "-1"], "--gap must be positive"),
        (["--case", "closure", "--tilt", "3"], "unrecognized arguments: --tilt"),
        (["--case", "channel", "--study"], "--study is for --case closure"),
        (["--case", "all", "--dry", "both"], "invalid choice: 'both'"),
    ],
)
def test_what_makes_no_sense_is_refused(comm, words, reason, capsys):
    with pytest.raises(SystemExit):
        demo.parse(words)
    # Rank 0 alone prints.
    assert comm.rank > 0 or reason in capsys.readouterr().err


def test_values_reach_every_case_that_knows_them():
    cases = demo.parse(["--gap", "3e-3", "--mu", "0.1"])
    assert list(cases) == list(demo.CASES)
    assert cases["channel"].gap == cases["sliding"].gap == 3e-3
    assert cases["sliding"].mu == 0.1 and not hasattr(cases["channel"], "mu")
    assert cases["closure"].rows == 20 and demo.parse(["--study"]).keys() == {"closure"}
    assert demo.parse(["--quick"])["closure"].rows == 8


@pytest.mark.mpi
def test_report_of_one_case(comm, shared_tmp_path, monkeypatch):
    report = shared_tmp_path / "report.json"
    words = ["--case", "leak-off", "--report", str(report), "--out", str(shared_tmp_path)]
    monkeypatch.setattr(sys, "argv", ["gap_flow.py", *words])
    demo.main()
    comm.Barrier()
    written = json.loads(report.read_text())
    assert written["figures"]["flow_error"] < 1e-7 and written["steps"] == 1
    assert written["parameters"]["gap"] == 1e-3 and written["unknowns"]["pore pressure"] == 70
    assert (shared_tmp_path / "pressure_across.png").exists()
    assert (shared_tmp_path / "gap.csv").exists()


# --- fracture.py ---------------------------------------------------------------------------------


def crack(*words):
    options = fractures.parse(["--case", "opening", *map(str, words)])["opening"]
    model = fractures.Crack(options)
    return model.errors(model.solve()[1])


@pytest.mark.mpi
def test_crack_opens_by_sneddon_with_first_order():
    coarse, fine = (crack("--edges", n, "--growth", 4.8 / n) for n in (12, 24))
    assert abs(coarse["centre_error"]) < 0.02 and abs(fine["centre_error"]) < 0.01
    assert fine["opening_error"] < 0.04 and fine["opening_error"] < 0.6 * coarse["opening_error"]
    assert abs(fine["volume_error"]) < 0.02


def test_size_of_the_square_does_not_matter():
    assert abs(crack("--size", 1.5)["centre_error"]) < 0.01


def test_displacements_on_the_crack_are_its_opening():
    o = fractures.parse(["--case", "opening"])["opening"]
    s = 0.5 * o.length * np.linspace(-0.99, 0.99, 12)
    upper, lower = (
        fractures.displacement(np.array((s, np.full_like(s, y), 0.0 * s)), o)[1]
        for y in (1e-14, -1e-14)
    )
    np.testing.assert_allclose(upper - lower, fractures.opening(s, o), rtol=1e-9)


@pytest.mark.mpi
def test_fracture_leaks_with_second_order():
    errors = []
    for edges in (32, 64):
        options = fractures.parse(["--case", "leak-off", "--upper", str(edges)])["leak-off"]
        model = fractures.Leak(options)
        errors.append(model.errors(model.solve()[1]))
    assert errors[1]["leak_pressure_error"] < 1e-3
    assert errors[1]["leak_pressure_error"] < 0.3 * errors[0]["leak_pressure_error"]
    assert abs(errors[1]["leak_flow_error"]) < 0.55 * abs(errors[0]["leak_flow_error"])
    assert errors[1]["mass_balance"] < 1e-10


@pytest.mark.mpi
def test_fracture_demo_writes_its_pictures(comm, shared_tmp_path):
    words = ["--edges", "16", "--upper", "16", "--out", str(shared_tmp_path)]
    for case, options in fractures.parse(words).items():
        fractures.CASES[case](options, Report("fracture", comm, {}))
    comm.Barrier()
    names = {path.name for path in shared_tmp_path.glob("*.png")}
    assert names == {"opening.png", "crack.png", "pressure.png"}


@pytest.mark.mpi
def test_mesh_of_the_fracture(comm):
    domain = fracture(comm, length=2.0, size=6.0, upper=8, lower=6)
    assert set(domain.bodies) == {"upper", "lower"}
    for name, facets in (("crack_upper", 8), ("crack_lower", 6)):
        assert comm.allreduce(len(domain.facets(name))) == facets
    for values, word in ((dict(length=7.0), "length"), (dict(growth=0.0), "growth")):
        with pytest.raises(ValueError, match=word):
            fracture(comm, size=6.0, **values)
