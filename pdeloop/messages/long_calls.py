# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Reports long calls of user code, and the line at which they are. Pure.

Code that hangs reports nothing itself, and from outside it looks like a lost message.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

PATIENCE = 10.0
"""Seconds after which it is said for the first time; then after twice as many, and so on."""


@dataclass
class Call:
    """A call that has not returned: its name, the frame that made it, and when to report next."""

    name: str
    frame: FrameType
    began: float
    due: float


class LongCalls:
    """Looks after the calls of this process, in a thread that begins with the first of them."""

    def __init__(self) -> None:
        self._calls: dict[int, Call] = {}
        self._thread: threading.Thread | None = None

    def tell(self, text: str) -> None:
        """The use of the sentence; a node logs it."""
        print(text, file=sys.stderr, flush=True)

    @contextmanager
    def during(self, name: str) -> Iterator[None]:
        """A call is made in the block. name: as the sentence has it, Class.method."""
        if self._thread is None or not self._thread.is_alive():  # a fork has none of the threads
            self._thread = threading.Thread(target=self._look, name="long_calls", daemon=True)
            self._thread.start()
        me, now = threading.get_ident(), time.monotonic()
        outer = self._calls.get(me)
        self._calls[me] = Call(name, sys._getframe(2), now, now + PATIENCE)
        try:
            yield
        finally:
            if outer is None:
                del self._calls[me]
            else:
                self._calls[me] = outer

    def _look(self) -> None:
        while True:
            time.sleep(PATIENCE / 10)
            now, frames = time.monotonic(), sys._current_frames()
            for thread, call in list(self._calls.items()):
                if now >= call.due and thread in frames:
                    seconds = now - call.began
                    call.due = call.began + 2 * seconds
                    self.tell(
                        f"{call.name} has been running for {seconds:.0f} s"
                        f"{_where(frames[thread], call.frame)}"
                    )


def _where(innermost: FrameType, caller: FrameType) -> str:
    """The last line that runs in the file that the caller has called."""
    frames: list[FrameType] = []
    frame: FrameType | None = innermost
    while frame is not None and frame is not caller:
        frames.append(frame)
        frame = frame.f_back
    if frame is None or not frames:
        return ""  # it has just returned
    file = frames[-1].f_code.co_filename
    line = next(f.f_lineno for f in frames if f.f_code.co_filename == file)
    return f", at {file}, line {line}"


LONG_CALLS = LongCalls()
"""Those of this process."""
