# SPDX-License-Identifier: LGPL-3.0-or-later
"""Water in the gap between two surfaces."""

from .film import film_conductance, mean_pressure
from .law import ApertureLaw, GapFlow, ResidualAperture
from .moving_film import MovingFilm, unseen_exchange
from .pressure import GapPressure

__all__ = [
    "ApertureLaw",
    "GapFlow",
    "GapPressure",
    "MovingFilm",
    "ResidualAperture",
    "film_conductance",
    "mean_pressure",
    "unseen_exchange",
]
