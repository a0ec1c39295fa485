# SPDX-License-Identifier: LGPL-3.0-or-later
"""Return mappings of Tresca and Mohr-Coulomb."""

from dataclasses import replace

import numpy as np
import pytest

import fenicsx_hmcontact as hm
from tests.materials import twin

E, NU, C = 1e6, 0.3, 1e4
LAWS = {
    "Tresca": hm.Tresca(E, NU, C),
    "Tresca, nu 0.499": hm.Tresca(E, 0.499, C),
    "Tresca, cut off": hm.Tresca(E, NU, C, tension_cutoff=3e3),
    "25/25": hm.MohrCoulomb(E, NU, C, phi=25.0),
    "30/10": hm.MohrCoulomb(E, NU, C, phi=30.0, psi=10.0),
    "30/0": hm.MohrCoulomb(E, NU, C, phi=30.0, psi=0.0),
    "25/25, cut off": hm.MohrCoulomb(E, NU, C, phi=25.0, tension_cutoff=5e3),
    "30/0, cut off": hm.MohrCoulomb(E, NU, C, phi=30.0, psi=0.0, tension_cutoff=0.0),
    "sand 35/5": hm.MohrCoulomb(E, NU, 0.0, phi=35.0, psi=5.0),
}
parametrized = pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)


def trials(n, size=3.0 * C, seed=0):
    """Random trial stresses [Pa]: a mean stress and, of the same size, deviators."""
    rng = np.random.default_rng(seed)
    mean = np.array([1.0, 1.0, 1.0, 0.0]) * rng.normal(size=(n, 1))
    return size * (mean - 0.3 * np.array([1.0, 1.0, 1.0, 0.0]) + 0.7 * rng.normal(size=(n, 4)))


def returned(law, trial, history=None):
    return law.return_mapping(
        trial, law.initial_history(len(trial)) if history is None else history
    )


def sorted_principal(stress):
    """Principal stresses from major to minor; shape (n, 3)."""
    tensors = np.zeros((len(stress), 3, 3))
    tensors[:, [0, 1, 2, 0, 1], [0, 1, 2, 1, 0]] = stress[:, [0, 1, 2, 3, 3]]
    return np.linalg.eigvalsh(tensors)[:, ::-1]


def yield_functions(law, stress):
    """Shear and, with a cut-off, tension yield function [Pa]; shape (n, 1 or 2)."""
    s = sorted_principal(stress)
    phi = np.radians(getattr(law, "phi", 0.0))
    values = [0.5 * (s[:, 0] - s[:, 2]) + 0.5 * (s[:, 0] + s[:, 2]) * np.sin(phi)]
    values[0] -= law.c * np.cos(phi)
    if law.tension_cutoff is not None:
        values.append(s[:, 0] - law.tension_cutoff)
    return np.column_stack(values)


def plastic_strain(law, trial, stress):
    """Plastic strain xx, yy, zz, xy of the return, by Hooke's law; shape (n, 4)."""
    change = trial - stress
    trace = change[:, :3].sum(axis=1, keepdims=True) * np.array([1.0, 1.0, 1.0, 0.0])
    return ((1.0 + law.nu) * change - law.nu * trace) / law.E


def regions_of(law, stress, trial):
    """What active planes a stress lies on, as a label for counting."""
    s = sorted_principal(stress)
    tolerance = 1e-9 * max(law.c, abs(trial).max())
    f = abs(yield_functions(law, stress)) < tolerance
    same = abs(np.diff(s, axis=1)) < tolerance
    moved = abs(stress - trial).max(axis=1) > tolerance
    return np.where(moved, f @ (1 << np.arange(f.shape[1])) + 4 * same[:, 0] + 8 * same[:, 1], -1)


@parametrized
def test_returned_stresses_lie_on_the_yield_surface(law):
    trial = trials(100_000)
    result = returned(law, trial)
    f = yield_functions(law, result.stress).max(axis=1)
    plastic = (result.stress != trial).any(axis=1)
    assert 0.3 * len(trial) < plastic.sum() < len(trial)
    scale = 1e-12 * (law.c or 3.0 * C)
    assert abs(f[plastic]).max() < scale
    assert f[~plastic].max() < scale
    assert (result.history[plastic, 0] > 0.0).all() and (result.history[~plastic] == 0.0).all()
    # Every part of the surface is met: main plane, edges, corners; elastic points besides.
    labels, counts = np.unique(regions_of(law, result.stress, trial), return_counts=True)
    assert len(labels) == len(law._planes.q) and counts.min() > 20


