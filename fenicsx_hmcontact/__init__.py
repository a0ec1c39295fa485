# SPDX-License-Identifier: LGPL-3.0-or-later
"""Hydro-mechanical contact at large deformation for FEniCSx.

Signs: stress is positive in tension, pore pressure in compression, and a gap is positive where
surfaces are apart. Units are SI; forces and volumes are per metre of thickness.
"""

# MPI comes first: DOLFINx's wheel finds its MPI library through mpi4py.
from mpi4py import MPI  # noqa: F401  # isort: skip

from importlib.metadata import version

from . import _compat

_compat.check_dolfinx()

from .contact import (  # noqa: E402
    ContactPair,
    CoulombFriction,
    Frictionless,
    InterfaceState,
    MortarOptions,
    NodeState,
    Tied,
)
from .domain import Domain, vertex_ghost_partitioner  # noqa: E402
from .gap_flow import GapFlow, ResidualAperture  # noqa: E402
from .materials import LinearElastic  # noqa: E402
from .poromechanics import (  # noqa: E402
    darcy_flux,
    equilibrium,
    pressure_projection,
    water_balance,
)
from .problem import ContactProblem  # noqa: E402
from .smoothing import create_node_cells, dc, node_cells_measure  # noqa: E402
from .solvers import ConvergenceError, NewtonOptions, SingularSystemError  # noqa: E402

__version__ = version("fenicsx_hmcontact")

__all__ = [
    "ContactPair",
    "ContactProblem",
    "ConvergenceError",
    "CoulombFriction",
    "Domain",
    "Frictionless",
    "GapFlow",
    "InterfaceState",
    "LinearElastic",
    "MortarOptions",
    "NewtonOptions",
    "NodeState",
    "ResidualAperture",
    "SingularSystemError",
    "Tied",
    "__version__",
    "create_node_cells",
    "darcy_flux",
    "dc",
    "equilibrium",
    "node_cells_measure",
    "pressure_projection",
    "vertex_ghost_partitioner",
    "water_balance",
]
