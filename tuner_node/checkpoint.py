# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Checkpoints: arrays in a file that is complete or absent after a crash.

A checkpoint is one line `pdeloop-checkpoint 1 <sha256>` followed by an npz archive without pickled
objects. It is written under another name, flushed to the disk and renamed; the one before is kept, so
that a file damaged later can be passed over. Where none is usable, a training begins again from its
start, and comes to the same result.
"""

import contextlib
import hashlib
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.array_files import Arrays, unpack_arrays
from pdeloop.messages.files import FileError, open_ordinary, sync_folder, write_part

MAGIC = b"pdeloop-checkpoint 1 "


def previous(path: Path) -> Path:
    """Path of the checkpoint before the one at `path`."""
    return path.with_name(path.name + ".previous")


def save(path: Path, arrays: Arrays) -> None:
    """Write a checkpoint and keep the one before.

    After an OSError, of a full or broken disk, the one before is at `path`, or at `previous(path)`.
    """
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    body = buffer.getbuffer()
    part = write_part(path, MAGIC + hashlib.sha256(body).hexdigest().encode() + b"\n", body)
    if path.exists():
        path.replace(previous(path))
    part.replace(path)
    sync_folder(path.parent)


def restore(path: Path, take: Callable[[dict[str, NDArray[Any]]], None]) -> tuple[bool, list[str]]:
    """Call `take` with the newest usable checkpoint: that at `path`, or the one before it.

    take: continues from the arrays, or raises ValueError without changing anything.
    Returns whether there was a usable one, and a sentence for each that was not. Those are set
    aside as `NAME.damaged`, so that the next `save` does not take them for the checkpoint to keep.
    """
    passed_over: list[str] = []
    for candidate in (path, previous(path)):
        if not candidate.exists():
            continue
        try:
            take(_read(candidate))
            return True, passed_over
        except ValueError as error:
            passed_over.append(f"{candidate} {error}")
            with contextlib.suppress(OSError):
                candidate.replace(candidate.with_name(candidate.name + ".damaged"))
    return False, passed_over


def _read(path: Path) -> dict[str, NDArray[Any]]:
    try:
        with open_ordinary(path) as file:
            head = file.readline(len(MAGIC) + 65)
            if not (head.startswith(MAGIC) and head.endswith(b"\n")):
                raise FileError("is not a checkpoint of pdeloop")
            if hashlib.file_digest(file, "sha256").hexdigest().encode() != head[len(MAGIC) : -1]:
                raise FileError("is damaged: its checksum does not match")
            body = file.tell() - len(head)
            file.seek(len(head))
            return unpack_arrays(file, body)  # they are stored as they are
    except OSError as error:
        raise FileError(f"cannot be read: {error.strerror or error}") from error
