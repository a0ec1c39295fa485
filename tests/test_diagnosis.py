# SPDX-License-Identifier: LGPL-3.0-or-later
"""Which bodies nothing holds and which pressures nothing sets, in words."""

from mpi4py import MPI  # noqa: F401

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import create_submesh

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.diagnosis import free_motions
from fenicsx_hmcontact.domain import Domain
from fenicsx_hmcontact.solvers import SingularSystemError
from tests.models import Elastic, Porous, fix, stack

pytestmark = pytest.mark.mpi

BASE = {("bottom_0", None): np.zeros(2)}
TIED = [("bottom_1", "top_0", None)]
UNSUPPORTED = "has no support and no closed contact: it can move along x and y and turn"


def singular(problem, domain=None):
    """What is free after a solve that has failed for it."""
    with pytest.raises(SingularSystemError):
        problem.solve()
    return free_motions(problem, domain)


def resting(domain, law=None, *, fixed=BASE, lift=0.0, names=("bottom_1", "top_0"), **options):
    """The problem of a block on another one, first lifted off."""
    m = Elastic(domain, fixed=fixed, tractions={"top_1": (1e3, -1e3)})
    secondary, primary = (domain.surface(name) for name in names)
    law = hm.Frictionless() if law is None else law
    pair = hm.ContactPair(domain.facet_tags, secondary, primary, friction=law, **options)
    upper = domain.cell_tags.find(domain.body("block_1"))
    m.u.interpolate(lambda x: np.vstack((0.0 * x[0], lift + 0.0 * x[0])), cells0=upper)
    m.u.x.scatter_forward()
    return hm.ContactProblem(m.F, m.u, bcs=m.problem.bcs, pairs=[pair])


def turned(domain, angle, move=(0.0, 0.0)):
    """Turn a mesh about the origin, then move it."""
    c, s = np.cos(angle), np.sin(angle)
    # Term by term: a product of matrices may round shared nodes differently on each rank.
    x, y, _ = domain.mesh.geometry.x.T
    x[:], y[:] = c * x - s * y + move[0], s * x + c * y + move[1]
    return domain


# --- one body -----------------------------------------------------------------------------------


@pytest.mark.parametrize("smoothing", ["deviatoric", "triangles"])
def test_a_free_block_has_three_motions(comm, smoothing):
    domain = stack(comm, [4])
    m = Elastic(domain, fixed={}, tractions={"top_0": (1.0, 0.0)}, smoothing=smoothing)
    assert singular(m.problem, domain) == [f"body 'block_0' {UNSUPPORTED}"]
    assert free_motions(m.problem) == [f"the body around (0.500, 0.500) {UNSUPPORTED}"]


@pytest.mark.parametrize("E", [1e-20, 1e28])
def test_units_do_not_matter(comm, E):
    # The last block is held at all its nodes.
    domain = turned(stack(comm, [4, 5, 3], rows=1), 0.3, (5e5, 4e6))
    fixed = {("bottom_0", 1): 0.0} | {(f"{s}_2", None): np.zeros(2) for s in ("bottom", "top")}
    tractions = {"top_0": (E, 0.0)}
    m = Elastic(domain, fixed=fixed, tractions=tractions, material=hm.LinearElastic(E, 0.2))
    assert singular(m.problem, domain) == [
        "body 'block_0' is not fully held: it can move along x",
        f"body 'block_1' {UNSUPPORTED}",
    ]


def test_what_is_coupled_below_round_off_does_not_hold(comm):
    domain = stack(comm, [4])
    V, Q = (fem.functionspace(domain.mesh, ("P", 1, shape)) for shape in ((2,), ()))
    u, p = fem.Function(V, name="displacement"), fem.Function(Q, name="head")
    v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))
    F = ufl.inner(ufl.sym(ufl.grad(u)), ufl.grad(v)) * ufl.dx - v[0] * ufl.dx
    F += (p + 1e-17 * u[0]) * q * ufl.dx
    assert singular(hm.ContactProblem(F, [u, p]), domain) == [f"body 'block_0' {UNSUPPORTED}"]


