# SPDX-License-Identifier: LGPL-3.0-or-later
"""The film of water between two surfaces of constant aperture (Eqs. 72-92)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.sparse

from ..contact import MortarOperator, Segments, Surface, covered_mass, covered_stiffness
from .law import GapFlow


def mean_pressure(
    operator: MortarOperator, prescribed: npt.NDArray[np.bool_]
) -> tuple[scipy.sparse.csr_array, scipy.sparse.csr_array]:
    """Mean pressure of the film from the condensed unknowns (Eq. 86): half the drop plus H p_M.

    Where the secondary pressure is prescribed, the film has that pressure: so a reservoir at the
    end of a gap feeds it, whatever the primary mesh.

    Args:
        operator: Coupling of the pressures.
        prescribed: Secondary nodes with a prescribed pressure; shape (n_s,).

    Returns:
        Weights of the secondary nodes' unknowns (n_s, n_s) and of the primary pressures (n_s, n_m).
    """
    tied = operator.kept & ~prescribed
    of_drop = scipy.sparse.diags_array(np.where(prescribed, 1.0, 0.5 * tied)).tocsr()
    of_dropped = scipy.sparse.diags_array(tied.astype(float)) @ operator.C
    of_primary = scipy.sparse.diags_array(tied.astype(float)) @ operator.H
    return (of_drop - of_dropped).tocsr(), of_primary.tocsr()


def film_conductance(
    flow: GapFlow,
    aperture: float,
    secondary: Surface,
    segments: Segments,
    operator: MortarOperator,
    prescribed: npt.NDArray[np.bool_],
) -> scipy.sparse.csr_array:
    """Flow of water per unit of the condensed pressures (Eqs. 81, 82 and 90).

    Args:
        flow: Law of the film.
        aperture: Its constant aperture [m].
        secondary: Surface that carries the film.
        segments: Its covered part.
        operator: Coupling of the pressures.
        prescribed: Secondary nodes with a prescribed pressure; shape (n_s,).

    Returns:
        Matrix over the secondary unknowns (drops, pressures where prescribed) followed by the
        primary pressures [m^3/(Pa s) per metre thickness]; shape (n_s + n_m, n_s + n_m).
    """
    across = covered_mass(secondary, segments, operator.kept)
    across = across * flow.transverse_conductivity(aperture)
    along = covered_stiffness(secondary, segments, operator.kept)
    along = along * flow.longitudinal_conductance(aperture)
    tied = (operator.kept & ~prescribed).astype(float)
    drop = scipy.sparse.hstack(
        (scipy.sparse.diags_array(tied), scipy.sparse.csr_array(operator.H.shape))
    )
    mean = scipy.sparse.hstack(mean_pressure(operator, prescribed))
    return (drop.T @ across @ drop + mean.T @ along @ mean).tocsr()
