# SPDX-License-Identifier: LGPL-3.0-or-later
import numpy as np
import pytest

from fenicsx_hmcontact import GapFlow


def test_flow_between_parallel_plates():
    # Poiseuille: the parabola u = -p' z (g - z) / (2 mu) over the aperture.
    g, mu = 2e-4, 1.3e-3
    z, w = np.polynomial.legendre.leggauss(3)
    z, w = g * (1 + z) / 2, g * w / 2
    flow = np.sum(w * z * (g - z)) / (2 * mu)
    law = GapFlow(1e-9, viscosity=mu)
    assert law.longitudinal_conductance(g) == pytest.approx(flow, rel=1e-14)


@pytest.mark.parametrize("sealing", [False, True])
def test_flow_between_two_nodes_is_that_of_all_between(sealing):
    law = GapFlow(1e-9, viscosity=1.3e-3, sealing=sealing)
    ends = np.array([[2e-4, 2e-4], [1e-4, 3e-4], [5e-4, 4e-5]])
    s, weight = np.polynomial.legendre.leggauss(60)
    widths = ends[:, :1] * (1.0 - s) / 2.0 + ends[:, 1:] * (1.0 + s) / 2.0
    local = law.longitudinal_conductance(widths)
    expected = 2.0 / ((1.0 / local) @ weight) if sealing else local @ weight / 2.0
    conductance, slopes = law.conductance_between(ends)
    assert conductance == pytest.approx(expected, rel=1e-12)
    for end in range(2):
        step = 1e-9 * np.eye(2)[end]
        above, below = (law.conductance_between(ends + sign * step)[0] for sign in (1.0, -1.0))
        assert slopes[:, end] == pytest.approx((above - below) / 2e-9, rel=1e-8)


def test_one_closed_node_seals_if_asked_to():
    ends = np.array([[0.0, 1e-3], [1e-3, 0.0], [0.0, 0.0]])
    conductance, slopes = GapFlow(1e-9, sealing=True).conductance_between(ends)
    assert not conductance.any() and not slopes.any()
    conductance, _ = GapFlow(1e-9).conductance_between(ends)
    assert conductance.astype(bool).tolist() == [True, True, False]


@pytest.mark.parametrize("sealing", [False, True])
def test_beyond_the_cap_a_gap_leads_no_more(sealing):
    law = GapFlow(1e-9, aperture_cap=1e-3, sealing=sealing)
    conductance, slopes = law.conductance_between(np.array([[5e-3, 2e-3]]))
    assert conductance == pytest.approx(law.longitudinal_conductance(1.0), rel=1e-14)
    assert not slopes.any()


def test_flow_across_is_darcys():
    law = GapFlow(3e-8, unit_weight=9.81e3)
    assert law.transverse_conductivity(2e-3) * 2e-3 * 9.81e3 == pytest.approx(3e-8, rel=1e-15)


@pytest.mark.parametrize("name", ["transverse_permeability", "viscosity", "unit_weight"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_refuses_what_must_be_positive(name, value):
    with pytest.raises(ValueError, match=name):
        GapFlow(**{"transverse_permeability": 1e-9, name: value})


@pytest.mark.parametrize("value", [-1e-16, np.nan, np.inf])
def test_refuses_apertures(value):
    with pytest.raises(ValueError, match="aperture"):
        GapFlow(1e-9, aperture=value)


@pytest.mark.parametrize("value", [None, 0.0, 1e-16, 1.0])
def test_takes_apertures(value):
    assert GapFlow(1e-9, aperture=value).aperture == value
