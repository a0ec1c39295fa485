# SPDX-License-Identifier: LGPL-3.0-or-later
"""ContactProblem: condensed equations, Newton's method, reactions, interface, refusals."""

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix
from dolfinx.mesh import compute_midpoints

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.contact import (
    gather_surface,
    mortar_operator,
    mortar_segments,
    surface_dofs,
)
from fenicsx_hmcontact.gap_flow import film_conductance
from fenicsx_hmcontact.output.fields import evaluate
from tests.models import (
    GAMMA,
    LOAD,
    MATERIAL,
    Elastic,
    K,
    Porous,
    dense,
    fix,
    gathered,
    integral,
    largest,
    stack,
    total,
)

CLOSED = hm.GapFlow(1e-9)
OPEN = hm.GapFlow(1e-9, aperture=2e-4)
UPPER = [("bottom_1", "top_0", CLOSED)]
BASE = {("bottom_0", 0): 0.0, ("bottom_0", 1): 0.0}
ROLLERS = {("bottom_0", 1): 0.0} | {
    (f"{side}_{k}", 0): 0.0 for side in ("left", "right") for k in (0, 1)
}
PRESS = {"top_1": (0.2 * LOAD, -LOAD)}


def porous(comm, *, across=(4, 6), slope=0.2, domain=None, **options):
    """Two consolidating blocks under a load on the drained top."""
    options = dict(fixed=BASE, drained={"top_1": 0.0}, tractions=PRESS, pairs=UPPER) | options
    return Porous(domain or stack(comm, across, slope=slope), **options)


def elastic(comm, *, across=(4, 6), slope=0.2, domain=None, **options):
    """Two tied elastic blocks under a load."""
    options = dict(fixed=BASE, tractions=PRESS, pairs=[("bottom_1", "top_0", None)]) | options
    return Elastic(domain or stack(comm, across, slope=slope), **options)


# --- the condensed equations ---------------------------------------------------------------


def tangent_and_residual(problem, F):
    """Dense K and residual at zero of a form on triangles, assembled by DOLFINx."""
    unknowns = problem.unknowns
    spaces = [u.function_space for u in unknowns]
    trials = [ufl.TrialFunction(V) for V in spaces]
    forms = [F] if len(unknowns) == 1 else ufl.extract_blocks(F)
    blocks = [
        [ufl.derivative(f, u, du) for u, du in zip(unknowns, trials, strict=True)] for f in forms
    ]
    K = assemble_matrix(fem.form(blocks), kind="mpi")
    K.assemble()
    values = [u.x.array.copy() for u in unknowns]
    r = np.zeros(problem.layout.n_local)
    for u, form, view in zip(unknowns, forms, problem.layout.views(r), strict=True):
        for f in unknowns:
            f.x.array[:] = 0.0
        fem.assemble_vector(view, fem.form(form))
    for u, value in zip(unknowns, values, strict=True):
        u.x.array[:] = value
    problem.layout.add_ghosts_to_owners(r)
    return dense(K, problem.comm), gathered(problem, r)


def prescribed_values(problem):
    """Global numbers and values of the prescribed unknowns."""
    values = np.zeros(problem.layout.n_local)
    marks = np.zeros(problem.layout.n_local)
    for bc in problem.bcs:
        V = bc.function_space
        field = problem.layout.block_sizes.index(2 if V.component() else V.dofmap.index_map_bs)
        view = problem.layout.views(values)[field]
        bc.set(view)
        problem.layout.views(marks)[field][bc.dof_indices()[0]] = 1.0
    problem.layout.add_ghosts_to_owners(marks)
    return gathered(problem, marks) > 0.0, gathered(problem, values)


def coupling(model, prescribed):
    """Dense X, mask of secondary unknowns, and conductance of the film, of the model's pairs."""
    problem, layout = model.problem, model.problem.layout
    X = np.zeros((layout.n_global,) * 2)
    film = np.zeros_like(X)
    closed = np.zeros(layout.n_global, bool)
    for pair in model.pairs:
        mesh = model.domain.mesh
        s, m = (
            gather_surface(mesh, pair.facet_tags, tag, "") for tag in (pair.secondary, pair.primary)
        )
        segments = mortar_segments(s, m)
        for field, u in enumerate(problem.unknowns):
            bs = layout.block_sizes[field]
            if bs == 1 and pair.flow is None:
                continue
            V = u.function_space
            on_s, on_m = (layout.global_of_blocks(field, surface_dofs(x, V)) for x in (s, m))
            for c in range(bs):
                fixed = prescribed[on_s[:, c]]
                op = mortar_operator(s, m, segments, fixed if bs == 2 else None)
                rows = op.kept & ~fixed
                X[np.ix_(on_s[rows, c], on_m[:, c])] += op.H.toarray()[rows]
                X[np.ix_(on_s[rows, c], on_s[:, c])] -= op.C.toarray()[rows]
                open_film = bs == 1 and bool(pair.flow.aperture)
                closed[on_s[rows, c]] = not open_film
                if open_film:
                    dofs = np.concatenate((on_s[:, c], on_m[:, c]))
                    A = film_conductance(pair.flow, pair.flow.aperture, s, segments, op, fixed)
                    film[np.ix_(dofs, dofs)] += A.toarray()
    return X, closed, film


CASES = {
    "dry": lambda comm: elastic(comm, smoothing="triangles", fixed=BASE),
    "dry, rollers": lambda comm: elastic(comm, smoothing="triangles", fixed=ROLLERS),
    "porous": lambda comm: porous(comm, smoothing="triangles", fixed=ROLLERS),
    "open gap": lambda comm: porous(
        comm, smoothing="triangles", pairs=[("bottom_1", "top_0", OPEN)], dt=50.0
    ),
    "reservoir": lambda comm: porous(
        comm,
        smoothing="triangles",
        pairs=[("bottom_1", "top_0", OPEN)],
        drained={"top_1": 0.0, "left_1": 3e3, "left_0": 3e3},
    ),
    "chain": lambda comm: Elastic(
        stack(comm, (3, 5, 4), slope=0.2),
        smoothing="triangles",
        fixed=BASE,
        tractions={"top_2": (0.0, -LOAD)},
        pairs=[("top_0", "bottom_1", None), ("top_1", "bottom_2", None)],
    ),
    "impermeable": lambda comm: porous(
        comm,
        smoothing="triangles",
        pairs=[("bottom_1", "top_0", None)],
        drained={"top_1": 0.0, "bottom_0": 0.0},
    ),
}


