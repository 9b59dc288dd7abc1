# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Controller status for /diagnostics. Pure."""

from controller_node.responder import Responder
from pdeloop.messages.diagnostics import ConditionTimer, Level, Rate, Status
from pdeloop.messages.topics import episode_name

SILENT = 5.0
"""Seconds without a state, within an episode, after which the plant counts as silent."""
WAITING = 2.0
"""Seconds that a state may wait for what its answer needs, before it is a warning."""


class ControllerDiagnostics:
    """Reports on a responder, from one call to the next."""

    def __init__(self, responder: Responder) -> None:
        self._responder = responder
        self._answers = Rate()
        self._answered = 0
        self._heard = float("-inf")
        self._waiting = ConditionTimer()
        self.plant_paused = False
        """True if the plant is paused, by its `episode/paused`."""
        self.plants: int | None = None
        """Number of publishers of `state`; None if not known."""

    def waiting(self, now: float) -> list[str]:
        """Inputs that a state has awaited for longer than WAITING; to be called in every round."""
        lacking = self._responder.waits_for()
        return lacking if self._waiting.seconds(bool(lacking), now) > WAITING else []

    def report(self, now: float) -> Status:
        """Level, sentence and values at time `now` (monotonic s)."""
        responder = self._responder
        if responder.answered != self._answered or self._heard == float("-inf"):
            self._answered, self._heard = responder.answered, now
        level, message = self._state(now)
        return Status(
            level,
            message,
            {
                "run": responder.run,
                "episode": responder.episode if responder.episode >= 0 else None,
                "step": responder.step if responder.episode >= 0 else None,
                "exploring": responder.exploring,
                "answers/s": self._answers.per_second(responder.answered, now),
                "answers": responder.answered,
                "states that had to wait": responder.counters["states that had to wait"],
                "models identified": responder.counters["models identified"],
                "identifications failed": responder.counters["identifications failed"],
                "plans that fell back": responder.counters["plans that fell back"],
                "last cost": responder.last_cost,
                "plant paused": self.plant_paused,
            },
        )

    def _state(self, now: float) -> tuple[Level, str]:
        responder = self._responder
        if lacking := self.waiting(now):
            return (
                Level.WARN,
                f"a state is waiting for its action; still missing: {', '.join(lacking)}",
            )
        if responder.failure:
            return Level.ERROR, f"no reduced model: {responder.failure}"
        where = f"step {responder.step} of episode {episode_name(responder.episode)}"
        gone = self.plants == 0 and responder.answered > 0
        if not responder.under_way and not gone:
            return Level.OK, "no episode under way"
        if self.plant_paused:
            return Level.OK, f"the plant is paused at {where}"
        if now - self._heard > SILENT:
            reason = "; the plant is gone" if gone else ""
            return Level.STALE, f"no state for {now - self._heard:.0f} s, after {where}{reason}"
        return Level.OK, where
