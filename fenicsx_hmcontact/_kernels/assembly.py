# SPDX-License-Identifier: LGPL-3.0-or-later
"""Assembly over node cells: an integrand at the smoothing points, given by its address.

Fields stand in the integrand's arrays by slots: a value, two gradient components, and for the
deviatoric enhancement the cell's mean divergence. A slot number of -1 means "not used". The number
of components of test and trial field come as tuples of zeros, so that the compiler knows them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from .point_call import call_kernel

REFERENCE_TRIANGLE = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0])
"""Coordinates given to the kernel; its weight there is 1/2, hence the factors 2 below."""


WIDTH = 4
"""Patches are padded to multiples of this, so that loops over nodes run in whole vectors."""


@njit(cache=True)
def _gradients_at(gx: Any, gy: Any, gradients: Any, radius: float, point: int, n: int) -> None:
    """Gradients of a patch's shape functions at a smoothing point (Eq. 37); zero beyond it."""
    axis = 1 + point // 2
    distance = 0.0 if n == 1 else radius * (2 * (point % 2) - 1)
    for k in range(gradients.shape[0]):
        gx[k] = gradients[k, 0, 0] + distance * gradients[k, axis, 0]
        gy[k] = gradients[k, 0, 1] + distance * gradients[k, axis, 1]
    gx[gradients.shape[0] :] = 0.0
    gy[gradients.shape[0] :] = 0.0


@njit(cache=True)
def _means(mean: Any, gradients: Any) -> None:
    """Mean gradients of a patch's shape functions, padded with zeros; shape (2, n)."""
    for k in range(gradients.shape[0]):
        mean[0, k] = gradients[k, 0, 0]
        mean[1, k] = gradients[k, 0, 1]
    mean[:, gradients.shape[0] :] = 0.0


@njit(cache=True)
def _pack(w: Any, slots: Any, fields: Any, nodes: Any, gx: Any, gy: Any, mean: Any) -> None:
    """Fill a point's coefficient array from nodal fields; ``nodes[0]`` is the cell's own node."""
    w[:] = 0.0
    for s in range(slots.shape[0]):
        value, gradient, divergence, axis = slots[s]
        if value >= 0:
            w[value] = fields[nodes[0], s]
        if gradient >= 0:
            sum_x = sum_y = sum_mean = 0.0
            for k in range(nodes.size):
                f = fields[nodes[k], s]
                sum_x += gx[k] * f
                sum_y += gy[k] * f
                sum_mean += mean[axis, k] * f
            w[gradient] = sum_x
            w[gradient + 1] = sum_y
            if divergence >= 0:
                w[divergence] += sum_mean


@njit(cache=True)
def _evaluate(address: int, tensor: Any, w: Any, constants: Any, coordinates: Any) -> None:
    tensor[:] = 0.0
    call_kernel(
        address, tensor.ctypes.data, w.ctypes.data, constants.ctypes.data, coordinates.ctypes.data
    )


@njit(cache=True)
def assemble_vector(
    address: int,
    constants: Any,
    coordinates: Any,
    cells: Any,
    offsets: Any,
    patch: Any,
    gradients: Any,
    areas: Any,
    n_points: int,
    fields: Any,
    field_slots: Any,
    n_coefficients: int,
    test: Any,
    test_slots: Any,
    n_test: int,
    test_dofs: Any,
    b: Any,
) -> None:
    """Add the integral of a linear form over node cells to ``b``.

    Args:
        address: Address of the integrand's kernel.
        constants: Values of its constants, packed.
        coordinates: `REFERENCE_TRIANGLE`.
        cells: Node cells to integrate over; int32.
        offsets: Where each patch begins in ``patch``.
        patch: Nodes of the patches, the cell's own node first.
        gradients: Mean and second gradients; shape (entries, 3, 2).
        areas: Cell areas [m^2].
        n_points: 4, or 1 for the mean gradient alone.
        fields: Nodal values of all coefficient components; shape (n_nodes, m).
        field_slots: Slots of value, gradient, mean divergence and its axis; shape (m, 4).
        n_coefficients: Length of the kernel's coefficient array.
        test: Tuple with one zero per component of the test field.
        test_slots: Slots of value, gradient, mean divergence of the test field.
        n_test: Length of the kernel's vector.
        test_dofs: Block dof of every node.
        b: Vector to add to; shape (n_dofs,).
    """
    components = len(test)
    value, gradient, divergence = test_slots
    largest = np.max(offsets[1:] - offsets[:-1])
    gx, gy, mean = np.zeros(largest), np.zeros(largest), np.zeros((2, largest))
    w = np.zeros(max(n_coefficients, 1))
    tensor = np.zeros(n_test)
    local = np.zeros((components, largest))
    for c in cells:
        begin, end = offsets[c], offsets[c + 1]
        n = end - begin
        nodes = patch[begin:end]
        weight = 2.0 * areas[c] / n_points
        radius = np.sqrt(areas[c] / np.pi)
        _means(mean, gradients[begin:end])
        local[:, :n] = 0.0
        for point in range(n_points):
            _gradients_at(gx, gy, gradients[begin:end], radius, point, n_points)
            _pack(w, field_slots, fields, nodes, gx, gy, mean)
            _evaluate(address, tensor, w, constants, coordinates)
            for a in range(components):
                if gradient >= 0:
                    along_x = weight * tensor[gradient + 2 * a]
                    along_y = weight * tensor[gradient + 2 * a + 1]
                    for k in range(n):
                        local[a, k] += along_x * gx[k] + along_y * gy[k]
                if divergence >= 0:
                    along_mean = weight * tensor[divergence]
                    for k in range(n):
                        local[a, k] += along_mean * mean[a, k]
                if value >= 0:
                    local[a, 0] += weight * tensor[value + a]
        for k in range(n if gradient >= 0 else 1):
            for a in range(components):
                b[test_dofs[nodes[k]] * components + a] += local[a, k]


