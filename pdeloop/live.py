# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A register of the loops on this machine: `pdeloop train` registers here, `monitor` looks it up.

Each puts a file into a folder of this user's under the temporary one and holds a lock on it. The
lock ends with its process, however that ends, so what is found here does run.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from pdeloop.domain import DOMAINS_FOLDER
from pdeloop.messages.documents import parse_json
from pdeloop.messages.files import (
    FileError,
    is_private,
    open_new,
    open_ordinary,
    private_folder,
    try_lock,
)

_PREFIX = "live-"
_MAX_TEXT = 10_000


@dataclass(frozen=True)
class Live:
    """A loop that runs: its ROS domain, the folder of its run, since when (epoch s).

    network: whether its messages may leave the machine.
    """

    domain: int
    folder: Path | None
    started: float
    network: bool = False


@contextlib.contextmanager
def announced(domain: int, folder: Path, *, network: bool = False) -> Iterator[None]:
    """Say for the time of the block that a loop with this folder runs in this domain.

    A temporary folder that cannot be written only means that it is not found.
    """
    content = {
        "domain": domain,
        "folder": str(folder.resolve()),
        "started": time.time(),
        "network": network,
    }
    with contextlib.ExitStack() as held:
        with contextlib.suppress(OSError, FileError):
            private_folder(DOMAINS_FOLDER)
            path = DOMAINS_FOLDER / f"{_PREFIX}{os.getpid()}-{domain}"
            new = path.with_name(f"new-{path.name}")
            new.unlink(missing_ok=True)  # of an earlier process of this number
            file = held.enter_context(open_new(new))
            fcntl.flock(file, fcntl.LOCK_EX)
            file.write(json.dumps(content).encode())
            file.flush()
            held.callback(path.unlink, missing_ok=True)
            new.rename(path)  # under this name it is locked and whole
        yield


def running() -> list[Live]:
    """The loops that this user has running now, the newest first."""
    found = []
    with contextlib.suppress(OSError):
        if not is_private(DOMAINS_FOLDER):
            return []
        for path in DOMAINS_FOLDER.glob(f"{_PREFIX}*"):
            with contextlib.suppress(OSError, ValueError, TypeError, KeyError):
                found += _read(path)
    return sorted(found, key=lambda live: -live.started)


def is_locked(file: BinaryIO) -> bool:
    """True if another process holds the lock of this open file."""
    return not try_lock(file, shared=True)


def _read(path: Path) -> list[Live]:
    with open_ordinary(path) as file:
        if not is_locked(file):
            path.unlink(missing_ok=True)  # of a process that was killed
            return []
        content = parse_json(file.read(_MAX_TEXT))
    folder, started = Path(content["folder"]), float(content["started"])
    return [Live(int(content["domain"]), folder, started, bool(content["network"]))]
