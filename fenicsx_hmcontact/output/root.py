# SPDX-License-Identifier: LGPL-3.0-or-later
"""Work that only rank 0 does, and whose failure every rank must hear of."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable
from pathlib import Path

from mpi4py import MPI


def on_root[T](comm: MPI.Comm, action: Callable[[], T]) -> T | None:
    """Run an action on rank 0 alone, and raise its error on every rank. Collective.

    Args:
        comm: Communicator.
        action: What rank 0 does: write a file, draw a figure. It must not be collective itself.

    Returns:
        What the action returns on rank 0, None on the others.

    Raises:
        Exception: What the action raised. Where it cannot be sent, the other ranks raise a
            RuntimeError with its text.
    """
    raised: Exception | None = None
    shared: Exception | None = None
    result: T | None = None
    if comm.rank == 0:
        try:
            result = action()
        except Exception as error:
            raised = error
            shared = _sendable(error)
    shared = comm.bcast(shared)
    if raised is not None:
        raise raised
    if shared is not None:
        raise shared
    return result


def write_whole(path: Path, content: bytes) -> None:
    """Write a file whole or not at all; one of that name is replaced.

    Args:
        path: The file; its folder is made where there is none.
        content: What it holds.

    Raises:
        OSError: If it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part")
    try:
        with open(part, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def _sendable(error: Exception) -> Exception:
    """The error, or one with its text where other ranks would not get the same."""
    try:
        copy = pickle.loads(pickle.dumps(error))
    except Exception:
        copy = None
    if type(copy) is type(error) and str(copy) == str(error):
        return error
    return RuntimeError(f"{type(error).__name__}: {error}")
