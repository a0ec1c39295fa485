# SPDX-License-Identifier: LGPL-3.0-or-later
"""Assembly over node cells: an integrand at the smoothing points, given by its address.

Fields stand in the integrand's arrays by slots: a value, two gradient components, and for the
deviatoric enhancement the cell's mean divergence. A slot number of -1 means "not used". After the
nodal fields come what is constant on a cell and what has values at points. Along test and trial
field follow variations of cell averages, whose patch vectors are given. The number of components
of test and trial field come as tuples of zeros, so that the compiler knows them.
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


# Helpers take whole arrays and a range: a slice costs more than what is done with it.


@njit(cache=True)
def _gradients_at(
    gx: Any, gy: Any, gradients: Any, begin: int, end: int, radius: float, point: int, n: int
) -> None:
    """Gradients of a patch's shape functions at a smoothing point (Eq. 37); zero beyond it."""
    axis = 1 + point // 2
    distance = 0.0 if n == 1 else radius * (2 * (point % 2) - 1)
    for k in range(begin, end):
        gx[k - begin] = gradients[k, 0, 0] + distance * gradients[k, axis, 0]
        gy[k - begin] = gradients[k, 0, 1] + distance * gradients[k, axis, 1]
    for k in range(end - begin, gx.size):
        gx[k] = gy[k] = 0.0


@njit(cache=True)
def _means(mean: Any, gradients: Any, averages: Any, begin: int, end: int) -> None:
    """Patch vectors of the mean divergence and of cell averages, padded; shape (1 + m, 2, n).

    Args:
        mean: The result.
        gradients: Gradients; shape (entries, 3, 2).
        averages: Patch vectors of variations of cell averages; shape (entries, m, components).
        begin: First entry of the patch.
        end: First entry beyond it.
    """
    for k in range(begin, end):
        mean[0, 0, k - begin] = gradients[k, 0, 0]
        mean[0, 1, k - begin] = gradients[k, 0, 1]
        for m in range(averages.shape[1]):
            for a in range(averages.shape[2]):
                mean[1 + m, a, k - begin] = averages[k, m, a]
    for m in range(mean.shape[0]):
        for k in range(end - begin, mean.shape[2]):
            mean[m, 0, k] = mean[m, 1, k] = 0.0


@njit(cache=True)
def _pack(
    w: Any,
    slots: Any,
    fields: Any,
    patch: Any,
    begin: int,
    end: int,
    gx: Any,
    gy: Any,
    mean: Any,
    cell_values: Any,
    point_values: Any,
    cell: int,
    point: int,
) -> None:
    """Fill a point's coefficient array; ``patch[begin]`` is the cell's own node."""
    n_cell, n_point = cell_values.shape[1], point_values.shape[2]
    first = w.size - n_cell - n_point
    w[:first] = 0.0
    for s in range(slots.shape[0]):
        value, gradient, divergence, axis = slots[s, 0], slots[s, 1], slots[s, 2], slots[s, 3]
        if value >= 0:
            w[value] = fields[patch[begin], s]
        if gradient >= 0:
            sum_x = sum_y = sum_mean = 0.0
            for k in range(end - begin):
                f = fields[patch[begin + k], s]
                sum_x += gx[k] * f
                sum_y += gy[k] * f
                sum_mean += mean[0, axis, k] * f
            w[gradient] = sum_x
            w[gradient + 1] = sum_y
            if divergence >= 0:
                w[divergence] += sum_mean
    for s in range(n_cell):
        w[first + s] = cell_values[cell, s]
    for s in range(n_point):
        w[first + n_cell + s] = point_values[cell, point, s]


