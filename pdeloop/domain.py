# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A separate ROS domain for each run, so that two runs on a machine never interfere.

Who works in a domain puts a file into a folder of this user's under the temporary one and holds a lock
on it. The lock ends with its process, however that ends, so what is found there does run: `pdeloop
train` announces itself, `monitor` looks it up.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import random
import re
import socket
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from pde_sim_node.run_record import forget
from pdeloop.messages import files
from pdeloop.messages.documents import parse_json

DOMAINS = range(1, 101)
"""Domains whose ports lie outside the ephemeral range on Linux; 0 is everybody's default."""
DOMAINS_FOLDER = Path(tempfile.gettempdir()) / f"pdeloop-domains-{os.getuid()}"
"""Locks of the domains in use, and who uses them (`announced`)."""
FIRST_PARTICIPANTS = 16
"""Participants whose ports are checked: more than a run of a few pairs has."""


class DomainError(RuntimeError):
    """No free ROS domain."""


def given_domain() -> int | None:
    """ROS_DOMAIN_ID, None if the user has not set it."""
    chosen = os.environ.get("ROS_DOMAIN_ID")
    if not chosen:
        return None
    if not re.fullmatch("[0-9]+", chosen) or int(chosen) > 232:
        raise DomainError(f"ROS_DOMAIN_ID is {chosen!r}; expected a whole number from 0 to 232")
    return int(chosen)


@contextlib.contextmanager
def own_domain() -> Iterator[int]:
    """ROS_DOMAIN_ID if the user set it, else a free domain, held until the end of the block.

    DomainError where another training was given the same, as by a shell's start-up file: each would
    take the other's nodes for its own.
    A domain is free when no other run holds its lock and nobody is bound to a discovery port of its
    first participants (7410 + 250 d + 2 i on loopback): the first of them may have left.
    """
    chosen = given_domain()
    if chosen is not None:
        with _held(chosen):
            yield chosen
        return
    try:
        files.private_folder(DOMAINS_FOLDER)
    except (OSError, files.FileError) as error:
        raise DomainError(f"no ROS domain can be reserved: {error}") from error
    for domain in random.sample(DOMAINS, len(DOMAINS)):
        with files.open_own(DOMAINS_FOLDER / str(domain), 0) as lock:
            try:
                free = files.try_lock(lock)
            except files.FileError as error:
                raise DomainError(
                    f"no ROS domain can be reserved: {DOMAINS_FOLDER / str(domain)} {error}; "
                    "set TMPDIR to a folder on one"
                ) from error
            if free and _unused(domain):
                forget(domain)
                yield domain
                return
    raise DomainError(f"all ROS domains from {DOMAINS[0]} to {DOMAINS[-1]} are in use")


@contextlib.contextmanager
def _held(chosen: int) -> Iterator[None]:
    """The user's domain, for this block; without a place for locks other runs go unnoticed."""
    with contextlib.ExitStack() as held:
        free = True
        with contextlib.suppress(OSError, files.FileError):
            files.private_folder(DOMAINS_FOLDER)
            lock = held.enter_context(files.open_own(DOMAINS_FOLDER / f"given-{chosen}", 0))
            free = files.try_lock(lock)
        if not free:
            raise DomainError(
                f"another training runs in ROS_DOMAIN_ID={chosen}; unset the variable to take a free "
                "domain, or wait until it has ended"
            )
        yield


def _unused(domain: int) -> bool:
    for participant in range(FIRST_PARTICIPANTS):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("127.0.0.1", 7410 + 250 * domain + 2 * participant))
            except OSError:
                return False
    return True


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
        with contextlib.suppress(OSError, files.FileError):
            files.private_folder(DOMAINS_FOLDER)
            path = DOMAINS_FOLDER / f"{_PREFIX}{os.getpid()}-{domain}"
            new = path.with_name(f"new-{path.name}")
            new.unlink(missing_ok=True)  # of an earlier process of this number
            file = held.enter_context(files.open_new(new))
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
        if not files.is_private(DOMAINS_FOLDER):
            return []
        for path in DOMAINS_FOLDER.glob(f"{_PREFIX}*"):
            with contextlib.suppress(OSError, ValueError, TypeError, KeyError):
                found += _read(path)
    return sorted(found, key=lambda live: -live.started)


def is_locked(file: BinaryIO) -> bool:
    """True if another process holds the lock of this open file."""
    return not files.try_lock(file, shared=True)


def _read(path: Path) -> list[Live]:
    with files.open_ordinary(path) as file:
        if not is_locked(file):
            path.unlink(missing_ok=True)  # of a process that was killed
            return []
        content = parse_json(file.read(_MAX_TEXT))
    folder, started = Path(content["folder"]), float(content["started"])
    return [Live(int(content["domain"]), folder, started, bool(content["network"]))]
