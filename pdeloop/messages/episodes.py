# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Episode numbers of our tuner, and their notation for people.

The tuner starts counting at a further multiple of `EPISODES_PER_START` each time that it is started, so
that a continued run never uses a number twice.
"""

EPISODES_PER_START = 2**32
"""Numbers for the episodes between two starts of the tuner."""


def episode_name(number: int) -> str:
    """The number of an episode as text: 2.17 is the 17th after the tuner's second start.

    Another tuner may count from 1 as it likes; such a number is its own name.

    >>> episode_name(2 * EPISODES_PER_START + 17), episode_name(17)
    ('2.17', '17')
    """
    start, index = divmod(number, EPISODES_PER_START)
    return f"{start}.{index}" if start else str(index)


def episode_number(name: str) -> int:
    """The number of the episode with this `episode_name`. ValueError if there is none."""
    start, _, index = name.rpartition(".")
    return int(start or 0) * EPISODES_PER_START + int(index)
