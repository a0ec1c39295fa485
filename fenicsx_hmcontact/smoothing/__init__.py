# SPDX-License-Identifier: LGPL-3.0-or-later
"""Node cells, the smoothed gradient, and assembly of UFL forms over node cells."""

from .assembly import PointExpression, SmoothedTerm, cells_of, evaluate_at_points
from .measure import METADATA_KEY, Enhancement, Smoothing, dc, node_cells_measure
from .node_cells import NodeCells, create_node_cells, points_per_cell
from .point_form import (
    PointForm,
    check_smoothable,
    point_forms,
    split_by_measure,
    subdomain_ids,
    unite_subdomains,
)
from .point_function import PointFunction

__all__ = [
    "METADATA_KEY",
    "Enhancement",
    "NodeCells",
    "PointExpression",
    "PointForm",
    "PointFunction",
    "SmoothedTerm",
    "Smoothing",
    "cells_of",
    "check_smoothable",
    "create_node_cells",
    "dc",
    "evaluate_at_points",
    "node_cells_measure",
    "point_forms",
    "points_per_cell",
    "split_by_measure",
    "subdomain_ids",
    "unite_subdomains",
]
