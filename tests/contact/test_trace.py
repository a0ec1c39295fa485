# SPDX-License-Identifier: LGPL-3.0-or-later
import numpy as np
import pytest
from dolfinx import fem

from fenicsx_hmcontact.contact import surface_values
from tests.models import stack

pytestmark = pytest.mark.mpi


def interpolated(mesh, shape, expression):
    function = fem.Function(fem.functionspace(mesh, ("P", 1, shape)))
    function.interpolate(expression)
    return function


@pytest.mark.parametrize("surface", ["bottom_1", "top_0", "left_1"])
def test_values_at_the_nodes(comm, surface):
    domain = stack(comm, (5, 7), slope=0.2)
    p = interpolated(domain.mesh, (), lambda x: x[0] ** 2 - 3 * x[1])
    u = interpolated(domain.mesh, (2,), lambda x: (np.sin(x[0]), x[0] * x[1]))
    tag = domain.surface(surface)
    points, values = surface_values(p, domain.facet_tags, tag)
    assert len(points) == {"bottom_1": 8, "top_0": 6, "left_1": 4}[surface]
    x, y = points.T
    straight = 0.0 * x if surface == "left_1" else 0.5 + 0.2 * (x - 0.5)
    np.testing.assert_allclose(x if surface == "left_1" else y, straight, atol=1e-15)
    np.testing.assert_allclose(values, (x**2 - 3 * y)[:, None], atol=1e-15)
    points, values = surface_values(u, domain.facet_tags, tag)
    x, y = points.T
    np.testing.assert_allclose(values, np.column_stack([np.sin(x), x * y]), atol=1e-15)
    assert all(np.array_equal(values, other) for other in comm.allgather(values))


def test_quadratic_field_is_refused(comm):
    domain = stack(comm, (2, 3))
    u = fem.Function(fem.functionspace(domain.mesh, ("P", 2)))
    with pytest.raises(ValueError, match="P1"):
        surface_values(u, domain.facet_tags, domain.surface("top_0"))


def test_unknown_tag_is_refused(comm):
    domain = stack(comm, (2, 3))
    u = fem.Function(fem.functionspace(domain.mesh, ("P", 1)))
    with pytest.raises(ValueError, match="tag 99"):
        surface_values(u, domain.facet_tags, 99)
