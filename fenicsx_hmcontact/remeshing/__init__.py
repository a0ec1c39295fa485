# SPDX-License-Identifier: LGPL-3.0-or-later
"""Remeshing: triangles rebuilt over the nodes of a body, some of which come and go (Section 3.4).

Which file does what: ``trigger`` says when, ``passes`` is the whole remesh, ``triangulation`` flips
edges or begins from scratch, ``boundary``, ``removal`` and ``insertion`` change nodes, ``bodies``
takes the mesh apart and puts it together, ``transfer`` carries what the nodes know.
"""

from .options import Remeshing
from .passes import Remeshed, due, remesh, target_sizes
from .quality import angles, areas
from .transfer import Merges, Transfer
from .triangulation import TriangulationError, triangulate, verify
from .trigger import Quality, reasons

__all__ = [
    "Merges",
    "Quality",
    "Remeshed",
    "Remeshing",
    "Transfer",
    "TriangulationError",
    "angles",
    "areas",
    "due",
    "reasons",
    "remesh",
    "target_sizes",
    "triangulate",
    "verify",
]