@pytest.mark.mpi
@pytest.mark.parametrize("case", CASES)
def test_condensed_matrix_is_the_triple_product(comm, case):
    model = CASES[case](comm)
    problem = model.problem
    problem.solve()
    matrix, _ = tangent_and_residual(problem, model.F)
    prescribed, _ = prescribed_values(problem)
    X, closed, film = coupling(model, prescribed)
    T = np.linalg.inv(np.eye(len(X)) - X)
    expected = T.T @ matrix @ T
    if film.any():
        expected += model.dt.value * film
    free = ~(prescribed | closed)
    expected = np.where(np.outer(free, free), expected, np.diag(~free))
    scale = np.concatenate(comm.allgather(problem._linear.scale))
    result = dense(problem._linear.matrix, comm)
    scaled = expected * np.outer(scale, scale)
    assert closed.sum() > 4 or case == "open gap"
    assert np.abs(result - scaled).max() < 1e-12
    np.testing.assert_allclose(np.abs(np.diag(result)), 1.0, rtol=1e-12)


def lagrange(model):
    """The step's solution with multipliers on the couplings, as one dense system."""
    problem = model.problem
    matrix, r = tangent_and_residual(problem, model.F)
    prescribed, values = prescribed_values(problem)
    X, closed, _ = coupling(model, prescribed)
    B = (np.eye(len(X)) - X)[closed]
    scale = 1 / np.sqrt(np.abs(np.diag(matrix)))
    matrix = scale[:, None] * matrix * scale
    B = B * scale
    B /= np.linalg.norm(B, axis=1)[:, None]
    n, k = len(matrix), len(B)
    full = np.block([[matrix, B.T], [B, np.zeros((k, k))]])
    right = np.concatenate((-scale * r, np.zeros(k)))
    full[:n][prescribed] = np.eye(n + k)[:n][prescribed]
    right[:n][prescribed] = (values / scale)[prescribed]
    return scale * np.linalg.solve(full, right)[:n]


MOVING = {
    ("bottom_0", 0): lambda x: 1e-4 * x[0],
    ("bottom_0", 1): lambda x: 2e-4 * np.sin(x[0]),
    ("left_0", 0): -1e-5,
    ("left_1", 0): lambda x: 1e-5 * x[1],
}


@pytest.mark.mpi
@pytest.mark.parametrize("sides", ["secondary above", "secondary below"])
@pytest.mark.parametrize("kind", ["dry", "porous"])
def test_solution_is_that_of_lagrange_multipliers(comm, kind, sides):
    # Ends of both surfaces are prescribed, with values that vary.
    pair = ("bottom_1", "top_0") if sides == "secondary above" else ("top_0", "bottom_1")
    options = dict(smoothing="triangles", fixed=MOVING)
    if kind == "dry":
        model = elastic(comm, pairs=[(*pair, None)], **options)
        assert model.problem.solve().iterations == 1
    else:
        drained = {"top_1": 0.0, "right_0": lambda x: 2e3 + 1e3 * x[1]}
        model = porous(comm, pairs=[(*pair, CLOSED)], drained=drained, **options)
        model.step()
        model.p_n.interpolate(lambda x: 300 * x[0])
        model.problem.solve()
    expected = lagrange(model)
    layout = model.problem.layout
    result = gathered(model.problem, np.concatenate([u.x.array for u in model.problem.unknowns]))
    field = np.concatenate(comm.allgather(layout.field_of_owned()))
    for f in range(len(model.problem.unknowns)):
        size = np.abs(expected[field == f]).max()
        assert size > 0 and np.abs(result - expected)[field == f].max() < 1e-9 * size
    # Ghosts hold their owners' values.
    for u in model.problem.unknowns:
        before = u.x.array.copy()
        u.x.scatter_forward()
        np.testing.assert_array_equal(u.x.array, before)


@pytest.mark.mpi
def test_prescribed_values_may_change_from_step_to_step(comm):
    domain = stack(comm, (4, 6), slope=0.2)
    push = fem.Constant(domain.mesh, 0.0)
    # The primary surface's end is on the moving side.
    model = porous(
        comm,
        domain=domain,
        smoothing="triangles",
        fixed=BASE | {("right_0", 0): push, ("right_1", 0): push},
    )
    for value in (1e-4, -3e-4, -3e-4):
        push.value = value
        model.step()
        expected = lagrange(model)
        result = gathered(
            model.problem, np.concatenate([u.x.array for u in model.problem.unknowns])
        )
        scale = np.concatenate(comm.allgather(model.problem._linear.scale))
        free = ~prescribed_values(model.problem)[0]
        assert np.abs(result - expected)[~free].max() < 1e-15
        # Displacements and pressures of one size, in the scaling of the matrix.
        difference = np.where(free, result - expected, 0.0) / scale
        assert np.abs(difference).max() < 1e-9 * np.abs(expected / scale)[free].max()
    assert model.problem.n_factorisations == 1


