"""The messages with numbers to a page, and what it has been sent. Pure.

Text is JSON. What has numbers is binary: the length of the header (uint32), the header as JSON
padded to 4 bytes, float32 numbers, all little-endian.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from viewer_node.episode_samples import EpisodeSamples, rows_of

_LENGTH = struct.Struct("<I")


@dataclass
class Cursor:
    """What one page has been sent so far."""

    status: int = -1
    curve: tuple[int, int] = (-1, -1)
    target: tuple[int, int, int] = (-1, -1, -1)
    shown: tuple[int, int, int, int] = (-1, -1, -1, -1)
    samples: tuple[int, int, bool] = (-1, -1, False)
    column: int = 0


def pack(header: Mapping[str, Any], values: NDArray[np.float32]) -> bytes:
    """A message with numbers."""
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    return _LENGTH.pack(len(text)) + text + values.astype("<f4").tobytes()


def target_message(
    values: NDArray[np.float64] | None, shown: EpisodeSamples, component: int
) -> bytes:
    """The target of the plant whose episode is shown; no numbers if it is not known."""
    if values is None:
        return pack({"part": "target"}, np.empty(0, np.float32))
    rows = rows_of(len(values), shown.components)[shown.part(component)]
    return pack({"part": "target"}, values[rows].astype(np.float32))


def samples_message(
    shown: EpisodeSamples,
    cursor: Cursor,
    *,
    controller: Callable[[], str],
    environment: int,
    component: int,
    colours: tuple[float, float],
    sample_time: float,
) -> bytes | None:
    """The columns of the shown episode that are new since `cursor`, or None.

    controller() tells who acts in the environment. The numbers: field (columns, rows), actions
    (columns, actions), the newest state (rows).
    """
    now = (shown.samples, shown.last, shown.ended)
    what = (shown.number, environment, component, shown.stride)
    same = cursor.shown == what
    if same and cursor.samples == now:
        return None
    row, part = shown.row(environment), shown.part(component)
    first = cursor.column if same else 0
    cursor.shown, cursor.samples, cursor.column = what, now, shown.settled
    fields = shown.fields[row, first : shown.columns, part]
    actions = shown.actions[row, first : shown.columns] if shown.actions.size else fields[:, :0]
    header = {
        "part": "episode",
        "new": not same,
        "run": shown.key[0],
        "episode": shown.key[1],
        "controller": controller(),
        "environment": shown.environments[row],
        "first": first,
        "columns": len(fields),
        "rows": fields.shape[1],
        "actions": actions.shape[1],
        "stride": shown.stride,
        "begin": shown.first,
        "last": shown.last,
        "ended": shown.ended,
        "sample_time": sample_time,
        "range": colours,
    }
    z = shown.z[shown.environments[row]]
    newest = z[rows_of(len(z), shown.components)[part]]
    return pack(header, np.concatenate([fields.ravel(), actions.ravel(), newest]))
