# SPDX-License-Identifier: LGPL-3.0-or-later
"""Every wrong mesh is refused on all ranks, with group and file in the message."""

import sys

from mpi4py import MPI

import numpy as np
import pytest

from fenicsx_hmcontact.domain import Domain, MeshArrays

pytestmark = pytest.mark.mpi

COMM = MPI.COMM_WORLD
LINE, TRIANGLE, QUADRILATERAL, TETRAHEDRON, TRIANGLE_6, POINT = 1, 2, 3, 4, 9, 15
DIMENSION = {LINE: 1, TRIANGLE: 2, QUADRILATERAL: 2, TETRAHEDRON: 3, TRIANGLE_6: 2, POINT: 0}

SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
TWO_TRIANGLES = [(0, 1, 2), (0, 2, 3)]


def model(points, *groups):
    """Drawing of a model from groups (name, gmsh element type, nodes of the elements)."""

    def draw(gmsh):
        home = gmsh.model.addDiscreteEntity(0)
        numbers = range(1, len(points) + 1)
        gmsh.model.mesh.addNodes(0, home, list(numbers), np.ravel(points).astype(float))
        for name, element_type, elements in groups:
            dim = DIMENSION[element_type]
            entity = gmsh.model.addDiscreteEntity(dim)
            if len(elements):
                nodes = (np.ravel(elements) + 1).tolist()
                gmsh.model.mesh.addElementsByType(entity, element_type, [], nodes)
            if name is not None:
                gmsh.model.addPhysicalGroup(dim, [entity], name=name)

    return draw


def soil(triangles=TWO_TRIANGLES):
    return ("soil", TRIANGLE, triangles)


def raised(call, kind=ValueError):
    """Message of the error, after checking that it is the same on all ranks."""
    with pytest.raises(kind) as caught:
        call()
    messages = COMM.allgather(str(caught.value))
    assert len(set(messages)) == 1
    return messages[0]


def refusal(draw, **options):
    message = raised(lambda: Domain.generate(draw, COMM, name="case", **options))
    assert message.startswith("case: ")
    return message


FLAT = [*SQUARE, (0.5, 0.5, 0.0)]

