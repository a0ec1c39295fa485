# SPDX-License-Identifier: LGPL-3.0-or-later
from pathlib import Path

from mpi4py import MPI

import pytest


@pytest.fixture
def common_dir(tmp_path):
    """A directory that all ranks know."""
    return Path(MPI.COMM_WORLD.bcast(str(tmp_path)))