@pytest.mark.parametrize(
    ("fixed", "axis"), [({("left_0", 0): 0.0}, "y"), ({("bottom_0", 1): 0.0}, "x")]
)
def test_a_block_on_rollers_has_one(comm, fixed, axis):
    domain = stack(comm, [4])
    m = Elastic(domain, fixed=fixed, tractions={"top_0": (1.0, 1.0)})
    expected = f"body 'block_0' is not fully held: it can move along {axis}"
    assert singular(m.problem, domain) == [expected]


def held_points(V, points):
    """Conditions on components of nodes, from (x, y, component)."""
    result = []
    for x, y, component in points:
        sub = V.sub(component)
        collapsed, _ = sub.collapse()
        at = fem.locate_dofs_geometrical(
            (sub, collapsed), lambda p, x=x, y=y: np.isclose(p[0], x) & np.isclose(p[1], y)
        )
        result.append(fem.dirichletbc(fem.Function(collapsed), at, sub))
    return result


@pytest.mark.parametrize(
    ("points", "words"),
    [
        ([(1, 0, 0), (1, 0, 1)], "turn about (1.000, 0.000)"),
        ([(0.25, 0, 1)], "move along x and turn"),
        # The lines of action of both meet at the centre of rotation.
        ([(0, 1, 0), (0.25, 0, 1)], "turn about (0.250, 1.000)"),
    ],
)
def test_a_block_held_at_nodes(comm, points, words):
    domain = stack(comm, [4])
    m = Elastic(domain, fixed={}, tractions={"right_0": (1.0, 2.0)})
    problem = hm.ContactProblem(m.F, m.u, bcs=held_points(m.V, points))
    assert singular(problem, domain) == [f"body 'block_0' is not fully held: it can {words}"]


def test_a_body_on_soft_springs_is_held(comm):
    domain = stack(comm, [4, 5])
    m = Elastic(domain, fixed={("bottom_0", 1): 0.0}, tractions={"top_0": (1.0, 0.0)})
    ds = ufl.Measure("ds", domain=domain.mesh, subdomain_data=domain.facet_tags)
    v = ufl.TestFunction(m.V)
    F = m.F + fem.Constant(domain.mesh, 10.0) * ufl.dot(m.u, v) * ds(domain.surface("top_1"))
    problem = hm.ContactProblem(F, m.u, bcs=m.problem.bcs)
    expected = "body 'block_0' is not fully held: it can move along x"
    assert singular(problem, domain) == [expected]


def test_nothing_is_free_where_all_is_held(comm):
    domain = stack(comm, [3, 5])
    m = Elastic(domain, fixed=BASE, pairs=TIED, tractions={"top_1": (1.0, 0.0)})
    with pytest.raises(RuntimeError, match="no system has been assembled yet"):
        free_motions(m.problem, domain)
    m.problem.solve()
    assert free_motions(m.problem, domain) == []


def test_a_body_that_has_turned_far_turns_about_where_it_is(comm):
    # Without stress, so that the tangent is that of the turned body.
    domain = stack(comm, [4])
    V = fem.functionspace(domain.mesh, ("P", 1, (2,)))
    u, v = fem.Function(V), ufl.TestFunction(V)
    F = ufl.Identity(2) + ufl.grad(u)
    E = 0.5 * (F.T * F - ufl.Identity(2))
    form = ufl.inner(F * (2.0 * E + ufl.tr(E) * ufl.Identity(2)), ufl.grad(v)) * ufl.dx
    form -= 1e-3 * v[1] * ufl.dx
    u.interpolate(lambda x: np.vstack((-x[0] - x[1], x[0] - x[1])))
    held = held_points(V, [(0, 0, 0), (0, 0, 1)])
    problem = hm.ContactProblem(form, u, bcs=held)
    expected = "body 'block_0' is not fully held: it can turn about (0.000, 0.000)"
    assert singular(problem, domain) == [expected]