@pytest.mark.mpi
@pytest.mark.parametrize("smoothing", ["deviatoric", "full", "triangles"])
def test_tangent_is_the_derivative_of_the_residual(comm, smoothing):
    # Water in an open gap, smoothing, and a term that is cubic.
    domain = stack(comm, (3, 4), slope=0.2)
    domain.mesh.topology.create_connectivity(1, 2)
    V, Q = (fem.functionspace(domain.mesh, ("P", 1, s)) for s in ((2,), ()))
    u, p = fem.Function(V, name="displacement"), fem.Function(Q, name="pore pressure")
    v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))
    dc = hm.node_cells_measure(smoothing)
    E = ufl.sym(ufl.grad(u) + ufl.grad(u).T * ufl.grad(u) / 2)
    F = ufl.inner((1 + ufl.tr(E)) * E, ufl.grad(v)) * dc - p * ufl.div(v) * ufl.dx
    F += ufl.div(u) * q * ufl.dx + (1 + p**2) * ufl.inner(ufl.grad(p), ufl.grad(q)) * dc
    F += ufl.dot(u, u) * ufl.dot(u, v) * ufl.ds + p * q * ufl.dx
    pair = hm.ContactPair(
        domain.facet_tags,
        domain.surface("bottom_1"),
        domain.surface("top_0"),
        flow=hm.GapFlow(2.0, 0.1, 1.0, aperture=0.7),
    )
    bcs = [fix(domain, V.sub(i), "bottom_0") for i in (0, 1)]
    bcs += [fix(domain, Q, "left_1")]
    step = fem.Constant(domain.mesh, 1.5)
    problem = hm.ContactProblem(F, [u, p], bcs=bcs, pairs=[pair], time_step=step)
    rng = np.random.default_rng(3)
    layout = problem.layout

    def perturb(a):
        """Add T a of condensed unknowns in global numbering."""
        local = a[layout.global_index]
        problem.condensation.expand(local)
        for f, view in zip((u, p), layout.views(local), strict=True):
            f.x.array[:] += view

    problem._update_tangent()
    free = np.concatenate(comm.allgather(problem._free))
    state, direction = (0.2 * np.where(free, rng.standard_normal(free.size), 0) for _ in range(2))
    perturb(state)
    problem._update_tangent()
    scale = np.concatenate(comm.allgather(problem._linear.scale))
    A = dense(problem._linear.matrix, comm) / np.outer(scale, scale)
    h, residuals = 1e-5, []
    for factor in (h, -2 * h):
        perturb(factor * direction)
        problem.residual()
        residuals.append(gathered(problem, problem._condensed))
    slope = (residuals[0] - residuals[1]) / (2 * h)
    expected = A @ direction
    assert np.abs(slope - expected)[free].max() < 1e-8 * np.abs(expected).max()


# --- the same answer on any number of ranks --------------------------------------------------

POINTS = np.array([(0.07, 0.11), (0.93, 0.3), (0.52, 0.77), (0.21, 0.9), (0.66, 0.96)])


@pytest.mark.mpi
@pytest.mark.parametrize("flow", [CLOSED, OPEN, None], ids=["closed", "open", "impermeable"])
@pytest.mark.parametrize("smoothing", ["deviatoric", "triangles"])
def test_ranks_do_not_matter(comm, smoothing, flow):
    results = []
    for c in (comm, MPI.COMM_SELF):
        model = porous(
            c,
            smoothing=smoothing,
            domain=stack(c, (4, 5), levels=[0, 0.6, 1], rows=20, slope=0.2),
            fixed=ROLLERS,
            drained={"top_1": 0.0, "bottom_0": 0.0},
            pairs=[("bottom_1", "top_0", flow)],
        )
        iterations = [model.step(dt).iterations for dt in (10.0, 100.0)]
        state = model.problem.interface(model.pairs[0])
        results.append(
            [
                evaluate(model.u, POINTS),
                evaluate(model.p, POINTS),
                state.pressure + state.pore_pressure,
                state.jump,
                model.outflow(),
                total(model.problem.reactions(model.u), model.domain)[1],
                iterations,
            ]
        )
        if c.size == 3:
            facets = c.allgather(sum(model.domain.facets(s).size for s in ("bottom_1", "top_0")))
            assert min(facets) == 0 < max(facets)
    for mine, serial, size in zip(*results, [1e-4, LOAD, LOAD, LOAD, 1e-7, LOAD, 1], strict=True):
        np.testing.assert_allclose(mine, serial, rtol=0, atol=1e-9 * size)


# --- what is allocated and factorised ------------------------------------------------------


@pytest.mark.mpi
def test_pairs_add_no_unknowns(comm):
    for model in (porous(comm), porous(comm, pairs=[("bottom_1", "top_0", OPEN)])):
        nodes = (5 + 7) * 4
        assert model.problem.n_unknowns == {"displacement": 2 * nodes, "pore pressure": nodes}
        model.problem.solve()
        assert model.problem._linear.matrix.getSize() == (3 * nodes,) * 2
    assert elastic(comm).problem.n_unknowns == {"displacement": 2 * nodes}


def test_without_flow_no_pressure_is_coupled(comm):
    model = porous(comm, pairs=[("bottom_1", "top_0", None)], drained={"top_1": 0.0})
    pressures = model.problem.layout.global_of_blocks(
        1, np.arange(model.Q.dofmap.index_map.size_global)
    )
    assert not np.isin(pressures, model.problem.condensation.unknowns).any()
    assert model.problem._film.nnz == 0


def part_of_volume_change(model, body):
    dx = ufl.Measure("dx", domain=model.domain.mesh, subdomain_data=model.domain.cell_tags)
    form = ufl.div(model.u - model.u_n) * dx(model.domain.body(body))
    return integral(fem.form(form), model.domain.mesh.comm)