WRONG_MODELS = {
    "no groups": (model(SQUARE, (None, TRIANGLE, TWO_TRIANGLES)), ["no physical groups"]),
    "only lines": (model(SQUARE, ("bottom", LINE, [(0, 1)])), ["no triangles"]),
    "three-dimensional": (
        model([*SQUARE, (0, 0, 1)], ("soil", TETRAHEDRON, [(0, 1, 2, 4)])),
        ["three-dimensional", "Tetrahedron 4"],
    ),
    "out of plane": (
        model([*SQUARE[:3], (0, 1, 0.01)], soil()),
        ["out of the plane", "(0, 1, 0.01)"],
    ),
    "not finite": (model([*SQUARE[:3], (0, np.nan, 0)], soil()), ["not finite"]),
    "quadrilaterals": (
        model(SQUARE, ("soil", QUADRILATERAL, [(0, 1, 2, 3)])),
        ["'soil'", "Quadrilateral 4"],
    ),
    "quadratic": (
        model([*SQUARE, (0.5, 0, 0), (1, 0.5, 0)], ("soil", TRIANGLE_6, [(0, 1, 2, 4, 5, 3)])),
        ["'soil'", "Triangle 6"],
    ),
    "points group": (model(SQUARE, soil(), ("corner", POINT, [(0,)])), ["'corner'", "dimension 0"]),
    "no name": (model(SQUARE, soil(), ("", LINE, [(0, 1)])), ["surface group with tag 2", "name"]),
    "no elements": (model(SQUARE, soil(), ("base", LINE, [])), ["surface group 'base' is empty"]),
    "no body group": (
        model(SQUARE, (None, TRIANGLE, TWO_TRIANGLES), ("base", LINE, [(0, 1)])),
        ["no body group", "(0, 0)"],
    ),
    "cells in two entities": (
        model(SQUARE, soil(), ("clay", TRIANGLE, TWO_TRIANGLES[1:])),
        ["'soil'", "'clay'", "exactly one", "(0.333333, 0.666667)"],
    ),
    "cell twice in a group": (model(SQUARE, soil([(0, 1, 2), (1, 2, 0)])), ["'soil'", "again"]),
    "degenerate": (
        model(FLAT, soil([*TWO_TRIANGLES, (0, 4, 2)])),
        ["1 of 3 cells of body group 'soil' are degenerate", "(0.5, 0.5)"],
    ),
    "point-like": (model([(1, 1, 0)] * 3, soil([(0, 1, 2)])), ["'soil' are degenerate"]),
    "inverted": (
        model([*SQUARE, (2, 0, 0)], soil([*TWO_TRIANGLES, (1, 2, 4)])),
        ["1 of 3 cells of body group 'soil' are inverted", "(1.33333, 0.333333)"],
    ),
    "shared nodes": (
        model(SQUARE, ("clay", TRIANGLE, [(0, 1, 2)]), ("sand", TRIANGLE, [(0, 2, 3)])),
        ["'clay' and 'sand' share", "(0, 0)", 'layers={"name of the body": ["clay", "sand"]}'],
    ),
    "overlapping cells": (
        model([*SQUARE, (0.2, 0.9, 0.0)], soil([*TWO_TRIANGLES, (0, 2, 4)])),
        ["edge at (0.5, 0.5) belongs to 3 cells"],
    ),
    "facet inside": (
        model(SQUARE, soil(), ("cut", LINE, [(0, 1), (2, 0)])),
        ["1 of 2 facets of surface group 'cut' lie inside a body", "(0.5, 0.5)"],
    ),
    "facet of no cell": (
        model(SQUARE, soil(), ("cut", LINE, [(1, 3)])),
        ["1 of 1 facets of surface group 'cut' are edges of no cell", "(0.5, 0.5)"],
    ),
    "facet at a node of no cell": (
        model([*SQUARE, (5, 5, 0)], soil(), ("cut", LINE, [(1, 4)])),
        ["surface group 'cut' are edges of no cell"],
    ),
    "facet in two surfaces": (
        model(SQUARE, soil(), ("base", LINE, [(0, 1)]), ("rim", LINE, [(2, 1), (1, 0)])),
        ["facet at (0.5, 0)", "'base'", "'rim'"],
    ),
}


@pytest.mark.parametrize("case", WRONG_MODELS)
def test_wrong_model_is_refused(case):
    draw, words = WRONG_MODELS[case]
    message = refusal(draw)
    for word in words:
        assert word in message


def test_group_without_entity_is_refused():
    def draw(gmsh):
        model(SQUARE, soil())(gmsh)
        gmsh.model.addPhysicalGroup(1, [], name="base")

    assert "surface group 'base' is empty" in refusal(draw)


def test_entity_in_two_body_groups_is_refused():
    def draw(gmsh):
        model(SQUARE, soil())(gmsh)
        gmsh.model.addPhysicalGroup(2, [1], name="clay")

    assert "in the body groups 'soil' and 'clay'" in refusal(draw)


def test_second_group_of_one_name_is_refused():
    def draw(gmsh):
        model(SQUARE, soil(), ("base", LINE, [(0, 1)]))(gmsh)
        gmsh.model.addPhysicalGroup(1, [gmsh.model.addDiscreteEntity(1)], name="base")

    assert "has no name (of its own)" in refusal(draw)


LAYERED = model(SQUARE, ("clay", TRIANGLE, [(0, 1, 2)]), ("sand", TRIANGLE, [(0, 2, 3)]))


@pytest.mark.parametrize(
    ("layers", "words"),
    [
        ({"soil": ["clay", "silt"]}, ["layer 'silt' of body 'soil'", "known: clay, sand"]),
        ({"soil": []}, ["'soil' has no layers"]),
        ({"sand": ["clay", "sand"]}, ["'sand' has the name of a body group"]),
        ({"one": ["clay", "sand"], "two": ["sand"]}, ["'sand' is a layer of 'one' and of 'two'"]),
        ({"one": ["clay"], "two": ["sand"]}, ["bodies 'one' and 'two' share nodes"]),
    ],
)
def test_wrong_layers_are_refused(layers, words):
    message = refusal(LAYERED, layers=layers)
    for word in words:
        assert word in message


