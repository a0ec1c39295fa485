# SPDX-License-Identifier: LGPL-3.0-or-later
"""The measure that says which terms of a form are smoothed over node cells."""

from __future__ import annotations

from typing import Any, Literal, get_args

import ufl

Enhancement = Literal["deviatoric", "full", "none"]
Smoothing = Literal["deviatoric", "full", "none", "triangles"]

METADATA_KEY = "node_cells"


class NodeCellsMeasure(ufl.Measure):
    """Measure over node cells, which have points of their own and no quadrature degree."""

    __slots__ = ()

    def reconstruct(self, *args: Any, metadata: Any = None, **options: Any) -> ufl.Measure:
        """Return the measure with other subdomain or domain.

        Raises:
            ValueError: If a quadrature degree, rule or other metadata is asked for.
        """
        if metadata is not None:
            raise ValueError(
                f"node cells take no metadata such as {metadata}: leave out the degree"
            )
        changed = super().reconstruct(*args, **options)
        changed.__class__ = NodeCellsMeasure
        return changed


def check_enhancement(name: str) -> None:
    """Refuse an enhancement that does not exist.

    Raises:
        ValueError: If there is none of that name.
    """
    if name not in get_args(Enhancement):
        known = ", ".join(get_args(Enhancement))
        raise ValueError(f"the enhancement of node cells is {name!r}; it must be one of {known}")


def node_cells_measure(smoothing: Smoothing = "deviatoric", **options: Any) -> ufl.Measure:
    """Return the measure over node cells with a given enhancement of the gradient.

    Args:
        smoothing: ``"deviatoric"`` (default): the second gradient enhances all but the divergence
            of vector fields, which stays the cell's mean and so does not lock; ``"full"``: Eq. 37
            as printed, locks volumetrically; ``"none"``: the cell's mean gradient (Eq. 31), has
            spurious modes and is there for comparison; ``"triangles"``: no smoothing, plain ``dx``.
        options: Passed on to `ufl.Measure`: ``domain``, ``subdomain_data``, ``subdomain_id``.

    Raises:
        ValueError: If ``smoothing`` is none of these.
    """
    if smoothing not in get_args(Smoothing):
        known = ", ".join(get_args(Smoothing))
        raise ValueError(f"smoothing is {smoothing!r}; it must be one of {known}")
    if smoothing == "triangles":
        return ufl.Measure("dx", **options)
    return NodeCellsMeasure("dx", metadata={METADATA_KEY: smoothing}, **options)


dc = node_cells_measure()
"""Measure over node cells with deviatoric enhancement; replaces ``dx`` in terms to be smoothed."""
