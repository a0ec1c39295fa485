# SPDX-License-Identifier: LGPL-3.0-or-later
"""Uniform stress across non-matching, inclined interfaces, to round-off."""

import numpy as np
import pytest
from dolfinx import fem

from tests.models import MATERIAL, Elastic, largest, stack

pytestmark = pytest.mark.mpi

STRESS = np.array([[-0.4, 0.25], [0.25, -1.0]]) * 1e4
STRAIN = (1 + MATERIAL.nu) / MATERIAL.E * (STRESS - MATERIAL.nu * np.trace(STRESS) * np.eye(2))


def patch(comm, across, *, slope, ends, pairs, smoothing="deviatoric"):
    """Solve blocks under tractions, or on inhomogeneous rollers at their ends."""
    n = len(across)
    fixed = {("bottom_0", None): lambda x: STRAIN @ x[:2]}
    tractions = {f"top_{n - 1}": STRESS @ (0, 1)}
    for k in range(n):
        for side, normal in (("left", (-1, 0)), ("right", (1, 0))):
            t = STRESS @ normal
            if ends == "rollers":
                # The shear stays a load.
                fixed[f"{side}_{k}", 0] = lambda x: STRAIN[0] @ x[:2]
                t[0] = 0.0
            tractions[f"{side}_{k}"] = t
    model = Elastic(
        stack(comm, across, slope=slope),
        fixed=fixed,
        tractions=tractions,
        pairs=[(*pair, None) for pair in pairs],
        smoothing=smoothing,
    )
    assert model.problem.solve().iterations == 1
    exact = fem.Function(model.V)
    exact.interpolate(lambda x: STRAIN @ x[:2])
    error = largest(model.u.x.array - exact.x.array, comm) / np.abs(STRAIN).max()
    return model, error


@pytest.mark.parametrize("across", [(7, 11), (5, 17), (19, 4)])
@pytest.mark.parametrize("slope", [0.0, 0.3, -0.4])
@pytest.mark.parametrize("ends", ["free", "rollers"])
def test_two_blocks(comm, across, slope, ends):
    for pair in (("bottom_1", "top_0"), ("top_0", "bottom_1")):
        model, error = patch(comm, across, slope=slope, ends=ends, pairs=[pair])
        assert error < 1e-11
        gradient = model.problem.node_cells.gradient(model.u, "deviatoric")
        assert largest(gradient - STRAIN, comm) < 1e-10 * np.abs(STRAIN).max()


@pytest.mark.parametrize("smoothing", ["full", "none", "triangles"])
def test_any_smoothing(comm, smoothing):
    _, error = patch(
        comm,
        (7, 11),
        slope=0.3,
        ends="rollers",
        pairs=[("bottom_1", "top_0")],
        smoothing=smoothing,
    )
    assert error < 1e-11


@pytest.mark.parametrize("ends", ["free", "rollers"])
def test_chain_of_three_blocks(comm, ends):
    # The middle block is secondary to one neighbour and primary to the other.
    for pairs in (
        [("bottom_1", "top_0"), ("bottom_2", "top_1")],
        [("top_0", "bottom_1"), ("bottom_2", "top_1")],
        [("bottom_1", "top_0"), ("top_1", "bottom_2")],
    ):
        _, error = patch(comm, (5, 8, 6), slope=0.2, ends=ends, pairs=pairs)
        assert error < 1e-11
