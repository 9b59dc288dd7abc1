# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Interruptions of resumable work: by a signal, an operator's request, or a reader who leaves."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from pdeloop.output import complain
from pdeloop.process.start import on_signals


class Interruption(BaseException):
    """The cause of the end: SIGINT, SIGTERM, SIGHUP (a terminal that was closed), a request."""


@contextmanager
def interruptible(continue_with: str, *, at_once: bool = True) -> Iterator[Callable[[], None]]:
    """SIGINT, SIGTERM and SIGHUP raise Interruption within the block, once.

    Yields a function to be called now and then, which also raises it: an exception that comes in the
    middle of a finalizer or a callback of some library is lost. at_once: without it only that function
    raises it, so that nothing else is left half done. What leaves the block says which command
    continues the work.
    """
    caught: list[str] = []

    def interrupt(name: str) -> None:
        caught.append(name)
        if at_once and len(caught) == 1:  # the way out is not interrupted again
            check()

    def check() -> None:
        if caught:
            raise Interruption(caught[0])

    known = on_signals(interrupt)
    try:
        yield check
    except Interruption as reason:
        raise Interruption(f"{reason}; continue with: {continue_with}") from None
    except BrokenPipeError:
        complain(f"the output has no reader; continue with: {continue_with}")
        raise
    finally:
        for number, handler in known.items():  # nor is the rest of the way
            signal.signal(number, signal.SIG_IGN if caught else handler)
