"""The header of an array message without decoding the rest: what the recorder needs of each sample."""

from __future__ import annotations

import math
import struct

from loop_interfaces.frames import HEADER, ArrayCodec, Frame, FrameError

_IDS = struct.Struct("<3d")


class HeaderReader:
    """Reads (run, episode, step) from the messages of one topic.

    labels: the topic's axes. A message of the shape of the one before costs one comparison.
    """

    def __init__(self, labels: tuple[str, ...]) -> None:
        self._codec = ArrayCodec(labels)
        self._prefix = b""
        self._size = -1

    def ids(self, raw: bytes) -> tuple[int, int, int] | None:
        """run, episode and step, or None when the bytes do not follow the interface."""
        if len(raw) == self._size and raw.startswith(self._prefix):
            run, episode, step = _IDS.unpack_from(raw, len(self._prefix))
            return int(run), int(episode), int(step)
        frame = self.frame(raw)
        return None if frame is None else (frame.run, frame.episode, frame.step)

    def frame(self, raw: bytes) -> Frame | None:
        """The whole frame, or None when the bytes do not follow the interface."""
        try:
            frame = self._codec.decode(raw)
        except FrameError:
            return None
        if raw[1] == 1:
            # The numbers end the message, but for padding to a multiple of 4, and begin on one of 8.
            numbers = HEADER + math.prod(frame.values.shape)
            start = len(raw) - (len(raw) - 4) % 8 - 8 * numbers
            self._prefix, self._size = raw[:start], len(raw)
        return frame
