# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a term on node cells may hold, and how a form is taken apart."""

import basix.ufl
import numpy as np
import pytest
import ufl
from dolfinx import fem

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.smoothing import check_smoothable, point_forms, split_by_measure
from tests.smoothing.helpers import COMM, assemble, make_mesh, smoothed_terms, square, tag_cells

pytestmark = pytest.mark.mpi

POINTS, TRIANGLES = square("right", 3)


@pytest.fixture
def mesh():
    return make_mesh(POINTS, TRIANGLES)


@pytest.fixture
def V(mesh):
    return fem.functionspace(mesh, ("P", 1, (2,)))


@pytest.fixture
def Q(mesh):
    return fem.functionspace(mesh, ("P", 1))


# --- refusals ------------------------------------------------------------------------------------


def test_second_derivatives_are_refused(V, Q):
    u, p = fem.Function(V), fem.Function(Q)
    v, q = ufl.TestFunction(V), ufl.TestFunction(Q)
    x = ufl.SpatialCoordinate(V.mesh)
    terms = [
        ufl.dot(ufl.div(ufl.grad(u)), v),
        ufl.grad(ufl.grad(p))[0, 1] * q,
        ufl.dot(ufl.grad(ufl.div(u)), v),
        p.dx(0).dx(1) * q,
        ufl.div(x[0] * ufl.grad(p)) * q,
        ufl.div(2.0 * ufl.sym(ufl.grad(u)))[0] * q,
        ufl.derivative(ufl.div(ufl.grad(p)) ** 2 * hm.dc, p, q).integrals()[0].integrand(),
    ]
    for term in terms:
        with pytest.raises(ValueError, match=r"a second derivative \(of .*\) cannot be smoothed"):
            check_smoothable(term * hm.dc)
        check_smoothable(term * ufl.dx)


@pytest.mark.parametrize(
    "element",
    [
        basix.ufl.element("P", "triangle", 2),
        basix.ufl.element("P", "triangle", 2, shape=(2,)),
        basix.ufl.element("DG", "triangle", 1),
        basix.ufl.element("CR", "triangle", 1),
        basix.ufl.element("RT", "triangle", 1),
        basix.ufl.element("P", "triangle", 1, shape=(2, 2), symmetry=True),
        basix.ufl.element("iso", "triangle", 1),
        basix.ufl.quadrature_element("triangle", degree=0),
        basix.ufl.mixed_element(
            [
                basix.ufl.element("P", "triangle", 1, shape=(2,)),
                basix.ufl.element("P", "triangle", 1),
            ]
        ),
    ],
    ids=["P2", "vector P2", "DG1", "CR", "RT", "symmetric", "macro", "quadrature", "mixed"],
)
def test_fields_that_are_not_p1_are_refused(mesh, Q, element):
    f = fem.Function(fem.functionspace(mesh, element), name="f")
    q = ufl.TestFunction(Q)
    first = f if not f.ufl_shape else f[(0,) * len(f.ufl_shape)]
    with pytest.raises(ValueError, match=r"f lives on .* put its terms on dx"):
        check_smoothable(first * q * hm.dc)
    check_smoothable(first * q * ufl.dx)


@pytest.mark.parametrize(
    "element", [basix.ufl.element("P", "triangle", 2), basix.ufl.element("DG", "triangle", 0)]
)
def test_test_functions_that_are_not_p1_are_refused(mesh, element):
    q = ufl.TestFunction(fem.functionspace(mesh, element))
    with pytest.raises(ValueError, match="node cells smooth continuous P1 fields"):
        check_smoothable(q * hm.dc)


def test_geometric_quantities_of_a_triangle_are_refused(mesh, Q):
    q = ufl.TestFunction(Q)
    quantities = {
        "CellVolume": ufl.CellVolume(mesh),
        "Circumradius": ufl.Circumradius(mesh),
        "FacetNormal": ufl.FacetNormal(mesh)[0],
        "CellDiameter": ufl.CellDiameter(mesh),
        "Jacobian": ufl.Jacobian(mesh)[0, 0],
    }
    for name, quantity in quantities.items():
        with pytest.raises(ValueError, match=f"{name} has no meaning on a node cell"):
            check_smoothable(quantity * q * hm.dc)
    check_smoothable(ufl.SpatialCoordinate(mesh)[0] * q * hm.dc)


