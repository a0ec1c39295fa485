# SPDX-License-Identifier: LGPL-3.0-or-later
"""Hooke's law in plane strain."""

from dataclasses import FrozenInstanceError

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import create_unit_square

import fenicsx_hmcontact as hm

pytestmark = pytest.mark.mpi

STEEL = hm.LinearElastic(E=210e9, nu=0.3)


def test_moduli_are_those_of_the_textbook():
    for nu in (-0.4, 0.0, 0.3, 0.4999):
        material = hm.LinearElastic(E=3.0e6, nu=nu)
        g, lame, m = material.shear_modulus, material.lame, material.oedometric_modulus
        # Back to E and nu, by relations the class does not use.
        assert g * (3.0 * lame + 2.0 * g) / (lame + g) == pytest.approx(3.0e6, rel=1e-12)
        assert 0.5 * lame / (lame + g) == pytest.approx(nu, rel=1e-12, abs=1e-15)
        assert m == pytest.approx(3.0e6 * (1.0 - nu) / ((1.0 + nu) * (1.0 - 2.0 * nu)), rel=1e-12)


def stress_of(material, slope, comm):
    """Mean stress of a uniform displacement gradient on the unit square."""
    mesh = create_unit_square(comm, 2, 2)
    u = fem.Function(fem.functionspace(mesh, ("P", 1, (2,))))
    u.interpolate(lambda x: np.asarray(slope) @ x[:2])
    stress = material.stress(u)
    assert stress.ufl_shape == (2, 2)
    parts = [fem.form(stress[i, j] * ufl.dx) for i in (0, 1) for j in (0, 1)]
    return np.reshape([comm.allreduce(fem.assemble_scalar(p)) for p in parts], (2, 2))


def test_stress_is_inverse_of_the_compliance(comm):
    """Strains from the plane-strain compliance, tension positive, sigma_zz = nu (s_xx + s_yy)."""
    wanted = np.array([[2.0e6, -0.7e6], [-0.7e6, -3.0e6]])
    e, nu = STEEL.E, STEEL.nu
    strain = (1.0 + nu) / e * (wanted - nu * np.trace(wanted) * np.eye(2))
    assert np.allclose(stress_of(STEEL, strain, comm), wanted, rtol=1e-12)


def test_rigid_rotation_is_free_of_stress(comm):
    spin = 1e-3 * np.array([[0.0, -1.0], [1.0, 0.0]])
    assert abs(stress_of(STEEL, spin, comm)).max() < 1e-12 * 1e-3 * STEEL.E


def test_stress_is_that_of_the_energy(comm):
    """Work conjugacy: the stress is the derivative of G e:e + lambda/2 tr(e)^2."""
    mesh = create_unit_square(comm, 2, 2)
    V = fem.functionspace(mesh, ("P", 1, (2,)))
    u, v = fem.Function(V), ufl.TestFunction(V)
    u.interpolate(lambda x: np.vstack((np.sin(3 * x[0]) * x[1], x[0] ** 2)))
    e = ufl.sym(ufl.grad(u))
    g, lame = STEEL.shear_modulus, STEEL.lame
    energy = (g * ufl.inner(e, e) + 0.5 * lame * ufl.tr(e) ** 2) * ufl.dx
    by_energy = fem.assemble_vector(fem.form(ufl.derivative(energy, u, v))).array
    by_stress = fem.assemble_vector(
        fem.form(ufl.inner(STEEL.stress(u), ufl.grad(v)) * ufl.dx)
    ).array
    assert np.allclose(by_stress, by_energy, rtol=0, atol=1e-13 * STEEL.E)


def test_update_adds_the_stress_of_the_strain_increment():
    """As a material: moduli by strain, nothing forgotten, sigma_zz carried."""
    rng = np.random.default_rng(0)
    stress, strain = 1e6 * rng.normal(size=(50, 4)), 1e-3 * rng.normal(size=(50, 3))
    assert isinstance(STEEL, hm.Material) and STEEL.history_names == ()
    update = STEEL.update(stress, strain, STEEL.initial_history(50))
    e, nu = STEEL.E, STEEL.nu
    # Strains back from the stresses by the compliance: e_zz vanishes.
    change = update.stress - stress
    trace = change[:, :3].sum(axis=1)
    back = (1.0 + nu) / e * change - nu / e * trace[:, None] * [1.0, 1.0, 1.0, 0.0]
    wanted = strain @ np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0.5]])
    assert np.abs(back - wanted).max() < 1e-14
    assert np.allclose(np.einsum("nij,nj->ni", update.by_strain, strain), change, rtol=1e-9)
    assert (update.by_stress == np.eye(4)).all() and update.history.shape == (50, 0)
    assert update.flagged is None


def test_values_out_of_range_are_refused():
    for e in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match=f"E is {e}; Young's modulus must be positive"):
            hm.LinearElastic(E=e, nu=0.3)
    for nu in (0.5, 0.7, -1.0, float("nan")):
        with pytest.raises(ValueError, match=f"nu is {nu}; Poisson's ratio must lie between"):
            hm.LinearElastic(E=1.0, nu=nu)


def test_values_cannot_be_changed_unchecked():
    with pytest.raises(FrozenInstanceError):
        STEEL.nu = 0.7
