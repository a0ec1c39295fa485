# SPDX-License-Identifier: LGPL-3.0-or-later
import numpy as np
import pytest
from dolfinx import fem
from dolfinx.fem.petsc import create_vector

from fenicsx_hmcontact.solvers import FieldLayout
from tests.models import stack

pytestmark = pytest.mark.mpi


@pytest.fixture
def spaces(comm):
    """A vector, a scalar and a quadratic vector field: blocks of different size and number."""
    mesh = stack(comm, (4, 5)).mesh
    return [fem.functionspace(mesh, ("P", *e)) for e in ((1, (2,)), (1,), (2, (2,)))]


@pytest.fixture
def layout(spaces):
    return FieldLayout(spaces)


def test_every_unknown_has_one_global_number(comm, layout, spaces):
    owned = np.concatenate(comm.allgather(layout.global_index[layout.owned]))
    np.testing.assert_array_equal(owned, np.arange(layout.n_global))
    sizes = [V.dofmap.index_map.size_global * V.dofmap.index_map_bs for V in spaces]
    assert layout.n_global == sum(sizes)
    first = layout.first
    assert np.array_equal(layout.global_index[layout.owned], first + np.arange(layout.owned.size))
    owners = comm.allgather(np.flatnonzero(layout.owns(np.arange(layout.n_global))))
    np.testing.assert_array_equal(np.concatenate(owners), np.arange(layout.n_global))


def test_numbering_is_that_of_blocked_petsc_vectors(layout, spaces):
    vector = create_vector(spaces, kind="mpi")
    assert vector.getOwnershipRange() == (layout.first, layout.first + layout.owned.size)


def test_ghosts_have_the_number_of_their_owners(comm, layout):
    array = np.full(layout.n_local, -1.0)
    array[layout.owned] = layout.global_index[layout.owned]
    layout.update_ghosts(array)
    np.testing.assert_array_equal(array, layout.global_index)
    assert comm.size == 1 or comm.allreduce(layout.n_local - layout.owned.size) > 0


def test_same_place_same_number_on_all_ranks(comm, layout, spaces):
    # Coordinates and bodies tell unknowns apart without any numbering.
    index = layout.views(layout.global_index)[1]
    mesh = spaces[1].mesh
    corners = mesh.geometry.dofmaps[0]
    number = np.empty(spaces[1].dofmap.list.max() + 1, np.int64)
    number[spaces[1].dofmap.list.ravel()] = mesh.geometry.input_global_indices[corners.ravel()]
    mine = dict(zip(number.tolist(), index.tolist(), strict=True))
    for others in comm.allgather(mine):
        assert all(mine.get(node, i) == i for node, i in others.items())


def test_blocks_of_a_field(layout, spaces):
    for field, V in enumerate(spaces):
        index_map, bs = V.dofmap.index_map, V.dofmap.index_map_bs
        local = np.arange(index_map.size_local + index_map.num_ghosts, dtype=np.int32)
        numbers = layout.global_of_blocks(field, index_map.local_to_global(local))
        assert numbers.shape == (local.size, bs)
        np.testing.assert_array_equal(numbers.ravel(), layout.views(layout.global_index)[field])


def test_adding_ghosts_counts_the_ranks_that_see_an_unknown(comm, layout):
    seen = np.bincount(
        np.concatenate(comm.allgather(layout.global_index)), minlength=layout.n_global
    )
    array = np.ones(layout.n_local)
    layout.add_ghosts_to_owners(array)
    np.testing.assert_array_equal(array, seen[layout.global_index])
    assert comm.size == 1 or seen.max() > 1


def test_gather_takes_owners_values_in_any_order(comm, layout):
    array = np.full(layout.n_local, np.nan)
    array[layout.owned] = 3.0 * layout.global_index[layout.owned]
    wanted = np.random.default_rng(0).permutation(layout.n_global)[:57]
    np.testing.assert_array_equal(layout.gather(wanted, array), 3.0 * wanted)
    assert layout.gather(np.zeros(0, np.int64), array).size == 0


def test_fields_of_owned_unknowns(layout, spaces):
    expected = [V.dofmap.index_map.size_local * V.dofmap.index_map_bs for V in spaces]
    np.testing.assert_array_equal(np.bincount(layout.field_of_owned(), minlength=3), expected)
    array = np.arange(layout.n_local, dtype=float)
    views = layout.views(array)
    assert np.shares_memory(views[1], array)
    np.testing.assert_array_equal(np.concatenate(views), array)