# --- several bodies -----------------------------------------------------------------------------


def test_tied_blocks_move_together(comm):
    domain = stack(comm, [3, 5])
    m = Elastic(domain, fixed={}, pairs=TIED, tractions={"top_1": (1.0, 0.0)})
    together = "together have no support and no closed contact with others"
    can = "they can move along x and y and turn"
    assert singular(m.problem, domain) == [f"bodies 'block_0' and 'block_1' {together}: {can}"]
    around = "the bodies around (0.500, 0.250) and around (0.500, 0.750)"
    assert free_motions(m.problem) == [f"{around} {together}: {can}"]


def test_tied_blocks_on_rollers_move_together(comm):
    domain = stack(comm, [3, 5, 4])
    m = Elastic(domain, fixed={("bottom_0", 1): 0.0}, pairs=[*TIED, ("bottom_2", "top_1", None)])
    m.u.interpolate(lambda x: np.vstack((0.0 * x[0], x[1])))
    bodies = "bodies 'block_0', 'block_1' and 'block_2'"
    expected = f"{bodies} together are not fully held: they can move along x"
    assert singular(m.problem, domain) == [expected]


@pytest.mark.parametrize("kind", ["upper secondary", "lower secondary"])
@pytest.mark.parametrize("motion", ["small", "finite"])
def test_a_block_slides_along_a_slope(comm, kind, motion):
    names = ("bottom_1", "top_0") if kind == "upper secondary" else ("top_0", "bottom_1")
    domain = stack(comm, [4, 5], slope=0.75)
    problem = resting(domain, names=names, motion=motion)
    expected = "body 'block_1' is not fully held: it can move along (0.800, 0.600)"
    assert singular(problem, domain) == [expected]


def test_a_block_that_sticks_is_held(comm):
    domain = stack(comm, [4, 5], slope=0.3)
    problem = resting(domain, hm.CoulombFriction(5.0))
    problem.solve()
    assert free_motions(problem, domain) == []


def test_blocks_that_slide_on_each_other_without_support(comm):
    domain = stack(comm, [4, 5])
    problem = resting(domain, fixed={})
    slides = "is not fully held: it can move along x"
    assert singular(problem, domain) == [
        f"body 'block_0' {slides}",
        f"body 'block_1' {slides}",
        "bodies 'block_0' and 'block_1' together have no support and no closed contact with "
        "others: they can move along x and y and turn",
    ]


def test_a_wedge_and_what_it_lifts_move_against_each_other(comm):
    domain = stack(comm, [4, 5], slope=0.5)
    problem = resting(domain, fixed={("bottom_0", 1): 0.0, ("right_1", 0): 0.0})
    assert singular(problem, domain) == [
        "bodies 'block_0' and 'block_1' are not fully held: they can move against each other"
    ]


def test_a_block_lifted_off_a_held_base(comm):
    domain = stack(comm, [4, 5])
    problem = resting(domain, lift=0.1)
    assert singular(problem, domain) == [f"body 'block_1' {UNSUPPORTED}"]
    assert free_motions(problem) == [f"the body around (0.500, 0.750) {UNSUPPORTED}"]


def test_parts_of_one_group_are_told_apart(comm):
    domain = stack(comm, [4, 3, 5])
    both = Domain(
        domain.mesh,
        domain.cell_tags,
        domain.facet_tags,
        domain.bodies,
        domain.surfaces,
        "stack",
        {"blocks": ["block_1", "block_2"]},
    )
    m = Elastic(domain, fixed=BASE, tractions={"top_2": (1.0, 0.0)})
    assert singular(m.problem, both) == [
        f"body 'blocks' around (0.500, 0.500) {UNSUPPORTED}",
        f"body 'blocks' around (0.500, 0.833) {UNSUPPORTED}",
    ]


# --- pore pressures -----------------------------------------------------------------------------

