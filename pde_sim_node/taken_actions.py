# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Starts and actions that a plant has taken in a run, and the detection of contradictory ones. Pure.

Answers are deterministic: two different ones to a state come from a second or a faulty controller.
Which of them was taken is random, so the episode is void. The same holds for two starts of an
episode. If the second one arrives after the end of one of the last episodes, the cost of that episode
is sent again, void.

Where the tuner asks for it (pdeloop.messages.protocol), the first action of a run says whether its
controller signs. If so, only actions with the signature of their episode are taken; if not, a signed
one comes from a second controller, and contradicts.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from pdeloop.messages.frames import Frame, FrameError, digest
from pdeloop.messages.protocol import NOT_SIGNED, signature_in
from pdeloop.messages.topics import START_COLUMNS, VOID, CostColumn, episode_name

REMEMBERED = 16
"""Ended episodes whose actions can still be contradicted."""


@dataclass
class Episode:
    """The record of an episode: the rows of its start, and the following of its actions.

    signature: what they carry if the controller signs; taken: a digest of the one that was taken at
    each step; cost: the episode's cost, once it has ended.
    """

    rows: np.ndarray
    signature: float = NOT_SIGNED
    taken: list[int] = field(default_factory=list)
    cost: Frame | None = None

    def started_otherwise(self, rows: np.ndarray, signature: float) -> bool:
        """True if this is another start than its own."""
        return signature != self.signature or not np.array_equal(rows, self.rows)

    def contradicted_by(self, action: Frame) -> bool:
        """True if another action was taken at this step."""
        return action.step < len(self.taken) and digest(action.values) != self.taken[action.step]


class TakenActions:
    """The actions of a run's episodes. signs: whether its controller signs; None: not known yet."""

    def __init__(self, signs: bool | None = None) -> None:
        self.signs = signs
        self.episode = Episode(np.empty((0, START_COLUMNS)))
        """The present one, or the last."""
        self._ended: dict[int, Episode] = {}

    @property
    def signature(self) -> float | None:
        """The key that the actions of the episode carry; None before the run's first one."""
        if self.signs is None:
            return None
        return self.episode.signature if self.signs else NOT_SIGNED

    def is_signed(self, action: Frame) -> bool:
        """True if an action of the episode is signed as the run's controller signs."""
        found, expected = signature_in(action.time), self.signature
        return (
            found in (NOT_SIGNED, self.episode.signature) if expected is None else found == expected
        )

    def contradiction(self, action: Frame) -> str:
        """Why the episode cannot be relied on any more, as this action of it has come; else empty.

        FrameError where the run's controller signs, and the action is not signed for this episode.
        """
        if not self.is_signed(action):
            if self.signs is False:
                return (
                    "a signed action came in a run whose controller does not sign; "
                    "expected one controller"
                )
            raise FrameError(
                f"the action for step {action.step} was not computed from the policy, model and target "
                "of its episode; expected one controller and one tuner"
            )
        return two_actions(action) if self.episode.contradicted_by(action) else ""

    def take_signature(self, action: Frame) -> bool:
        """An action is taken: from now on the run's controller signs, or does not."""
        self.signs = action.time < NOT_SIGNED
        return self.signs

    def end(self, cost: Frame, *, void: bool) -> None:
        """The episode came to this cost."""
        self.episode.cost = cost
        if not void:
            self._ended[cost.episode] = self.episode
            if len(self._ended) > REMEMBERED:
                del self._ended[min(self._ended)]

    def retract(self, action: Frame) -> Frame | None:
        """The cost of an ended episode, void, if this action contradicts one of its own; once."""
        ended = self._ended.get(action.episode)
        if ended is None or len(action.values) != len(ended.rows):
            return None
        if self.signs and signature_in(action.time) != ended.signature:
            return None  # it could never have been taken
        if not ended.contradicted_by(action):
            return None
        return self._void(action.episode)

    def retract_start(self, episode: int, rows: np.ndarray, signature: float) -> Frame | None:
        """The cost of an ended episode, void, if it was started with other rows; once."""
        ended = self._ended.get(episode)
        if ended is None or not ended.started_otherwise(rows, signature):
            return None
        return self._void(episode)

    def _void(self, episode: int) -> Frame:
        ended = self._ended.pop(episode)
        assert ended.cost is not None
        values = ended.cost.values.copy()
        values[:, CostColumn.ENDED] = VOID
        ended.cost = replace(ended.cost, values=values)
        return ended.cost


def two_actions(action: Frame) -> str:
    """Message that a different action was taken."""
    return (
        f"two different actions arrived for step {action.step} of episode "
        f"{episode_name(action.episode)}; expected one controller, which answers a repeated state "
        "with the same action"
    )


def two_starts(start: Frame) -> str:
    """Message that a different start was taken."""
    return (
        f"two different starts arrived for episode {episode_name(start.episode)}; expected one "
        "tuner"
    )
