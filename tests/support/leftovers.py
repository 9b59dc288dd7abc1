# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What tests leave behind: files in their temporary folder, and processes that have inherited it."""

from __future__ import annotations

import contextlib
import gc
import os
import time
from pathlib import Path

PATIENCE = 20.0
"""Seconds that a process which was told to end may take, on a busy machine."""
SERVERS = (b"multiprocessing.forkserver", b"multiprocessing.resource_tracker")
"""Processes of multiprocessing, which end with the one that runs the tests."""


def files(folder: Path) -> set[str]:
    """What is in the temporary folder, but for what has to stay there.

    These are the folders that the product keeps for a user, and multiprocessing's own, which it
    removes at the end of the process.
    """
    kept = f"-{os.getuid()}"
    names = {path.name for path in folder.iterdir()}
    product = {name for name in names if name.startswith("pdeloop-") and name.endswith(kept)}
    return {name for name in names - product if not name.startswith("pymp-")}


def processes(folder: Path) -> dict[int, str]:
    """Processes other than this one that were started with this temporary folder: their commands."""
    found = {}
    inherited = f"TMPDIR={folder}\0".encode()
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if inherited not in (entry / "environ").read_bytes() + b"\0":
                continue
            command = (entry / "cmdline").read_bytes()
            if command and not any(server in command for server in SERVERS):
                found[int(entry.name)] = command.replace(b"\0", b" ").decode(errors="replace")
    found.pop(os.getpid(), None)
    return found


def check(folder: Path, before: set[str], whose: str) -> None:
    """AssertionError if there are other files than before, or processes that do not end."""
    deadline = time.monotonic() + PATIENCE
    while (running := processes(folder)) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not running, f"{whose} leave processes: {running}"
    if files(folder) - before:
        gc.collect()  # a folder may belong to an object that waits for it
    left = sorted(files(folder) - before)
    assert not left, f"{whose} leave files in the temporary folder: {', '.join(left)}"
