# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Finds missing episodes by their numbers: our tuner counts from 1 without gaps."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import groupby, pairwise

from pdeloop.messages.episodes import EPISODES_PER_START, episode_name

NAMED = 5
"""Gaps that are named; the others are only counted."""

Gap = tuple[int, int]
"""The first and the last of consecutive numbers that are missing."""


def gaps(numbers: Iterable[int]) -> list[Gap]:
    """The numbers missing before and between these, of each start of the tuner that is among them.

    Numbers that are not our tuner's have none.

    >>> gaps([EPISODES_PER_START + 2, EPISODES_PER_START + 5]) == [
    ...     (EPISODES_PER_START + 1, EPISODES_PER_START + 1),
    ...     (EPISODES_PER_START + 3, EPISODES_PER_START + 4),
    ... ]
    True
    >>> gaps([3, 9])
    []
    """
    found = []
    for start, own in groupby(
        sorted(set(numbers)), key=lambda number: number // EPISODES_PER_START
    ):
        if start:
            for a, b in pairwise([start * EPISODES_PER_START, *own]):
                found += [(a + 1, b - 1)] if b - a > 1 else []
    return found


def gaps_text(found: Sequence[Gap]) -> str:
    """The gaps in words.

    >>> gaps_text([(EPISODES_PER_START + 3, EPISODES_PER_START + 4)])
    'episodes 1.3 to 1.4'
    """
    parts = [
        episode_name(a) if a == b else f"{episode_name(a)} to {episode_name(b)}"
        for a, b in found[:NAMED]
    ]
    more = f" and {len(found) - NAMED} more gaps" if len(found) > NAMED else ""
    several = len(found) > 1 or any(a != b for a, b in found)
    return f"episode{'s' if several else ''} {', '.join(parts)}{more}"
