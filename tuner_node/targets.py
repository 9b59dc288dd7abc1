# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Targets of all plants that published one, until the run's own plant is known. Pure."""

from __future__ import annotations

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.messages.frames import Frame, FrameError
from tuner_node.errors import ContradictionError

MAX_TARGETS, MAX_TARGET_BYTES = 64, 2**28
"""Plants whose targets are remembered, and the bytes of all."""


class Targets:
    """z_r by the fingerprints of plants."""

    def __init__(self) -> None:
        self._known: dict[int, Array] = {}

    def of(self, plant: int) -> Array | None:
        """The target of a plant; None if it has not arrived."""
        return self._known.get(plant)

    def keep_only(self, plant: int) -> None:
        """Forget those of other plants."""
        self._known = {p: target for p, target in self._known.items() if p == plant}

    def take(self, frame: Frame) -> None:
        """Take a message on `target`.

        ContradictionError if that of its plant was another. FrameError if there is no room for it.
        """
        known = self._known.get(frame.plant)
        if known is None:
            size = sum(target.nbytes for target in self._known.values()) + frame.values.nbytes
            if len(self._known) == MAX_TARGETS or size > MAX_TARGET_BYTES:
                raise FrameError(
                    f"expected the targets of at most {MAX_TARGETS} plants, {MAX_TARGET_BYTES} bytes"
                )
            self._known[frame.plant] = frame.values.copy()
        elif not np.array_equal(known, frame.values):
            raise ContradictionError(
                f"two different targets arrived for the plant {frame.plant} of this run; expected "
                "one plant with this fingerprint: stop the other and start a new run"
            )