@pytest.mark.mpi
def test_impermeable_interface_separates_the_water(comm):
    material = hm.LinearElastic(1e8, 0.0)
    options = dict(material=material, dt=50.0, tractions={"top_1": (0.0, -LOAD)})
    pairs = [("bottom_1", "top_0", None)]
    both = porous(
        comm,
        across=(8, 12),
        slope=0.0,
        fixed=ROLLERS,
        drained={"top_1": 0.0, "bottom_0": 0.0},
        pairs=pairs,
        **options,
    )
    alone = []
    for across, levels, drained in ((8, [0, 0.5], "bottom_0"), (12, [0.5, 1], "top_0")):
        alone.append(
            Porous(
                stack(comm, (across,), levels=levels),
                fixed={("bottom_0", 1): 0.0, ("left_0", 0): 0.0, ("right_0", 0): 0.0},
                drained={drained: 0.0},
                **options | {"tractions": {"top_0": (0.0, -LOAD)}},
            )
        )
    for _ in range(4):
        for model in (both, *alone):
            model.step()
        for body, drained in (("block_0", "bottom_0"), ("block_1", "top_1")):
            change = part_of_volume_change(both, body)
            assert both.outflow(drained) == pytest.approx(-change, rel=1e-12)
    # The column's share of the load is not quite uniform on triangles.
    for model, x in zip(alone, (POINTS[:2], POINTS[2:]), strict=True):
        assert np.abs(evaluate(both.p, x) - evaluate(model.p, x)).max() < 1e-2 * LOAD

    # Drained on top alone, the lower block keeps the whole load in its water for ever.
    sealed = porous(comm, slope=0.0, fixed=ROLLERS, pairs=pairs, **options)
    for dt in (50.0, 1e12, 1e12, 1e12):
        sealed.step(dt)
    expected = np.repeat([LOAD, 0.0], [2, 3])
    assert np.abs(evaluate(sealed.p, POINTS)[:, 0] - expected).max() < 1e-8 * LOAD
    state = sealed.problem.interface(sealed.pairs[0])
    np.testing.assert_array_equal(state.pore_pressure, 0.0)
    # Without a law for the water the pair carries all, grains and water together.
    assert np.abs(state.pressure[1:-1] - LOAD).max() < 1e-8 * LOAD


@pytest.mark.mpi
def test_scalar_problem_without_pairs(comm):
    # -div grad p = 6x - 2 with the cubic on the boundary, against the direct P1 solution.
    domain = stack(comm, (6,), rows=5, alternate=True)
    mesh = domain.mesh
    mesh.topology.create_connectivity(1, 2)
    Q = fem.functionspace(mesh, ("P", 1))
    p, q = fem.Function(Q, name="head"), ufl.TestFunction(Q)
    x = ufl.SpatialCoordinate(mesh)
    F = ufl.inner(ufl.grad(p), ufl.grad(q)) * ufl.dx - (6 * x[0] - 2) * q * ufl.dx
    sides = ("bottom_0", "top_0", "left_0", "right_0")
    bcs = [fix(domain, Q, name, lambda x: x[1] ** 2 - x[0] ** 3) for name in sides]
    problem = hm.ContactProblem(F, p, bcs=bcs)
    assert problem.solve().iterations == 1
    assert problem.node_cells is None and problem.n_unknowns == {"head": 42}

    a = ufl.inner(ufl.grad(ufl.TrialFunction(Q)), ufl.grad(q)) * ufl.dx
    A = assemble_matrix(fem.form(a))
    A.assemble()
    A = dense(A, comm)
    prescribed, values = prescribed_values(problem)
    b = np.zeros(problem.layout.n_local)
    fem.assemble_vector(b, fem.form((6 * x[0] - 2) * q * ufl.dx))
    problem.layout.add_ghosts_to_owners(b)
    b = gathered(problem, b) - A @ np.where(prescribed, values, 0)
    expected = np.where(prescribed, values, 0)
    free = ~prescribed
    expected[free] = np.linalg.solve(A[np.ix_(free, free)], b[free])
    np.testing.assert_allclose(gathered(problem, p.x.array), expected, rtol=0, atol=1e-13)


def test_smoothing_is_only_built_where_asked(comm):
    assert elastic(comm, smoothing="triangles").problem.node_cells is None
    assert elastic(comm).problem.node_cells is not None


@pytest.mark.mpi
@pytest.mark.parametrize("flow", [CLOSED, OPEN], ids=["closed", "open"])
def test_factorises_only_when_the_tangent_changes(comm, flow):
    model = porous(comm, pairs=[("bottom_1", "top_0", flow)])
    assert model.problem.n_factorisations == 0
    for _ in range(3):
        assert model.step(100.0).iterations == 1
    assert model.problem.n_factorisations == 1
    model.step(50.0)
    model.step(50.0)
    assert model.problem.n_factorisations == 2
    model.step(100.0)
    assert model.problem.n_factorisations == 3


def test_dry_problem_factorises_once(comm):
    domain = stack(comm, (4, 6))
    t = fem.Constant(domain.mesh, (0.0, -LOAD))
    model = elastic(comm, domain=domain, tractions={"top_1": t})
    model.problem.solve()
    first = total(model.u, domain)
    t.value = (0.0, -2 * LOAD)
    model.problem.solve()
    np.testing.assert_allclose(total(model.u, domain), 2 * first, rtol=1e-10)
    assert model.problem.n_factorisations == 1


def test_film_feels_a_changed_step_when_dry_terms_do_not(comm):
    # The step's length enters through the film alone: the form itself is steady.
    domain = stack(comm, (4, 4), slope=0.0)
    domain.mesh.topology.create_connectivity(1, 2)
    V, Q = (fem.functionspace(domain.mesh, ("P", 1, s)) for s in ((2,), ()))
    u, p = fem.Function(V, name="displacement"), fem.Function(Q, name="pore pressure")
    v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))
    F = ufl.inner(MATERIAL.stress(u), ufl.grad(v)) * ufl.dx
    F += ufl.inner(ufl.grad(p), ufl.grad(q)) * ufl.dx
    dt = fem.Constant(domain.mesh, 2.0)
    flow = hm.GapFlow(0.5, 1e9, 1.0, aperture=0.1)
    pair = hm.ContactPair(
        domain.facet_tags, domain.surface("bottom_1"), domain.surface("top_0"), flow=flow
    )
    bcs = [fix(domain, V.sub(0), "bottom_0"), fix(domain, V.sub(1), "bottom_0")]
    bcs += [fix(domain, Q, "top_1", 1.0), fix(domain, Q, "bottom_0", 0.0)]
    problem = hm.ContactProblem(F, [u, p], bcs=bcs, pairs=[pair], time_step=dt)
    for step in (2.0, 0.1):
        dt.value = step
        problem.solve()
        # Resistances in series: two half blocks, and the film.
        flow_through = 1.0 / (1.0 + 0.1 / 0.5 / step)
        assert -total(problem.reactions(p), domain, "bottom_0")[0] == pytest.approx(
            flow_through, rel=1e-10
        )
    assert problem.n_factorisations == 2