@parametrized
def test_multipliers_are_not_negative(law):
    """Some region holds every trial stress: multipliers positive, order and other planes kept."""
    trial, planes = trials(100_000), law._planes
    values = planes.conditions @ sorted_principal(trial).T + planes.offsets[:, :, None]
    margin = values.min(axis=1).max(axis=0)
    assert margin[~returned(law, trial).flagged].min() > -1e-12 * 3.0 * C / (0.5 - law.nu)


@parametrized
def test_only_stresses_beyond_the_apex_without_dilation_are_flagged(law):
    result = returned(law, trials(100_000))
    if law != LAWS["30/0"]:
        assert not result.flagged.any()
        return
    beyond = result.flagged
    assert 1000 < beyond.sum() < 50_000
    assert np.abs(result.stress[beyond] - law.apex * np.array([1, 1, 1, 0])).max() < 1e-12 * C
    assert (result.tangent[beyond] == 0.0).all()
    assert "beyond the apex" in result.reason


@parametrized
def test_stress_and_plastic_strain_satisfy_koiters_conditions(law):
    trial = trials(100, seed=1)
    result = returned(law, trial)
    for point, s in enumerate(trial):
        found = twin.solutions(law, s)
        assert bool(found) != result.flagged[point]
        for stress, plastic in found:
            assert abs(result.stress[point] - stress).max() < 1e-11 * 3.0 * C
            kappa = np.sqrt(2.0 / 3.0 * plastic @ plastic)
            assert result.history[point, 0] == pytest.approx(kappa, rel=1e-9, abs=1e-13)


@pytest.mark.parametrize("name", ["Tresca", "Tresca, cut off", "25/25", "25/25, cut off"])
def test_plastic_work_of_associated_flow_is_largest(name):
    """Maximum dissipation: no admissible stress does more work on the plastic strain."""
    law = LAWS[name]
    trial = trials(2000, seed=2)
    stress = returned(law, trial).stress
    flow = plastic_strain(law, trial, stress) * [1.0, 1.0, 1.0, 2.0]
    others = returned(law, trials(2000, seed=3)).stress
    assert ((others - stress) * flow).sum(axis=1).max() < 1e-12 * abs(flow).max() * 10.0 * C


@parametrized
def test_tangents_are_the_derivatives(law):
    trial = trials(4000, seed=4)
    strain = 1e-3 * np.random.default_rng(5).normal(size=(len(trial), 3))
    history = law.initial_history(len(trial))
    update = law.update(trial, strain, history)
    inside = np.ones(len(trial), bool)

    def difference(stress_step, strain_step):
        after = law.update(trial + stress_step, strain + strain_step, history)
        before = law.update(trial - stress_step, strain - strain_step, history)
        for other in (after, before):
            same = regions_of(law, other.stress, trial) == regions_of(law, update.stress, trial)
            inside[:] &= same
        return after.stress - before.stress

    by_stress = [difference(0.1 * d, 0.0) / 0.2 for d in np.eye(4)]
    by_strain = [difference(0.0, 1e-7 * d) / 2e-7 for d in np.eye(3)]
    # A step across the border of two regions, where the tangent jumps, tells nothing.
    assert inside.mean() > 0.97
    errors = np.abs(np.stack(by_stress, axis=-1) - update.by_stress)[inside]
    assert errors.max() < 1e-7
    errors = np.abs(np.stack(by_strain, axis=-1) - update.by_strain)[inside]
    assert errors.max() < 1e-7 * law.E


@parametrized
def test_tangent_is_symmetric_for_associated_flow_alone(law):
    tangent = returned(law, trials(2000, seed=6)).tangent
    # By symmetric pairs of stress and strain: xy counts twice.
    stiffness = np.column_stack((law.stiffness[:, :2], law.stiffness[:, 0], law.stiffness[:, 2]))
    stiffness[:3, 2] = law.lame, law.lame, law.oedometric_modulus
    D = tangent @ stiffness
    difference = np.abs(D - D.swapaxes(1, 2)).max() / law.E
    if getattr(law, "psi", None) is None:
        assert difference < 1e-12 / (0.5 - law.nu)
    else:
        assert difference > 0.1


