# SPDX-License-Identifier: LGPL-3.0-or-later
"""Which nodes close, open, stick and slide: the decisions one by one."""

import numpy as np
import pytest

from fenicsx_hmcontact.contact import ContactStatus, CoulombFriction, complementarity
from fenicsx_hmcontact.contact.active_set import BOUND_TOLERANCE

C_N, C_T = 100.0, 1000.0
LAW = CoulombFriction(0.5)


def status(closed, slipping=False, direction=1.0):
    return ContactStatus(np.array([closed]), np.array([slipping]), np.array([direction]))


def decide(before, *, p=0.0, t=0.0, gap=0.0, slip=0.0, kept=True, law=LAW, scale=1.0):
    """One node's closed, slipping and direction of slip after the update; None where it sticks."""
    values = [np.array([float(x)]) for x in (p, t, gap, slip)]
    constants = np.array([C_N * scale]), np.array([C_T * scale])
    after = before.updated(np.array([kept]), *values, constants, law)
    (closed,), (slipping,), (direction,) = after.closed, after.slipping, after.direction
    assert not (slipping and not closed)
    assert after.sticking[0] == (closed and not slipping)
    return bool(closed), int(direction) if slipping else None


OPEN, STICK = status(False), status(True)
FORWARD, BACKWARD = status(True, True, 1.0), status(True, True, -1.0)


@pytest.mark.parametrize(
    ("before", "values", "closed", "slip"),
    [
        pytest.param(OPEN, dict(gap=0.01), False, None, id="open stays open"),
        pytest.param(OPEN, dict(gap=0.01, p=5.0, t=3.0), False, None, id="open has no traction"),
        pytest.param(OPEN, dict(gap=0.0), False, None, id="open at no gap stays open"),
        pytest.param(OPEN, dict(gap=-0.01), True, None, id="penetration closes"),
        pytest.param(OPEN, dict(gap=-0.01, kept=False), False, None, id="dropped stays open"),
        pytest.param(STICK, dict(p=1.0, kept=False), False, None, id="dropped opens"),
        pytest.param(STICK, dict(p=1.0), True, None, id="closed stays closed"),
        pytest.param(STICK, dict(p=-1.0), False, None, id="tension opens"),
        pytest.param(FORWARD, dict(p=-1.0, t=-1.0), False, None, id="tension opens what slid"),
        pytest.param(STICK, dict(p=1.0, gap=0.02), False, None, id="a gap beyond p / c_n opens"),
        pytest.param(STICK, dict(p=-1.0, gap=-0.02), True, None, id="penetration keeps closed"),
        pytest.param(STICK, dict(p=1.0, t=0.49), True, None, id="below the bound sticks"),
        pytest.param(STICK, dict(p=1.0, t=0.5), True, None, id="on the bound sticks"),
        pytest.param(STICK, dict(p=1.0, t=0.51), True, -1, id="slides against the shear"),
        pytest.param(STICK, dict(p=1.0, t=-0.51), True, 1, id="slides the other way"),
        pytest.param(FORWARD, dict(p=1.0, t=-0.5, slip=1e-6), True, 1, id="goes on sliding"),
        pytest.param(BACKWARD, dict(p=1.0, t=0.5, slip=-1e-6), True, -1, id="backwards too"),
        pytest.param(FORWARD, dict(p=1.0, t=-0.5, slip=-1e-4), True, None, id="reversal sticks"),
        pytest.param(BACKWARD, dict(p=1.0, t=0.5, slip=1e-4), True, None, id="of both directions"),
        # bound = 0.5 * 100 * 0.01 = 0.5, reached by c_t slip at 5e-4
        pytest.param(OPEN, dict(gap=-0.01, slip=4e-4), True, None, id="newly closed sticks"),
        pytest.param(OPEN, dict(gap=-0.01, slip=6e-4), True, 1, id="newly closed slides"),
        pytest.param(OPEN, dict(gap=-0.01, slip=-6e-4), True, -1, id="newly closed slides back"),
        pytest.param(OPEN, dict(gap=-0.01, t=9.0), True, None, id="newly closed has no shear yet"),
        # The bound is that of p - c_n gap = 2.
        pytest.param(STICK, dict(p=1.0, gap=-0.01, t=0.99), True, None, id="bound of the trial"),
        pytest.param(STICK, dict(p=1.0, gap=-0.01, t=1.01), True, -1, id="and beyond it"),
    ],
)
def test_decisions(before, values, closed, slip):
    assert decide(before, **values) == (closed, slip)


@pytest.mark.parametrize(("before", "way"), [(FORWARD, 1), (BACKWARD, -1)])
def test_what_moves_back_does_not_go_on_sliding(before, way):
    closed, slip = decide(before, p=1.0, t=-0.5 * way, slip=-0.1 * way)
    assert closed and slip != way


def test_bound_has_a_tolerance_for_round_off():
    assert decide(STICK, p=1.0, t=0.5 * (1 + 0.5 * BOUND_TOLERANCE)) == (True, None)
    assert decide(STICK, p=1.0, t=0.5 * (1 + 2 * BOUND_TOLERANCE)) == (True, -1)


