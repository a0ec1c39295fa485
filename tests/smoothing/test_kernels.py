# SPDX-License-Identifier: LGPL-3.0-or-later
"""Assembly kernels as plain Python, and calls of FFCx kernels by address."""

from mpi4py import MPI

import basix.ufl
import numpy as np
import pytest
import ufl
from dolfinx import fem
from numba import njit

import fenicsx_hmcontact as hm
from fenicsx_hmcontact import _compat
from fenicsx_hmcontact._kernels import assembly as kernels
from fenicsx_hmcontact._kernels.point_call import call_kernel
from fenicsx_hmcontact.smoothing import assembly
from tests.smoothing.helpers import hooke, make_mesh, set_values, smoothed_terms, square

POINTS, TRIANGLES = square("unstructured", 3)
DOMAIN = ufl.Mesh(basix.ufl.element("P", "triangle", 1, shape=(2,)))


@njit
def evaluate(address, tensor, w, constants, coordinates):
    call_kernel(
        address, tensor.ctypes.data, w.ctypes.data, constants.ctypes.data, coordinates.ctypes.data
    )


def test_kernel_called_by_address_reads_all_its_arguments():
    """Mass matrix of any triangle, times a coefficient and a constant."""
    space = ufl.FunctionSpace(DOMAIN, basix.ufl.element("P", "triangle", 1))
    constant_space = ufl.FunctionSpace(DOMAIN, basix.ufl.element("DG", "triangle", 0, shape=(2,)))
    p, q = ufl.TrialFunction(space), ufl.TestFunction(space)
    f, c = ufl.Coefficient(constant_space), ufl.Constant(DOMAIN, (2,))
    (compiled,) = _compat.compile_forms(MPI.COMM_SELF, [ufl.dot(c, f) * p * q * ufl.dx])
    (address,) = _compat.kernel_addresses(compiled)
    corners = np.array([[0.2, 0.1, 0.0], [1.5, 0.3, 0.0], [0.4, 2.0, 0.0]])
    edges = corners[1:, :2] - corners[0, :2]
    area = 0.5 * abs(np.linalg.det(edges))
    matrix = np.ones((3, 3))
    w, constants = np.array([2.0, -1.0]), np.array([3.0, 4.0])
    evaluate(address, matrix, w, constants, corners)
    mass = area / 12.0 * (np.ones((3, 3)) + np.eye(3))
    # The kernel adds to what is there.
    assert np.allclose(matrix, 1.0 + 2.0 * mass, rtol=1e-14)


def test_tensor_is_cleared_before_the_kernel_adds_to_it():
    space = ufl.FunctionSpace(DOMAIN, basix.ufl.element("DG", "triangle", 0, shape=(2,)))
    v = ufl.TestFunction(space)
    (compiled,) = _compat.compile_forms(MPI.COMM_SELF, [(3.0 * v[0] - v[1]) * ufl.dx])
    (address,) = _compat.kernel_addresses(compiled)
    tensor = np.full(2, 7.0)
    none = np.zeros(1)
    arrays = (tensor, none, none, kernels.REFERENCE_TRIANGLE)
    kernels._evaluate(address, tensor, tuple(a.ctypes.data for a in arrays))
    # The reference triangle has the area 1/2.
    assert np.allclose(tensor, [1.5, -0.5], rtol=1e-15)


@pytest.mark.parametrize("enhancement", ["deviatoric", "full", "none"])
def test_assembly_agrees_with_its_python_source(monkeypatch, enhancement):
    """Where numba read past an array, the interpreter would raise."""
    mesh = make_mesh(POINTS, TRIANGLES, MPI.COMM_SELF)
    V, Q = fem.functionspace(mesh, ("P", 1, (2,))), fem.functionspace(mesh, ("P", 1))
    u, p = fem.Function(V), fem.Function(Q)
    rng = np.random.default_rng(0)
    set_values(u, rng.normal(size=2 * len(POINTS)))
    set_values(p, rng.normal(size=len(POINTS)))
    v, du = ufl.TestFunction(V), ufl.TrialFunction(V)
    x = ufl.SpatialCoordinate(mesh)
    work = (1.0 + p**2) * ufl.inner(hooke(u, 1.0 + x[0], 2.0), ufl.grad(v)) + ufl.dot(u, v)
    form = work * hm.node_cells_measure(enhancement)
    vector_term, matrix_term = (
        smoothed_terms(f)[0][0] for f in (form, ufl.derivative(form, u, du))
    )
    n = 2 * len(POINTS)
    rows, columns = matrix_term.pairs()
    lengths = np.full(len(POINTS), n, np.int32)
    matrix_term.set_positions((rows * 2 * n + columns * 2).astype(np.int32), lengths)
    results = []
    for source in (False, True):
        if source:
            for name in ("_gradients_at", "_means", "_pack"):
                monkeypatch.setattr(kernels, name, getattr(kernels, name).py_func)
            for name in ("assemble_vector", "assemble_matrix"):
                monkeypatch.setattr(assembly.kernels, name, getattr(kernels, name).py_func)
        b, values = np.zeros(n), np.zeros(n * n)
        vector_term.add_to_vector(b)
        matrix_term.add_to_matrix(values)
        results.append((b, values))
    for compiled, expected in zip(*results, strict=True):
        assert abs(expected).max() > 0.1
        assert np.allclose(compiled, expected, rtol=0, atol=1e-14 * abs(expected).max())


def test_terms_add_to_what_is_there():
    mesh = make_mesh(POINTS, TRIANGLES, MPI.COMM_SELF)
    q = ufl.TestFunction(fem.functionspace(mesh, ("P", 1)))
    (term,), _ = smoothed_terms(q * hm.dc)
    b = np.full(len(POINTS), 4.0)
    term.add_to_vector(b)
    assert b.sum() == pytest.approx(4.0 * len(POINTS) + 1.0, rel=1e-14)
