# SPDX-License-Identifier: LGPL-3.0-or-later
"""Laws between the solids: values, slopes, refusals, laws of one's own."""

import numpy as np
import pytest

from fenicsx_hmcontact.contact import (
    CoulombFriction,
    FrictionLaw,
    Frictionless,
    Tied,
    tangential_law,
)

LAWS = [
    CoulombFriction(0.3),
    CoulombFriction(0.0, 2e3),
    CoulombFriction(0.3, 2e3),
    CoulombFriction(0.3, 2e3, ramp=5e3),
]


def test_coulomb():
    bound, slope = CoulombFriction(0.3).bound(np.array([0.0, 1.0, 2e6]))
    np.testing.assert_allclose(bound, [0.0, 0.3, 6e5], rtol=1e-15)
    np.testing.assert_array_equal(slope, 0.3)


@pytest.mark.parametrize(("ramp", "full"), [(None, 200.0), (5e3, 5e3)])
def test_cohesion_acts_in_full_from_the_ramp_on(ramp, full):
    law = CoulombFriction(0.3, 2e3, ramp=ramp)
    p = full * np.array([0.0, 0.25, 0.5, 1.0, 1.5, 40.0])
    bound, slope = law.bound(p)
    np.testing.assert_allclose(bound, 0.3 * p + 2e3 * np.array([0, 0.25, 0.5, 1, 1, 1]), rtol=1e-14)
    np.testing.assert_allclose(slope, 0.3 + 2e3 / full * np.array([1, 1, 1, 0, 0, 0]), rtol=1e-14)


@pytest.mark.parametrize("law", LAWS)
def test_slopes_are_those_of_the_bound(law):
    p = np.concatenate((np.linspace(1.0, 190.0, 7), np.linspace(210.0, 4.9e3, 7), [5.1e3, 1e6]))
    h = 1e-3
    difference = (law.bound(p + h)[0] - law.bound(p - h)[0]) / (2 * h)
    np.testing.assert_allclose(law.bound(p)[1], difference, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("law", LAWS)
def test_no_pressure_holds_no_shear(law):
    # A jump where a node opens would let it open and close in turns.
    bound, _ = law.bound(np.array([0.0, 1e-9]))
    assert bound[0] == 0.0 and 0.0 <= bound[1] < 1e-7


@pytest.mark.parametrize("value", [-0.1, np.nan, np.inf])
@pytest.mark.parametrize("name", ["mu", "cohesion"])
def test_refuses_values(name, value):
    with pytest.raises(ValueError, match=f"{name} is {value}; it must be zero or positive"):
        CoulombFriction(**{"mu": 0.1, "cohesion": 0.1, name: value})


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_refuses_ramps(value):
    with pytest.raises(ValueError, match=f"ramp is {value}; it must be positive"):
        CoulombFriction(0.3, 1e3, ramp=value)


def test_no_friction_is_no_tangential_law():
    assert tangential_law(Frictionless()) is None
    assert tangential_law(CoulombFriction(0.0)) is None
    for law in LAWS:
        assert tangential_law(law) is law


def test_a_law_of_ones_own_needs_nothing_but_a_bound():
    class Capped:
        def bound(self, pressure):
            return np.minimum(pressure, 1e3), (pressure < 1e3).astype(float)

    law = Capped()
    assert isinstance(law, FrictionLaw) and tangential_law(law) is law


@pytest.mark.parametrize("law", [0.3, None, "coulomb", object(), Tied()])
def test_refuses_what_is_no_law(law):
    with pytest.raises(ValueError, match="is no friction law: it has no method bound"):
        tangential_law(law)
