# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Data on stdout for scripts, tables for people, lines on stderr."""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from pdeloop.messages.text import printable

LONGEST = 4000
"""Characters of a complaint; a longer one repeats what a file says."""


def print_json(value: Any) -> None:
    """One line of JSON. A number that JSON has no word for is null."""
    print(json.dumps(_strict(value), allow_nan=False))


def complain(text: str) -> None:
    """One line on stderr, where it can be written; a terminal does not obey what a file says."""
    told = text if len(text) <= LONGEST else f"{text[:LONGEST]}..."
    with contextlib.suppress(OSError):
        print(f"pdeloop: {printable(told)}", file=sys.stderr)


def drop_unwritable() -> None:
    """Let stdout and stderr lead to /dev/null where they cannot be written (a full disk, no reader).

    What waits in them would be tried again with all that follows, at last by the interpreter.
    """
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def aligned(rows: Sequence[Sequence[str]], names: int = 1) -> list[str]:
    """The rows of a table as lines, the columns side by side; the first `names` are words.

    Examples
    --------
    >>> aligned([("problem", "cost"), ("kdv", "33.71")])
    ['problem   cost', 'kdv      33.71']
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if place < names else cell.rjust(width)
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def _strict(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): _strict(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_strict(entry) for entry in value]
    return value