@njit(cache=True)
def _evaluate(address: int, tensor: Any, pointers: Any) -> None:
    """Evaluate an integrand.

    Args:
        address: Address of its kernel.
        tensor: What the first of ``pointers`` points to.
        pointers: Addresses of result, coefficients, constants and coordinates, taken once.
    """
    tensor[:] = 0.0
    call_kernel(address, *pointers)


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
    cell_values: Any,
    point_values: Any,
    n_coefficients: int,
    test: Any,
    test_slots: Any,
    test_averages: Any,
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
        cell_values: What is constant on a cell; shape (n_cells, m).
        point_values: What has values at points; shape (n_cells, n_points, m).
        n_coefficients: Length of the kernel's coefficient array.
        test: Tuple with one zero per component of the test field.
        test_slots: Slots of value, gradient, mean divergence, first cell average and first pair of
            the test field.
        test_averages: Patch vectors of its variations of cell averages; shape
            (entries, m, components).
        n_test: Length of the kernel's vector.
        test_dofs: Block dof of every node.
        b: Vector to add to; shape (n_dofs,).
    """
    components = len(test)
    value, gradient, divergence, average, _ = test_slots
    n_averages = test_averages.shape[1]
    largest = np.max(offsets[1:] - offsets[:-1])
    gx, gy, mean = np.zeros(largest), np.zeros(largest), np.zeros((1 + n_averages, 2, largest))
    w = np.zeros(n_coefficients)
    tensor = np.zeros(n_test)
    pointers = tensor.ctypes.data, w.ctypes.data, constants.ctypes.data, coordinates.ctypes.data
    along_mean = np.zeros(1 + n_averages)
    local = np.zeros((components, largest))
    for c in cells:
        begin, end = offsets[c], offsets[c + 1]
        n = end - begin
        nodes = patch[begin:end]
        weight = 2.0 * areas[c] / n_points
        radius = np.sqrt(areas[c] / np.pi)
        _means(mean, gradients, test_averages, begin, end)
        local[:, :n] = 0.0
        along_mean[:] = 0.0
        for point in range(n_points):
            _gradients_at(gx, gy, gradients, begin, end, radius, point, n_points)
            _pack(
                w,
                field_slots,
                fields,
                patch,
                begin,
                end,
                gx,
                gy,
                mean,
                cell_values,
                point_values,
                c,
                point,
            )
            _evaluate(address, tensor, pointers)
            for a in range(components):
                if gradient >= 0:
                    along_x = weight * tensor[gradient + 2 * a]
                    along_y = weight * tensor[gradient + 2 * a + 1]
                    for k in range(n):
                        local[a, k] += along_x * gx[k] + along_y * gy[k]
                if value >= 0:
                    local[a, 0] += weight * tensor[value + a]
            if divergence >= 0:
                along_mean[0] += weight * tensor[divergence]
            for m in range(n_averages):
                along_mean[1 + m] += weight * tensor[average + m]
        for m in range(0 if divergence >= 0 else 1, 1 + n_averages):
            for a in range(components):
                for k in range(n):
                    local[a, k] += along_mean[m] * mean[m, a, k]
        for k in range(n if gradient >= 0 or n_averages > 0 else 1):
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
    cell_values: Any,
    point_values: Any,
    n_coefficients: int,
    test: Any,
    test_slots: Any,
    test_averages: Any,
    n_test: int,
    trial: Any,
    trial_slots: Any,
    trial_averages: Any,
    n_trial: int,
    test_dofs: Any,
    position_offsets: Any,
    positions: Any,
    row_lengths: Any,
    pair_weights: Any,
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
        cell_values: What is constant on a cell; shape (n_cells, m).
        point_values: What has values at points; shape (n_cells, n_points, m).
        n_coefficients: Length of the kernel's coefficient array.
        test: Tuple with one zero per component of the test field.
        test_slots: Slots of value, gradient, mean divergence, first cell average and first pair of
            the test field.
        test_averages: Patch vectors of its variations of cell averages; shape
            (entries, m, components).
        n_test: Number of rows of the kernel's matrix.
        trial: Tuple with one zero per component of the trial field.
        trial_slots: Slots of value, gradient, mean divergence, first cell average and first pair of
            the trial field.
        trial_averages: Patch vectors of its variations of cell averages; shape
            (entries, m, components).
        n_trial: Number of columns of the kernel's matrix.
        test_dofs: Block dof of every node in the test field.
        position_offsets: Where each cell of ``cells`` begins in ``positions``.
        positions: First entry of the block of each pair (test node, trial node) of the patch.
        row_lengths: Entries in a row of each block row.
        pair_weights: Set to the weights of second variations of cell averages; zero before, shape
            (n_cells, m).
        values: Values to add to.
    """
    rows, columns = len(test), len(trial)
    value_i, gradient_i, divergence_i, average_i, pair_i = test_slots
    value_j, gradient_j, divergence_j, average_j, pair_j = trial_slots
    m_i, m_j, n_pairs = test_averages.shape[1], trial_averages.shape[1], pair_weights.shape[1]
    wide_i = gradient_i >= 0 or m_i + n_pairs > 0
    wide_j = gradient_j >= 0 or m_j + n_pairs > 0
    largest = (np.max(offsets[1:] - offsets[:-1]) + WIDTH - 1) // WIDTH * WIDTH
    gx, gy = np.zeros(largest), np.zeros(largest)
    mean_i, mean_j = np.zeros((1 + m_i, 2, largest)), np.zeros((1 + m_j, 2, largest))
    w = np.zeros(n_coefficients)
    tensor = np.zeros((n_test, n_trial))
    pointers = tensor.ctypes.data, w.ctypes.data, constants.ctypes.data, coordinates.ctypes.data
    image = np.zeros((n_test, columns, largest))
    mean_image = np.zeros((1 + m_i, columns, largest))
    local = np.zeros((largest, rows, columns, largest))
    if n_coefficients == 0:
        _evaluate(address, tensor, pointers)
    for index in range(cells.size):
        c = cells[index]
        begin, end = offsets[c], offsets[c + 1]
        nodes = patch[begin:end]
        n = (nodes.size + WIDTH - 1) // WIDTH * WIDTH
        n_i = nodes.size if wide_i else 1
        n_j = nodes.size if wide_j else 1
        weight = 2.0 * areas[c] / n_points
        radius = np.sqrt(areas[c] / np.pi)
        _means(mean_i, gradients, test_averages, begin, end)
        _means(mean_j, gradients, trial_averages, begin, end)
        local[:n_i, :, :, :n] = 0.0
        mean_image[:, :, :n] = 0.0
        for point in range(n_points):
            _gradients_at(gx, gy, gradients, begin, end, radius, point, n_points)
            if n_coefficients > 0:
                _pack(
                    w,
                    field_slots,
                    fields,
                    patch,
                    begin,
                    end,
                    gx,
                    gy,
                    mean_j,
                    cell_values,
                    point_values,
                    c,
                    point,
                )
                _evaluate(address, tensor, pointers)
            for m in range(n_pairs):
                pair_weights[c, m] += weight * tensor[pair_i + m, pair_j + m]
            for r in range(n_test - n_pairs):
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
                            image[r, b, j] += along_mean * mean_j[0, b, j]
                    for m in range(m_j):
                        along_mean = weight * tensor[r, average_j + m]
                        for j in range(n):
                            image[r, b, j] += along_mean * mean_j[1 + m, b, j]
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
                mean_image[0, :, :n] += image[divergence_i, :, :n]
            for m in range(m_i):
                mean_image[1 + m, :, :n] += image[average_i + m, :, :n]
            if value_i >= 0:
                for a in range(rows):
                    for b in range(columns):
                        for j in range(n):
                            local[0, a, b, j] += image[value_i + a, b, j]
        for m in range(0 if divergence_i >= 0 else 1, 1 + m_i):
            for i in range(n_i):
                for a in range(rows):
                    for b in range(columns):
                        for j in range(n):
                            local[i, a, b, j] += mean_i[m, a, i] * mean_image[m, b, j]
        first = position_offsets[index]
        for i in range(n_i):
            length = row_lengths[test_dofs[nodes[i]]]
            for j in range(n_j):
                start = positions[first + i * n_j + j]
                for a in range(rows):
                    for b in range(columns):
                        values[start + a * length + b] += local[i, a, b, j]


