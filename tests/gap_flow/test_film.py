# SPDX-License-Identifier: LGPL-3.0-or-later
"""Film between surfaces of given aperture: matrices against exact fields and flows."""

import numpy as np
import pytest

from fenicsx_hmcontact import GapFlow
from fenicsx_hmcontact.contact import gather_surface, mortar_operator, mortar_segments
from fenicsx_hmcontact.gap_flow import film_conductance, mean_pressure
from tests.models import stack

pytestmark = pytest.mark.mpi

FLOW = GapFlow(1e-7, viscosity=2e-3, unit_weight=9e3)
G = 1e-3
MESHES = [((5, 7), 0.0), ((11, 4), 0.3), ((6, 6), -0.2)]


def film(comm, across, slope, shift=0.0, ends=()):
    domain = stack(comm, across, slope=slope, shift=shift)
    secondary, primary = (
        gather_surface(domain.mesh, domain.facet_tags, domain.surface(name), name)
        for name in ("bottom_1", "top_0")
    )
    segments = mortar_segments(secondary, primary)
    operator = mortar_operator(secondary, primary, segments)
    prescribed = np.isin(np.arange(len(secondary.nodes)), ends)
    A = film_conductance(FLOW, G, secondary, segments, operator, prescribed)
    return secondary, primary, operator, prescribed, A


def condensed(operator, prescribed, p_s, p_m):
    """Unknowns of a film of given face pressures."""
    tied = operator.kept & ~prescribed
    drop = p_s + operator.C @ p_s - operator.H @ p_m
    return np.concatenate((np.where(tied, drop, p_s), p_m))


@pytest.mark.parametrize(("across", "slope"), MESHES)
@pytest.mark.parametrize("ends", [(), (0, -1)])
@pytest.mark.parametrize("shift", [0.0, 0.13])
def test_constant_pressure_flows_nowhere(comm, across, slope, ends, shift):
    ends = [e % (across[1] + 1) for e in ends] if shift == 0.0 else ()
    secondary, primary, operator, prescribed, A = film(comm, across, slope, shift, ends)
    n_s, n_m = len(secondary.nodes), len(primary.nodes)
    assert A.shape == (n_s + n_m, n_s + n_m)
    p = condensed(operator, prescribed, np.ones(n_s), np.ones(n_m))
    assert np.abs(A @ p).max() < 1e-14 * np.abs(A).max()
    assert np.abs(A - A.T).max() < 1e-15 * np.abs(A).max()
    assert np.linalg.eigvalsh(A.toarray())[0] > -1e-14 * np.abs(A).max()


@pytest.mark.parametrize(("across", "slope"), MESHES)
def test_mean_pressure_is_that_of_both_faces(comm, across, slope):
    secondary, primary, operator, none, _ = film(comm, across, slope)
    p_s = 3 + 2 * secondary.points[:, 0]
    p_m = 1 - 4 * primary.points[:, 0]
    of_secondary, of_primary = mean_pressure(operator, none)
    drop = p_s - operator.H @ p_m
    x = secondary.points[:, 0]
    expected = (3 + 2 * x + 1 - 4 * x) / 2
    np.testing.assert_allclose(of_secondary @ drop + of_primary @ p_m, expected, atol=1e-13)


def test_mean_pressure_is_the_prescribed_one_at_a_reservoir(comm):
    _, _, operator, _, _ = film(comm, (5, 7), 0.0)
    prescribed = np.arange(8) == 0
    of_secondary, of_primary = mean_pressure(operator, prescribed)
    unknowns = np.where(prescribed, 42.0, 0.0)
    values = of_secondary @ unknowns + of_primary @ np.full(6, 7.0)
    np.testing.assert_allclose(values, np.where(prescribed, 42.0, 7.0), atol=1e-13)


@pytest.mark.parametrize(("across", "slope"), MESHES)
def test_uniform_drop_leaks_through(comm, across, slope):
    secondary, primary, operator, none, A = film(comm, across, slope)
    n_s = len(secondary.nodes)
    p = condensed(operator, none, np.full(n_s, 5.0), np.full(len(primary.nodes), 2.0))
    length = np.hypot(1.0, slope)
    leak = FLOW.transverse_permeability / (FLOW.unit_weight * G) * 3.0 * length
    assert (A @ p)[:n_s].sum() == pytest.approx(leak, rel=1e-12)
    assert p @ A @ p == pytest.approx(3.0 * leak, rel=1e-12)


@pytest.mark.parametrize(("across", "slope"), MESHES)
def test_linear_pressure_dissipates_like_poiseuille(comm, across, slope):
    secondary, primary, operator, none, A = film(comm, across, slope)
    gradient = 7.0
    p = condensed(
        operator, none, gradient * secondary.points[:, 0], gradient * primary.points[:, 0]
    )
    # The gradient along the inclined gap; H reproduces linear fields, so nothing leaks.
    along = gradient / np.hypot(1.0, slope)
    loss = G**3 / (12 * FLOW.viscosity) * along**2 * np.hypot(1.0, slope)
    assert p @ A @ p == pytest.approx(loss, rel=1e-10)
