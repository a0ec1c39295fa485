# SPDX-License-Identifier: LGPL-3.0-or-later
"""Condensation of made-up dependences against dense matrices."""

import numpy as np
import pytest
from dolfinx import fem
from scipy import sparse

from fenicsx_hmcontact.contact import Condensation, Dependence
from fenicsx_hmcontact.solvers import FieldLayout
from tests.models import stack

pytestmark = pytest.mark.mpi


@pytest.fixture
def layout(comm):
    mesh = stack(comm, (3, 4)).mesh
    return FieldLayout([fem.functionspace(mesh, ("P", 1, (2,))), fem.functionspace(mesh, ("P", 1))])


def dependence(secondary, others, seed, closed=False, density=0.7):
    rng = np.random.default_rng(seed)
    x = sparse.random_array((len(secondary), len(others)), density=density, rng=rng, format="csr")
    closed = np.broadcast_to(closed, len(secondary))
    return Dependence(np.array(secondary), np.array(others), sparse.csr_matrix(x), closed)


def dense(dependences, n):
    """X over all unknowns."""
    X = np.zeros((n, n))
    for d in dependences:
        X[np.ix_(d.secondary, d.others)] += d.coefficients.toarray()
    return X


def one(layout):
    return [dependence([40, 7, 21], [0, 13, 55, 30], 0, closed=[True, False, True])]


def chain(layout):
    """Unknowns secondary in one pair are primary in the next, three deep."""
    return [
        dependence([3, 17], [20, 5, 48], 1, closed=True),
        dependence([5, 20], [33, 9], 2, closed=True),
        dependence([33], [50, 51], 3, density=1.0),
    ]


SETS = pytest.mark.parametrize("make", [one, chain])


@SETS
def test_transformation_is_the_inverse(layout, make):
    dependences = make(layout)
    condensation = Condensation(dependences, layout)
    n = layout.n_global
    T = np.linalg.inv(np.eye(n) - dense(dependences, n))
    at = condensation.unknowns
    assert np.all(np.diff(at) > 0)
    np.testing.assert_allclose(condensation.transformation.toarray(), T[np.ix_(at, at)], atol=1e-15)
    # Nothing happens elsewhere.
    rest = np.setdiff1d(np.arange(n), at)
    np.testing.assert_array_equal(T[rest], np.eye(n)[rest])
    secondary = np.concatenate([d.secondary for d in dependences])
    np.testing.assert_array_equal(at[condensation.is_secondary], np.sort(secondary))
    closed = np.concatenate([d.secondary[d.closed] for d in dependences])
    np.testing.assert_array_equal(at[condensation.closed], np.sort(closed))


@SETS
def test_vectors_on_any_number_of_ranks(layout, make):
    dependences = make(layout)
    condensation = Condensation(dependences, layout)
    n = layout.n_global
    X = dense(dependences, n)
    T = np.linalg.inv(np.eye(n) - X)
    a = np.random.default_rng(5).standard_normal(n)

    expanded = a[layout.global_index]
    condensation.expand(expanded)
    np.testing.assert_allclose(expanded, (T @ a)[layout.global_index], atol=1e-14)
    np.testing.assert_allclose(
        condensation.relative(expanded), a[condensation.unknowns], rtol=0, atol=1e-14
    )
    condensed = a[layout.global_index]
    condensation.condense(condensed)
    np.testing.assert_allclose(condensed, (T.T @ a)[layout.global_index], atol=1e-14)
    np.testing.assert_array_equal(
        condensation.gather(a[layout.global_index]), a[condensation.unknowns]
    )
    np.testing.assert_array_equal(
        condensation.secondary_mask(),
        np.isin(layout.global_index, condensation.unknowns[condensation.is_secondary]),
    )


@SETS
def test_matrix_entries_make_the_triple_product(comm, layout, make):
    dependences = make(layout)
    condensation = Condensation(dependences, layout)
    n = layout.n_global
    T = np.linalg.inv(np.eye(n) - dense(dependences, n))
    # Each rank brings a full matrix over what it sees.
    rows, columns = (a.ravel().astype(np.int32) for a in np.indices((layout.n_local,) * 2))
    values = np.random.default_rng(comm.rank).standard_normal(rows.size)
    local = np.zeros((n, n))
    numbers = layout.global_index
    local[np.ix_(numbers, numbers)] = values.reshape((layout.n_local,) * 2)
    K = comm.allreduce(local)

    prescribed = np.isin(np.arange(n), [13, 30, 50, 2, 11])
    fixed = prescribed[condensation.unknowns] | condensation.closed
    source, factor, new_rows, new_columns = condensation.matrix_entries(
        rows, columns, prescribed[numbers], fixed
    )
    result = np.zeros((n, n))
    np.add.at(result, (new_rows, new_columns), factor * values[source])
    kept = ~(condensation.secondary_mask() | prescribed[numbers])
    inside = kept[rows] & kept[columns]
    np.add.at(result, (numbers[rows[inside]], numbers[columns[inside]]), values[inside])
    free = ~prescribed
    free[condensation.unknowns[condensation.closed]] = False
    expected = np.outer(free, free) * (T.T @ K @ T)
    np.testing.assert_allclose(comm.allreduce(result), expected, rtol=0, atol=1e-12)


def test_nothing_to_condense(layout):
    condensation = Condensation([], layout)
    array = np.arange(layout.n_local, dtype=float)
    condensation.expand(array)
    condensation.condense(array)
    np.testing.assert_array_equal(array, np.arange(layout.n_local))
    assert condensation.unknowns.size == 0 and not condensation.secondary_mask().any()


def test_secondary_twice_is_refused(layout):
    twice = [dependence([3, 8], [20], 0), dependence([8, 9, 3], [30], 1)]
    with pytest.raises(ValueError, match="2 unknowns belong to the secondary surfaces of two"):
        Condensation(twice, layout)


@pytest.mark.parametrize("length", [1, 2, 3])
def test_circle_is_refused(layout, length):
    circle = [dependence([i], [(i + 1) % length], 0, density=1.0) for i in range(length)]
    with pytest.raises(ValueError, match="depend on each other in a circle"):
        Condensation(circle, layout)
