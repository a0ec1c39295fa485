# SPDX-License-Identifier: LGPL-3.0-or-later
"""ContactProblem in unusual use: the answer is right, or what is wrong is refused by name."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import meshtags

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.contact import Kinematics, gather_surface
from fenicsx_hmcontact.domain import Domain, MeshArrays
from tests.models import LOAD, MATERIAL, Elastic, Porous, fix, integral, largest, stack, total

BASE = {("bottom_0", None): np.zeros(2)}
TIED = [("bottom_1", "top_0", None)]
CLOSED = hm.GapFlow(1e-9)
OPEN = hm.GapFlow(1e-9, aperture=2e-4)


class Scalar:
    """A block, or blocks without contact, with one scalar unknown."""

    def __init__(self, comm, across=(4,)):
        self.domain = stack(comm, across)
        self.mesh = self.domain.mesh
        self.mesh.topology.create_connectivity(1, 2)
        self.Q = fem.functionspace(self.mesh, ("P", 1))
        self.u, self.v = fem.Function(self.Q, name="head"), ufl.TestFunction(self.Q)
        self.bcs = [fix(self.domain, self.Q, "bottom_0")]

    def laplace(self, measure=hm.dc):
        return ufl.inner(ufl.grad(self.u), ufl.grad(self.v)) * measure

    def halves(self):
        """Tags 1 and 2 of cells left and right of the diagonal, which share nodes."""
        return self.tagged(lambda x: np.where(x[:, 0] < x[:, 1], 1, 2))

    def tagged(self, values, owned=False):
        cells = self.mesh.topology.index_map(2)
        cells = np.arange(cells.size_local + (0 if owned else cells.num_ghosts), dtype=np.int32)
        middle = self.mesh.geometry.x[self.mesh.geometry.dofmaps[0][cells]].mean(axis=1)
        return meshtags(self.mesh, 2, cells, np.asarray(values(middle), np.int32))

    def solve(self, residual, **options):
        """Solve from zero; return a copy of the local unknowns."""
        self.u.x.array[:] = 0.0
        hm.ContactProblem(residual, self.u, **({"bcs": self.bcs} | options)).solve()
        return self.u.x.array.copy()


def assert_close(values, expected, comm, tolerance=1e-9):
    """The arrays of all ranks agree, relative to the largest value."""
    assert largest(values - expected, comm) <= tolerance * largest(expected, comm)


# --- terms on node cells ---------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("load", "amount"),
    [
        (lambda f, dc: f * dc, 1.0),
        (lambda f, dc: f * dc + f * dc, 2.0),
        (lambda f, dc: f * dc(1) + f * dc(1), 1.0),
        (lambda f, dc: f * dc + f * dc(1), 1.5),
        (lambda f, dc: f * dc((1, 2)) + f * dc(2), 1.5),
        (lambda f, dc: f * dc((1, 2)) + f * dc((1, 2)), 2.0),
        (lambda f, dc: f * dc + f * dc - f * dc, 1.0),
    ],
)
def test_every_term_counts_once(comm, load, amount):
    s = Scalar(comm, (3, 4))
    dc = hm.dc(domain=s.mesh, subdomain_data=s.domain.cell_tags)
    source = fem.Constant(s.mesh, 1.0) * s.v
    s.solve(s.u * s.v * ufl.dx - load(source, dc), bcs=[])
    assert integral(fem.form(s.u * ufl.dx), comm) == pytest.approx(amount, rel=1e-12)


@pytest.mark.mpi
def test_layers_that_share_nodes_make_one_region(comm):
    s = Scalar(comm)
    layers = hm.dc(domain=s.mesh, subdomain_data=s.halves())((1, 2))

    def residual(measure):
        return s.laplace(measure) + (s.u + s.u**3 - 1.0) * s.v * measure

    assert_close(s.solve(residual(layers)), s.solve(residual(hm.dc)), comm)


@pytest.mark.mpi
def test_stress_of_layers_that_share_nodes(comm):
    s = Scalar(comm)
    V = fem.functionspace(s.mesh, ("P", 1, (2,)))
    u, w = fem.Function(V), ufl.TestFunction(V)
    layers = hm.dc(domain=s.mesh, subdomain_data=s.halves())((1, 2))
    found = []
    for measure in (layers, hm.dc):
        u.x.array[:] = 0.0
        F = ufl.inner(MATERIAL.stress(u), ufl.grad(w)) * measure - LOAD * w[1] * ufl.dx
        hm.ContactProblem(F, u, bcs=[fix(s.domain, V, "bottom_0", np.zeros(2))]).solve()
        found.append(u.x.array.copy())
    assert_close(*found, comm)


@pytest.mark.mpi
def test_tags_may_name_owned_cells_alone(comm):
    s = Scalar(comm)
    tags = s.tagged(lambda x: np.ones(len(x)), owned=True)
    owned = hm.dc(domain=s.mesh, subdomain_data=tags)(1)
    load = s.v * hm.dc
    assert_close(s.solve(s.laplace(owned) - load), s.solve(s.laplace() - load), comm)


def test_constants_in_single_precision(comm):
    s = Scalar(comm)
    load = s.v * hm.dc
    expected = s.solve(2.0 * s.laplace() - load)
    assert_close(
        s.solve(fem.Constant(s.mesh, np.float32(2.0)) * s.laplace() - load), expected, comm
    )


# --- pairs -----------------------------------------------------------------------------------


@pytest.mark.mpi
def test_a_tie_closes_a_jump_of_the_displacement(comm):
    options = dict(fixed=BASE, tractions={"top_1": (0.0, -LOAD)}, pairs=TIED)
    m = Elastic(stack(comm, [3, 5]), **options)
    m.problem.solve()
    expected = m.u.x.array.copy()
    m.u.interpolate(lambda x: np.where(x[1] > 0.4, 1e-3, -2e-3) * np.vstack((x[0] ** 2, x[0])))
    m.problem.solve()
    assert_close(m.u.x.array, expected, comm)


@pytest.mark.mpi
def test_a_tie_closes_a_jump_of_the_pore_pressure(comm):
    sides = {(f"{side}_{k}", 0): 0.0 for side in ("left", "right") for k in (0, 1)}
    domain = stack(comm, [3, 5])
    m = Porous(
        domain,
        fixed=sides | {("bottom_0", 0): 0.0, ("bottom_0", 1): 0.0},
        drained={"top_1": 0.0},
        tractions={"top_1": (0.0, -LOAD)},
        pairs=[("bottom_1", "top_0", CLOSED)],
    )
    m.problem.solve()
    expected = m.u.x.array.copy(), m.p.x.array.copy()
    domain.mesh.topology.create_connectivity(2, 2)
    upper = fem.locate_dofs_topological(m.Q, 2, domain.cell_tags.find(2))
    m.p.x.array[upper] = LOAD
    m.problem.solve()
    assert_close(m.u.x.array, expected[0], comm)
    assert_close(m.p.x.array, expected[1], comm)
    m.p.x.array[upper] += LOAD
    m.step()
    assert np.abs(m.problem.interface(m.pairs[0]).jump).max() < 1e-9 * LOAD


@pytest.mark.mpi
def test_tractions_at_a_node_between_two_pairs(comm):
    domain = stack(comm, [6, 8, 5], levels=[0.0, 1.0, 2.0, 4.0], rows=6)
    mesh = domain.mesh
    # The third block beside the others: the corner of the first is primary and secondary.
    beside = np.unique(mesh.geometry.dofmaps[0][domain.cell_tags.find(domain.body("block_2"))])
    mesh.geometry.x[beside] += (1.0, -2.0, 0.0)
    m = Elastic(
        domain,
        fixed={("right_2", None): np.zeros(2)},
        tractions={"top_1": (0.0, -1e4), "left_0": (5e3, 0.0), "left_1": (5e3, 0.0)},
        pairs=[*TIED, ("right_0", "left_2", None)],
    )
    m.problem.solve()
    state = m.problem.interface(m.pairs[1])
    order = np.argsort(state.points[:, 1])
    lengths = np.diff(state.points[order, 1])
    weights = 0.5 * (np.append(lengths, 0.0) + np.append(0.0, lengths))
    n = state.normals
    t = np.column_stack((n[:, 1], -n[:, 0]))
    traction = state.pressure[:, None] * n + state.shear[:, None] * t
    np.testing.assert_allclose(weights @ traction[order], (-1e4, 1e4), rtol=1e-8)
    support = total(m.problem.reactions(m.u), domain, "right_2")
    np.testing.assert_allclose(support, (-1e4, 1e4), rtol=1e-8)


def test_refuses_a_secondary_pressure_wholly_prescribed(comm):
    with pytest.raises(ValueError, match="pore pressure is prescribed on the whole secondary"):
        Porous(
            stack(comm, [3, 5]),
            fixed={("bottom_0", 0): 0.0, ("bottom_0", 1): 0.0},
            drained={"bottom_1": 0.0},
            pairs=[("bottom_1", "top_0", CLOSED)],
        )


def test_of_primary_layers_the_nearest_counts(comm):
    domain = stack(comm, [5, 6, 7], levels=[0.0, 0.45, 0.5, 1.0])
    tags, primary = domain.facet_tags, 99
    both = np.isin(tags.values, [domain.surface("top_0"), domain.surface("top_1")])
    values = np.where(both, primary, tags.values).astype(np.int32)
    tags = meshtags(domain.mesh, 1, tags.indices, values)
    fixed = BASE | {("bottom_1", 0): 0.0, ("bottom_1", 1): 0.0}
    m = Elastic(domain, fixed=fixed, tractions={"top_2": (0.0, -LOAD)})
    pair = hm.ContactPair(tags, domain.surface("bottom_2"), primary)
    hm.ContactProblem(m.F, m.u, bcs=m.problem.bcs, pairs=[pair]).solve()
    near = m.u.x.array.copy()
    m.u.x.array[:] = 0.0
    pair = hm.ContactPair(domain.facet_tags, domain.surface("bottom_2"), domain.surface("top_1"))
    hm.ContactProblem(m.F, m.u, bcs=m.problem.bcs, pairs=[pair]).solve()
    assert largest(near, comm) > 0.0
    np.testing.assert_allclose(near, m.u.x.array, rtol=0, atol=1e-12 * largest(near, comm))


@pytest.mark.parametrize(("option", "value"), [("friction", None), ("flow", 3)])
def test_refuses_laws_that_are_none(comm, option, value):
    domain = stack(comm, [2, 3])
    with pytest.raises(ValueError, match=f"{value} is no {option}|{option} is {value}"):
        hm.ContactPair(domain.facet_tags, 1, 2, **{option: value})


# --- fields and conditions -------------------------------------------------------------------


def two_fields(s, names=("a", "b")):
    """Two unknowns of one space: u'' = -1 and u'' - u = -2."""
    a, b = (fem.Function(s.Q, name=name) for name in names)
    v, w = ufl.TestFunctions(ufl.MixedFunctionSpace(s.Q, s.Q))
    F = (ufl.inner(ufl.grad(a), ufl.grad(v)) - v) * hm.dc
    F += (ufl.inner(ufl.grad(b), ufl.grad(w)) + b * w - 2.0 * w) * hm.dc
    return F, [a, b]


@pytest.mark.mpi
def test_a_condition_on_a_space_holds_for_all_its_fields(comm):
    s = Scalar(comm)
    F, (a, b) = two_fields(s)
    hm.ContactProblem(F, [a, b], bcs=s.bcs).solve()
    assert_close(a.x.array, s.solve(s.laplace() - s.v * hm.dc), comm)
    assert_close(b.x.array, s.solve(s.laplace() + (s.u - 2.0) * s.v * hm.dc), comm)


def test_fields_of_equal_names_are_numbered(comm):
    s = Scalar(comm)
    F, unknowns = two_fields(s, ("w", "w"))
    n = s.Q.dofmap.index_map.size_global
    assert hm.ContactProblem(F, unknowns, bcs=s.bcs).n_unknowns == {"w 0": n, "w 1": n}


@pytest.mark.parametrize("linear", [True, False])
def test_refuses_a_trial_function(comm, linear):
    s = Scalar(comm)
    bilinear = ufl.inner(ufl.grad(ufl.TrialFunction(s.Q)), ufl.grad(s.v)) * hm.dc
    with pytest.raises(ValueError, match=r"has 2 arguments.*no trial function"):
        hm.ContactProblem(bilinear - s.v * hm.dc if linear else bilinear, s.u, bcs=s.bcs)


def test_refuses_unknowns_in_the_wrong_order(comm):
    m = Porous(stack(comm, [3]), fixed={("bottom_0", 1): 0.0}, drained={"top_0": 0.0})
    with pytest.raises(ValueError, match="in the order of the residual's test functions"):
        hm.ContactProblem(m.F, [m.p, m.u], bcs=m.bcs)


# --- tags, measures and meshes ---------------------------------------------------------------


@pytest.mark.parametrize("kind", ["dx", "ds"])
def test_refuses_several_tags_for_one_kind_of_term(comm, kind):
    s = Scalar(comm)
    if kind == "dx":
        tags = [s.tagged(lambda x, n=n: np.full(len(x), n)) for n in (1, 2)]
    else:
        old = s.domain.facet_tags
        tags = [old, meshtags(s.mesh, 1, old.indices, old.values)]
    first, second = (ufl.Measure(kind, s.mesh, subdomain_data=t)(1) for t in tags)
    with pytest.raises(ValueError, match="use several tags"):
        hm.ContactProblem(s.laplace() + s.u * s.v * first + 5.0 * s.u * s.v * second, s.u)


@pytest.mark.parametrize("measure", [hm.dc, ufl.dx, ufl.ds])
def test_refuses_a_measure_on_another_mesh(comm, measure):
    s, other = Scalar(comm), stack(comm, [3]).mesh
    with pytest.raises(ValueError, match="equation of head is integrated over another mesh"):
        hm.ContactProblem(s.laplace(hm.dc(domain=s.mesh)) - s.v * measure(domain=other), s.u)


@pytest.mark.parametrize("kind", ["dc", "dx", "ds"])
def test_rebinding_refuses_tags_of_the_old_mesh(comm, kind):
    old, new = Scalar(comm), Scalar(comm, (6,))
    tags, new_tags = (
        s.domain.facet_tags if kind == "ds" else s.domain.cell_tags for s in (old, new)
    )
    measure = {"dc": hm.dc, "dx": ufl.dx, "ds": ufl.ds}[kind]
    restricted = measure(domain=old.mesh, subdomain_data=tags)(1)
    F = old.laplace() + (old.u - 1.0) * old.v * restricted
    model = hm.ContactProblem(F, old.u).model
    with pytest.raises(ValueError, match="tags belong to another mesh"):
        hm.ContactProblem(model, new.u)
    hm.ContactProblem(model, new.u, replace={tags: new_tags}).solve()
    np.testing.assert_allclose(new.u.x.array, 1.0, rtol=1e-9)


@pytest.mark.mpi
def test_refuses_a_mesh_that_has_moved(comm):
    s = Scalar(comm)
    problem = hm.ContactProblem(s.laplace() - s.v * hm.dc, s.u, bcs=s.bcs)
    problem.solve()
    before = s.u.x.array.copy()
    # One corner, which only one rank may see.
    x = s.mesh.geometry.x
    x[(x[:, 0] == 0.0) & (x[:, 1] == 0.0), 0] -= 0.1
    with pytest.raises(RuntimeError, match="mesh has moved"):
        problem.solve()
    np.testing.assert_array_equal(s.u.x.array, before)


# --- Newton's method and steps ---------------------------------------------------------------


def test_one_wild_increment_does_not_loosen_the_test(comm):
    s = Scalar(comm)
    # Almost flat about the start: the first increment is 1e15 times the solution.
    flat = ufl.conditional(ufl.lt(abs(s.u - 3.0), 1.0), 1.0 + 1e-15 * s.u, s.u)
    s.u.x.array[:] = 3.0
    hm.ContactProblem((flat - 0.5) * s.v * ufl.dx, s.u).solve()
    np.testing.assert_allclose(s.u.x.array, 0.5, rtol=1e-8)


def test_balanced_initial_stress_takes_one_iteration(comm):
    domain = stack(comm, [6])
    domain.mesh.topology.create_connectivity(1, 2)
    V = fem.functionspace(domain.mesh, ("P", 1, (2,)))
    u, v = fem.Function(V), ufl.TestFunction(V)
    initial = fem.Function(fem.functionspace(domain.mesh, ("DG", 0, (2, 2))))
    stress = np.array([-1e5, 0.0, 0.0, -2e5])
    initial.interpolate(lambda x: np.outer(stress, np.ones(x.shape[1])))
    ds = ufl.Measure("ds", domain=domain.mesh, subdomain_data=domain.facet_tags)
    free = ds(tuple(domain.surface(f"{side}_0") for side in ("top", "left", "right")))
    n = ufl.FacetNormal(domain.mesh)
    F = ufl.inner(MATERIAL.stress(u) + initial, ufl.grad(v)) * hm.dc
    F -= (stress[0] * n[0] * v[0] + stress[3] * n[1] * v[1]) * free
    problem = hm.ContactProblem(F, u, bcs=[fix(domain, V, "bottom_0", np.zeros(2))])
    assert problem.solve().iterations == 1
    # Round-off against the strain of the initial stress, about 2e-3.
    assert largest(u.x.array, comm) < 1e-13
    reaction = total(problem.reactions(u), domain, "bottom_0")
    np.testing.assert_allclose(reaction, (0.0, 2e5), atol=1e-6)


@pytest.mark.mpi
def test_values_set_on_owned_unknowns_alone(comm):
    s = Scalar(comm)
    F = s.laplace(ufl.dx) + (s.u**3 - 1.0) * s.v * ufl.dx
    expected = s.solve(F)
    s.u.x.array[:] = -0.3
    s.u.x.array[: s.Q.dofmap.index_map.size_local] = 0.3
    hm.ContactProblem(F, s.u, bcs=s.bcs).solve()
    assert_close(s.u.x.array, expected, comm)


@pytest.mark.mpi
def test_a_failed_solve_leaves_the_unknowns(comm):
    s = Scalar(comm)
    s.u.interpolate(lambda x: 0.3 + np.sin(7.0 * x[0]) * x[1])
    s.u.x.scatter_forward()
    before = s.u.x.array.copy()
    F = (s.u**2 + 1.0) * s.v * ufl.dx
    problem = hm.ContactProblem(F, s.u, bcs=s.bcs, newton=hm.NewtonOptions(max_iterations=3))
    with pytest.raises(hm.ConvergenceError):
        problem.solve()
    np.testing.assert_array_equal(s.u.x.array, before)


def film(comm):
    """Two blocks with water in a gap of given aperture."""
    fixed = {("bottom_0", 0): 0.0, ("bottom_0", 1): 0.0}
    pairs = [("bottom_1", "top_0", OPEN)]
    return Porous(stack(comm, [3, 5]), fixed=fixed, drained={"top_1": 0.0}, pairs=pairs)


def test_refuses_a_time_step_that_is_no_constant(comm):
    m = film(comm)
    with pytest.raises(ValueError, match=r"time_step must be the fem\.Constant"):
        hm.ContactProblem(m.F, [m.u, m.p], bcs=m.bcs, pairs=m.pairs, time_step=100.0)


@pytest.mark.parametrize("dt", [0.0, -1.0])
def test_refuses_a_time_step_that_is_not_positive(comm, dt):
    with pytest.raises(ValueError, match=f"time_step is {dt}; it must be positive"):
        film(comm).step(dt)


# --- sliding pairs -----------------------------------------------------------------------------

FRICTION = hm.CoulombFriction(0.3)


def pushed(comm, law=FRICTION, *, shift=0.0, extra=(), flow=None, E=100.0):
    """A block pushed over a base: problem, its push, displacement, pair and domain."""
    domain = stack(comm, (7, 5), rows=2, levels=(0.0, 0.5, 0.8))
    domain.mesh.geometry.x[:, :2] += shift
    push = fem.Constant(domain.mesh, 0.0)
    m = Elastic(
        domain,
        fixed={("bottom_0", None): np.zeros(2), ("top_1", 0): push} | dict(extra),
        tractions={"top_1": (0.0, -1.0)},
        material=hm.LinearElastic(E, 0.3),
        pairs=[("bottom_1", "top_0", flow, law)],
    )
    return m, push


def test_a_failed_step_leaves_what_is_reported(comm):
    m, push = pushed(comm)
    problem, pair = m.problem, m.pairs[0]
    push.value = 0.004
    problem.solve()
    before = problem.interface(pair), problem.reactions(m.u).x.array.copy(), problem.contacts()
    problem.newton = hm.NewtonOptions(max_iterations=1)
    push.value = 0.03
    with pytest.raises(hm.ConvergenceError):
        problem.solve()
    after = problem.interface(pair)
    for name, value in vars(before[0]).items():
        np.testing.assert_array_equal(getattr(after, name), value, err_msg=name)
    np.testing.assert_array_equal(problem.reactions(m.u).x.array, before[1])
    assert problem.contacts() == before[2]
    # What comes then is what would have come without the failure.
    problem.newton = hm.NewtonOptions()
    problem.solve()
    other, push = pushed(comm)
    for push.value in (0.004, 0.03):
        other.problem.solve()
    np.testing.assert_array_equal(m.u.x.array, other.u.x.array)


@pytest.mark.mpi
def test_creeping_ends_where_newtons_method_does(comm, monkeypatch):
    def fails(*_):
        raise hm.ConvergenceError("as if the sets cycled", [])

    states = []
    for crept in (False, True):
        m, push = pushed(comm)
        if crept:
            monkeypatch.setattr("fenicsx_hmcontact.problem.solve_newton", fails)
            m.problem.newton = hm.NewtonOptions(relaxation=1e-2)
        for push.value in (0.004, 0.03):
            m.problem.solve()
        states.append((m.u.x.array.copy(), m.problem.interface(m.pairs[0])))
    (newton, one), (creep, other) = states
    assert_close(creep, newton, comm, 1e-8)
    np.testing.assert_array_equal(other.state, one.state)
    np.testing.assert_allclose(other.shear, one.shear, atol=1e-7)


@pytest.mark.parametrize("law", [FRICTION, hm.Frictionless()])
def test_prescribed_neighbours_of_a_sliding_pair_are_refused(comm, law):
    def clamped(V):
        dofs = fem.locate_dofs_geometrical(V, lambda x: np.isclose(x[1], 0.5) & (x[0] < 0.3))
        return fem.dirichletbc(np.zeros(2), dofs, V)

    m, _ = pushed(comm)
    tags = m.domain.facet_tags
    pair = hm.ContactPair(tags, m.domain.surface("bottom_1"), m.domain.surface("top_0"), law)
    with pytest.raises(ValueError, match=f"pair {pair.name}: neighbouring nodes"):
        hm.ContactProblem(m.F, m.u, bcs=[*m.problem.bcs, clamped(m.V)], pairs=[pair])


def test_map_coordinates_change_nothing(comm):
    states = []
    for shift in (0.0, np.array([4e5, 5e6])):
        m, push = pushed(comm, shift=shift, E=3e6)
        push.value = 1e-6
        m.problem.solve()
        states.append((m.problem.interface(m.pairs[0]), shift))
        assert m.problem.solve().iterations <= 2
    (near, _), (far, shift) = states
    np.testing.assert_allclose(far.points - shift, near.points, atol=1e-8)
    np.testing.assert_allclose(far.pressure, near.pressure, atol=1e-5)
    np.testing.assert_array_equal(far.state, near.state)


def test_friction_that_is_not_a_number_names_the_pair(comm):
    class Broken:
        def bound(self, pressure):
            return pressure * np.nan, pressure

    m, push = pushed(comm, Broken())
    push.value = 0.01
    with pytest.raises(hm.ConvergenceError, match=f"pair {m.pairs[0].name}.* not a number"):
        m.problem.solve()


def test_sliding_pairs_refuse_what_they_cannot_do(comm):
    domain = stack(comm, (4, 5), rows=2)
    arguments = dict(fixed={("bottom_0", 0): 0.0, ("bottom_0", 1): 0.0}, drained={"top_1": 0.0})
    for aperture, law, message in (
        (0.0, FRICTION, "an aperture of zero is for tied pairs"),
        (hm.ResidualAperture(1e-4), hm.Tied(), "tied surfaces have no gap"),
    ):
        flow = hm.GapFlow(1e-9, aperture=aperture)
        with pytest.raises(ValueError, match=message):
            Porous(domain, **arguments, pairs=[("bottom_1", "top_0", flow, law)])
    m = Porous(domain, **arguments, pairs=[("bottom_1", "top_0", hm.GapFlow(1e-9), FRICTION)])
    with pytest.raises(ValueError, match=r"time_step is 0\.0; it must be positive"):
        m.step(0.0)
    with pytest.raises(ValueError, match="turn their backs"):
        Porous(domain, **arguments, pairs=[("top_1", "top_0", None, FRICTION)])


def corner(comm):
    """A block on the floor and at the wall of an L-shaped body, whose corner both share."""
    points, cells, groups, facets, facet_groups, surfaces = [], [], [], [], [], {}

    def grid(x, y, nx, ny, body, inside):
        X, Y = np.meshgrid(np.linspace(*x, nx + 1), np.linspace(*y, ny + 1))
        at = np.arange(X.size).reshape(X.shape)
        i, j = (a.ravel() for a in np.meshgrid(np.arange(nx), np.arange(ny)))
        i, j = i[inside(i, j)], j[inside(i, j)]
        a, b, c, d = at[j, i], at[j, i + 1], at[j + 1, i + 1], at[j + 1, i]
        triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
        used = np.unique(triangles)
        number = np.full(X.size, -1)
        number[used] = sum(map(len, points)) + np.arange(used.size)
        points.append(np.column_stack([X.ravel(), Y.ravel(), 0.0 * X.ravel()])[used])
        cells.append(number[triangles])
        groups.append(np.full(len(triangles), body, np.int32))
        return number[at]

    def surface(name, nodes):
        surfaces[name] = len(surfaces) + 1
        facets.append(np.column_stack([nodes[:-1], nodes[1:]]))
        facet_groups.append(np.full(len(nodes) - 1, surfaces[name], np.int32))

    body = grid((0.0, 1.5), (0.0, 1.0), 15, 10, 1, lambda i, j: (j < 5) | (i >= 10))
    block = grid((0.2, 1.0), (0.5, 1.0), 7, 5, 2, lambda i, j: i >= 0)
    surface("base", body[0])
    surface("floor", body[5, :11])
    surface("wall", body[5:, 10])
    surface("bottom", block[0])
    surface("right", block[:, -1])
    surface("top", block[-1])
    arrays = MeshArrays(
        *map(np.concatenate, (points, cells, groups, facets, facet_groups)),
        {"body": 1, "block": 2},
        surfaces,
    )
    return Domain.from_arrays(arrays if comm.rank == 0 else None, comm, name="corner")


@pytest.mark.mpi
@pytest.mark.parametrize(
    "pairs", [[("bottom", "floor"), ("right", "wall")], [("floor", "bottom"), ("wall", "right")]]
)
def test_a_block_in_a_corner_touches_floor_and_wall(comm, pairs):
    domain = corner(comm)
    push = fem.Constant(domain.mesh, 0.0)
    m = Elastic(
        domain,
        fixed={("base", None): np.zeros(2), ("top", 0): push},
        tractions={"top": (0.0, -1.0)},
        material=hm.LinearElastic(1000.0, 0.3),
        pairs=[(*pair, None, FRICTION) for pair in pairs],
    )
    for push.value in (0.002, 0.004):
        m.problem.solve()
    states = [m.problem.interface(pair) for pair in m.pairs]
    total_force = sum(state.force for state in states)
    sign = 1.0 if pairs[0][0] == "bottom" else -1.0
    assert sign * total_force[1] == pytest.approx(0.8, rel=1e-9)
    assert sign * states[1].force[0] < -0.1 and sign * states[0].force[1] > 0.1
    pushed_by = total(m.problem.reactions(m.u), domain, "top")[0]
    assert sign * total_force[0] == pytest.approx(-pushed_by, rel=1e-9)


def apart(comm, gap, **pair):
    """Two blocks of 1 m, the upper one moved by a gap in y at the start."""
    domain = stack(comm, (4, 6), rows=2)
    m = Elastic(domain, fixed=BASE | {("top_1", 0): 0.0, ("top_1", 1): gap})
    upper = domain.cell_tags.find(domain.bodies["block_1"])
    m.u.x.array[2 * np.unique(m.V.dofmap.list[upper]) + 1] = gap
    tags, surfaces = domain.facet_tags, (domain.surface("bottom_1"), domain.surface("top_0"))
    pair = hm.ContactPair(tags, *surfaces, friction=FRICTION, **pair)
    return m, hm.ContactProblem(m.F, m.u, bcs=m.problem.bcs, pairs=[pair]), pair


def test_a_deep_overlap_at_the_start_is_refused(comm):
    apart(comm, -0.1)
    with pytest.raises(ValueError, match=r"overlap by 0\.2 m at .* more than a facet"):
        apart(comm, -0.2)
    apart(comm, -0.2, close_gaps=0.3)
    with pytest.raises(ValueError, match="close_gaps is -1"):
        apart(comm, 0.0, close_gaps=-1.0)


@pytest.mark.parametrize("gap", [0.01, -0.01])
def test_small_gaps_at_the_start_may_count_as_touching(comm, gap):
    for close_gaps in (0.0, 0.005, 0.02):
        _, problem, pair = apart(comm, gap, close_gaps=close_gaps)
        problem.solve()
        state = problem.interface(pair)
        stays_open = gap > close_gaps
        np.testing.assert_allclose(state.gap, gap if stays_open else 0.0, atol=1e-12)
        # What counts as touching presses with nothing.
        force = largest(state.forces, comm)
        presses = gap < -close_gaps
        assert force > 1e4 if presses else force < 1e-9 * MATERIAL.E * abs(gap)


def test_state_tells_slip_forces_and_moment(comm):
    m, push = pushed(comm, hm.CoulombFriction(0.1))
    for push.value in (0.02, 0.05):
        m.problem.solve()
    state = m.problem.interface(m.pairs[0])
    sliding = state.state == hm.NodeState.SLIPPING
    assert sliding.sum() > 3 and np.all(state.state[~sliding] >= hm.NodeState.UNPAIRED)
    # Nearly rigid: the last step moved the block by 0.03, against the tangent or along it.
    np.testing.assert_allclose(np.abs(state.slip[sliding]), 0.03, rtol=0.1)
    tractions = state.pressure[:, None] * state.normals
    tractions += state.shear[:, None] * np.column_stack((state.normals[:, 1], -state.normals[:, 0]))
    np.testing.assert_allclose(state.forces, state.length[:, None] * tractions, atol=1e-12)
    np.testing.assert_allclose(state.force, -state.primary_forces.sum(axis=0), atol=1e-13)
    assert state.force[1] == pytest.approx(1.0, rel=1e-9)
    # The load acts in the middle of the block.
    arm = state.points - [0.3, 0.2]
    expected = np.sum(arm[:, 0] * state.forces[:, 1] - arm[:, 1] * state.forces[:, 0])
    assert state.moment((0.3, 0.2)) == pytest.approx(expected)
    assert state.moment() == pytest.approx(expected + 0.3 * state.force[1] - 0.2 * state.force[0])


def facing(comm, **options):
    """Two surfaces of stacked blocks, and their kinematics with options of the mortar."""
    domain = stack(comm, (5, 4), levels=(0.0, 0.5, 1.0), rows=1)
    tags = domain.facet_tags
    lower, upper = (
        gather_surface(domain.mesh, tags, domain.surface(name), name)
        for name in ("top_0", "bottom_1")
    )
    pair = hm.ContactPair(tags, 1, 2, friction=FRICTION, mortar=hm.MortarOptions(**options))
    zero = np.zeros_like(lower.points), np.zeros_like(upper.points)
    kinematics = Kinematics(pair, lower, upper, np.zeros(len(lower.nodes), bool), zero)
    return lower, upper, kinematics


@pytest.mark.mpi
def test_nodes_at_the_smallest_coverage_do_not_come_and_go(comm):
    lower, upper, kinematics = facing(comm, min_coverage=0.3)
    zero = np.zeros_like(lower.points), np.zeros_like(upper.points)
    end = int(np.argmin(lower.points[:, 0]))
    kept = {}
    for shift in (0.0, 0.1, 0.13, 0.1):
        kinematics.place((zero[0], zero[1] + [shift, 0.0]))
        coverage = kinematics.operator.coverage[end]
        kept.setdefault(shift, []).append((bool(kinematics.operator.kept[end]), coverage))
    # The end node stands for 0.1 m. Where its coverage is between half the limit and the limit it
    # stays what it was.
    assert 0.15 < kept[0.1][0][1] < 0.3 and kept[0.13][0][1] < 0.15
    assert [k for k, _ in kept[0.1]] == [True, False]
    assert kept[0.0][0][0] and not kept[0.13][0][0]

    # A rejected step leaves no trace.
    kinematics.place(zero)
    kinematics.start_step()
    between = zero[0], zero[1] + [0.1, 0.0]
    kinematics.place((zero[0], zero[1] + [0.13, 0.0]))
    kinematics.restart_step()
    kinematics.place(between)
    assert kinematics.operator.kept[end]


@pytest.mark.mpi
def test_edges_that_turn_within_a_step_do_not_come_and_go(comm):
    lower, upper, kinematics = facing(comm, largest_angle=40.0)

    def turned(degrees):
        """Displacements that turn the lower surface about the middle of the interface."""
        x, angle = lower.points - [0.5, 0.5], np.radians(degrees)
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        return x @ turn - x, np.zeros_like(upper.points)

    def seen(degrees):
        kinematics.place(turned(degrees))
        return kinematics.segments.weight.size > 0

    assert seen(39.0) and seen(41.0) and seen(39.0)
    start = kinematics.save()
    kinematics.place(turned(41.0))
    kinematics.start_step()
    assert not seen(41.0) and not seen(39.0)
    # Given up, and begun anew where it did.
    kinematics.restore(start)
    assert seen(41.0)
    states = kinematics.nodal_states()
    kinematics.set_nodal_states(states, lower.points.mean(axis=0), turned(41.0))
    assert not seen(39.0)
    kinematics.set_nodal_states(states, lower.points.mean(axis=0), turned(39.0))
    assert seen(41.0)
