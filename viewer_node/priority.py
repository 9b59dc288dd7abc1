"""The priority of a process that only looks. Pure."""

from __future__ import annotations

import contextlib
import os


def stand_back() -> None:
    """Let the loop's processes go first: what arrives here must not preempt its sender."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        os.nice(19)
