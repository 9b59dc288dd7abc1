# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Disks that refuse: a real one that is full after a megabyte, and a folder nobody can write to."""

from __future__ import annotations

import contextlib
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest


@contextlib.contextmanager
def small_disk(folder: Path, megabytes: int, *options: str) -> Iterator[Path]:
    """A tmpfs of this size mounted at `folder`; only root can mount, and not in every container."""
    folder.mkdir()
    how = ",".join((f"size={megabytes}m", *options))
    mount = ["mount", "-t", "tmpfs", "-o", how, "tmpfs", str(folder)]
    if os.getuid() != 0 or subprocess.run(mount).returncode != 0:
        pytest.skip("mounting a small disk needs root, and the right to mount")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


@contextlib.contextmanager
def read_only_folder(folder: Path) -> Iterator[Path]:
    """A folder that cannot be written to: for root one on a read-only disk."""
    if os.getuid() == 0:
        with small_disk(folder, 1, "ro") as mounted:
            yield mounted
        return
    folder.mkdir(mode=0o500)
    yield folder
