# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Training status for the tuner's /diagnostics. Pure."""

import numpy as np

from pdeloop.messages.diagnostics import ConditionTimer, Level, Rate, Status
from tuner_node.session import Session

FOUND = 1.0
"""Seconds within which a running node is discovered."""
RECENT = 10.0
"""Seconds for which a repeated episode is worth a warning."""


class TunerDiagnostics:
    """Reports on a session, from one call to the next."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._rate, self._missing = Rate(), ConditionTimer()
        self._repeated = 0
        self._repeated_at = float("-inf")

    def absent(self, now: float) -> tuple[list[str], float]:
        """The nodes that are missing for longer than it takes to find them, and for how long (s)."""
        missing = self._session.dispatcher.missing()
        seconds = self._missing.seconds(bool(missing), now)
        return (missing, seconds) if seconds > FOUND else ([], 0.0)

    def report(self, now: float) -> Status:
        """Level, sentence and values at time `now` (monotonic s)."""
        absent, _ = self.absent(now)
        session, dispatcher = self._session, self._session.dispatcher
        training = session.training
        repeated = (
            dispatcher.counters["episodes repeated"] + dispatcher.counters["episodes taken over"]
        )
        if repeated > self._repeated:
            self._repeated, self._repeated_at = repeated, now
        level, message = self._state(now, absent)
        paid, budget = (sum(counts) for counts in training.progress.values())
        costs = dispatcher.last_costs
        adapted = next((row["cost"] for row in reversed(training.history) if "cost" in row), None)
        return Status(
            level,
            message,
            {
                "run": dispatcher.run,
                "restarts": dispatcher.incarnation,
                "phase": training.phase,
                "rollouts": paid,
                "budget": budget,
                "rollouts/s": self._rate.per_second(paid, now),
                "episode": dispatcher.newest_episode,
                "episodes under way": len(dispatcher.episodes()),
                "last cost": float(np.mean(costs)) if costs is not None and len(costs) else None,
                "adapted cost": None if adapted is None else float(adapted),
                "cost without control": session.baseline("none"),
                "cost with LQT": session.baseline("lqt"),
                "episodes repeated": repeated,
                "stale messages": (
                    dispatcher.counters["answers of another run"]
                    + dispatcher.counters["answers of another episode"]
                ),
                "paused": dispatcher.paused,
                "paused plants": len(dispatcher.paused_pairs(now)),
                "waiting for": " and ".join(absent),
            },
        )

    def _state(self, now: float, absent: list[str]) -> tuple[Level, str]:
        session = self._session
        where = session.training.phase
        if where == "adapt":
            paid, budget = (sum(counts) for counts in session.training.progress.values())
            where = f"rollout {paid} of {budget}"
        if absent:
            return Level.WARN, f"waiting for {' and '.join(absent)}"
        if session.dispatcher.paused:
            return Level.WARN, f"paused in {where}"
        if session.dispatcher.paused_pairs(now):
            return Level.WARN, f"the plant is paused in {where}"
        if session.stopping:
            return Level.OK, f"{where}; stopping after it"
        if now - self._repeated_at < RECENT:
            return Level.WARN, f"{where}; an episode had to be repeated"
        return Level.OK, where