def test_facet_between_layers_is_inside():
    def draw(gmsh):
        LAYERED(gmsh)
        line = gmsh.model.addDiscreteEntity(1)
        gmsh.model.mesh.addElementsByType(line, LINE, [], [1, 3])
        gmsh.model.addPhysicalGroup(1, [line], name="seam")

    assert "'seam' lie inside" in refusal(draw, layers={"soil": ["clay", "sand"]})


def test_unknown_names_list_the_known_ones():
    draw = model(SQUARE, soil(), ("base", LINE, [(0, 1)]))
    domain = Domain.generate(draw, COMM, name="case")
    for call in (domain.surface, domain.facets, domain.body_of_surface):
        assert raised(lambda call=call: call("top")) == (
            "case: unknown surface 'top'; known: base."
        )
    for call in (domain.body, domain.cells):
        assert raised(lambda call=call: call("rock")) == "case: unknown body 'rock'; known: soil."


def test_files_that_are_no_mesh_are_refused(common_dir):
    missing = str(common_dir / "missing.msh")
    assert missing in raised(lambda: Domain.read(missing, COMM), FileNotFoundError)

    text, cut = common_dir / "text.msh", common_dir / "cut.msh"
    if COMM.rank == 0:
        text.write_text("hello world\n")
        cut.write_text("$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Nodes\n1 4 1 4\n")
    COMM.Barrier()
    message = raised(lambda: Domain.read(text, COMM))
    assert message == f"{text}: not a gmsh mesh file (it must begin with $MeshFormat)."
    assert raised(lambda: Domain.read(cut, COMM)).startswith(f"{cut}: gmsh cannot read the file")


def test_group_without_elements_in_a_file_is_refused(common_dir):
    path = common_dir / "case.msh"

    def draw(gmsh):
        model(SQUARE, soil())(gmsh)
        gmsh.write(str(path))
        lines = path.read_text().split("\n")
        count = lines.index("$PhysicalNames") + 1
        lines[count : count + 1] = ["2", '1 17 "base"']
        path.write_text("\n".join(lines))

    Domain.generate(draw, COMM, name="case")
    message = raised(lambda: Domain.read(path, COMM))
    assert message.startswith(f"{path}: surface group 'base' is empty")


def test_missing_gmsh_says_how_to_install_it(monkeypatch):
    if COMM.rank == 0:
        monkeypatch.setitem(sys.modules, "gmsh", None)
    draw = model(SQUARE, soil())
    message = raised(lambda: Domain.generate(draw, COMM, name="case"), ImportError)
    assert "pip install 'fenicsx_hmcontact[mesh]'" in message
    assert "libgl1" in message


def test_failure_while_drawing_reaches_all_ranks():
    def draw(gmsh):
        raise KeyError("corner")

    message = raised(lambda: Domain.generate(draw, COMM, name="case"), RuntimeError)
    assert message == "case: the mesh cannot be made: KeyError('corner')."


def test_nothing_handed_over_is_refused():
    assert "has None" in raised(lambda: Domain.from_gmsh(None, COMM))
    assert "has None" in raised(lambda: Domain.from_arrays(None, COMM, name="remesh"))


def test_inverted_cell_in_arrays_is_refused():
    arrays = MeshArrays(
        np.array([*SQUARE, (2.0, 0.0, 0.0)], dtype=float),
        np.array([(0, 1, 2), (0, 2, 3), (1, 2, 4)]),
        np.array([5, 5, 5], dtype=np.int32),
        np.empty((0, 2), dtype=np.int64),
        np.empty(0, dtype=np.int32),
        {"soil": 5},
        {},
    )
    hand_over = arrays if COMM.rank == 0 else None
    message = raised(lambda: Domain.from_arrays(hand_over, COMM, name="remesh"))
    assert message.startswith("remesh: 1 of 3 cells of body group 'soil' are inverted")