@parametrized
@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_units_of_stress_do_not_matter(law, scale):
    changed = {"E": law.E * scale, "c": law.c * scale}
    if law.tension_cutoff is not None:
        changed["tension_cutoff"] = law.tension_cutoff * scale
    trial = trials(2000, seed=7)
    result, other = returned(law, trial), returned(replace(law, **changed), trial * scale)
    assert np.allclose(other.stress, result.stress * scale, rtol=0, atol=1e-11 * C * scale)
    assert np.allclose(other.history, result.history, rtol=0, atol=1e-14)
    assert np.allclose(other.tangent, result.tangent, rtol=0, atol=1e-9)
    assert (other.flagged == result.flagged).all()


@parametrized
def test_material_has_no_preferred_direction(law):
    """Turning the trial stress by any angle turns the result."""
    trial = trials(500, seed=8)
    angle = np.random.default_rng(9).uniform(0.0, np.pi, len(trial))
    c, s, zero = np.cos(angle), np.sin(angle), np.zeros(len(trial))
    one = zero + 1.0
    turn = np.array(
        [
            [c * c, s * s, zero, -2 * c * s],
            [s * s, c * c, zero, 2 * c * s],
            [zero, zero, one, zero],
            [c * s, -c * s, zero, c * c - s * s],
        ]
    ).transpose(2, 0, 1)
    there = np.einsum("nij,nj->ni", turn, trial)
    result, turned = returned(law, trial), returned(law, there)
    back = np.einsum("nij,nj->ni", turn, result.stress)
    assert np.abs(turned.stress - back).max() < 1e-10 * C
    assert np.abs(turned.tangent @ turn - turn @ result.tangent).max() < 1e-9


@parametrized
def test_out_of_plane_stress_is_a_principal_stress_like_the_others(law):
    """The stresses (a, b) in the plane and z out of it may change places."""
    values = sorted_principal(trials(500, seed=10))
    expected = None
    for order in ((0, 1, 2), (0, 2, 1), (1, 2, 0), (2, 1, 0)):
        a, b, z = values[:, order].T
        stress = returned(law, np.column_stack((a, b, z, 0.0 * a))).stress
        assert (stress[:, 3] == 0.0).all()
        principal = np.empty_like(values)
        principal[:, order] = stress[:, :3]
        expected = principal if expected is None else expected
        assert np.abs(principal - expected).max() < 1e-10 * C
        assert (np.diff(principal, axis=1) < 1e-11 * C).all()


@parametrized
def test_equal_principal_stresses(law):
    """Isotropic trials, equal stresses in the plane, and any in-plane stress equal to zz."""
    base = trials(300, seed=11)
    isotropic = base[:, [0, 0, 0, 3]] * [1, 1, 1, 0]
    in_plane = base[:, [0, 0, 2, 3]] * [1, 1, 1, 0]
    out_of_plane = base[:, [0, 1, 0, 3]] * [1, 1, 1, 0]
    for trial in (isotropic, in_plane, out_of_plane):
        result = returned(law, trial)
        equal = trial[:, [0, 0, 1]] == trial[:, [1, 2, 2]]
        s = result.stress
        assert np.abs((s[:, [0, 0, 1]] - s[:, [1, 2, 2]])[equal]).max() < 1e-11 * C
        assert np.isfinite(result.tangent).all()
        # Of in-plane stresses that nearly are equal, stress and tangent are nearly the same. At
        # a stress equal to zz the tangent jumps.
        nearby = trial + np.array([1e-8, -1e-8, 0.0, 1e-8]) * C
        other = returned(law, nearby)
        assert np.abs(other.stress - s).max() < 1e-6 * C
        if trial is in_plane:
            assert np.abs(other.tangent - result.tangent).max() < 1e-6


