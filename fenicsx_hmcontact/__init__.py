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
from .materials import (  # noqa: E402
    ElasticPlastic,
    LinearElastic,
    Material,
    MaterialStress,
    MaterialUpdate,
    MohrCoulomb,
    ReturnMapping,
    Tresca,
)
from .poromechanics import (  # noqa: E402
    darcy_flux,
    equilibrium,
    finite_strain,
    pressure_projection,
    water_balance,
)
from .problem import ContactProblem  # noqa: E402
from .remeshing import Remeshing  # noqa: E402
from .scene import Scene, SceneModel  # noqa: E402
from .simulation import Simulation  # noqa: E402
from .smoothing import (  # noqa: E402
    create_node_cells,
    dc,
    evaluate_at_points,
    node_cells_measure,
)
from .solvers import (  # noqa: E402
    ConvergenceError,
    NewtonOptions,
    SingularSystemError,
    StepOptions,
    StepRejected,
    TimeStepping,
    TimeSteppingError,
    TransientModel,
)

__version__ = version("fenicsx_hmcontact")

__all__ = [
    "ContactPair",
    "ContactProblem",
    "ConvergenceError",
    "CoulombFriction",
    "Domain",
    "ElasticPlastic",
    "Frictionless",
    "GapFlow",
    "InterfaceState",
    "LinearElastic",
    "Material",
    "MaterialStress",
    "MaterialUpdate",
    "MohrCoulomb",
    "MortarOptions",
    "NewtonOptions",
    "NodeState",
    "Remeshing",
    "ResidualAperture",
    "ReturnMapping",
    "Scene",
    "SceneModel",
    "Simulation",
    "SingularSystemError",
    "StepOptions",
    "StepRejected",
    "Tied",
    "TimeStepping",
    "TimeSteppingError",
    "TransientModel",
    "Tresca",
    "__version__",
    "create_node_cells",
    "darcy_flux",
    "dc",
    "equilibrium",
    "evaluate_at_points",
    "finite_strain",
    "node_cells_measure",
    "pressure_projection",
    "vertex_ghost_partitioner",
    "water_balance",
]
