"""The field of one environment over space and time, as rows of a picture. Pure."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MAX_ROWS = 400
"""Rows of a picture; a longer episode has several steps in one row, the last of them shown."""
UNSEEN = (128, 128, 128)
"""Colour of steps that were not seen."""
_NEGATIVE, _ZERO, _POSITIVE = (33, 102, 172), (247, 247, 247), (178, 24, 43)


def _colours() -> NDArray[np.uint8]:
    """511 colours from blue over white to red."""
    up = np.linspace(0.0, 1.0, 256)[:, None]
    positive = (1 - up) * _ZERO + up * np.array(_POSITIVE)
    negative = (1 - up) * _ZERO + up * np.array(_NEGATIVE)
    return np.concatenate([negative[:0:-1], positive]).round().astype(np.uint8)


_COLOURS = _colours()


class SpaceTime:
    """Rows of fields (n_z,) by step. horizon: steps that are expected; more of them are squeezed in."""

    def __init__(self, n_z: int, horizon: int) -> None:
        self._per_row = -(-(horizon + 1) // MAX_ROWS)
        rows = -(-(horizon + 1) // self._per_row)
        self._rows = np.full((rows, n_z), np.nan, dtype=np.float32)

    def put(self, step: int, z: NDArray[np.float64]) -> None:
        """Take the field at a step of at least 0."""
        if z.shape != self._rows.shape[1:]:
            return
        while step // self._per_row >= len(self._rows):
            self._squeeze()
        self._rows[step // self._per_row] = z

    def colours(self) -> NDArray[np.uint8]:
        """The picture, (rows, n_z, 3): zero is white, the largest magnitude full red or blue."""
        seen = np.isfinite(self._rows)
        scale = float(np.abs(self._rows[seen]).max()) if seen.any() else 0.0
        level = np.where(seen, self._rows, 0.0) / (scale or 1.0)
        picture = _COLOURS[(255 * level).round().astype(np.int64) + 255]
        picture[~seen] = UNSEEN
        return picture

    def _squeeze(self) -> None:
        """Two rows become one, the later of them that was seen."""
        if len(self._rows) < MAX_ROWS:  # there is room: no need to squeeze
            more = np.full_like(self._rows, np.nan)[: MAX_ROWS - len(self._rows)]
            self._rows = np.concatenate([self._rows, more])
            return
        first, second = self._rows[0::2], self._rows[1::2]
        kept = np.full_like(self._rows, np.nan)
        kept[: len(first)] = first
        later = np.isfinite(second[:, 0])
        kept[: len(second)][later] = second[later]
        self._rows, self._per_row = kept, 2 * self._per_row