# --- Newton's method -------------------------------------------------------------------------


def scalar_problem(comm, make, start, **options):
    domain = stack(comm, (3,), rows=3)
    Q = fem.functionspace(domain.mesh, ("P", 1))
    p, q = fem.Function(Q, name="head"), ufl.TestFunction(Q)
    p.x.array[:] = start
    return p, hm.ContactProblem(make(p, q), p, **options)


@pytest.mark.mpi
def test_nonlinear_problem_converges_quadratically(comm):
    p, problem = scalar_problem(
        comm,
        lambda p, q: (p**3 - 8) * q * ufl.dx + ufl.inner(ufl.grad(p), ufl.grad(q)) * ufl.dx,
        3.0,
    )
    result = problem.solve()
    np.testing.assert_allclose(p.x.array, 2.0, rtol=1e-12)
    assert problem.n_factorisations == result.iterations == 5
    errors = [h[0] for h in result.history]
    assert errors[-1] < 1e-10 and errors[3] < 10 * errors[2] ** 2


@pytest.mark.mpi
def test_no_solution_is_reported(comm):
    _, problem = scalar_problem(
        comm,
        lambda p, q: (p**2 + 1) * q * ufl.dx,
        0.7,
        newton=hm.NewtonOptions(max_iterations=6),
    )
    with pytest.raises(hm.ConvergenceError, match="6 iterations: the residual of head") as error:
        problem.solve()
    assert len(error.value.history) == 6


@pytest.mark.mpi
def test_solid_creeps_where_newtons_method_fails(comm):
    domain = stack(comm, (3,), rows=3)
    V = fem.functionspace(domain.mesh, ("P", 1, (2,)))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    # Springs whose left branch ends just before this load; neighbours pull each other along.
    force = ufl.as_vector([u[i] ** 3 - 3 * u[i] - 2.01 for i in range(2)])
    F = ufl.inner(force, v) * ufl.dx + ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx
    problem = hm.ContactProblem(F, u, newton=hm.NewtonOptions(max_iterations=6))
    u.x.array[:] = -1.3
    with pytest.raises(hm.ConvergenceError):
        problem.solve()
    problem.newton = hm.NewtonOptions(max_iterations=6, relaxation=0.1)
    problem.solve()
    np.testing.assert_allclose(u.x.array**3 - 3 * u.x.array, 2.01, rtol=1e-9)
    assert u.x.array.min() > 2.0
    # No dashpot is left in the matrix.
    assert problem.solve().iterations == 1
    u.x.array[:] = 1.5
    found = []
    for damping in (0.0, 1.0):
        problem.residual()
        problem.increment(damping)
        problem.move(-1.0)
        found.append((problem.farthest, problem.condition_number()))
    (plain, condition), (damped, same) = found
    assert damped < 0.9 * plain and same == pytest.approx(condition, rel=1e-9)


@pytest.mark.mpi
def test_nothing_creeps_without_a_displacement(comm):
    relaxed = {"newton": hm.NewtonOptions(relaxation=0.1)}
    _, problem = scalar_problem(comm, lambda p, q: (p**2 - 1) * q * ufl.dx, 0.7, **relaxed)
    with pytest.raises(ValueError, match="needs a displacement, not only head"):
        problem.solve()


@pytest.mark.mpi
def test_not_a_number_names_the_field(comm):
    _, problem = scalar_problem(comm, lambda p, q: (ufl.ln(p) + 3) * q * ufl.dx, -1.0)
    with pytest.raises(hm.ConvergenceError, match="residual of head is not a number"):
        problem.solve()


@pytest.mark.mpi
def test_a_step_to_where_there_is_no_residual_is_cut(comm):
    # The first increment leads where the logarithm is not defined.
    p, problem = scalar_problem(comm, lambda p, q: (ufl.ln(p) + 3) * q * ufl.dx, 1.0)
    assert min(problem.solve().lengths) < 1.0
    np.testing.assert_allclose(p.x.array, np.exp(-3.0), rtol=1e-9)


@pytest.mark.mpi
def test_not_a_number_at_the_start_names_the_field(comm):
    _, problem = scalar_problem(comm, lambda p, q: (ufl.ln(p) + 3) * q * ufl.dx, -1.0)
    with pytest.raises(hm.ConvergenceError, match="residual of head is not a number"):
        problem.solve()


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("never held", "bodies 'block_0' and 'block_1' together have no support.*x and y and turn"),
        ("free to slide", "bodies 'block_0' and 'block_1' together.*can move along x$"),
        ("parted from the other", "body 'block_1' has no support and no closed contact"),
    ],
)
def test_unsupported_body_is_reported(comm, kind, message):
    domain = stack(comm, (4, 6))
    model = elastic(
        comm,
        domain=domain,
        pairs=[] if kind.startswith("parted") else [("bottom_1", "top_0", None)],
        fixed={"never held": {}, "free to slide": {("bottom_0", 1): 0.0}}.get(kind, BASE),
    )
    with pytest.raises(hm.SingularSystemError, match=message):
        model.problem.solve()