BOX = {(f"{side}_{k}", 0): 0.0 for side in ("left", "right") for k in (0, 1)}
CLOSED_BOX = BOX | {(f"{side}_{k}", 1): 0.0 for side in ("bottom", "top") for k in (0, 1)}
UNSET = "is prescribed nowhere and not stored"


def test_pressure_of_closed_boxes(comm):
    domain = stack(comm, [3, 5])
    m = Porous(domain, fixed=CLOSED_BOX, drained={}, fluxes={"top_1": 1e-9})
    assert singular(m.problem, domain) == [
        f"the pore pressure of body 'block_0' {UNSET}",
        f"the pore pressure of body 'block_1' {UNSET}",
    ]
    assert free_motions(m.problem)[0] == (
        f"the pore pressure of the body around (0.500, 0.250) {UNSET}"
    )


def test_pressure_of_one_closed_box(comm):
    domain = stack(comm, [3, 5])
    m = Porous(domain, fixed=CLOSED_BOX, drained={"top_0": 0.0}, fluxes={"top_1": 1e-9})
    assert singular(m.problem, domain) == [f"the pore pressure of body 'block_1' {UNSET}"]


def test_pressure_of_boxes_with_water_flowing_between(comm):
    domain = stack(comm, [3, 5])
    fixed = {key: 0.0 for key in CLOSED_BOX if key[0] not in ("top_0", "bottom_1")}
    pairs = [("bottom_1", "top_0", hm.GapFlow(1e-9))]
    m = Porous(domain, fixed=fixed, drained={}, pairs=pairs, fluxes={"top_1": 1e-9})
    expected = f"the pore pressure of bodies 'block_0' and 'block_1' {UNSET}"
    assert singular(m.problem, domain) == [expected]


def test_a_pressure_that_a_free_face_sets_is_not_named(comm):
    # Undrained, and held but for its top, which the water must carry.
    domain = stack(comm, [3])
    fixed = {("left_0", 0): 0.0, ("right_0", 0): 0.0, ("bottom_0", 1): 0.0}
    m = Porous(domain, fixed=fixed, drained={}, tractions={"top_0": (0.0, -1.0)})
    m.problem.solve()
    assert free_motions(m.problem, domain) == []


def test_motions_and_pressures_of_one_system(comm):
    domain = stack(comm, [3, 5])
    fixed = {key: 0.0 for key in CLOSED_BOX if key[0].endswith("0")}
    m = Porous(domain, fixed=fixed, drained={"top_1": 0.0}, tractions={"top_1": (1.0, 0.0)})
    assert singular(m.problem, domain) == [
        f"body 'block_1' {UNSUPPORTED}",
        f"the pore pressure of body 'block_0' {UNSET}",
    ]


def test_a_field_on_a_part_of_the_mesh_is_named_by_the_whole(comm):
    domain = stack(comm, [3, 5])
    mesh = domain.mesh
    part, entity_map, *_ = create_submesh(mesh, 2, domain.cell_tags.find(domain.body("block_1")))
    u = fem.Function(fem.functionspace(mesh, ("P", 1)), name="head")
    p = fem.Function(fem.functionspace(part, ("P", 1)), name="salt")
    v, q = (ufl.TestFunction(f.function_space) for f in (u, p))
    cells = ufl.Measure("dx", mesh, subdomain_data=domain.cell_tags)
    upper = cells(domain.body("block_1"))
    F = ufl.inner(ufl.grad(u), ufl.grad(v)) * cells + 0.0 * p * v * upper
    G = ufl.inner(ufl.grad(p), ufl.grad(q)) * upper + 0.0 * u * q * upper - q * upper
    bcs = [fix(domain, u.function_space, f"bottom_{k}") for k in (0, 1)]
    problem = hm.ContactProblem([F, G], [u, p], bcs=bcs, entity_maps=[entity_map])
    assert singular(problem, domain) == [f"the salt of body 'block_1' {UNSET}"]
