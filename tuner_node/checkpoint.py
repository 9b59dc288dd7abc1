"""What must survive a crash: arrays in a file that is whole or not there.

A checkpoint is one line `pdeloop-checkpoint 1 <sha256>` followed by an npz archive without pickled
objects. It is written beside its place, flushed to the disk and renamed; the previous one is kept, so
that a file damaged later can be passed over.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAGIC = b"pdeloop-checkpoint 1 "
MAX_BYTES = 2**30
Arrays = Mapping[str, NDArray[Any]]


class CheckpointError(ValueError):
    """No usable checkpoint; the text says which files were tried and what is wrong with each."""


def write_atomically(path: Path, content: bytes) -> None:
    """Replace `path` by `content`, so that a crash at any moment leaves the old or the new file.

    Raises OSError (full disk, no permission) with the old file untouched.
    """
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def previous(path: Path) -> Path:
    """Where the checkpoint before the one at `path` is kept."""
    return path.with_name(path.name + ".previous")


def save(path: Path, arrays: Arrays) -> None:
    """Write a checkpoint and keep the one before. Raises OSError with the old ones untouched."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    body = buffer.getvalue()
    content = MAGIC + hashlib.sha256(body).hexdigest().encode() + b"\n" + body
    part = path.with_name(path.name + ".new")
    write_atomically(part, content)
    if path.exists():
        path.replace(previous(path))
    part.replace(path)


def load(path: Path, run: int | None = None) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """The newest good checkpoint at `path` and warnings about what was passed over.

    run: the run it must belong to, if given. What is damaged or foreign is set aside as
    `checkpoint*.damaged`, so that the next `save` cannot take it for the checkpoint to keep.
    Raises CheckpointError when neither the file nor its predecessor is whole.
    """
    warnings: list[str] = []
    for candidate in (path.with_name(path.name + ".new"), path, previous(path)):
        if not candidate.exists():
            continue
        try:
            arrays = _read(candidate)
            if run is not None and int(arrays.get("run", np.array(-1))) != run:
                raise CheckpointError(f"{candidate} belongs to another run")
            return arrays, warnings
        except CheckpointError as error:
            warnings.append(str(error))
            with contextlib.suppress(OSError):
                candidate.replace(candidate.with_name(candidate.name + ".damaged"))
    detail = "; ".join(warnings) if warnings else f"{path} does not exist"
    raise CheckpointError(f"no usable checkpoint: {detail}")


def _read(path: Path) -> dict[str, NDArray[Any]]:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise CheckpointError(f"{path} is larger than {MAX_BYTES} bytes")
        content = path.read_bytes()
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read: {error.strerror}") from error
    head, newline, body = content.partition(b"\n")
    if not (head.startswith(MAGIC) and newline):
        raise CheckpointError(f"{path} is not a checkpoint of pdeloop")
    if hashlib.sha256(body).hexdigest().encode() != head[len(MAGIC) :]:
        raise CheckpointError(f"{path} is damaged: its checksum does not match")
    try:
        with np.load(io.BytesIO(body), allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (ValueError, OSError, zipfile.BadZipFile, KeyError) as error:
        raise CheckpointError(f"{path} holds no arrays: {error}") from error
