# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What `pdeloop bag verify` says of a bag, and the messages of one by episodes."""

from __future__ import annotations

from pathlib import Path

from pdeloop.bags.mcap_messages import Message
from pdeloop.bags.report import Report
from pdeloop.cli import main
from recorder_node.recording import CLOCK
from tests.support.recorded_here import PART, episode_of

HORIZON = 12
"""As short as its model allows."""
EPISODES = 1 + 1 + 3 + 4
"""Exploration, check, three steps of four rollouts, twelve of the evaluation and two repeated ones."""


def by_episodes(messages: list[Message], *ends: int) -> list[list[Message]]:
    """The messages cut after these episodes, counted from 1; what is about none goes to the first.

    A time on /clock stays with its state.
    """
    edges = [PART - 1, *(PART - 1 + end for end in ends), 2**60]
    parts: list[list[Message]] = [[] for _ in edges[1:]]
    number = 0
    for message in messages:
        number = number if message.topic == CLOCK.channel.topic else episode_of(message)
        part = next(i for i, edge in enumerate(edges[1:]) if number <= edge)
        parts[part].append(message)
    return parts


def words_of(report: Report) -> str:
    return "\n".join([*report.missing, *report.differences, *report.incomplete, *report.notes])


def verified(*paths: Path) -> int:
    return main(["bag", "verify", *map(str, paths)])
