# SPDX-License-Identifier: LGPL-3.0-or-later
"""The example of a material of one's own: modified Cam-clay."""

import numpy as np
import pytest

import fenicsx_hmcontact as hm
from tests.materials.cam_clay import CamClay

CLAY = CamClay(M=1.0, lam=0.1, kappa=0.02, nu=0.3, p_c=1e5)
ISOTROPIC = np.array([[-1.0, -1.0, -1.0, 0.0]])


def invariants(stress):
    """Mean effective compression p and deviator stress q [Pa]."""
    p = -stress[:, :3].mean(axis=1)
    s = stress + p[:, None] * [1.0, 1.0, 1.0, 0.0]
    return p, np.sqrt(1.5 * (s * s) @ [1.0, 1.0, 1.0, 2.0])


def states(n, seed=0):
    """Random states on and within the yield surface, and strain increments."""
    rng = np.random.default_rng(seed)
    p = rng.uniform(0.1, 1.0, size=n) * CLAY.p_c
    stress = 0.4 * rng.normal(size=(n, 4)) * p[:, None] / 2.0
    stress -= stress @ np.array([[1, 1, 1, 0]]).T / 3.0 * [1.0, 1.0, 1.0, 0.0]
    return stress + p[:, None] * ISOTROPIC, 6e-3 * rng.normal(size=(n, 3))


def path(stress, strain, steps, p_c=CLAY.p_c):
    history = np.array([[p_c]])
    for _ in range(steps):
        update = CLAY.update(stress, np.array([strain]) / steps, history)
        assert not update.flagged.any()
        stress, history = update.stress, update.history
    return stress, history[0, 0]


def test_it_is_a_material():
    assert isinstance(CLAY, hm.Material)
    assert CLAY.initial_history(2).tolist() == [[1e5], [1e5]]


def test_end_of_a_step_is_admissible():
    stress, strain = states(2000)
    update = CLAY.update(stress, strain, CLAY.initial_history(2000))
    p, q = invariants(update.stress)
    p_c = update.history[:, 0]
    f = (q**2 / CLAY.M**2 + p * (p - p_c)) / p_c**2
    plastic = p_c != CLAY.p_c
    assert 500 < plastic.sum() < 1900
    assert np.abs(f[plastic]).max() < 1e-11 and f.max() < 1e-11
    assert not update.flagged.any()


def test_tangents_are_the_derivatives():
    stress, strain = states(500, seed=1)
    history = CLAY.initial_history(500)
    update = CLAY.update(stress, strain, history)

    def difference(stress_step, strain_step):
        after = CLAY.update(stress + stress_step, strain + strain_step, history)
        before = CLAY.update(stress - stress_step, strain - strain_step, history)
        return after.stress - before.stress

    by_stress = np.stack([difference(1.0 * d, 0.0) / 2.0 for d in np.eye(4)], axis=-1)
    by_strain = np.stack([difference(0.0, 1e-7 * d) / 2e-7 for d in np.eye(3)], axis=-1)
    assert np.abs(by_stress - update.by_stress).max() < 1e-6
    assert np.abs(by_strain - update.by_strain).max() < 1e-6 * CLAY.p_c / CLAY.kappa


def test_swelling_line_is_exact():
    stress, _ = path(5e4 * ISOTROPIC, [-2e-3, -1e-3, 0.0], 4)
    assert invariants(stress)[0][0] == pytest.approx(5e4 * np.exp(3e-3 / CLAY.kappa), rel=1e-12)


@pytest.mark.parametrize(("p", "steps"), [(1e5, 10), (1e5, 40), (2e4, 40)])
def test_undrained_shear_ends_at_the_critical_state(p, steps):
    """There q = M p, p_c = 2 p; at constant volume kappa ln p + (lam - kappa) ln p_c is constant.

    From normally consolidated and, with softening, from overconsolidated clay.
    """
    stress, p_c = path(p * ISOTROPIC, [1.0, -1.0, 0.0], steps)
    share = CLAY.kappa / CLAY.lam
    critical = p**share * (0.5 * CLAY.p_c) ** (1.0 - share)
    end, q = invariants(stress)
    assert end[0] == pytest.approx(critical, rel=1e-6)
    assert q[0] == pytest.approx(CLAY.M * critical, rel=1e-6)
    assert p_c == pytest.approx(2.0 * critical, rel=1e-6)


def test_oedometer_follows_the_compression_line():
    """One-dimensional compression far past p_c: p grows by exp(e / lam), stress ratio constant."""
    first, p_c = path(5e4 * ISOTROPIC, [0.0, -0.4, 0.0], 400)
    second, _ = path(first, [0.0, -0.02, 0.0], 20, p_c)
    (p1, q1), (p2, q2) = invariants(first), invariants(second)
    assert p2 / p1 == pytest.approx(np.exp(0.02 / CLAY.lam), rel=1e-6)
    assert q2 / p2 == pytest.approx(q1 / p1, rel=1e-6)


def test_without_compression_it_is_refused():
    with pytest.raises(ValueError, match="set the stress first"):
        CLAY.update(0.0 * ISOTROPIC, np.zeros((1, 3)), CLAY.initial_history(1))
