# SPDX-License-Identifier: LGPL-3.0-or-later
import numpy as np
import pytest
from scipy.integrate import quad

from fenicsx_hmcontact.contact.analytic import (
    cattaneo_mindlin_shear,
    contact_modulus,
    hertz_half_width,
    hertz_load,
    hertz_pressure,
    moment_half_width,
    stick_half_width,
)

E, NU, R, A = 200.0, 0.3, 8.0, 0.4
MODULUS = contact_modulus(E, NU, (E, NU))
LOAD = hertz_load(A, R, MODULUS)


def integral(function, width):
    """Over -width to width, with the roots at its ends taken out by x = width sin(t)."""
    half = 0.5 * np.pi
    value, _ = quad(
        lambda t: float(function(width * np.sin(t))) * width * np.cos(t), -half, half, epsabs=1e-13
    )
    return value


def slope(function, width, x):
    """Principal value of the integral of f(s) / (x - s) over the contact, by Chebyshev points.

    Midpoints between the points of f make the rule exact (Erdogan and Gupta, 1972).
    """
    n = 800
    k = np.arange(1, n + 1)
    s = np.cos(k * np.pi / (n + 1))
    weights = np.pi / (n + 1) * np.sin(k * np.pi / (n + 1)) ** 2
    r = np.arange(1, n + 2)
    middle = np.cos((r - 0.5) * np.pi / (n + 1))
    smooth = function(width * s) / np.sqrt(1.0 - s**2)
    values = (weights * smooth / (middle[:, None] - s)).sum(axis=1)
    return np.interp(x / width, middle[::-1], values[::-1])


def test_two_equal_bodies_are_half_as_stiff_as_one_against_a_rigid_one():
    assert contact_modulus(E, NU) == pytest.approx(200.0 / 0.91, rel=1e-14)
    assert pytest.approx(contact_modulus(E, NU) / 2, rel=1e-14) == MODULUS
    assert contact_modulus(3.0, 0.0, (6.0, 0.0)) == pytest.approx(2.0, rel=1e-14)


def test_known_figures_of_a_steel_like_disc():
    assert pytest.approx(1.72615, rel=1e-5) == LOAD
    assert hertz_pressure(0.0, LOAD, A) == pytest.approx(2.74725, rel=1e-5)
    rigid = contact_modulus(E, NU)
    assert hertz_load(A, R, rigid) == pytest.approx(3.45230, rel=1e-5)
    # p0 = sqrt(P E* / (pi R)), Johnson's other form
    assert hertz_pressure(0.0, LOAD, A) == pytest.approx(
        np.sqrt(LOAD * MODULUS / np.pi / R), rel=1e-14
    )


def test_half_width_is_the_inverse_of_the_load():
    assert hertz_half_width(LOAD, R, MODULUS) == pytest.approx(A, rel=1e-14)
    assert hertz_half_width(4 * LOAD, R, MODULUS) == pytest.approx(2 * A, rel=1e-14)


def test_pressure_carries_the_load_and_ends_at_the_half_width():
    assert integral(lambda x: hertz_pressure(x, LOAD, A), A) == pytest.approx(LOAD, rel=1e-12)
    np.testing.assert_array_equal(hertz_pressure([-A, A, 1.1 * A], LOAD, A), 0.0)
    assert hertz_pressure(np.zeros((2, 3)), LOAD, A).shape == (2, 3)


def test_pressure_flattens_the_parabola():
    # Slopes of both surfaces add up to that of the disc: 2/(pi E*) pv int p/(x - s) ds = x/R.
    x = np.linspace(-0.9, 0.9, 19) * A
    found = slope(lambda s: hertz_pressure(s, LOAD, A), A, x)
    np.testing.assert_allclose(2 / (np.pi * MODULUS) * found, x / R, rtol=0, atol=1e-6)


@pytest.mark.parametrize("part", [0.0, 0.1, 0.5, 0.9, 1.0])
def test_shear_carries_the_push_and_is_at_most_friction(part):
    mu = 0.3
    push = part * mu * LOAD
    c = stick_half_width(LOAD, A, push, mu)
    shear = cattaneo_mindlin_shear(0.0, LOAD, A, push, mu)
    assert shear == pytest.approx(mu * hertz_pressure(0.0, LOAD, A) * (1 - c / A), abs=1e-12)

    def at(x):
        return cattaneo_mindlin_shear(x, LOAD, A, push, mu)

    inner, _ = quad(at, -c, c, epsabs=1e-12)
    outer, _ = quad(at, c, A, epsabs=1e-12)
    assert inner + 2 * outer == pytest.approx(push, abs=1e-8)
    x = np.linspace(-1.2 * A, 1.2 * A, 241)
    bound = mu * hertz_pressure(x, LOAD, A)
    assert np.all(at(x) <= bound + 1e-15)
    slips = np.abs(x) > c
    np.testing.assert_allclose(at(x)[slips], bound[slips], rtol=1e-14)


def test_what_sticks_moves_as_one():
    # No relative strain where it sticks; beyond, slip along the push: the same integral as Hertz'.
    mu, push = 0.3, 0.15 * LOAD
    c = stick_half_width(LOAD, A, push, mu)
    assert c == pytest.approx(A * np.sqrt(0.5), rel=1e-14)
    strain = slope(
        lambda s: cattaneo_mindlin_shear(s, LOAD, A, push, mu), A, np.array([0.2, 0.9]) * A
    )
    size = mu * hertz_pressure(0.0, LOAD, A) * np.pi
    assert abs(strain[0]) < 1e-3 * size < strain[1]


def test_a_push_the_other_way_turns_the_shear():
    x = np.linspace(-A, A, 11)
    there, back = (cattaneo_mindlin_shear(x, LOAD, A, q, 0.3) for q in (0.1, -0.1))
    np.testing.assert_array_equal(there, -back)
    assert there[5] > 0.0


def test_moment_sees_the_half_width_below_the_distance_of_nodes():
    for shift in (0.0, 0.013, 0.05):
        x = 0.7 + shift + np.arange(-8, 9) * 0.1
        pressure = hertz_pressure(x - 0.7, 1.0, 0.67)
        assert moment_half_width(x, 0.1 * pressure) == pytest.approx(0.67, rel=0.015)
    x = 0.7 + np.linspace(-0.67, 0.67, 20001)
    assert moment_half_width(x, hertz_pressure(x - 0.7, 1.0, 0.67)) == pytest.approx(0.67, rel=1e-5)


@pytest.mark.parametrize(
    ("call", "word"),
    [
        (lambda: contact_modulus(0.0, 0.3), "E must"),
        (lambda: contact_modulus(1.0, 0.3, (1.0, 0.5)), "nu must"),
        (lambda: hertz_half_width(-1.0, R, MODULUS), "load must"),
        (lambda: hertz_load(A, 0.0, MODULUS), "radius must"),
        (lambda: hertz_pressure(0.0, LOAD, 0.0), "half_width must"),
        (lambda: stick_half_width(LOAD, A, 0.1, 0.0), "mu must"),
        (lambda: cattaneo_mindlin_shear(0.0, LOAD, A, LOAD, 0.3), "all slides"),
        (lambda: moment_half_width([0.0, 1.0], [0.0, 0.0]), "force must"),
    ],
)
def test_wrong_values_are_refused_by_name(call, word):
    with pytest.raises(ValueError, match=word):
        call()