@pytest.mark.mpi
def test_options_reach_the_solver(comm):
    reference = porous(comm)
    reference.step()
    for options, types in (
        (
            {"ksp_type": "gmres", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps"},
            ("gmres", "mumps"),
        ),
        (
            {
                "ksp_type": "preonly",
                "pc_type": "lu",
                "pc_factor_mat_solver_type": "superlu_dist",
            },
            ("preonly", "superlu_dist"),
        ),
    ):
        model = porous(comm, petsc_options=options)
        model.step()
        ksp = model.problem._linear.ksp
        assert (ksp.type, ksp.pc.getFactorSolverType()) == types
        assert largest(model.p.x.array - reference.p.x.array, comm) < 1e-8 * LOAD


# --- balances --------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize("flow", [CLOSED, OPEN, None], ids=["closed", "open", "impermeable"])
@pytest.mark.parametrize("fixed", [BASE, ROLLERS], ids=["clamped", "rollers"])
def test_forces_and_water_balance(comm, fixed, flow):
    model = porous(
        comm,
        fixed=fixed,
        slope=0.3,
        pairs=[("bottom_1", "top_0", flow)],
        drained={"top_1": 0.0, "bottom_0": 0.0},
    )
    for dt in (20.0, 20.0, 100.0, 500.0):
        model.step(dt)
        support = total(model.problem.reactions(model.u), model.domain)
        np.testing.assert_allclose(support, [-0.2 * LOAD, LOAD], rtol=0, atol=1e-12 * LOAD)
        lost = -integral(model.volume_change, comm)
        assert model.outflow() == pytest.approx(lost, rel=1e-12)
        parts = sum(model.outflow(name) for name in ("top_1", "bottom_0"))
        assert model.outflow() == pytest.approx(parts, rel=1e-12)


@pytest.mark.mpi
def test_reactions_are_zero_at_free_unknowns(comm):
    model = porous(comm)
    model.step()
    free = total(model.problem.reactions(model.u), model.domain, "top_1")
    np.testing.assert_array_equal(free, 0.0)
    with pytest.raises(ValueError, match="none of the unknowns displacement, pore pressure"):
        model.problem.reactions(model.u_n)


@pytest.mark.mpi
@pytest.mark.parametrize("secondary", [("bottom_1", "top_0"), ("top_0", "bottom_1")])
@pytest.mark.parametrize("smoothing", ["deviatoric", "full", "triangles"])
def test_rigid_motion_makes_no_stress(comm, smoothing, secondary):
    def motion(x):
        return np.array([2e-3 - 5e-3 * x[1], -1e-3 + 5e-3 * x[0]])

    model = elastic(
        comm,
        slope=0.3,
        smoothing=smoothing,
        tractions={},
        pairs=[(*secondary, None)],
        fixed={("bottom_0", None): motion},
    )
    model.problem.solve()
    exact = fem.Function(model.V)
    exact.interpolate(motion)
    assert largest(model.u.x.array - exact.x.array, comm) < 1e-12 * 5e-3
    state = model.problem.interface(model.pairs[0])
    stress = 1e-11 * MATERIAL.E * 5e-3
    assert np.abs(state.pressure).max() < stress and np.abs(state.shear).max() < stress
    assert largest(model.problem.reactions(model.u).x.array, comm) < stress


# --- what acts between the surfaces ----------------------------------------------------------


def nodal_lengths(state):
    """Length of the surface that belongs to each of its nodes, in the order of a straight one."""
    order = np.argsort(state.points[:, 0])
    gaps = np.linalg.norm(np.diff(state.points[order], axis=0), axis=1) / 2
    lengths = np.empty(len(order))
    lengths[order] = np.append(gaps, 0) + np.insert(gaps, 0, 0)
    return lengths


@pytest.mark.mpi
@pytest.mark.parametrize("slope", [0.0, 0.3, -0.6])
@pytest.mark.parametrize("smoothing", ["deviatoric", "triangles"])
def test_tractions_of_a_patch(comm, slope, smoothing):
    stress = np.array([[-0.4, 0.25], [0.25, -1.0]]) * LOAD
    strain = (1 + MATERIAL.nu) * (stress - MATERIAL.nu * np.trace(stress) * np.eye(2)) / MATERIAL.E
    domain = stack(comm, (7, 11), slope=slope)
    sides = {"left": (-1, 0), "right": (1, 0)}
    tractions = {f"{side}_{k}": stress @ normal for side, normal in sides.items() for k in (0, 1)}
    model = elastic(
        comm,
        domain=domain,
        smoothing=smoothing,
        fixed={("bottom_0", None): lambda x: strain @ x[:2]},
        tractions=tractions | {"top_1": stress @ (0, 1)},
    )
    assert model.problem.solve().iterations == 1
    state = model.problem.interface(model.pairs[0])
    normal = np.array([-slope, 1.0]) / np.hypot(slope, 1)
    tangent = np.array([normal[1], -normal[0]])
    np.testing.assert_allclose(state.normals, np.tile(normal, (12, 1)), atol=1e-14)
    assert np.abs(state.pressure + normal @ stress @ normal).max() < 1e-12 * LOAD
    # What acts on the secondary body above, whose outward normal is -n.
    assert np.abs(state.shear + tangent @ stress @ normal).max() < 1e-12 * LOAD
    np.testing.assert_array_equal(state.pore_pressure, 0.0)
    np.testing.assert_array_equal(state.jump, 0.0)


@pytest.mark.mpi
@pytest.mark.parametrize("slope", [0.0, 0.3])
@pytest.mark.parametrize("flow", [CLOSED, OPEN], ids=["closed", "open"])
def test_interface_carries_the_load(comm, flow, slope):
    model = porous(comm, slope=slope, pairs=[("bottom_1", "top_0", flow)])
    for dt in (10.0, 100.0, 1e4):
        model.step(dt)
        state = model.problem.interface(model.pairs[0])
        length = nodal_lengths(state)
        n = state.normals
        t = np.column_stack((n[:, 1], -n[:, 0]))
        total_traction = (state.pressure + state.pore_pressure)[:, None] * n
        total_traction += state.shear[:, None] * t
        # From primary to secondary, against the load on the top.
        np.testing.assert_allclose(
            length @ total_traction, [-0.2 * LOAD, LOAD], rtol=0, atol=1e-11 * LOAD
        )


@pytest.mark.mpi
def test_column_shares_the_load_between_grains_and_water(comm):
    deviations = []
    for across, rows in (((4, 6), 3), ((16, 24), 12)):
        model = porous(
            comm,
            domain=stack(comm, across, rows=rows),
            fixed=ROLLERS,
            tractions={"top_1": (0.0, -LOAD)},
            material=hm.LinearElastic(1e8, 0.0),
        )
        deviation = 0.0
        # The first step only overcomes the jump under the drained top.
        model.step(10.0)
        for dt in (1e3, 1e4, 1e8):
            model.step(dt)
            state = model.problem.interface(model.pairs[0])
            # The ends on rollers have no shear traction, but a pressure.
            assert np.isnan(state.shear).sum() == 2
            carried = (state.pressure + state.pore_pressure) / LOAD
            deviation = max(deviation, np.abs(carried - 1).max())
        assert np.abs(state.pore_pressure).max() < 1e-3 * LOAD
        deviations.append(deviation)
    # The film's water is interpolated along the surface, the blocks' on triangles: second order.
    assert deviations[1] < 1.5e-3 and deviations[1] < deviations[0] / 8


@pytest.mark.mpi
@pytest.mark.parametrize("flow", [CLOSED, OPEN], ids=["closed", "open"])
def test_effective_pressure_under_uniform_pore_pressure(comm, flow):
    water = 0.3 * LOAD
    model = porous(
        comm,
        slope=0.3,
        pairs=[("bottom_1", "top_0", flow)],
        drained={"top_1": water, "bottom_0": water},
        tractions={
            "top_1": (0.0, -LOAD),
            **{f"left_{k}": (water, 0.0) for k in (0, 1)},
            **{f"right_{k}": (-water, 0.0) for k in (0, 1)},
        },
        material=hm.LinearElastic(1e8, 0.0),
        fixed={("bottom_0", 0): 0.0, ("bottom_0", 1): 0.0},
    )
    for _ in range(3):
        model.step(1e12)
    state = model.problem.interface(model.pairs[0])
    n = state.normals
    effective = (LOAD - water) * n[:, 1] ** 2
    assert np.abs(state.pore_pressure - water).max() < 1e-9 * LOAD
    assert np.abs(state.jump).max() < 1e-9 * LOAD
    assert np.abs(state.pressure - effective).max() < 1e-8 * LOAD
    assert np.abs(state.shear + (LOAD - water) * n[:, 1] * n[:, 0]).max() < 1e-8 * LOAD


def test_interface_of_a_foreign_pair_is_refused(comm):
    model, other = elastic(comm), elastic(comm)
    with pytest.raises(ValueError, match="none of this problem's"):
        model.problem.interface(other.pairs[0])


# --- units -----------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.parametrize("aperture", [None, 2e-4], ids=["closed", "open"])
def test_units_do_not_matter(comm, aperture):
    answers = []
    for m, N, s in ((1.0, 1.0, 1.0), (1e3, 1e-3, 1 / 86400)):
        Pa = N / m**2
        domain = stack(comm, (4, 6), width=m, levels=np.array([0, 0.5, 1]) * m, slope=0.2)
        flow = hm.GapFlow(
            1e-9 * m / s,
            1e-3 * Pa * s,
            GAMMA * N / m**3,
            None if aperture is None else aperture * m,
        )
        model = Porous(
            domain,
            fixed=ROLLERS,
            drained={"top_1": 0.0},
            tractions={"top_1": (0.0, -LOAD * Pa)},
            pairs=[("bottom_1", "top_0", flow)],
            material=hm.LinearElastic(1e8 * Pa, 0.2),
            permeability=K * m / s,
            unit_weight=GAMMA * N / m**3,
        )
        iterations = [model.step(dt * s).iterations for dt in (20.0, 20.0, 500.0)]
        state = model.problem.interface(model.pairs[0])
        answers.append(
            [
                evaluate(model.u, POINTS * m) / m * 1e4,
                evaluate(model.p, POINTS * m) / (LOAD * Pa),
                state.pressure / (LOAD * Pa),
                model.outflow() / m**2 * 1e6,
                iterations,
            ]
        )
    for si, other in zip(*answers, strict=True):
        np.testing.assert_allclose(si, other, rtol=0, atol=1e-10)


# --- refusals --------------------------------------------------------------------------------


@pytest.fixture
def parts(comm):
    """Spaces, unknowns and a form that fit together."""
    domain = stack(comm, (3, 4))
    domain.mesh.topology.create_connectivity(1, 2)
    V, Q = (fem.functionspace(domain.mesh, ("P", 1, s)) for s in ((2,), ()))
    u, p = fem.Function(V, name="displacement"), fem.Function(Q, name="pore pressure")
    v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))
    F = ufl.inner(MATERIAL.stress(u), ufl.grad(v)) * ufl.dx + p * q * ufl.dx
    return domain, V, Q, u, p, v, q, F


