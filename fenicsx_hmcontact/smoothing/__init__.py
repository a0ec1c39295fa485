# SPDX-License-Identifier: LGPL-3.0-or-later
"""Node cells, the smoothed gradient, and assembly of UFL forms over node cells."""

from .assembly import SmoothedTerm
from .measure import Enhancement, Smoothing, dc, node_cells_measure
from .node_cells import NodeCells, create_node_cells
from .point_form import (
    PointForm,
    check_smoothable,
    point_forms,
    split_by_measure,
    unite_subdomains,
)

__all__ = [
    "Enhancement",
    "NodeCells",
    "PointForm",
    "SmoothedTerm",
    "Smoothing",
    "check_smoothable",
    "create_node_cells",
    "dc",
    "node_cells_measure",
    "point_forms",
    "split_by_measure",
    "unite_subdomains",
]
