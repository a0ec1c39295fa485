# SPDX-License-Identifier: LGPL-3.0-or-later
"""Fixtures, and what lets the tests run under mpirun."""

import gc
import shutil
import sys
import tempfile
from collections.abc import Generator, Iterator
from pathlib import Path
from types import SimpleNamespace

from mpi4py import MPI

import pytest

COMM = MPI.COMM_WORLD


@pytest.fixture
def comm() -> MPI.Intracomm:
    """All ranks of the run."""
    return COMM


@pytest.fixture
def shared_tmp_path(comm: MPI.Intracomm) -> Iterator[Path]:
    """One empty folder for all ranks, removed after the test."""
    path = Path(comm.bcast(tempfile.mkdtemp(prefix="hmcontact-") if comm.rank == 0 else None))
    yield path
    comm.Barrier()
    if comm.rank == 0:
        shutil.rmtree(path)


def pytest_collection_finish() -> None:
    """Spare the collection after each test all that was imported."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> Generator[None]:
    """Destroy PETSc and DOLFINx objects, which is collective, on all ranks at the same place."""
    yield
    # One rank waits for nobody: a collection after each file spares minutes.
    if COMM.size > 1 or nextitem is None or nextitem.path != item.path:
        gc.collect()
    COMM.Barrier()


@pytest.hookimpl(trylast=True)
def pytest_configure(config: pytest.Config) -> None:
    """Let rank 0 alone report."""
    if COMM.rank > 0:
        plugins = config.pluginmanager
        reporter = plugins.unregister(name="terminalreporter")
        # pytest-timeout writes the stacks of a hanging rank through the reporter of that name.
        plugins.register(SimpleNamespace(_tw=reporter._tw), "terminalreporter")


def _abort_on_failure(report: pytest.TestReport | pytest.CollectReport) -> None:
    """End all ranks when one has failed: the others would wait for it in their next collective."""
    if report.failed and COMM.size > 1:
        print(f"\nFAILED on rank {COMM.rank} of {COMM.size}: {report.nodeid}", file=sys.stderr)
        for title, text in [("", report.longreprtext), *report.sections]:
            print(title, text, sep="\n", file=sys.stderr, flush=True)
        COMM.Abort(1)


@pytest.hookimpl(trylast=True)
def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Do not wait for a rank whose test failed."""
    _abort_on_failure(report)


@pytest.hookimpl(trylast=True)
def pytest_collectreport(report: pytest.CollectReport) -> None:
    """Do not wait for a rank that could not import a test file."""
    _abort_on_failure(report)
