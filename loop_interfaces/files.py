"""Files that are whole or not there, whatever moment a crash comes at. No ROS import."""

from __future__ import annotations

import os
from pathlib import Path
from typing import BinaryIO


def write_atomically(path: Path, *content: bytes | memoryview) -> None:
    """Replace `path` by `content`, so that a crash at any moment leaves the old or the new file.

    The content is on the disk before the name points to it, and the name before this returns.

    Raises
    ------
    OSError
        A full or broken disk, or no permission; at `path` is the old file or the new one.
    """
    write_part(path, *content).replace(path)
    sync_folder(path.parent)


def write_part(path: Path, *content: bytes | memoryview) -> Path:
    """Write `content` to the disk as `path`.part, and return that, to be renamed to `path`.

    What an earlier crash has left there is removed, and a link there is not followed.
    """
    part = path.with_name(path.name + ".part")
    part.unlink(missing_ok=True)
    try:
        with open_new(part) as file:
            for piece in content:
                file.write(piece)
            file.flush()
            os.fsync(file.fileno())
    except OSError:
        part.unlink(missing_ok=True)
        raise
    return part


def open_new(path: Path) -> BinaryIO:
    """Make the file `path` and open it for writing. FileExistsError if anything is there, or a link."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
    return os.fdopen(os.open(path, flags, 0o666), "wb")


def sync_folder(folder: Path) -> None:
    """Have the names in `folder` written to the disk."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def make_folder(path: Path) -> None:
    """Make the folder `path`, and those above it that are missing, and have them on the disk."""
    missing = [folder for folder in (path, *path.parents) if not folder.exists()]
    path.mkdir(parents=True, exist_ok=True)
    for folder in missing:
        sync_folder(folder.parent)
