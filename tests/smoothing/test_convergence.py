# SPDX-License-Identifier: LGPL-3.0-or-later
"""Solutions approach exact ones with the order that linear fields allow."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import exterior_facet_indices, locate_entities_boundary, meshtags

import fenicsx_hmcontact as hm
from tests.smoothing.helpers import ENHANCEMENTS, make_mesh, square

pytestmark = pytest.mark.mpi


def l2_norm(expression, mesh):
    square_sum = ufl.inner(expression, expression) * ufl.dx(mesh, degree=4)
    return np.sqrt(mesh.comm.allreduce(fem.assemble_scalar(fem.form(square_sum))))


def order(errors):
    """Mean order over all halvings of the element size."""
    return np.log2(errors[0] / errors[-1]) / (len(errors) - 1)


def poisson_error(n, enhancement):
    mesh = make_mesh(*square("unstructured", n))
    Q = fem.functionspace(mesh, ("P", 1))
    p, q = fem.Function(Q), ufl.TestFunction(Q)
    x, y = ufl.SpatialCoordinate(mesh)
    exact = ufl.sin(2.0 * x + 0.3) * ufl.cos(3.0 * y) + x * y
    source = 13.0 * ufl.sin(2.0 * x + 0.3) * ufl.cos(3.0 * y)
    on_boundary = fem.Function(Q)
    on_boundary.interpolate(lambda x: np.sin(2.0 * x[0] + 0.3) * np.cos(3.0 * x[1]) + x[0] * x[1])
    mesh.topology.create_connectivity(1, 2)
    dofs = fem.locate_dofs_topological(Q, 1, exterior_facet_indices(mesh.topology))
    measure = hm.node_cells_measure(enhancement)
    form = ufl.dot(ufl.grad(p), ufl.grad(q)) * measure - source * q * ufl.dx(degree=3)
    hm.ContactProblem(form, p, bcs=[fem.dirichletbc(on_boundary, dofs)]).solve()
    return l2_norm(p - exact, mesh)


@pytest.mark.parametrize("enhancement", ENHANCEMENTS)
def test_poisson(enhancement):
    errors = [poisson_error(n, enhancement) for n in (8, 16, 32)]
    assert order(errors) > 1.85
    assert errors[-1] < 2e-3


INNER, OUTER, PRESSURE = 1.0, 2.0, 3.0
HOLLOW = hm.LinearElastic(E=100.0, nu=0.3)


def lame_displacement(r):
    """Radial displacement of a thick cylinder under inner pressure, plane strain (Lame, 1852)."""
    factor = (1.0 + HOLLOW.nu) / HOLLOW.E * PRESSURE * INNER**2 / (OUTER**2 - INNER**2)
    return factor * ((1.0 - 2.0 * HOLLOW.nu) * r + OUTER**2 / r)


def cylinder_error(n, smoothing):
    points, triangles = square("unstructured", n)
    mesh = make_mesh(points + np.array([INNER, 0.0]), triangles)
    V = fem.functionspace(mesh, ("P", 1, (2,)))
    u, v = fem.Function(V), ufl.TestFunction(V)
    r = ufl.SpatialCoordinate(mesh)[0]

    def strain(w):
        e = ufl.sym(ufl.grad(w))
        return ufl.as_tensor([[e[0, 0], e[0, 1], 0], [e[1, 0], e[1, 1], 0], [0, 0, w[0] / r]])

    stress = 2.0 * HOLLOW.shear_modulus * strain(u)
    stress += HOLLOW.lame * ufl.tr(strain(u)) * ufl.Identity(3)
    inside = np.sort(locate_entities_boundary(mesh, 1, lambda x: np.isclose(x[0], INNER)))
    tags = meshtags(mesh, 1, inside, np.ones(inside.size, np.int32))
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=tags)
    form = ufl.inner(stress, strain(v)) * r * hm.node_cells_measure(smoothing)
    form -= PRESSURE * v[0] * r * ds(1)
    ends = fem.locate_dofs_geometrical(
        (V.sub(1), V.sub(1).collapse()[0]), lambda x: np.isclose(abs(x[1] - 0.5), 0.5)
    )
    none = fem.Function(V.sub(1).collapse()[0])
    bc = fem.dirichletbc(none, ends, V.sub(1))
    hm.ContactProblem(form, u, bcs=[bc]).solve()
    exact = ufl.as_vector([lame_displacement(r), 0.0])
    return l2_norm(u - exact, mesh) / l2_norm(exact, mesh)


@pytest.mark.parametrize("enhancement", ENHANCEMENTS)
def test_thick_cylinder(enhancement):
    errors = [cylinder_error(n, enhancement) for n in (6, 12, 24)]
    assert order(errors) > 1.85
    assert errors[-1] < 2e-3


def test_axisymmetric_body_may_touch_the_axis():
    """A full cylinder in uniform strain: values at the node integrate the hoop stress exactly."""
    mesh = make_mesh(*square("unstructured", 4))
    V = fem.functionspace(mesh, ("P", 1, (2,)))
    u, v = fem.Function(V), ufl.TestFunction(V)
    r = ufl.SpatialCoordinate(mesh)[0]

    def strain(w):
        # At the axis the weight r makes any finite hoop strain vanish from the term, but not 0/0.
        hoop = w[0] / ufl.conditional(ufl.lt(r, 1e-12), 1.0, r)
        e = ufl.sym(ufl.grad(w))
        return ufl.as_tensor([[e[0, 0], e[0, 1], 0], [e[1, 0], e[1, 1], 0], [0, 0, hoop]])

    stress = 2.0 * HOLLOW.shear_modulus * strain(u)
    stress += HOLLOW.lame * ufl.tr(strain(u)) * ufl.Identity(3)
    exact = fem.Function(V)
    exact.interpolate(lambda x: np.vstack((-0.01 * x[0], 0.004 * x[1])))
    mesh.topology.create_connectivity(1, 2)
    dofs = fem.locate_dofs_topological(V, 1, exterior_facet_indices(mesh.topology))
    form = ufl.inner(stress, strain(v)) * r * hm.dc
    hm.ContactProblem(form, u, bcs=[fem.dirichletbc(exact, dofs)]).solve()
    assert np.allclose(u.x.array, exact.x.array, rtol=0, atol=1e-15)
