# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The array on the wire: std_msgs/Float64MultiArray with a five-number header, as CDR bytes.

Every array of the loop travels as one `Float64MultiArray` whose `layout.dim` is labelled and filled
in, whose `layout.data_offset` is 5 and whose `data` is

    [run, episode, step, time, plant, values...]      (values in row-major order of the dims)

`run`, `episode`, `step` and `plant` are whole numbers below 2^53 (exact in float64), `time` is
simulated time in seconds, or in an action its signature (protocol.py). `plant` is a fingerprint of
the plant's parameters: an action carries that of the state it answers, so two different plants on
one topic are never mixed up. The bytes are the plain CDR encoding of the message (OMG CDR 1.0, as
every ROS 2 middleware uses it), so a node with ordinary message objects reads and writes the same
thing; encoding them here once, with a prefix that depends only on the shape, keeps per-element
Python out of the hot path.
"""

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

HEADER = 5
"""Numbers in front of the values: run, episode, step, time, plant."""
MAX_ID = 2**53
"""Ids are whole numbers below this: the largest range a float64 holds exactly."""
MAX_VALUES = 2**24
"""Largest number of values accepted in one array (128 MiB): the bound on what a peer can send."""


_NATIVE = np.dtype("<f8")
_HEAD = struct.Struct("<5d")


KEPT_ARRAY = 320
"""Bytes of Python's overhead for an array that is kept under its ids, in addition to the values."""


class FrameError(ValueError):
    """An array message that does not follow the interface; the text says what and what was expected."""


@dataclass(slots=True)
class Frame:
    """One array of the loop with its header. Never changed once it is made: take `replace`.

    (Not declared frozen, which makes a frame four times as slow to make, and every round makes
    four.) time: simulated, in s, or a signature; values: one axis for each label of the topic.
    """

    run: int
    episode: int
    step: int
    time: float
    values: NDArray[np.float64]
    plant: int = 0


def digest(values: NDArray[np.float64]) -> int:
    """A number that distinguishes these values from others, in this process."""
    return hash(values.tobytes())


@dataclass(frozen=True, slots=True)
class _Layout:
    """The bytes in front of the numbers of a message, and their meaning."""

    prefix: bytes
    shape: tuple[int, ...]
    count: int
    length: int
    """Bytes of the whole message."""
    type: np.dtype[np.float64]
    swapped: bool
    """True if its numbers are in big-endian order."""


