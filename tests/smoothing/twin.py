# SPDX-License-Identifier: LGPL-3.0-or-later
"""NumPy twin of node smoothing, written from Eqs. 31-38 node by node; numbering of the input."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

POINTS = {"full": 4, "deviatoric": 4, "none": 1}


def triangle_gradients(points, cells):
    """Area of each triangle (nt,), and its P1 gradient along x and y; operators (nt, nn)."""
    n_cells, n_nodes = len(cells), len(points)
    areas = np.empty(n_cells)
    along = [sp.lil_matrix((n_cells, n_nodes)) for _ in range(2)]
    for e, corners in enumerate(cells):
        # Rows of the inverse of [1, x, y] are the coefficients of the shape functions.
        vandermonde = np.column_stack((np.ones(3), points[corners]))
        areas[e] = 0.5 * abs(np.linalg.det(vandermonde))
        coefficients = np.linalg.inv(vandermonde)
        for axis in range(2):
            along[axis][e, corners] = coefficients[1 + axis]
    return areas, [g.tocsr() for g in along]


@dataclass
class Twin:
    """Smoothing as sparse operators.

    Attributes:
        areas: Areas of the cells; shape (nn,).
        weights: alpha_I of each cell; shape (nn, nt).
        second: Derivatives of the smoothing coefficients along x and y; each (nn, nt).
        mean: Cell means of the gradient along x and y; each (nn, nn).
        at_points: Gradient along x and y at the four points of each cell; each (4 nn, nn).
    """

    areas: np.ndarray
    weights: sp.csr_matrix
    second: list
    mean: list
    at_points: list

    def gradient(self, enhancement):
        """Operators along x and y at the points of a scalar field, or a vector's full gradient."""
        return self.mean if enhancement == "none" else self.at_points

    def point_weights(self, enhancement):
        n = POINTS[enhancement]
        return np.repeat(self.areas / n, n)

    def displacement_gradient(self, enhancement):
        """Operators of du_x/dx, du_x/dy, du_y/dx, du_y/dy on (u_x0, u_y0, u_x1, ...)."""
        gx, gy = self.gradient(enhancement)
        e_x, e_y = sp.csr_matrix([[1.0, 0.0]]), sp.csr_matrix([[0.0, 1.0]])
        xx, xy, yx, yy = (sp.kron(g, e).tocsr() for e in (e_x, e_y) for g in (gx, gy))
        if enhancement == "deviatoric":
            mean = sp.kron(self.mean[0], e_x) + sp.kron(self.mean[1], e_y)
            excess = 0.5 * (sp.kron(mean, np.ones((4, 1))) - xx - yy)
            xx, yy = xx + excess, yy + excess
        return xx, xy, yx, yy

    def elasticity(self, enhancement, shear_modulus, lame):
        """Stiffness of plane strain, dense; the moduli are numbers or one per cell."""
        n = POINTS[enhancement]
        w = self.point_weights(enhancement)
        g, la = (np.repeat(np.broadcast_to(m, self.areas.shape), n) for m in (shear_modulus, lame))
        xx, xy, yx, yy = self.displacement_gradient(enhancement)
        shear, volume = xy + yx, xx + yy
        k = xx.T @ sp.diags(2 * g * w) @ xx + yy.T @ sp.diags(2 * g * w) @ yy
        k += shear.T @ sp.diags(g * w) @ shear + volume.T @ sp.diags(la * w) @ volume
        return k.toarray()

    def poisson(self, enhancement, conductivity=1.0):
        """Stiffness of a scalar field, dense."""
        n = POINTS[enhancement]
        k = np.repeat(np.broadcast_to(conductivity, self.areas.shape), n)
        w = sp.diags(k * self.point_weights(enhancement))
        return sum(g.T @ w @ g for g in self.gradient(enhancement)).toarray()


def make_twin(points, cells):
    """Build the operators of a mesh."""
    n_nodes, n_cells = len(points), len(cells)
    element_areas, along = triangle_gradients(points, cells)
    areas = np.zeros(n_nodes)
    weights = np.zeros((n_nodes, n_cells))
    second = np.zeros((2, n_nodes, n_cells))
    at_points = np.zeros((4 * n_nodes, n_cells))
    for c in range(n_nodes):
        around = np.flatnonzero(np.any(cells == c, axis=1))
        areas[c] = element_areas[around].sum() / 3.0
        alpha = element_areas[around] / (3.0 * areas[c])
        radius = np.sqrt(areas[c] / np.pi)
        b, h = (points[cells[around]].mean(axis=1) - points[c]).T
        phi = 2.0 * np.array([b, h]) / (b**2 + h**2)
        d_alpha = alpha * (phi - (phi @ alpha)[:, None])
        weights[c, around] = alpha
        second[:, c, around] = d_alpha
        steps = (-radius * d_alpha[0], radius * d_alpha[0], -radius * d_alpha[1])
        for point, step in enumerate((*steps, radius * d_alpha[1])):
            at_points[4 * c + point, around] = alpha + step
    weights_, at_points_ = sp.csr_matrix(weights), sp.csr_matrix(at_points)
    return Twin(
        areas,
        weights_,
        [sp.csr_matrix(s) for s in second],
        [(weights_ @ g).tocsr() for g in along],
        [(at_points_ @ g).tocsr() for g in along],
    )
