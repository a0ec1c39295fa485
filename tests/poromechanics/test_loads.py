# SPDX-License-Identifier: LGPL-3.0-or-later
"""Pressures that follow a surface and tractions that do not, on a mesh that moves."""

import numpy as np
import pytest
import ufl
from dolfinx import fem

from fenicsx_hmcontact import _compat
from fenicsx_hmcontact.poromechanics.finite_strain import dead_load, pressure_load
from tests.smoothing.helpers import make_mesh, set_values, square

pytestmark = pytest.mark.mpi

POINTS, TRIANGLES = square("unstructured", 4)
REST = np.zeros_like(POINTS)


class Loaded:
    """A square under loads, its mesh at a displacement u_n, its end at u."""

    def __init__(self, load, u_n, u):
        """Take a load as a function of u, u_n, v and ds."""
        self.mesh = make_mesh(POINTS, TRIANGLES)
        V = fem.functionspace(self.mesh, ("P", 1, (2,)))
        self.u, self.u_n, self.w = fem.Function(V), fem.Function(V), fem.Function(V)
        set_values(self.u, u.ravel())
        set_values(self.u_n, u_n.ravel())
        nodes, dofs = _compat.cell_nodes(self.mesh).ravel(), V.dofmap.list.ravel()
        x = self.mesh.geometry.x
        moved = x.copy()
        moved[nodes, :2] = x[nodes, :2] + self.u_n.x.array.reshape(-1, 2)[dofs]
        x[:] = moved
        form = load(self.u, self.u_n, ufl.TestFunction(V), ufl.ds(domain=self.mesh))
        self.work = ufl.action(form, self.w)
        self._compiled = fem.form(self.work)

    def work_by(self, values):
        """Work of the term by displacements of the nodes, on all ranks."""
        set_values(self.w, values.ravel())
        return self.mesh.comm.allreduce(fem.assemble_scalar(self._compiled))

    def force(self):
        """Sum of the nodal forces of the term."""
        return np.array([self.work_by(REST + direction) for direction in np.eye(2)])


def area(points):
    """Area of the triangles."""
    edges = points[TRIANGLES[:, 1:]] - points[TRIANGLES[:, :1]]
    return 0.5 * np.abs(np.linalg.det(edges)).sum()


def random(seed, size=0.02):
    return np.random.default_rng(seed).normal(scale=size, size=POINTS.shape)


def pressing(u, u_n, v, ds, p=3.0):
    return pressure_load(p, u, u_n, v, ds)


def test_pressure_all_around_does_the_work_of_volume():
    """The residual term is p dV by the displacement, at any configuration and on any mesh."""
    u_n, u, w = random(1), random(2), random(3)
    body = Loaded(pressing, u_n, u)
    h = 1e-5
    volume = (area(POINTS + u + h * w) - area(POINTS + u - h * w)) / (2.0 * h)
    assert body.work_by(w) == pytest.approx(3.0 * volume, rel=1e-9)
    assert np.allclose(body.force(), 0.0, atol=1e-15)
    # It depends on where the surface is, not on where the mesh stands.
    assert Loaded(pressing, REST, u).work_by(w) == pytest.approx(body.work_by(w), rel=1e-12)


def test_pressure_turns_with_the_body():
    c, s = np.cos(0.7), np.sin(0.7)
    turn = np.array([[c, -s], [s, c]])

    def on_top(u, u_n, v, ds):
        y = ufl.SpatialCoordinate(u.function_space.mesh)[1]
        return pressure_load(ufl.conditional(ufl.gt(y, 0.999), 3.0, 0.0), u, u_n, v, ds)

    body = Loaded(on_top, REST, POINTS @ (1.2 * turn).T - POINTS)
    # On the residual's side the pressure acts along the outward normal, here of 1.2 times the top.
    assert np.allclose(body.force(), turn @ [0.0, 3.6], atol=1e-14)


def test_tangent_of_the_pressure():
    u_n, u, w, direction = (random(seed) for seed in (1, 2, 3, 4))
    body = Loaded(pressing, u_n, u)
    du = fem.Function(body.u.function_space)
    set_values(du, direction.ravel())
    set_values(body.w, w.ravel())
    form = fem.form(ufl.derivative(body.work, body.u, du))
    tangent = body.mesh.comm.allreduce(fem.assemble_scalar(form))
    works = []
    for h in (1e-6, -1e-6):
        set_values(body.u, (u + h * direction).ravel())
        works.append(body.work_by(w))
    assert tangent == pytest.approx((works[0] - works[1]) / 2e-6, rel=1e-7)


def test_dead_loads_stay():
    """The nodal forces of a traction are the same wherever the mesh stands."""

    def dead(u, u_n, v, ds):
        return dead_load(ufl.as_vector((0.3, -2.0)), u_n, v, ds)

    bodies = [Loaded(dead, u_n, REST) for u_n in (REST, random(6), random(7, 0.05))]
    works = [body.work_by(random(5)) for body in bodies]
    assert np.allclose(works[1:], works[0], rtol=1e-13, atol=0)
    assert np.allclose(bodies[1].force(), [1.2, -8.0], rtol=1e-13, atol=0)