class ArrayCodec:
    """Encodes and decodes the arrays of one topic; labels: the names of the axes, in order.

    others: the names where an array has another number of axes.

    >>> codec = ArrayCodec(("env", "actuator"))
    >>> raw = codec.encode(Frame(run=7, episode=1, step=0, time=0.5, values=np.ones((1, 2))))
    >>> frame = codec.decode(raw)
    >>> frame.run, frame.time, frame.values
    (7, 0.5, array([[1., 1.]]))
    """

    def __init__(self, labels: tuple[str, ...], *others: tuple[str, ...]) -> None:
        self.labels = labels
        self._labels = {len(names): names for names in (labels, *others)}
        self._templates: dict[tuple[int, ...], tuple[bytearray, int, NDArray[np.float64]]] = {}
        self._last: _Layout | None = None

    def prefix_of(self, shape: tuple[int, ...]) -> bytes | None:
        """The bytes in front of the header in messages of the peer that was decoded last.

        None if their values had another shape, or their numbers another byte order.
        """
        last = self._last
        return last.prefix if last and last.shape == shape and not last.swapped else None

    def encode(self, frame: Frame) -> bytes:
        """CDR bytes of `frame`, little-endian. FrameError if it has another number of axes."""
        return bytes(self.encode_into_own(frame))

    def encode_into_own(self, frame: Frame) -> bytearray:
        """`encode` without the last copy: the bytes are valid until the next call."""
        values = frame.values
        template = self._templates.get(values.shape)
        if template is None:
            template = self._template(values.shape)
        buffer, start, data = template
        _HEAD.pack_into(
            buffer, start, frame.run, frame.episode, frame.step, frame.time, frame.plant
        )
        data[...] = values
        return buffer

    def decode(self, raw: bytes) -> Frame:
        """The frame in the CDR bytes `raw`; its values are a view of them.

        FrameError for bytes that are no Float64MultiArray of these axes, an id that is not a whole
        number in [0, 2^53), and NaN or infinity.
        """
        layout = self._last
        # A peer of ours sends the same prefix each time; ordinary message objects leave padding
        # bytes undefined.
        if layout is None or len(raw) != layout.length or not raw.startswith(layout.prefix):
            layout = self._last = self._parse(raw)
        numbers = np.frombuffer(raw, layout.type, offset=len(layout.prefix), count=layout.count)
        if layout.swapped:
            numbers = numbers.astype(np.float64)
        if not np.isfinite(numbers).all():
            raise FrameError("expected finite numbers, got NaN or infinity")
        run, episode, step, time, plant = numbers[:HEADER].tolist()
        for name, number in ("run", run), ("episode", episode), ("step", step), ("plant", plant):
            if not (0.0 <= number < MAX_ID and number.is_integer()):
                raise FrameError(f"expected {name} to be a whole number in [0, 2^53), got {number}")
        values = numbers[HEADER:].reshape(layout.shape)
        return Frame(int(run), int(episode), int(step), time, values, int(plant))

    def _template(self, shape: tuple[int, ...]) -> tuple[bytearray, int, NDArray[np.float64]]:
        labels = self._labels.get(len(shape))
        if labels is None:
            raise FrameError(f"expected the axes {self.labels}, got an array of shape {shape}")
        total = math.prod(shape)
        head = bytearray(b"\x00\x01\x00\x00") + struct.pack("<I", len(shape))
        for label, size, stride in zip(labels, shape, _strides(shape), strict=True):
            text = label.encode() + b"\0"
            head += struct.pack("<I", len(text)) + text
            head += bytes(-(len(head) - 4) % 4) + struct.pack("<II", size, stride)
        head += struct.pack("<II", HEADER, HEADER + total)
        head += bytes(-(len(head) - 4) % 8)
        start = len(head)
        buffer = head + bytes(8 * (HEADER + total))
        data = np.ndarray(shape, _NATIVE, buffer, start + _HEAD.size)
        # Shapes are few; a bound keeps a long life flat.
        known = sum(len(buffer) for buffer, _, _ in self._templates.values())
        if len(self._templates) >= 64 or known > MAX_VALUES:
            self._templates.clear()
        self._templates[shape] = (buffer, start, data)
        return self._templates[shape]

    def _parse(self, raw: bytes) -> _Layout:
        if len(raw) < 8 or raw[0] != 0 or raw[1] not in (0, 1):
            raise FrameError("expected CDR bytes, got something else")
        order = "<" if raw[1] else ">"
        position = 4

        def number() -> int:
            nonlocal position
            position += -(position - 4) % 4
            if position + 4 > len(raw):
                raise FrameError(f"the message ends after {len(raw)} bytes, within its layout")
            (value,) = struct.unpack_from(f"{order}I", raw, position)
            position += 4
            return int(value)

        axes = number()
        labels = self._labels.get(axes)
        if labels is None:
            raise FrameError(f"expected {len(self.labels)} axes {self.labels}, got {axes}")
        shape, strides = [], []
        for expected in labels:
            length = number()
            label = raw[position : position + length].rstrip(b"\0")
            if length > 256 or label != expected.encode():
                raise FrameError(f"expected an axis labelled {expected!r}, got {label[:32]!r}")
            position += length
            shape.append(number())
            strides.append(number())
        if max(math.prod(shape), *shape) > MAX_VALUES:
            raise FrameError(f"expected at most {MAX_VALUES} values, got a layout of {shape}")
        if strides != _strides(shape):
            raise FrameError(f"expected row-major strides for {shape}, got {strides}")
        offset, count = number(), number()
        if offset != HEADER:
            raise FrameError(f"expected layout.data_offset {HEADER}, got {offset}")
        if count != HEADER + math.prod(shape):
            raise FrameError(
                f"expected {HEADER} + {math.prod(shape)} numbers for {shape}, got {count}"
            )
        position += -(position - 4) % 8
        # RTPS rounds a payload up to 4 bytes; our data ends on 8, so at most 3 bytes may follow.
        if not 0 <= len(raw) - position - 8 * count < 4:
            raise FrameError(f"expected {count} numbers after the layout, got another length")
        kind = np.dtype(f"{order}f8")
        return _Layout(raw[:position], tuple(shape), count, len(raw), kind, order == ">")


def _strides(shape: Sequence[int]) -> list[int]:
    """`layout.dim[i].stride`: how many values lie in one block of axis i, as ROS defines it."""
    return [math.prod(shape[axis:]) for axis in range(len(shape))]
