# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Messages to send, as returned by the protocols of the three nodes. No ROS import.

A node's protocol is an object without clock, thread or network: an event comes in (a frame, or the
time), messages come out, and the node's only job is to move them. So every fault is a unit test.
"""

from __future__ import annotations

import json
from dataclasses import dataclass

from pdeloop.messages.documents import parse_json
from pdeloop.messages.frames import Frame
from pdeloop.messages.text import printable
from pdeloop.messages.topics import Topic

STOPPED = 75
"""Exit code of a tuner that an operator stopped (as sysexits' EX_TEMPFAIL)."""
NO_CONTROLLER = 65
"""Exit code of a tuner whose laws diverged (as sysexits' EX_DATAERR); its results are written."""


MAX_REASON = 1000
"""Characters of a reason that are shown."""


@dataclass(slots=True)
class Publication:
    """Publish `frame` on `topic`. Never changed once it is made (see `Frame`)."""

    topic: Topic
    frame: Frame


@dataclass(frozen=True)
class ModelFailure:
    """Why an exploratory episode gave no model, or why an episode cannot be relied on.

    retry: something was incomplete or contradictory, and the same rows can be run again; otherwise
    the data allow no model, or the episode is not to be used, and `reason` says why.
    """

    run: int
    episode: int
    retry: bool
    reason: str

    def to_json(self) -> str:
        return json.dumps(
            {"run": self.run, "episode": self.episode, "retry": self.retry, "reason": self.reason}
        )

    @staticmethod
    def from_json(text: str) -> ModelFailure:
        """Raises ValueError when `text` is not the JSON of a failure."""
        try:
            fields = parse_json(text[:10_000])
            return ModelFailure(
                run=int(fields["run"]),
                episode=int(fields["episode"]),
                retry=bool(fields["retry"]),
                reason=_one_line(str(fields["reason"])),
            )
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"expected the JSON of a model failure, got {text[:80]!r}") from error


def _one_line(text: str) -> str:
    """The beginning of a text from the network, as it may be printed."""
    return printable(" ".join(text[:MAX_REASON].split()))[:MAX_REASON]