def test_facet_terms_are_refused(Q):
    q = ufl.TestFunction(Q)
    smoothed = {"node_cells": "full"}
    with pytest.raises(ValueError, match="exterior_facet terms cannot be smoothed over node cells"):
        check_smoothable(q * ufl.ds(metadata=smoothed))
    with pytest.raises(ValueError, match="interior_facet terms cannot be smoothed"):
        point_forms(ufl.avg(q) * ufl.dS(metadata=smoothed))


def test_problem_refuses_before_it_compiles(V, Q):
    """The same messages reach who only knows the problem."""
    p, q = fem.Function(Q), ufl.TestFunction(Q)
    n = ufl.FacetNormal(Q.mesh)
    refused = {
        "a second derivative": ufl.div(ufl.grad(p)) * q * hm.dc,
        "FacetNormal": ufl.dot(n, n) * p * q * hm.dc,
        "exterior_facet": p * q * ufl.ds(metadata={"node_cells": "none"}),
    }
    for message, form in refused.items():
        with pytest.raises(ValueError, match=message):
            hm.ContactProblem(form, p)
    w = fem.Function(fem.functionspace(Q.mesh, ("P", 2)), name="w")
    with pytest.raises(ValueError, match="w lives on"):
        hm.ContactProblem(w * ufl.TestFunction(w.function_space) * hm.dc, w)


def test_unknown_smoothing_is_refused():
    with pytest.raises(ValueError, match="smoothing is 'Full'; it must be one of deviatoric, full"):
        hm.node_cells_measure("Full")


def test_tags_that_cut_node_cells_are_refused_on_all_ranks(mesh, Q):
    layer = (POINTS[TRIANGLES].mean(axis=1)[:, 1] > 1.0 / 3.0).astype(int) + 1
    dc = hm.node_cells_measure("full", domain=mesh, subdomain_data=tag_cells(mesh, layer))
    q = ufl.TestFunction(Q)
    # The four nodes of the row between the layers.
    with pytest.raises(ValueError, match=r"dc\(2\) cuts through 4 node cells") as refusal:
        smoothed_terms(q * dc(2))
    assert len(set(COMM.allgather(str(refusal.value)))) == 1
    assert "DG 0" in str(refusal.value)


def test_layers_of_one_body_are_named_together(mesh, Q):
    """Each id alone would cut the node cells between the layers, both together do not."""
    layer = (POINTS[TRIANGLES].mean(axis=1)[:, 1] > 1.0 / 3.0).astype(int) + 1
    dc = hm.node_cells_measure("full", domain=mesh, subdomain_data=tag_cells(mesh, layer))
    volume = assemble(ufl.TestFunction(Q) * dc((1, 2)))
    assert volume.sum() == pytest.approx(1.0, rel=1e-14)


def test_ids_without_tags_are_refused(Q):
    with pytest.raises(ValueError, match=r"dc\(3\) needs subdomain_data with tags of cells"):
        smoothed_terms(ufl.TestFunction(Q) * hm.dc(3))


def test_ids_of_no_cell_are_refused(mesh, Q):
    tags = tag_cells(mesh, np.ones(len(TRIANGLES)))
    dc = hm.node_cells_measure("full", domain=mesh, subdomain_data=tags)
    with pytest.raises(ValueError, match=r"dc\(7\): no cell has such a tag"):
        smoothed_terms(ufl.TestFunction(Q) * dc(7))


def test_quadrature_degree_is_refused():
    with pytest.raises(
        ValueError, match=r"node cells take no metadata such as .*quadrature_degree"
    ):
        hm.dc(degree=2)
    assert hm.dc(3)(degree=None).metadata() == hm.dc.metadata()


def test_misspelt_enhancement_is_refused(Q):
    form = ufl.TestFunction(Q) * ufl.dx(metadata={"node_cells": "Full"})
    with pytest.raises(ValueError, match="the enhancement of node cells is 'Full'"):
        point_forms(form)