def test_cohesion_widens_the_bound():
    law = CoulombFriction(0.5, 0.2)
    assert decide(STICK, p=1.0, t=0.69, law=law) == (True, None)
    assert decide(STICK, p=1.0, t=0.71, law=law) == (True, -1)
    # Half of the ramp, a tenth of the cohesion.
    assert decide(STICK, p=0.01, t=0.104, law=law) == (True, None)
    assert decide(STICK, p=0.01, t=0.106, law=law) == (True, -1)


def test_without_friction_nothing_slides():
    assert decide(STICK, p=1.0, t=9.0, slip=1.0, law=None) == (True, None)
    assert decide(FORWARD, p=-1.0, law=None) == (False, None)
    assert decide(OPEN, gap=-0.01, slip=1.0, law=None) == (True, None)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_converged_states_stay_whatever_the_constants(scale):
    for before, values, expected in (
        (OPEN, dict(gap=0.3), (False, None)),
        (STICK, dict(p=1.0, t=0.4), (True, None)),
        (FORWARD, dict(p=1.0, t=-0.5, slip=0.1), (True, 1)),
        (BACKWARD, dict(p=1.0, t=0.5, slip=-0.1), (True, -1)),
    ):
        assert decide(before, **values, scale=scale) == expected


def test_nodes_decide_alone():
    before = ContactStatus(
        np.array([False, True, True, True]),
        np.array([False, False, False, True]),
        np.array([-1.0, 1.0, 1.0, -1.0]),
    )
    after = before.updated(
        np.ones(4, bool),
        np.array([0.0, 1.0, 2.0, -1.0]),
        np.array([0.0, 0.7, 0.7, 0.0]),
        np.array([0.1, 0.0, 0.0, 0.0]),
        np.zeros(4),
        (np.full(4, C_N), np.full(4, C_T)),
        LAW,
    )
    np.testing.assert_array_equal(after.closed, [False, True, True, False])
    np.testing.assert_array_equal(after.slipping, [False, True, False, False])
    # Nodes that do not slide keep their last direction.
    np.testing.assert_array_equal(after.direction, [-1.0, -1.0, 1.0, -1.0])
    # The state before is left as it was.
    np.testing.assert_array_equal(before.slipping, [False, False, False, True])


def test_same_compares_sets_and_directions_of_what_slides():
    assert STICK.same(status(True)) and STICK.same(status(True, direction=-1.0))
    assert not STICK.same(OPEN) and not STICK.same(FORWARD) and not FORWARD.same(BACKWARD)
    none = ContactStatus.open(3)
    assert none.same(ContactStatus.open(3)) and not none.sticking.any() and not none.closed.any()


def test_complementarity_vanishes_where_contact_and_friction_hold():
    # Sticking, open, and sliding both ways against the shear traction of mu p
    p, t = np.array([2.0, 0.0, 2.0, 2.0]), np.array([0.3, 0.0, 1.0, -1.0])
    gap, slip = np.array([0.0, 0.1, 0.0, 0.0]), np.array([0.0, 5.0, -0.2, 0.2])

    def violation(p, t, gap, slip):
        both = complementarity(p, t, gap, slip, (np.full(4, 7.0),) * 2, CoulombFriction(0.5))
        return np.abs(both).max(axis=0)

    np.testing.assert_array_equal(violation(p, t, gap, slip), 0.0)
    np.testing.assert_allclose(violation(p, t, gap - 0.2, slip)[[0, 2, 3]], 1.4)
    assert np.all(violation(p + 0.1, t, gap, slip)[1:] > 0.04)
    assert np.all(violation(p, t + 0.1, gap, slip)[1:] > 0.04)
    assert np.all(violation(p, t, gap, slip + 0.01)[[0, 3]] >= 0.0)
    assert violation(p, t, gap, slip + 0.01)[0] == pytest.approx(0.07)


def test_complementarity_is_continuous_across_the_sets():
    rng = np.random.default_rng(3)
    state, way = rng.normal(size=(2, 4, 2000))
    at = state[..., None] + way[..., None] * np.linspace(0.0, 1.0, 500)
    values = np.array(complementarity(*at, (3.0, 3.0), CoulombFriction(0.7, 0.3)))
    # Slopes: at most 2 c_n, and mu and the cohesion's ramp times that
    bound = 500**-1 * np.abs(way).sum(axis=0) * (4.0 + 12.0 * 7.0)
    assert np.all(np.abs(np.diff(values, axis=-1)).max(axis=(0, -1)) < bound)


def test_signature_tells_sets_and_directions_apart():
    def status(closed, slipping, direction=(1.0, 1.0, 1.0)):
        return ContactStatus(*map(np.array, (closed, slipping, direction)))

    base = status([True, True, False], [True, False, False], [1.0, 1.0, 1.0])
    same = status([True, True, False], [True, False, False], [1.0, -1.0, -1.0])
    assert base.signature == same.signature and base.same(same)
    others = [
        status([True, False, False], [True, False, False]),
        status([True, True, False], [True, True, False]),
        status([True, True, False], [True, False, False], [-1.0, 1.0, 1.0]),
    ]
    signatures = {base.signature, *(other.signature for other in others)}
    assert len(signatures) == 4
