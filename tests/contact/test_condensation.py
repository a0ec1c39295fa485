# SPDX-License-Identifier: LGPL-3.0-or-later
"""Condensation of made-up dependences against dense matrices."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from dolfinx import fem
from scipy import linalg, sparse, stats

from fenicsx_hmcontact.contact import Condensation, Dependence
from fenicsx_hmcontact.solvers import FieldLayout
from tests.models import stack

pytestmark = pytest.mark.mpi

BARE = 44
"""A secondary unknown that depends on nothing, as that of a dropped node."""


@pytest.fixture
def layout(comm):
    mesh = stack(comm, (3, 4)).mesh
    return FieldLayout([fem.functionspace(mesh, ("P", 1, (2,))), fem.functionspace(mesh, ("P", 1))])


def dependence(secondary, others, seed, closed=False, density=0.7):
    """Unknowns in no order, secondary ones between the others."""
    rng = np.random.default_rng(seed)
    unknowns = rng.permutation(np.concatenate((secondary, others)))
    positions = np.flatnonzero(np.isin(unknowns, secondary))
    x = sparse.random_array((positions.size, unknowns.size), density=density, rng=rng).toarray()
    x[:, positions] = 0.0
    closed = np.broadcast_to(closed, positions.size)
    return Dependence(unknowns.astype(np.int64), positions, sparse.csr_array(x), closed)


def contact(secondary, others, seed, constrained):
    """As rows of contact: turned pairs, other tests than trials, constraints, moving geometry."""
    d = dependence(secondary, others, seed)
    rng = np.random.default_rng(seed + 100)
    n, m = len(secondary), d.unknowns.size
    turns = [stats.special_ortho_group.rvs(2, random_state=rng) for _ in range(n // 2)]
    shears = [turn @ ([1.0, rng.normal()], [0.0, 1.0]) for turn in turns]
    return replace(
        d,
        frame=sparse.csr_array(linalg.block_diag(*turns)),
        test_frame=sparse.csr_array(linalg.block_diag(*shears)),
        stiffness=np.where(np.isin(np.arange(n), constrained), rng.uniform(1.0, 9.0, n), 0.0),
        values=rng.normal(size=n),
        derivative=sparse.random_array((n, m), density=0.4, rng=rng, format="csr"),
        transmitted=sparse.random_array((m, m), density=0.4, rng=rng, format="csr"),
    )


def tied():
    return [dependence([7, 21, 40], [0, 13, 30, 55], 0, closed=[True, False, True])]


def tied_chain():
    """Unknowns secondary in one pair are primary in the next, three deep."""
    return [
        dependence([3, 17], [20, 5, 48], 1, closed=True),
        dependence([5, 20], [33, 9], 2, closed=True),
        dependence([33], [50, 51], 3, density=1.0),
    ]


def sliding():
    return [contact([7, 8, 21, 22], [0, 1, 13, 30, 55], 4, constrained=[0, 2, 3])]


def sliding_chain():
    """A sliding pair on a sliding pair on a tied one."""
    return [
        contact([3, 4, 17, 18], [5, 6, 48], 5, constrained=[0]),
        contact([5, 6, 9, 10], [33, 2], 6, constrained=[1, 2]),
        dependence([33], [50, 51], 7, closed=True, density=1.0),
    ]


SETS = pytest.mark.parametrize("make", [tied, tied_chain, sliding, sliding_chain])


def condensation_of(dependences, layout):
    none = np.zeros(0, np.int64)
    condensation = Condensation(
        np.concatenate([none, *(d.unknowns for d in dependences), [BARE]]),
        np.concatenate([none, *(d.unknowns[d.secondary] for d in dependences), [BARE]]),
        layout,
    )
    condensation.update(dependences)
    return condensation


def dense(dependences, n):
    """The definitions, over all unknowns: v = T a, tests W, added matrix and offset."""
    X, B, B_test, G, Z = np.zeros((n, n)), np.eye(n), np.eye(n), np.zeros((n, n)), np.zeros((n, n))
    stiffness, offset = np.zeros(n), np.zeros(n)
    for d in dependences:
        s = d.unknowns[d.secondary]
        X[np.ix_(s, d.unknowns)] += d.coefficients.toarray()
        if d.frame is not None:
            B[np.ix_(s, s)] = d.frame.toarray()
            B_test[np.ix_(s, s)] = d.test_frame.toarray()
            stiffness[s] = d.stiffness
            offset[s] = np.where(d.stiffness > 0, d.stiffness * d.values, d.values)
            G[np.ix_(s, d.unknowns)] += d.derivative.toarray()
            Z[np.ix_(d.unknowns, d.unknowns)] += d.transmitted.toarray()
    T, W = (np.linalg.solve(np.eye(n) - X, b) for b in (B, B_test))
    W[:, stiffness > 0] = 0.0
    return SimpleNamespace(T=T, W=W, added=(G + W.T @ Z) @ T + np.diag(stiffness), offset=offset)


@SETS
def test_transformation_follows_its_definition(layout, make):
    dependences = make()
    condensation = condensation_of(dependences, layout)
    n = layout.n_global
    reference = dense(dependences, n)
    at = condensation.unknowns
    assert np.all(np.diff(at) > 0)
    inside = np.ix_(at, at)
    for name, expected in (
        ("transformation", reference.T),
        ("tests", reference.W),
        ("matrix", reference.added),
    ):
        result = getattr(condensation, name).toarray()
        np.testing.assert_allclose(result, expected[inside], rtol=0, atol=1e-13)
    np.testing.assert_allclose(condensation.offset, reference.offset[at], rtol=1e-15)
    # Nothing happens elsewhere.
    rest = np.setdiff1d(np.arange(n), at)
    np.testing.assert_array_equal(reference.T[rest], np.eye(n)[rest])
    secondary = np.concatenate([[BARE], *(d.unknowns[d.secondary] for d in dependences)])
    slots = condensation.slots
    np.testing.assert_array_equal(slots >= 0, np.isin(layout.global_index, secondary))
    np.testing.assert_array_equal(at[slots[slots >= 0]], layout.global_index[slots >= 0])
    closed = np.concatenate([d.unknowns[d.secondary[d.closed]] for d in dependences])
    np.testing.assert_array_equal(at[condensation.closed], np.sort(closed))


@SETS
def test_vectors_on_any_number_of_ranks(layout, make):
    dependences = make()
    condensation = condensation_of(dependences, layout)
    n, numbers = layout.n_global, layout.global_index
    reference = dense(dependences, n)
    a = np.random.default_rng(5).standard_normal(n)
    at = condensation.unknowns

    expanded = a[numbers]
    condensation.expand(expanded)
    np.testing.assert_allclose(expanded, (reference.T @ a)[numbers], atol=1e-13)
    np.testing.assert_allclose(condensation.relative(expanded), a[at], rtol=0, atol=1e-13)

    added = np.zeros(n)
    added[at] = np.random.default_rng(6).standard_normal(at.size)
    condensed = a[numbers]
    condensation.condense(condensed, added[at])
    np.testing.assert_allclose(condensed, (reference.W.T @ a + added)[numbers], atol=1e-13)
    np.testing.assert_array_equal(condensation.gather(a[numbers]), a[at])


def test_pattern_does_not_depend_on_constraints(layout):
    free, held = ([contact([7, 8], [0, 1, 13], 4, constrained=c)] for c in ((), (0, 1)))
    condensation = condensation_of(free, layout)
    pattern = condensation.tests
    condensation.update(held)
    np.testing.assert_array_equal(condensation.tests.indptr, pattern.indptr)
    np.testing.assert_array_equal(condensation.tests.indices, pattern.indices)
    at = np.searchsorted(condensation.unknowns, (7, 8))
    np.testing.assert_array_equal(np.flatnonzero(condensation.constrained), at)
    assert not condensation.tests[:, at].toarray().any() and pattern[:, at].toarray().any()


def test_update_forgets_what_was_before(layout):
    condensation = condensation_of(sliding(), layout)
    condensation.update([])
    n = condensation.unknowns.size
    for matrix in (condensation.transformation, condensation.tests):
        np.testing.assert_array_equal(matrix.toarray(), np.eye(n))
    assert not condensation.matrix.toarray().any() and not condensation.offset.any()
    assert not condensation.closed.any() and not condensation.constrained.any()


def test_nothing_to_condense(layout):
    none = np.zeros(0, np.int64)
    condensation = Condensation(none, none, layout)
    array = np.arange(layout.n_local, dtype=float)
    condensation.expand(array)
    condensation.condense(array, np.zeros(0))
    np.testing.assert_array_equal(array, np.arange(layout.n_local))
    assert condensation.unknowns.size == 0 and np.all(condensation.slots == -1)


def test_secondary_twice_is_refused(layout):
    twice = [dependence([3, 8], [20], 0), dependence([8, 9, 3], [30], 1)]
    with pytest.raises(ValueError, match="2 unknowns belong to the secondary surfaces of two"):
        condensation_of(twice, layout)


@pytest.mark.parametrize("length", [2, 3])
def test_circle_is_refused(layout, length):
    circle = [dependence([i], [(i + 1) % length], 0, density=1.0) for i in range(length)]
    with pytest.raises(ValueError, match="depend on each other in a circle"):
        condensation_of(circle, layout)


def test_dependence_on_itself_is_refused(layout):
    itself = Dependence(
        np.array([3]), np.array([0]), sparse.csr_array([[0.5]]), np.zeros(1, dtype=bool)
    )
    with pytest.raises(ValueError, match="depend on each other in a circle"):
        condensation_of([itself], layout)