@njit(cache=True)
def assemble_matrix(
    address: int,
    constants: Any,
    coordinates: Any,
    cells: Any,
    offsets: Any,
    patch: Any,
    gradients: Any,
    areas: Any,
    n_points: int,
    fields: Any,
    field_slots: Any,
    n_coefficients: int,
    test: Any,
    test_slots: Any,
    n_test: int,
    trial: Any,
    trial_slots: Any,
    n_trial: int,
    test_dofs: Any,
    position_offsets: Any,
    positions: Any,
    row_lengths: Any,
    values: Any,
) -> None:
    """Add the integral of a bilinear form over node cells to the values of a CSR matrix.

    Args:
        address: Address of the integrand's kernel.
        constants: Values of its constants, packed.
        coordinates: `REFERENCE_TRIANGLE`.
        cells: Node cells to integrate over; int32.
        offsets: Where each patch begins in ``patch``.
        patch: Nodes of the patches, the cell's own node first.
        gradients: Mean and second gradients; shape (entries, 3, 2).
        areas: Cell areas [m^2].
        n_points: 4, or 1 for the mean gradient alone.
        fields: Nodal values of all coefficient components; shape (n_nodes, m).
        field_slots: Slots of value, gradient, mean divergence and its axis; shape (m, 4).
        n_coefficients: Length of the kernel's coefficient array.
        test: Tuple with one zero per component of the test field.
        test_slots: Slots of value, gradient, mean divergence of the test field.
        n_test: Number of rows of the kernel's matrix.
        trial: Tuple with one zero per component of the trial field.
        trial_slots: Slots of value, gradient, mean divergence of the trial field.
        n_trial: Number of columns of the kernel's matrix.
        test_dofs: Block dof of every node in the test field.
        position_offsets: Where each cell of ``cells`` begins in ``positions``.
        positions: First entry of the block of each pair (test node, trial node) of the patch.
        row_lengths: Entries in a row of each block row.
        values: Values to add to.
    """
    rows, columns = len(test), len(trial)
    value_i, gradient_i, divergence_i = test_slots
    value_j, gradient_j, divergence_j = trial_slots
    largest = (np.max(offsets[1:] - offsets[:-1]) + WIDTH - 1) // WIDTH * WIDTH
    gx, gy, mean = np.zeros(largest), np.zeros(largest), np.zeros((2, largest))
    w = np.zeros(max(n_coefficients, 1))
    tensor = np.zeros((n_test, n_trial))
    image = np.zeros((n_test, columns, largest))
    local = np.zeros((largest, rows, columns, largest))
    if n_coefficients == 0:
        _evaluate(address, tensor, w, constants, coordinates)
    for index in range(cells.size):
        c = cells[index]
        begin, end = offsets[c], offsets[c + 1]
        nodes = patch[begin:end]
        n = (nodes.size + WIDTH - 1) // WIDTH * WIDTH
        n_i = nodes.size if gradient_i >= 0 else 1
        n_j = nodes.size if gradient_j >= 0 else 1
        weight = 2.0 * areas[c] / n_points
        radius = np.sqrt(areas[c] / np.pi)
        _means(mean, gradients[begin:end])
        local[:n_i, :, :, :n] = 0.0
        for point in range(n_points):
            _gradients_at(gx, gy, gradients[begin:end], radius, point, n_points)
            if n_coefficients > 0:
                _pack(w, field_slots, fields, nodes, gx, gy, mean)
                _evaluate(address, tensor, w, constants, coordinates)
            for r in range(n_test):
                for b in range(columns):
                    if gradient_j >= 0:
                        along_x = weight * tensor[r, gradient_j + 2 * b]
                        along_y = weight * tensor[r, gradient_j + 2 * b + 1]
                        for j in range(n):
                            image[r, b, j] = along_x * gx[j] + along_y * gy[j]
                    else:
                        image[r, b, :n] = 0.0
                    if divergence_j >= 0:
                        along_mean = weight * tensor[r, divergence_j]
                        for j in range(n):
                            image[r, b, j] += along_mean * mean[b, j]
                    if value_j >= 0:
                        image[r, b, 0] += weight * tensor[r, value_j + b]
            if gradient_i >= 0:
                for i in range(n_i):
                    for a in range(rows):
                        for b in range(columns):
                            x, y = gradient_i + 2 * a, gradient_i + 2 * a + 1
                            for j in range(n):
                                local[i, a, b, j] += gx[i] * image[x, b, j] + gy[i] * image[y, b, j]
                if divergence_i >= 0:
                    for i in range(n_i):
                        for a in range(rows):
                            for b in range(columns):
                                for j in range(n):
                                    local[i, a, b, j] += mean[a, i] * image[divergence_i, b, j]
            if value_i >= 0:
                for a in range(rows):
                    for b in range(columns):
                        for j in range(n):
                            local[0, a, b, j] += image[value_i + a, b, j]
        first = position_offsets[index]
        for i in range(n_i):
            length = row_lengths[test_dofs[nodes[i]]]
            for j in range(n_j):
                start = positions[first + i * n_j + j]
                for a in range(rows):
                    for b in range(columns):
                        values[start + a * length + b] += local[i, a, b, j]
