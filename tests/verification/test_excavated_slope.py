# SPDX-License-Identifier: LGPL-3.0-or-later
"""An excavated slope fails as fast as it sucks in water, sooner along an interface."""

import numpy as np
import pytest

from demos import excavated_slope as demo

pytestmark = pytest.mark.mpi


@pytest.fixture(scope="module")
def runs():
    """Both slopes on a coarse mesh, for a day: options, and what the runs left."""
    options, _ = demo.parse(["--quick", "--days", "1"])
    return options, {case: demo.run(case, options) for case in demo.CASES}


def test_ground_settles_by_its_weight(runs):
    """Elastic, of the weight under buoyancy: half of it times height squared over the modulus."""
    o, both = runs
    modulus = o.E * (1.0 - o.nu) / ((1.0 + o.nu) * (1.0 - 2.0 * o.nu))
    settlement = 0.5 * (o.unit_weight - o.water_weight) * o.height**2 / modulus
    for run in both.values():
        # The weight stays as drawn, but the sunk ground is less high.
        assert run.slide.settlement == pytest.approx(settlement, rel=0.02)
        assert run.slide.plastic_strain[0] == 0.0


def test_water_that_comes_in_makes_room_for_the_soil_that_dilates(runs):
    for run in runs[1].values():
        assert run.slide.balance < 1e-9
        assert run.inflow > 0.0


def test_slide_goes_on_and_slows_down(runs):
    for run in runs[1].values():
        strain, days = np.array(run.slide.plastic_strain), np.array(run.slide.days)
        assert (np.diff(strain) > 0.0).all() and (np.diff(run.slide.displacement) > 0.0).all()
        rates = np.diff(strain) / np.diff(days)
        assert rates[-1] < 0.5 * rates.max()


def test_interface_makes_it_fail_sooner(runs):
    o, both = runs
    found = demo.together({case: demo.figures_of(run.slide, o) for case, run in both.items()})
    assert found["day_0.1H_ratio"] < 0.5
    assert found["failed_steps"] == 0 and found["newton_median"] <= 6.0


def test_slide_follows_the_interface_with_one_pore_pressure(runs):
    o, both = runs
    run = both["with"]
    assert run.slide.slip > 1.0
    assert run.slide.jump < 1e-9 * o.water_weight * o.height
    # Below the interface next to nothing yields.
    model = run.scene.model
    state = model.contact("cut")
    assert state.closed.sum() > 0.8 * len(state.closed)


def test_days_are_found_between_steps():
    assert demo.day_of(0.5, [0.0, 1.0, 3.0], [0.0, 0.25, 0.75]) == pytest.approx(2.0)
    assert demo.day_of(0.8, [0.0, 1.0, 3.0], [0.0, 0.25, 0.75]) is None
    assert demo.day_of(0.0, [0.0, 1.0], [0.0, 0.25]) == 0.0
