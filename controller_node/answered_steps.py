# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Detects episode costs that the plant cannot have sent. Pure.

A controller knows how far it has answered the states of an episode. A cost that says that the episode
went further, and the plant that gives it up before that step, together are a contradiction. One of the
two alone is none: a second controller may have answered the others, or a second plant be slower.
"""

from typing import TypeAlias

from pdeloop.messages.frames import Frame
from pdeloop.messages.topics import VOID

Ids: TypeAlias = tuple[int, int, int]
"""Run, plant and episode."""
NONE: Ids = (-1, -1, -1)


class AnsweredSteps:
    """The last answered step of an episode, and its last step according to its cost."""

    def __init__(self) -> None:
        self._episode = NONE
        """The last one whose states were answered from the first one on."""
        self._furthest = -1
        """The last step of it that was answered."""
        self._claimed = NONE, -1
        """An episode, and the step to which it went by a cost: further than was answered."""

    def answered(self, episode: Ids, step: int) -> None:
        """Note that states of an episode were answered, `step` the furthest of them."""
        if step == 0 and episode != self._episode:
            self._episode, self._furthest = episode, 0
        if episode == self._episode:
            self._furthest = max(self._furthest, step)
        if episode == self._claimed[0] and step >= self._claimed[1]:
            self._claimed = NONE, -1

    def contradiction(self, cost: Frame) -> str:
        """Why the episode of a cost cannot be relied on; empty if nothing is known against it."""
        episode = cost.run, cost.plant, cost.episode
        if not (cost.values[:, -1:] == VOID).any():
            if episode == self._episode and cost.step > self._furthest:
                self._claimed = episode, cost.step
            return ""
        known, step = self._claimed
        if episode != known or cost.step >= step:
            return ""
        self._claimed = NONE, -1
        return (
            f"a cost claims that the episode reached step {step}, but the plant gave it up at step "
            f"{cost.step}"
        )