@njit(cache=True)
def evaluate(
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
    cell_values: Any,
    point_values: Any,
    n_coefficients: int,
    result: Any,
) -> None:
    """Evaluate an integrand at the points of cells.

    Args:
        address: Address of the integrand's kernel.
        constants: Values of its constants, packed.
        coordinates: `REFERENCE_TRIANGLE`.
        cells: Cells to evaluate in; int32.
        offsets: Where each patch begins in ``patch``.
        patch: Nodes of the patches, the cell's own node first.
        gradients: Mean and second gradients; shape (entries, 3, 2).
        areas: Cell areas [m^2].
        n_points: 4, or 1 for the mean gradient alone.
        fields: Nodal values of all coefficient components; shape (n_nodes, m).
        field_slots: Slots of value, gradient, mean divergence and its axis; shape (m, 4).
        cell_values: What is constant on a cell; shape (n_cells, m).
        point_values: What has values at points; shape (n_cells, n_points, m).
        n_coefficients: Length of the kernel's coefficient array.
        result: Set to the integrand's arrays; shape (cells.size, n_points, size).
    """
    largest = np.max(offsets[1:] - offsets[:-1])
    gx, gy, mean = np.zeros(largest), np.zeros(largest), np.zeros((1, 2, largest))
    none = np.zeros((largest, 0, 0))
    w = np.zeros(n_coefficients)
    tensor = np.zeros(result.shape[2])
    pointers = tensor.ctypes.data, w.ctypes.data, constants.ctypes.data, coordinates.ctypes.data
    for index in range(cells.size):
        c = cells[index]
        begin, end = offsets[c], offsets[c + 1]
        radius = np.sqrt(areas[c] / np.pi)
        _means(mean, gradients, none, begin, end)
        for point in range(n_points):
            _gradients_at(gx, gy, gradients, begin, end, radius, point, n_points)
            _pack(
                w,
                field_slots,
                fields,
                patch,
                begin,
                end,
                gx,
                gy,
                mean,
                cell_values,
                point_values,
                c,
                point,
            )
            _evaluate(address, tensor, pointers)
            for i in range(tensor.size):
                result[index, point, i] = 2.0 * tensor[i]


