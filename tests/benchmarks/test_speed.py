# SPDX-License-Identifier: LGPL-3.0-or-later
"""Speed and memory of the smoothed u-p form, as ratios within one run; run with -m benchmark -s.

Nothing here asserts a time: machines differ and are shared. The tests print a table; what they
assert is that both sides of a ratio did the same work.
"""

import os
import subprocess
import sys
import time

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh
from dolfinx.fem import petsc

import fenicsx_hmcontact as hm
from tests.models import fix, loads, stack

pytestmark = [pytest.mark.benchmark, pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="serial")]


def model(n, smoothing):
    """Smoothed or plain u-p model on n x n squares: form, unknowns, conditions."""
    domain = mesh.create_rectangle(MPI.COMM_WORLD, [[0.0, 0.0], [1.0, 1.0]], [n, n])
    V = fem.functionspace(domain, ("P", 1, (2,)))
    Q = fem.functionspace(domain, ("P", 1))
    u, p = fem.Function(V, name="u"), fem.Function(Q, name="p")
    u_n, p_n = fem.Function(V), fem.Function(Q)
    v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))
    material = hm.LinearElastic(1e8, 0.3)
    dt = fem.Constant(domain, 5.0)
    k = fem.Constant(domain, 1e-9 * np.eye(2))
    dc = hm.node_cells_measure(smoothing)
    F = hm.equilibrium(material.stress(u), p, v, smoothed=dc)
    F += hm.water_balance(u, u_n, p, q, dt, permeability=k, unit_weight=1e4, smoothed=dc)
    F += hm.pressure_projection(p, p_n, q, material.shear_modulus)
    F += 1e4 * v[1] * ufl.ds
    bottom = fem.locate_dofs_geometrical(V, lambda x: np.isclose(x[1], 0.0))
    top = fem.locate_dofs_geometrical(Q, lambda x: np.isclose(x[1], 1.0))
    bcs = [fem.dirichletbc(np.zeros(2), bottom, V), fem.dirichletbc(0.0, top, Q)]
    return F, [u, p], bcs


def seconds(action, repetitions=5):
    """Least process time of an action [s]."""
    times = []
    for _ in range(repetitions):
        start = time.process_time()
        action()
        times.append(time.process_time() - start)
    return min(times)


def smoothed_assembly(n):
    """Problem after one solve, and the process times of its residual, tangent and linear solve."""
    F, unknowns, bcs = model(n, "deviatoric")
    problem = hm.ContactProblem(F, unknowns, bcs=bcs)
    problem.solve()
    residual = seconds(problem.residual)

    def tangent():
        problem._matrix.assemble()
        problem._system.set_values(problem._added_matrix())

    assemble = seconds(tangent)
    b = np.ones(problem.layout.owned.size)

    def solve():
        problem._linear.set_values(problem._matrix.values)
        problem._linear.solve(b)

    return problem, residual, assemble, seconds(solve, 2)


def test_cost_against_plain_assembly_of_dolfinx():
    n = 223
    problem, residual, tangent, solve = smoothed_assembly(n)
    F, unknowns, bcs = model(n, "triangles")
    blocks = list(ufl.extract_blocks(F))
    trials = [ufl.TrialFunction(u.function_space) for u in unknowns]
    directions = list(zip(unknowns, trials, strict=True))
    J = fem.form([[ufl.derivative(f, u, du) for u, du in directions] for f in blocks])
    L = fem.form(blocks)
    A = petsc.create_matrix(J, kind="mpi")
    b = petsc.create_vector([u.function_space for u in unknowns], kind="mpi")

    def plain_matrix():
        A.zeroEntries()
        petsc.assemble_matrix(A, J, bcs)
        A.assemble()

    plain = seconds(plain_matrix) + seconds(lambda: petsc.assemble_vector(b, L))
    assert A.size[0] == problem.layout.n_global
    nodes = (n + 1) ** 2
    print(f"\n{nodes} nodes, process seconds")
    print(f"  residual {residual:.3f}, tangent {tangent:.3f}, linear solve {solve:.2f}")
    print(f"  DOLFINx, plain P1, the same form: {plain:.3f}")
    print(f"  smoothed / plain: {(residual + tangent) / plain:.2f}")
    print(f"  a step without its linear solve / solve: {(2 * residual + tangent) / solve:.2f}")


