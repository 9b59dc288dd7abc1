# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The end of a command by a signal, or by an operator's request."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


class Interruption(BaseException):
    """Who or what ended the work: SIGINT, SIGTERM, SIGHUP (a terminal that was closed), a request."""


@contextmanager
def interruptible(continue_with: str) -> Iterator[Callable[[], None]]:
    """SIGINT, SIGTERM and SIGHUP raise Interruption within the block, once.

    Yields a function to be called now and then, which raises it, too: an exception that comes in the
    middle of a finalizer or a callback of some library is lost. What leaves the block says which
    command continues the work.
    """
    caught: list[str] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        if not caught:  # the way out is not interrupted again
            caught.append(signal.Signals(number).name)
            raise Interruption(caught[0])

    def check() -> None:
        if caught:
            raise Interruption(caught[0])

    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # as nohup leaves it
        numbers.append(signal.SIGHUP)
    known = {n: signal.signal(n, interrupt) for n in numbers}
    try:
        yield check
    except Interruption as reason:
        raise Interruption(f"{reason}; continue with: {continue_with}") from None
    finally:
        for number, handler in known.items():
            signal.signal(number, handler)
