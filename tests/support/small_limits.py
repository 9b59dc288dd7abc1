# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Hard limits on what a test may use, so that a hang or an explosion is a failure and not a wait."""

from __future__ import annotations

import contextlib
import resource
import signal
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def limited(seconds: int, megabytes: int = 0) -> Iterator[None]:
    """Raise TimeoutError in the main thread after `seconds`, MemoryError beyond `megabytes` more."""

    def over(*_: object) -> None:
        raise TimeoutError(f"not done after {seconds} s")

    before = resource.getrlimit(resource.RLIMIT_AS)
    handler = signal.signal(signal.SIGALRM, over)
    signal.alarm(seconds)
    if megabytes:
        with Path("/proc/self/statm").open() as file:
            now = int(file.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (now + megabytes * 2**20, before[1]))
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, handler)
        resource.setrlimit(resource.RLIMIT_AS, before)