def test_growth_with_the_number_of_nodes():
    print("\n   nodes   residual   tangent   [microseconds a node]   linear solve")
    for n in (100, 173, 316):
        problem, residual, tangent, solve = smoothed_assembly(n)
        nodes = (n + 1) ** 2
        assert problem.layout.n_global == 3 * nodes
        per_node = 1e6 / nodes
        print(
            f"  {nodes:6d}   {residual * per_node:8.2f}   {tangent * per_node:7.2f}"
            f"   {solve * per_node:35.2f}"
        )


def test_memory_of_assembly():
    n = 223
    F, unknowns, bcs = model(n, "deviatoric")
    problem = hm.ContactProblem(F, unknowns, bcs=bcs)
    problem.solve()
    entries = problem._linear.matrix.getInfo()["nz_used"]
    matrix = 12.0 * entries
    arrays = sum(
        array.nbytes
        for block in problem._matrix._blocks
        for array in (block.indptr, block.indices, *(t._positions for t in block.terms))
    )
    arrays += problem._matrix.values.nbytes
    # PETSc keeps two 8-byte indices an entry to sum entries in coordinate form.
    coordinate_form = 16.0 * entries
    assert entries > 0
    print(f"\nmatrix {matrix / 1e6:.0f} MB")
    print(f"  arrays of the assembly / matrix: {arrays / matrix:.2f}")
    print(f"  PETSc's maps of the coordinate form / matrix: {coordinate_form / matrix:.2f}")


def test_first_and_later_starts(tmp_path):
    script = "import sys; sys.path.insert(0, '.'); sys.argv = ['x', '--schedule', '1x5']; " + (
        "import demos.two_block_consolidation as d; o = d.parser().parse_args(); "
        "c = d.Column(o, 'deviatoric', 1.0); c.step(5.0)"
    )
    environment = os.environ | {
        "XDG_CACHE_HOME": str(tmp_path / "forms"),
        "NUMBA_CACHE_DIR": str(tmp_path / "numba"),
    }
    times = []
    for _ in range(2):
        start = time.perf_counter()
        subprocess.run([sys.executable, "-c", script], env=environment, check=True)
        times.append(time.perf_counter() - start)
    assert any((tmp_path / "forms").rglob("*.so"))
    print(f"\nfirst start, everything compiled: {times[0]:.1f} s; later: {times[1]:.1f} s")


def test_cost_of_frictional_contact():
    domain = stack(MPI.COMM_WORLD, (208, 270), rows=208)
    V = fem.functionspace(domain.mesh, ("P", 1, (2,)))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    F = ufl.inner(hm.LinearElastic(100.0, 0.3).stress(u), ufl.grad(v)) * hm.dc
    F += loads(domain, v, {"top_1": (0.0, -1.0)})
    bcs = [fix(domain, V.sub(i), "bottom_0", 0.0) for i in (0, 1)]
    bcs.append(fix(domain, V.sub(0), "top_1", 0.01))
    surfaces = domain.surface("bottom_1"), domain.surface("top_0")
    pair = hm.ContactPair(domain.facet_tags, *surfaces, friction=hm.CoulombFriction(0.3))
    problem = hm.ContactProblem(F, u, bcs=bcs, pairs=[pair])
    problem.solve()
    (coupling,), condensation, system = problem._sliding, problem.condensation, problem._system
    current = problem._current()

    def bulk():
        problem._matrix.assemble()
        view = np.zeros(problem.layout.n_local)
        for term in problem._vector_terms[0]:
            term.add_to_vector(view)

    def contact():
        coupling.place(current)
        condensation.couple(problem._dependences)
        transmitted = problem._raw.copy()
        condensation.transmit(transmitted)
        coupling.update(transmitted, problem._diagonal)
        condensation.constrain(problem._dependences)
        condensation.condense(problem._raw.copy(), condensation.offset)
        maps = condensation.tests, condensation.transformation
        for pattern, matrix in zip((system._tests, system._trials), maps, strict=True):
            pattern.admit(matrix)
        system._expand(*maps)

    times = seconds(bulk), seconds(contact)
    print(
        f"\n{V.dofmap.index_map.size_global} nodes, {len(coupling.status.closed)} of them in pairs"
    )
    print(f"assembly {times[0]:.4f} s, contact {times[1]:.4f} s: {times[1] / times[0]:.3f}")
    assert times[1] < 0.1 * times[0]
