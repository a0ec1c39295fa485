# SPDX-License-Identifier: LGPL-3.0-or-later
"""A file that holds arrays and a description of them, whole or not at all."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .root import write_whole

FORMAT = "fenicsx_hmcontact checkpoint"
VERSION = 1
"""Version of the format; raised when older files can no longer be read."""

_HEADER = "header"


class CheckpointError(ValueError):
    """A file that a run cannot go on from, and why."""


def write_checkpoint(
    path: str | Path, arrays: Mapping[str, npt.NDArray[Any]], description: Mapping[str, Any]
) -> None:
    """Write a checkpoint; a file of that name is replaced once the new one is whole.

    Args:
        path: The file.
        arrays: Arrays by name.
        description: Anything that JSON can hold.

    Raises:
        OSError: If the file cannot be written.
    """
    header = {
        "format": FORMAT,
        "version": VERSION,
        "digest": _digest(arrays, description),
        "description": dict(description),
    }
    words = np.frombuffer(json.dumps(header).encode(), np.uint8)
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, **{_HEADER: words}, **arrays)
    write_whole(Path(path), content.getvalue())


def read_checkpoint(path: str | Path) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
    """Read what `write_checkpoint` wrote.

    Args:
        path: The file.

    Returns:
        The arrays, and the description.

    Raises:
        FileNotFoundError: If there is no such file.
        CheckpointError: If it is no checkpoint, one of another version, or damaged.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"there is no checkpoint {path}")
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (ValueError, EOFError, OSError, KeyError, zipfile.BadZipFile) as error:
        raise CheckpointError(f"{path} is damaged or no checkpoint: {error}") from error
    try:
        header = json.loads(arrays.pop(_HEADER).tobytes())
        if header["format"] != FORMAT:
            raise KeyError
        version, digest, description = (header[k] for k in ("version", "digest", "description"))
    except (KeyError, TypeError, ValueError, AttributeError):
        raise CheckpointError(f"{path} is no checkpoint of a run") from None
    if version != VERSION:
        raise CheckpointError(
            f"{path} is of version {version}; this package reads and writes version {VERSION}"
        )
    if digest != _digest(arrays, description):
        raise CheckpointError(f"{path} is damaged: its content is not what was written")
    return arrays, description


def _digest(arrays: Mapping[str, npt.NDArray[Any]], description: Mapping[str, Any]) -> str:
    """Fingerprint of a content."""
    result = hashlib.sha256(json.dumps(description, sort_keys=True).encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        result.update(f"{name} {array.dtype.str} {array.shape}".encode())
        result.update(array.tobytes())
    return result.hexdigest()