def pair_of(domain, secondary="bottom_1", primary="top_0", **options):
    return hm.ContactPair(
        domain.facet_tags, domain.surface(secondary), domain.surface(primary), **options
    )


@pytest.mark.mpi
def test_refuses_a_wrong_number_of_unknowns(parts):
    _, V, _, u, p, _, _, F = parts
    with pytest.raises(ValueError, match="3 unknowns need a residual with 3 test functions"):
        hm.ContactProblem(F, [u, p, fem.Function(V)])


@pytest.mark.mpi
def test_refuses_a_field_without_equation(parts):
    _, _, _, u, p, v, _, _ = parts
    F = ufl.inner(MATERIAL.stress(u), ufl.grad(v)) * ufl.dx
    with pytest.raises(ValueError, match="unknown"):
        hm.ContactProblem(F, [u, p])
    with pytest.raises(ValueError, match="the residual has no equation for pore pressure"):
        hm.ContactProblem([F, None], [u, p])


@pytest.mark.mpi
def test_refuses_conditions_on_foreign_spaces(parts):
    domain, _, _, u, p, _, _, F = parts
    other = fem.functionspace(domain.mesh, ("P", 1, (2,)))
    with pytest.raises(ValueError, match="none of the fields displacement, pore pressure"):
        hm.ContactProblem(F, [u, p], bcs=[fix(domain, other.sub(0), "bottom_0")])