def test_isotropic_trials_within_rounding_of_the_apex():
    """Where rounding sends equal stresses to a region that tells them apart, tangents are numbers.

    Such trials come from points that stay at the apex in a step of next to no strain.
    """
    law = hm.MohrCoulomb(1e7, 0.35, 5e3, phi=25.0)
    trial = np.full((200, 4), law.apex)
    trial[:, 2] += np.arange(-100, 100) * np.spacing(law.apex)
    trial[:, 3] = 0.0
    result = returned(law, trial)
    assert np.isfinite(result.tangent).all() and np.abs(result.tangent).max() < 2.0
    assert np.abs(result.stress - trial).max() < 1e-12 * law.apex


@parametrized
def test_stress_on_the_surface_stays(law):
    """Points on planes, edges and corners already: returning them again changes nothing."""
    first = returned(law, trials(5000, seed=12))
    again = returned(law, first.stress)
    assert np.abs(again.stress - first.stress).max() < 1e-11 * C
    assert again.history.max() < 1e-11 * C / E
    assert not again.flagged.any()


def test_kappa_accumulates():
    law = LAWS["25/25"]
    trial = trials(100, seed=13)
    fresh = returned(law, trial).history
    start = np.full((100, 1), 0.25)
    assert np.allclose(returned(law, trial, start).history, fresh + 0.25, rtol=1e-14)
    assert (start == 0.25).all() and law.initial_history(3).tolist() == [[0.0]] * 3
    assert law.history_names == ("kappa",)


def test_elastic_step_is_exact_and_leaves_its_arguments():
    law = LAWS["Tresca"]
    stress, strain = 0.2 * C * np.ones((5, 4)), 1e-4 * np.ones((5, 3))
    history = law.initial_history(5)
    update = law.update(stress, strain, history)
    elastic = hm.LinearElastic(E, NU).update(stress, strain, np.zeros((5, 0)))
    assert (update.stress == elastic.stress).all()
    assert (update.by_strain == elastic.by_strain).all()
    assert (update.by_stress == elastic.by_stress).all()
    assert (stress == 0.2 * C).all() and (strain == 1e-4).all() and (history == 0.0).all()
    assert isinstance(law, hm.Material)


def path(law, stress, strain, steps):
    """Stress after a strain path in equal steps; shape (4,)."""
    stress, history = np.array([stress]), law.initial_history(1)
    for _ in range(steps):
        update = law.update(stress, np.array([strain]) / steps, history)
        stress, history = update.stress, update.history
    return stress[0], history[0, 0]


@pytest.mark.parametrize("steps", [1, 7])
def test_undrained_plane_strain_compression(steps):
    """Constant volume: elastic to s_yy = -2 c, where the yield surface and sigma_zz stand still."""
    law = hm.Tresca(E, NU, C)
    G, strain = law.shear_modulus, 0.1
    stress, kappa = path(law, np.zeros(4), [strain, -strain, 0.0], steps)
    assert np.allclose(stress, [C, -C, 0.0, 0.0], rtol=0, atol=1e-10 * C)
    assert kappa == pytest.approx(np.sqrt(4.0 / 3.0) * (strain - C / (2.0 * G)), rel=1e-10)


@pytest.mark.parametrize(("phi", "psi"), [(30.0, 30.0), (30.0, 10.0), (30.0, 0.0)])
def test_drained_biaxial_compression(phi, psi):
    """Constant lateral stress: failure at sigma_1 = K_p sigma_3 + 2 c sqrt(K_p), and dilation.

    The lateral strain is sought that keeps the lateral stress, with the tangent of the law.
    """
    law = hm.MohrCoulomb(E, NU, C, phi, psi)
    lateral = -1e5
    stress, history = np.array([[lateral, lateral, lateral, 0.0]]), law.initial_history(1)
    volumes = []
    for _ in range(60):
        strain = np.array([[0.0, -0.01, 0.0]])
        for _ in range(30):
            update = law.update(stress, strain, history)
            miss = update.stress[0, 0] - lateral
            if abs(miss) < 1e-10 * abs(lateral):
                break
            strain[0, 0] -= miss / update.by_strain[0, 0, 0]
        stress, history = update.stress, update.history
        volumes.append(strain[0, :2].sum() / 0.01)
    K_p = (1.0 + np.sin(np.radians(phi))) / (1.0 - np.sin(np.radians(phi)))
    assert stress[0, 1] == pytest.approx(K_p * lateral - 2.0 * C * np.sqrt(K_p), rel=1e-9)
    # At failure the stresses stand still, the strain is plastic: e_v / e_y = 1 - tan^2(45 + psi/2).
    N = (1.0 + np.sin(np.radians(psi))) / (1.0 - np.sin(np.radians(psi)))
    assert volumes[-1] == pytest.approx(N - 1.0, rel=1e-7, abs=1e-7)


