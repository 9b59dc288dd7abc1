"""The scheduling priority of a process that only observes. Pure."""

from __future__ import annotations

import contextlib
import os


def lower_priority() -> None:
    """Schedule this process as batch work at nice 19: a message that arrives here must not preempt its
    sender.
    """
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        os.nice(19)