@njit(cache=True)
def patch_vectors(
    triangles: Any, weights: Any, corners: Any, gradients: Any, by_gradient: Any, n_entries: int
) -> Any:
    """Means over node cells of linear forms on triangles, as vectors over the patches.

    Args:
        triangles: Triangles around each node.
        weights: Their smoothing coefficients alpha_I.
        corners: Entry of the patch arrays of each of their vertices; shape (entries, 3).
        gradients: Gradients of the shape functions on triangles; shape (n_triangles, 3, 2).
        by_gradient: Linear forms of the gradient; shape (n_triangles, components, 2).
        n_entries: Number of entries of all patches.

    Returns:
        Shape (patch entries, components).
    """
    n, components = by_gradient.shape[0], by_gradient.shape[1]
    by_vertex = np.empty((n, 3, components))
    for t in range(n):
        for i in range(3):
            for a in range(components):
                along_x = by_gradient[t, a, 0] * gradients[t, i, 0]
                by_vertex[t, i, a] = along_x + by_gradient[t, a, 1] * gradients[t, i, 1]
    result = np.zeros((n_entries, components))
    for k in range(triangles.size):
        for i in range(3):
            for a in range(components):
                result[corners[k, i], a] += weights[k] * by_vertex[triangles[k], i, a]
    return result


@njit(cache=True)
def add_second_variations(
    used: Any,
    triangle_pairs: Any,
    weights: Any,
    gradients: Any,
    by_gradients: Any,
    vertices: Any,
    test_dofs: Any,
    positions: Any,
    row_lengths: Any,
    values: Any,
) -> None:
    """Add bilinear forms on triangles to the values of a CSR matrix.

    Args:
        used: Triangles of the term's cells.
        triangle_pairs: Entry of ``positions`` of each pair of their vertices; shape (n_used, 3, 3).
        weights: Weight of each of all triangles; shape (n_triangles,).
        gradients: Gradients of the shape functions on triangles; shape (n_triangles, 3, 2).
        by_gradients: Bilinear forms of the gradients; shape (n_triangles, rows, 2, columns, 2).
        vertices: Vertices of the triangles; shape (n_triangles, 3).
        test_dofs: Block dof of every node in the test field.
        positions: First entry of the block of each pair.
        row_lengths: Entries in a row of each block row.
        values: Values to add to.
    """
    rows, columns = by_gradients.shape[1], by_gradients.shape[3]
    for k in range(used.size):
        t = used[k]
        g, form = gradients[t], by_gradients[t]
        for i in range(3):
            length = row_lengths[test_dofs[vertices[t, i]]]
            for j in range(3):
                start = positions[triangle_pairs[k, i, j]]
                for a in range(rows):
                    for b in range(columns):
                        entry = 0.0
                        for x in range(2):
                            for y in range(2):
                                entry += g[i, x] * form[a, x, b, y] * g[j, y]
                        values[start + a * length + b] += weights[t] * entry