@pytest.mark.mpi
def test_refuses_quadratic_fields_in_contact(comm):
    with pytest.raises(ValueError, match=r"pair .*: contact needs P1 fields, displacement is of"):
        porous(comm, degree=2, smoothing="triangles", tau=0.0)


@pytest.mark.mpi
def test_refuses_flow_without_pressure(comm):
    with pytest.raises(ValueError, match="needs one scalar field, the pore pressure; there are 0"):
        elastic(comm, pairs=UPPER)


@pytest.mark.mpi
def test_refuses_an_aperture_without_time_step(parts):
    domain, *_, u, p, _, _, F = parts
    with pytest.raises(ValueError, match="in its gap: the problem needs time_step"):
        hm.ContactProblem(F, [u, p], pairs=[pair_of(domain, flow=OPEN, name="crack")])


@pytest.mark.mpi
def test_refuses_a_pair_without_displacement(parts):
    domain, _, Q, _, p, _, _, _ = parts
    F = p * ufl.TestFunction(Q) * ufl.dx
    with pytest.raises(ValueError, match="pair crack: there is no displacement to couple"):
        hm.ContactProblem(F, p, pairs=[pair_of(domain, flow=CLOSED, name="crack")])


@pytest.mark.mpi
@pytest.mark.parametrize("component", [0, None])
def test_refuses_a_secondary_surface_wholly_prescribed(comm, component):
    value = 0.0 if component == 0 else lambda x: 0 * x[:2]
    with pytest.raises(ValueError, match="is prescribed at all its nodes; swap secondary"):
        elastic(comm, fixed=BASE | {("bottom_1", component): value})


@pytest.mark.mpi
def test_refuses_neighbouring_prescribed_nodes_of_a_secondary_surface(comm):
    domain = stack(comm, (4, 6))
    model = elastic(comm, domain=domain)
    facets = domain.facet_tags.find(domain.surface("bottom_1"))
    facets = facets[compute_midpoints(domain.mesh, 1, facets)[:, 0] < 0.2]
    dofs = fem.locate_dofs_topological(model.V.sub(1), 1, facets)
    bcs = [*model.problem.bcs, fem.dirichletbc(0.0, dofs, model.V.sub(1))]
    with pytest.raises(ValueError, match="pair base: neighbouring nodes of the secondary surface"):
        hm.ContactProblem(model.F, model.u, bcs=bcs, pairs=[pair_of(domain, name="base")])
    # The other way round the prescribed nodes are primary.
    pair = pair_of(domain, "top_0", "bottom_1")
    assert hm.ContactProblem(model.F, model.u, bcs=bcs, pairs=[pair]).solve().iterations == 1


@pytest.mark.mpi
def test_refuses_flow_with_two_scalar_fields(comm):
    domain = stack(comm, (3, 4))
    spaces = [fem.functionspace(domain.mesh, ("P", 1, s)) for s in ((2,), (), ())]
    fields = [fem.Function(V) for V in spaces]
    tests = ufl.TestFunctions(ufl.MixedFunctionSpace(*spaces))
    F = sum(ufl.inner(f, v) * ufl.dx for f, v in zip(fields, tests, strict=True))
    with pytest.raises(ValueError, match="needs one scalar field, the pore pressure; there are 2"):
        hm.ContactProblem(F, fields, pairs=[pair_of(domain, flow=CLOSED)])


@pytest.mark.mpi
def test_refuses_surfaces_too_far_apart(comm):
    domain = stack(comm, (6, 5, 4), levels=[0.0, 0.05, 0.95, 1.0])
    options = dict(domain=domain, tractions={}, fixed=BASE)
    with pytest.raises(ValueError, match="faces no primary edge within the search radius"):
        model = elastic(comm, **options, pairs=[])
        pair = pair_of(domain, "bottom_2", "top_0", mortar=hm.MortarOptions(search_radius=0.5))
        hm.ContactProblem(model.F, model.u, pairs=[pair])


@pytest.mark.mpi
def test_refuses_a_surface_paired_with_itself(parts):
    with pytest.raises(ValueError, match="secondary and primary surface are the same"):
        pair_of(parts[0], "top_0", "top_0")


@pytest.mark.mpi
def test_refuses_a_surface_that_does_not_exist(parts):
    domain, *_, u, p, _, _, F = parts
    pair = hm.ContactPair(domain.facet_tags, 77, domain.surface("top_0"))
    with pytest.raises(ValueError, match="77"):
        hm.ContactProblem(F, [u, p], pairs=[pair])


@pytest.mark.mpi
def test_refuses_a_node_that_is_secondary_twice(comm):
    with pytest.raises(ValueError, match="secondary surfaces of two pairs"):
        elastic(comm, pairs=[("bottom_1", "top_0", None)] * 2)


@pytest.mark.mpi
def test_refuses_pairs_in_a_circle(comm):
    with pytest.raises(ValueError, match="depend on each other in a circle"):
        elastic(comm, pairs=[("bottom_1", "top_0", None), ("top_0", "bottom_1", None)])


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"search_radius": 0.0}, "search_radius"),
        ({"search_radius": np.nan}, "search_radius"),
        ({"min_coverage": 0.5}, "min_coverage"),
        ({"min_coverage": -0.1}, "min_coverage"),
    ],
)
def test_refuses_mortar_options(options, name):
    with pytest.raises(ValueError, match=name):
        hm.MortarOptions(**options)


@pytest.mark.parametrize(
    ("values", "name"),
    [((0.0, 0.3), "E is"), ((-1.0, 0.3), "E is"), ((np.nan, 0.3), "E is"), ((1.0, 0.5), "nu is")],
)
def test_refuses_materials(values, name):
    with pytest.raises(ValueError, match=name):
        hm.LinearElastic(*values)


def test_pairs_are_named_by_their_tags(parts):
    domain = parts[0]
    s, m = domain.surface("bottom_1"), domain.surface("top_0")
    assert pair_of(domain).name == f"{s}/{m}"
    assert pair_of(domain, name="base").name == "base"