def test_function_of_another_mesh_is_refused(Q):
    other = make_mesh(POINTS, TRIANGLES)
    g = fem.Function(fem.functionspace(other, ("P", 1)), name="g")
    term = g * ufl.TestFunction(Q) * hm.dc(domain=Q.mesh)
    with pytest.raises(ValueError, match="g lives on another mesh"):
        smoothed_terms(term)


# --- taking a form apart -------------------------------------------------------------------------


def test_split_by_measure(Q):
    p, q = fem.Function(Q), ufl.TestFunction(Q)
    on_cells = p * q * hm.dc
    on_triangles, on_facets = p * q * ufl.dx, p * q * ufl.ds
    smoothed, rest = split_by_measure(on_cells + on_triangles + on_facets)
    assert [i.metadata()["node_cells"] for i in smoothed] == ["deviatoric"]
    assert rest.signature() == (on_triangles + on_facets).signature()
    assert split_by_measure(on_cells)[1] is None
    assert split_by_measure(on_triangles)[0] == []
    assert split_by_measure(None) == ([], None)
    assert split_by_measure(ufl.ZeroBaseForm((q,))) == ([], None)
    assert point_forms(None) == []


def test_one_integrand_for_each_enhancement_and_subdomain(mesh, Q):
    q = ufl.TestFunction(Q)
    tags = tag_cells(mesh, np.ones(len(TRIANGLES)))
    full = hm.node_cells_measure("full", domain=mesh, subdomain_data=tags)
    forms = point_forms(q * full + 2 * q * full + q * full(1) + q * hm.dc)
    assert sorted((f.enhancement, f.subdomain) for f in forms) == [
        ("deviatoric", ()),
        ("full", ()),
        ("full", (1,)),
    ]


def test_only_what_is_used_gets_a_slot(V, Q):
    u, p = fem.Function(V), fem.Function(Q)
    v, du = ufl.TestFunction(V), ufl.TrialFunction(V)
    k, unused = fem.Constant(V.mesh, 2.0), fem.Constant(V.mesh, 1.0)
    form = k * p * ufl.inner(ufl.grad(u), ufl.grad(v)) * hm.dc
    (point,) = point_forms(form)
    assert point.n_coefficients == 6  # four entries and the divergence of grad u, and p
    assert point.argument_sizes == [5]
    assert point.constants == [k] and unused not in point.constants
    slots = point.coefficients[u]
    assert (slots.value, slots.gradient, slots.divergence) == (-1, 0, 4)
    assert (point.coefficients[p].value, point.coefficients[p].gradient) == (5, -1)
    assert point.position is None
    (tangent,) = point_forms(ufl.derivative(form, u, du))
    assert tangent.argument_sizes == [5, 5]
    assert list(tangent.coefficients) == [p]
    # A scalar has no divergence, and the full enhancement needs none.
    (full,) = point_forms(ufl.inner(ufl.grad(u), ufl.grad(v)) * hm.node_cells_measure("full"))
    assert full.argument_sizes == [4] and full.coefficients[u].divergence == -1
    (scalar,) = point_forms(ufl.dot(ufl.grad(p), ufl.grad(ufl.TestFunction(Q))) * hm.dc)
    assert scalar.argument_sizes == [2] and scalar.n_coefficients == 2


def test_replaced_functions_and_constants_are_those_of_the_successor(mesh, Q):
    tags = [tag_cells(mesh, np.full(len(TRIANGLES), i)) for i in (1, 2)]
    f, g = fem.Function(Q), fem.Function(Q)
    c, d = fem.Constant(mesh, 1.0), fem.Constant(mesh, 2.0)
    dc = hm.node_cells_measure("full", domain=mesh, subdomain_data=tags[0])
    (point,) = point_forms(c * f * ufl.TestFunction(Q) * dc(1))
    successors = {id(f): g, id(c): d, id(tags[0]): tags[1]}
    other = point.replaced(lambda old: successors[id(old)])
    assert list(other.coefficients) == [g] and other.coefficients[g] is point.coefficients[f]
    assert other.constants == [d] and other.subdomain_data is tags[1]
    assert list(point.coefficients) == [f] and point.constants == [c]
