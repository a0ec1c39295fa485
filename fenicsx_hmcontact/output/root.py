# SPDX-License-Identifier: LGPL-3.0-or-later
"""Work that only rank 0 does, and whose failure every rank must hear of."""

from __future__ import annotations

from collections.abc import Callable

from mpi4py import MPI


def on_root(comm: MPI.Comm, action: Callable[[], object]) -> None:
    """Run an action on rank 0 alone, and raise its error on every rank. Collective.

    Args:
        comm: Communicator.
        action: What rank 0 does: write a file, draw a figure. It must not be collective itself.

    Raises:
        Exception: What the action raised. Where that is no built-in exception, the other ranks
            raise a RuntimeError with its text.
    """
    raised: Exception | None = None
    shared: Exception | None = None
    if comm.rank == 0:
        try:
            action()
        except Exception as error:
            raised = error
            # Only built-in exceptions are sure to survive pickling.
            builtin = type(error).__module__ == "builtins"
            shared = error if builtin else RuntimeError(f"{type(error).__name__}: {error}")
    shared = comm.bcast(shared)
    if raised is not None:
        raise raised
    if shared is not None:
        raise shared