def test_uniaxial_tension_stops_at_the_cut_off():
    law = hm.MohrCoulomb(E, NU, C, 30.0, tension_cutoff=2e3)
    stress, _ = path(law, np.zeros(4), [0.0, 0.1, 0.0], 3)
    assert stress[1] == pytest.approx(2e3, rel=1e-12)
    # Elastic until the cut-off, then the crack opens; lateral stress stays nu/(1 - nu) of it.
    assert stress[0] == pytest.approx(2e3 * NU / (1.0 - NU), rel=1e-10)


def test_phi_zero_is_tresca():
    trial = trials(1000, seed=14)
    clay, soil = (
        returned(hm.Tresca(E, NU, C), trial),
        returned(hm.MohrCoulomb(E, NU, C, 0.0), trial),
    )
    assert (clay.stress == soil.stress).all() and (clay.tangent == soil.tangent).all()


@parametrized
@pytest.mark.parametrize("component", range(4))
def test_what_is_no_number_stays_so(law, component):
    trial = trials(3, seed=15)
    trial[1, component] = np.nan
    result = returned(law, trial)
    assert np.isnan(result.stress[1]).any() and np.isfinite(result.stress[[0, 2]]).all()
    assert not result.flagged[1]
    assert returned(law, trial[:0]).stress.shape == (0, 4)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"c": -1.0}, "c is -1.0"),
        ({"c": float("nan")}, "c is nan"),
        ({"phi": 90.0}, "phi is 90.0"),
        ({"phi": -1.0}, "phi is -1.0"),
        ({"c": 0.0, "phi": 0.0, "psi": None}, "c and phi are both 0"),
        ({"psi": 31.0}, "psi is 31.0; it must be from 0 to phi"),
        ({"psi": -1.0}, "psi is -1.0"),
        ({"tension_cutoff": -1.0}, "tension_cutoff is -1.0"),
        ({"tension_cutoff": 2e4}, "tension_cutoff is 20000.0; .* below c cot"),
        ({"E": 0.0}, "E is 0.0"),
        ({"nu": 0.5}, "nu is 0.5"),
    ],
)
def test_values_out_of_range_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        replace(hm.MohrCoulomb(E, NU, C, 30.0, 10.0), **values)


@pytest.mark.parametrize("values", [{"c": 0.0}, {"tension_cutoff": float("nan")}])
def test_values_of_tresca_out_of_range_are_refused(values):
    with pytest.raises(ValueError, match=f"{next(iter(values))} is"):
        replace(LAWS["Tresca"], **values)


def test_koiters_conditions_for_random_soils():
    """Angles, stiffness and strength at random, weak and strong trials; the solution is unique."""
    rng = np.random.default_rng(16)
    without = 0
    for _ in range(40):
        phi, c = rng.uniform(1.0, 70.0), 10.0 ** rng.uniform(2.0, 5.0)
        psi = rng.choice([0.0, 1e-3 * phi, 0.5 * phi, phi])
        cutoff = rng.choice([None, 0.0, 0.5 * c / np.tan(np.radians(phi))])
        nu = rng.choice([-0.3, 0.0, 0.3, 0.4999])
        law = hm.MohrCoulomb(E, nu, c, phi, psi, cutoff)
        trial = trials(10, 1.0, seed=rng) * 10.0 ** rng.uniform(3.0, 6.0, size=(10, 1))
        result = returned(law, trial)
        for s, stress, flagged in zip(trial, result.stress, result.flagged, strict=True):
            found = twin.solutions(law, s)
            assert bool(found) != flagged
            assert not flagged or (psi == 0.0 and cutoff is None)
            without += flagged
            for other, _ in found:
                assert np.abs(other - stress).max() < 1e-8 * max(c, np.abs(s).max())
    assert without > 0
