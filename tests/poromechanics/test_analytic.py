# SPDX-License-Identifier: LGPL-3.0-or-later
import numpy as np
import pytest
from scipy.sparse import diags_array, eye_array
from scipy.sparse.linalg import splu

from fenicsx_hmcontact.poromechanics.analytic import (
    EARLY,
    consolidation_coefficient,
    terzaghi_degree,
    terzaghi_pressure,
)


def test_consolidation_coefficient():
    assert consolidation_coefficient(1e-9, 1e4, 1e8, 0.0) == pytest.approx(1e-5, rel=1e-15)
    lame = 1e6 * 0.3 / (1.3 * 0.4)
    shear = 1e6 / 2.6
    cv = 1e-5 / 1e4 * (lame + 2 * shear)
    assert consolidation_coefficient(1e-5, 1e4, 1e6, 0.3) == pytest.approx(cv, rel=1e-14)


@pytest.mark.parametrize(
    ("time", "base", "degree"),
    [
        (0.05, 0.99687, 0.25231),
        (0.1, 0.949305, 0.356823),
        (0.197, 0.77774, 0.50034),
        (0.5, 0.370777, 0.763950),
        (0.848, 0.157113, 0.899979),
        (1.0, 0.107977, 0.931260),
    ],
)
def test_textbook_values(time, base, degree):
    # T = cv t / H^2 with H = 2 m and cv = 3e-6 m2/s.
    t = time * 4.0 / 3e-6
    assert terzaghi_pressure(0.0, t, 2.0, 3e-6, 5e3) / 5e3 == pytest.approx(base, abs=6e-6)
    assert terzaghi_degree(t, 2.0, 3e-6) == pytest.approx(degree, abs=6e-6)


@pytest.mark.parametrize("time", [1e-3, 0.02, 0.19, 0.21, 0.7])
def test_is_the_long_cosine_series(time):
    y = np.linspace(0, 1, 41)
    m = (2 * np.arange(400) + 1) * np.pi / 2
    decay = np.exp(-(m**2) * time)
    p = np.cos(np.outer(y, m)) @ (2 * (-1.0) ** np.arange(400) / m * decay)
    np.testing.assert_allclose(terzaghi_pressure(y, time, 1.0, 1.0, 1.0), p, atol=2e-14)
    degree = 1 - np.sum(2 / m**2 * decay)
    # The series of the degree has lost its tail of 1 / (pi^2 n) at the smallest time.
    assert terzaghi_degree(time, 1.0, 1.0) == pytest.approx(degree, abs=1e-13)


def test_both_forms_agree_where_they_meet():
    y = np.linspace(0, 1, 101)
    before = np.nextafter(EARLY, 0)
    p = [terzaghi_pressure(y, t, 1.0, 1.0, 1.0) for t in (before, EARLY)]
    np.testing.assert_allclose(p[0], p[1], atol=1e-15)
    degree = [terzaghi_degree(t, 1.0, 1.0) for t in (before, EARLY)]
    assert degree[0] == pytest.approx(degree[1], abs=1e-15)


def test_solves_the_diffusion_equation():
    # Crank-Nicolson on 400 cells from the exact pressure at T = 0.01 to T = 0.4.
    n, steps = 400, 800
    y = np.linspace(0, 1, n + 1)
    dt = 0.39 / steps
    laplacian = diags_array([1.0, -2.0, 1.0], offsets=[-1, 0, 1], shape=(n + 1, n + 1)).tolil()
    laplacian[0, 1] = 2.0  # sealed base
    laplacian[n] = 0.0  # drained top
    half = (0.5 * dt * n**2) * laplacian.tocsc()
    solve = splu((eye_array(n + 1) - half).tocsc()).solve
    p = terzaghi_pressure(y, 0.01, 1.0, 1.0, 1.0)
    for _ in range(steps):
        p = solve(p + half @ p)
    np.testing.assert_allclose(terzaghi_pressure(y, 0.4, 1.0, 1.0, 1.0), p, atol=2e-5)


@pytest.mark.parametrize("t", [1e-4, 1e-2, 0.15, 0.3, 1.0])
def test_settlement_is_the_mean_pressure_lost(t):
    x, weights = np.polynomial.legendre.leggauss(200)
    # Points crowd at the drained top, where early pressures fall steeply.
    s = (x + 1) / 2
    p = terzaghi_pressure(1 - s**4, t, 1.0, 1.0, 1.0)
    mean = np.sum(weights / 2 * 4 * s**3 * p)
    assert terzaghi_degree(t, 1.0, 1.0) == pytest.approx(1 - mean, abs=1e-12)


def test_limits():
    y = np.linspace(0, 3, 7)
    p = terzaghi_pressure(y, [[0.0], [1e-30], [1e12]], 3.0, 1e-5, 1e4)
    start = np.where(y < 3, 1e4, 0.0)
    np.testing.assert_array_equal(p[:2], [start, start])
    np.testing.assert_array_equal(p[2], 0.0)
    np.testing.assert_array_equal(terzaghi_degree([0.0, 1e30], 3.0, 1e-5), [0.0, 1.0])
    # Half space: 2 sqrt(T / pi); no term of any series lost however early.
    assert terzaghi_degree(1e-20, 1.0, 1.0) == pytest.approx(2e-10 / np.sqrt(np.pi), rel=1e-15)
    # Slope at the drained top, p0 / sqrt(pi cv t), from a pressure of 1e-9 of the load.
    t, depth = 1e-4, 2e-11
    gradient = terzaghi_pressure(1 - depth, t, 1.0, 1.0, 1.0) / (1 - (1 - depth))
    assert gradient == pytest.approx(1 / np.sqrt(np.pi * t), rel=1e-12)


def test_shapes_broadcast():
    assert terzaghi_pressure(np.zeros((4, 1)), np.ones(3), 1.0, 1.0, 1.0).shape == (4, 3)
    assert terzaghi_pressure(0.5, 1.0, 1.0, 1.0, 1.0).shape == ()
    assert terzaghi_degree(np.ones((2, 3)), 1.0, 1.0).shape == (2, 3)


def test_units_do_not_matter():
    y, t = np.linspace(0, 1, 11), np.array([[1e2], [1e4]])
    si = terzaghi_pressure(y, t, 1.0, 1e-5, 1e4)
    days = terzaghi_pressure(y * 1e3, t / 86400, 1e3, 1e-5 * 86400 * 1e6, 10.0)
    np.testing.assert_allclose(days * 1e3, si, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: consolidation_coefficient(0.0, 1e4, 1e8, 0.0), "permeability must be positive"),
        (lambda: consolidation_coefficient(1e-9, -1.0, 1e8, 0.0), "unit_weight must be positive"),
        (lambda: consolidation_coefficient(1e-9, 1e4, np.nan, 0.0), "E must be positive"),
        (lambda: consolidation_coefficient(1e-9, 1e4, 1e8, 0.5), "nu must lie between"),
        (lambda: terzaghi_pressure(1.1, 1.0, 1.0, 1.0, 1.0), "y must lie between"),
        (lambda: terzaghi_pressure(0.5, -1.0, 1.0, 1.0, 1.0), "t must not be negative"),
        (lambda: terzaghi_degree(1.0, 0.0, 1.0), "height must be positive"),
        (lambda: terzaghi_degree(1.0, 1.0, -1.0), "cv must be positive"),
    ],
)
def test_wrong_values_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
