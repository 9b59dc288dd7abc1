"""The messages to a page, and what it has been told. Pure.

Text is JSON. What has numbers is binary: the length of the header (uint32), the header as JSON
padded to 4 bytes, float32 numbers, all little-endian.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from viewer_node.episode_samples import Episode, rows_of
from viewer_node.loop_view import Watched

_LENGTH = struct.Struct("<I")


@dataclass
class Cursor:
    """What one page has been told so far."""

    status: int = -1
    curve: tuple[int, int] = (-1, -1)
    target: tuple[int, int, int] = (-1, -1, -1)
    begun: tuple[int, int] = (-1, -1)
    chosen: tuple[int, int] = (-1, -1)
    stride: int = 0
    column: int = 0
    shown: tuple[int, int, bool] = (-1, -1, False)


def pack(header: Mapping[str, Any], values: NDArray[np.float32]) -> bytes:
    """A message with numbers."""
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    return _LENGTH.pack(len(text)) + text + values.astype("<f4").tobytes()


def target(watched: Watched, shown: Episode, component: int) -> bytes:
    """The target of the plant whose episode is shown; no numbers if it is not known."""
    values = watched.targets.get(shown.key[2])
    if values is None:
        return pack({"part": "target"}, np.empty(0, np.float32))
    rows = rows_of(len(values), shown.components)[shown.part(component)]
    return pack({"part": "target"}, values[rows].astype(np.float32))


def sample(
    watched: Watched,
    shown: Episode,
    cursor: Cursor,
    *,
    generation: int,
    chosen: tuple[int, int],
    colours: tuple[float, float],
) -> bytes | None:
    """The columns of the shown episode that are new since `cursor`, or None.

    Its numbers: field (columns, rows), actions (columns, actions), the newest state (rows).
    generation: of what is watched; chosen: environment and component.
    """
    now = (shown.samples, shown.last, shown.ended)
    begun = (generation, watched.begun)
    same = (cursor.begun, cursor.chosen, cursor.stride) == (begun, chosen, shown.stride)
    if same and cursor.shown == now:
        return None
    row, part = shown.row(chosen[0]), shown.part(chosen[1])
    first = cursor.column if same else 0
    cursor.begun, cursor.chosen, cursor.stride = begun, chosen, shown.stride
    cursor.column, cursor.shown = shown.settled, now
    fields = shown.fields[row, first : shown.columns, part]
    actions = shown.actions[row, first : shown.columns] if shown.actions.size else fields[:, :0]
    header = {
        "part": "episode",
        "new": not same,
        "run": shown.key[0],
        "episode": shown.key[1],
        "kind": watched.kinds.get(shown.key[:2], ""),
        "environment": shown.environments[row],
        "first": first,
        "columns": len(fields),
        "rows": fields.shape[1],
        "actions": actions.shape[1],
        "stride": shown.stride,
        "begin": shown.first,
        "last": shown.last,
        "ended": shown.ended,
        "sample_time": shown.sample_time or watched.parameters.get("sample_time", 0.0),
        "range": colours,
    }
    latest = shown.latest[row][rows_of(shown.latest.shape[1], shown.components)[part]]
    return pack(header, np.concatenate([fields.ravel(), actions.ravel(), latest]))
