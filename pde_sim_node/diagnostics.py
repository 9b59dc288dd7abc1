# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Plant status for /diagnostics. Pure."""

import numpy as np

from pde_sim_node.lockstep import Lockstep
from pdeloop.messages.diagnostics import Level, Rate, Status
from pdeloop.messages.topics import VOID, CostColumn, episode_name


class PlantDiagnostics:
    """Reports on a lock-step protocol, from one call to the next."""

    def __init__(self, lockstep: Lockstep) -> None:
        self._lockstep = lockstep
        self._rounds, self._steps = Rate(), Rate()
        self._missed = 0

    def report(self, now: float) -> Status:
        """Level, sentence and values at time `now` (monotonic s)."""
        lockstep = self._lockstep
        level, message = self._state()
        costs = lockstep.last_cost
        completed = costs is not None and not (costs[:, CostColumn.ENDED] == VOID).any()
        pacer = lockstep.pacer
        if pacer and pacer.missed > self._missed and level is Level.OK:
            level = Level.WARN
            late = pacer.missed - self._missed
            message += f"; {late} state{'s' * (late > 1)} too late for real time"
        self._missed = pacer.missed if pacer else 0
        return Status(
            level,
            message,
            {
                "run": lockstep.run or None,
                "episode": lockstep.episode if lockstep.episode >= 0 else None,
                "step": lockstep.step,
                "horizon": lockstep.plant.horizon,
                "environments": lockstep.plant.batch,
                "paused": lockstep.paused,
                "steps/s": self._rounds.per_second(lockstep.rounds_total, now),
                "environment steps/s": self._steps.per_second(lockstep.steps_total, now),
                "episodes": lockstep.episodes_total,
                "episodes void": lockstep.counters["episodes void"],
                "last cost": _mean(costs) if completed and costs is not None else None,
                "last diverged": (
                    int((costs[:, CostColumn.ENDED] >= 0).sum()) if costs is not None else None
                ),
                "simulated time": lockstep.time,
                "states repeated": lockstep.counters["states repeated"],
                "stale messages": lockstep.stale,
                "missed deadlines": pacer.missed if pacer else None,
                "jitter p99 (us)": 1e6 * pacer.quantile(0.99) if pacer else None,
            },
        )

    def _state(self) -> tuple[Level, str]:
        lockstep = self._lockstep
        where = f"step {lockstep.step} of episode {episode_name(lockstep.episode)}"
        if lockstep.overdue():
            return Level.WARN, f"no action for {where}; is the controller running?"
        if lockstep.paused:
            return Level.WARN, f"paused at {where}" if lockstep.active else "paused"
        if lockstep.active:
            return Level.OK, where
        costs = lockstep.last_cost
        if lockstep.run and costs is not None and (costs[:, CostColumn.ENDED] == VOID).any():
            why = lockstep.contradiction or "no controller answered a state"
            return Level.ERROR, f"episode {episode_name(lockstep.episode)} is void: {why}"
        return Level.OK, "between two episodes" if lockstep.run else "no run; ready for one"


def _mean(costs: np.ndarray) -> float | None:
    """Mean stage cost of the environments that did not diverge."""
    completed = costs[costs[:, CostColumn.ENDED] < 0, CostColumn.MEAN]
    return float(completed.mean()) if len(completed) else None
