# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""State of one loop, shared by the ROS views and the web page. Pure.

Frames of the loop's topics go in; episodes, numbers, learning curve and the state of the nodes come
out. `now` is any monotonic time in s.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.arrays import Array
from pdeloop.messages.colour_scale import field_range
from pdeloop.messages.cost import Cost
from pdeloop.messages.frames import Frame
from pdeloop.messages.grid import Grid
from pdeloop.messages.topics import VOID, CostColumn
from viewer_node.episode_samples import EpisodeSamples, Key, key_of
from viewer_node.learning_curve import LearningCurve
from viewer_node.loop_nodes import LoopNodes, Operation
from viewer_node.rollout_costs import RolloutCosts, remember

SLOW = 1.0
"""Seconds after which an episode is shown while it runs; shorter ones when they are over."""
SILENT = 5.0
"""Seconds without a message after which a loop is not going."""
STEADY = 0.15
"""Share of the colours' range by which it must change to be changed: they would only flicker."""
COSTS = {"none": "cost_no_control", "lqt": "cost_lqt", "adapted": "cost"}
"""The number with the cost of each controller (pdeloop.messages.controllers)."""


def path_of(values: Mapping[str, Any]) -> NDArray[np.float64] | None:
    """The target of each step from a plant's parameters; None where it is constant or of an output."""
    try:
        cost = Cost.parse(values["cost"])
    except (KeyError, TypeError, ValueError):
        return None
    moves = cost is not None and cost.target.ndim > 1 and cost.output is None
    return cost.target if cost is not None and moves else None


class LoopView:
    """Follows the loop of one plant and controller.

    only: the run to follow, any by default; curve_from_topics: whether the learning curve comes
    from the costs on the topics; horizon, weights: steps of an episode, q and r, where known;
    components: their names; path: the target of each step where it moves.
    """

    def __init__(
        self,
        *,
        only: int | None = None,
        curve_from_topics: bool = True,
        horizon: int = 0,
        weights: tuple[float, float] = (0.0, 0.0),
        components: Sequence[str] = ("u",),
        path: Array | None = None,
    ) -> None:
        self.only, self.curve_from_topics = only, curve_from_topics
        self.horizon, self.weights, self.components = horizon, weights, list(components)
        self.path = np.empty((0, 0)) if path is None else path
        self.grid: Grid | None = None
        """Grid of the state, if known."""
        self.environment = 0
        """The one that is shown; of a smaller episode the last one is."""
        self.nodes = LoopNodes()
        self.operation = Operation(self.nodes)
        self.curve = LearningCurve()
        self.rounds = self.episodes = self.samples = 0
        self.current: EpisodeSamples | None = None
        self.finished: EpisodeSamples | None = None
        self._targets: dict[int, Frame] = {}
        self.run = 0
        self._costs = RolloutCosts()
        self._numbers: dict[str, float] = {}
        self._current_since = 0.0
        self._costs_of: tuple[int, int] | None = None
        self._counted: tuple[Key, int] | None = None
        self._heard: float | None = None
        self._ended = False

    # What comes from the topics.

    def state(self, frame: Frame, now: float) -> None:
        """Take z_k of all environments."""
        if not self._wanted(frame, now, "plant"):
            return
        self.samples += 1
        key, current = key_of(frame), self.current
        if (
            current is None
            or current.key != key
            or current.environment != min(self.environment, current.batch - 1)
            or (frame.step == 0 and current.last > 0)  # from its beginning: the plant was restarted
        ):
            self._current_since = now
            self.current = current = EpisodeSamples(
                frame,
                environment=self.environment,
                components=len(self.components),
                horizon=self.horizon,
                grid=self.grid,
            )
        current.state(frame)
        self._count(key, frame.step)

    def action(self, frame: Frame, now: float) -> None:
        """Take a_k of all environments."""
        wanted, current = self._wanted(frame, now, "controller"), self.current
        if not wanted or current is None or current.key != key_of(frame):
            return
        current.action(frame)
        a = frame.values[min(current.environment, len(frame.values) - 1)]
        self._numbers["action_norm"] = float(np.sqrt(a @ a))
        if frame.step == current.last and (error := self._error()) is not None:
            q, r = self.weights
            self._numbers["stage_cost"] = float(q * error @ error + r * a @ a)

    def start(self, frame: Frame, now: float) -> None:
        """Take the start of an episode; without rows it is the end of the run."""
        if self._wanted(frame, now, "tuner"):
            self._ended = not len(frame.values)
            if not self._ended:
                self._costs.start(frame)

    def policy(self, frame: Frame, now: float) -> None:
        """Take the gains of an episode."""
        if self._wanted(frame, now, "tuner"):
            self._costs.policy(frame)

    def model(self, frame: Frame, now: float) -> None:
        """Take a run's reduced models, which have the LQT gains in them."""
        if self._wanted(frame, now, "tuner"):
            self._costs.model(frame)

    def cost(self, frame: Frame, now: float) -> None:
        """Take the costs of an episode that is over."""
        if not self._wanted(frame, now, "plant"):
            return
        key, ids, current = key_of(frame), (frame.run, frame.episode), self.current
        if current is not None and current.key == key:
            current.ended = True
            if current.whole or self.finished is None:
                self.finished = current
            if current.last == frame.step and (error := self._error()) is not None:
                self._numbers["final_error"] = _rms(error)
        if self._costs_of == ids:
            return  # repeated
        self._costs_of = ids
        self._count(key, frame.step)
        if (frame.values[:, CostColumn.ENDED] == VOID).any():
            return
        self.episodes += 1
        self.nodes.heard(now, "controller")
        rollouts = self._costs.cost(frame)
        if rollouts is None:
            return
        for controller, name in COSTS.items():
            if (mean := rollouts.mean_cost(controller)) is not None:
                self._numbers[name] = mean
        same = rollouts.compared(
            "lqt", "adapted"
        )  # costs on other fields compare with none of these
        if same.get("lqt", 0.0) > 0.0:
            self._numbers["reduction"] = 100.0 * (1.0 - same["adapted"] / same["lqt"])
        if self.curve_from_topics:
            self.curve.episode(rollouts)

    def target(self, frame: Frame, now: float) -> None:
        """Take z_r of a plant."""
        self.nodes.heard(now, "plant")
        remember(self._targets, frame.plant, frame)

    def paused(self, frame: Frame, now: float) -> None:
        """Take whether an operator holds the plant."""
        self.nodes.heard(now, "plant")
        self.operation.plant_paused = bool(frame.values.any())

    # What is shown.

    def shown(self, now: float) -> EpisodeSamples | None:
        """The episode that runs, if it has for longer than SLOW, else the last that is over."""
        current = self.current
        runs = current is not None and not current.ended and now - self._current_since > SLOW
        return current if runs or self.finished is None else self.finished

    def numbers(self) -> dict[str, float]:
        """The numbers of VIEW_NUMBERS that are known by now."""
        found = dict(self._numbers)
        if self.current is not None:
            found["step"] = float(self.current.last)
        if (error := self._error()) is not None:
            found["tracking_error"] = _rms(error)
        gains, lqt = self._costs.gains(self.environment)
        if gains is not None:
            found["gain_norm"] = float(np.linalg.norm(gains))
        if gains is not None and lqt is not None and lqt.any():
            found["gain_change"] = float(np.linalg.norm(gains - lqt) / np.linalg.norm(lqt))
        return found

    def profile(self) -> tuple[Array, Array | None] | None:
        """The newest field (n_z,) of the chosen environment and its target; None before the first."""
        current = self.current
        if current is None:
            return None
        target = self.path_at(current)
        target = self.target_of(current.key) if target is None else target
        fits = target is not None and len(target) == len(current.z)
        return current.z, target if fits else None

    def space_time(self, now: float) -> NDArray[np.float32] | None:
        """The field of the shown episode, (steps, points), to the horizon; NaN where not seen."""
        shown = self.shown(now)
        if shown is None:
            return None
        return shown.fields[: max(shown.columns, self.horizon // shown.stride + 1)]

    def state_of_loop(self, now: float) -> str:
        """The state of the loop in one word."""
        nobody = not any(node.present for node in self.nodes.by_role.values())
        quiet = self.quiet(now)
        # The last message of a tuner that was interrupted may be lost: then everybody is gone. Who
        # was starved for seconds also sees nobody for a moment, but hears them again.
        if self._ended or (nobody and quiet is not None and quiet >= SILENT):
            return "ended"
        if nobody and quiet is None:
            return "empty"
        if self.operation.paused(now):
            return "paused"
        if quiet is None:
            return "waiting"
        return "running" if quiet < SILENT else "silent"

    def controller(self, shown: EpisodeSamples) -> str:
        """The controller in the shown environment: see RolloutCosts.controller."""
        return self._costs.controller(shown.key[0], shown.key[1], shown.environment)

    def quiet(self, now: float) -> float | None:
        """Seconds since the last message of the loop; None before the first."""
        return None if self._heard is None else now - self._heard

    def colours(
        self, component: int, before: tuple[float, float], now: float
    ) -> tuple[float, float]:
        """The range that the colours of a component span; `before` if it is hardly another one."""
        shown = self.shown(now)
        if shown is None:
            return before
        part = shown.part(component)
        seen = shown.fields[: shown.columns, part].ravel()
        if not np.isfinite(seen).any():
            return before
        target = self.target_of(shown.key)
        known = np.empty(0)
        if target is not None and target.size == shown.z.size:
            known = target[shown.rows][part]
        low, high = field_range(seen[:: max(1, seen.size // 20_000)], known)
        size = STEADY * max(high - low, before[1] - before[0])
        same = abs(low - before[0]) <= size and abs(high - before[1]) <= size
        return before if same else (low, high)

    def newest_target(self) -> Array | None:
        """z_r of the plant that was heard last; None before the first."""
        return next((frame.values for frame in reversed(self._targets.values())), None)

    def target_of(self, key: Key) -> Array | None:
        """z_r of the plant of an episode."""
        frame = self._targets.get(key[2])
        return None if frame is None else frame.values

    def path_at(self, shown: EpisodeSamples) -> Array | None:
        """The target at the newest step of an episode; None where it does not move."""
        fits = self.path.shape[1] == shown.z.size
        return np.asarray(self.path[min(shown.last, len(self.path) - 1)]) if fits else None

    def _error(self) -> Array | None:
        """z - z_r of the newest sample."""
        found = self.profile()
        return None if found is None or found[1] is None else found[0] - found[1]

    def _wanted(self, frame: Frame, now: float, role: str) -> bool:
        if self.only is not None and frame.run != self.only:
            return False
        self.nodes.heard(now, role)
        if self.run and frame.run != self.run and self.curve_from_topics:
            self.curve = LearningCurve()
        self._heard, self.run = now, frame.run
        return True

    def _count(self, key: Key, step: int) -> None:
        """Count rounds, of which not every one was seen: an episode's last step says how many."""
        before = self._counted[1] if self._counted and self._counted[0] == key else 0
        if step > before:
            self.rounds += step - before
        self._counted = key, max(step, before)


def _rms(error: Array) -> float:
    return float(np.sqrt(np.mean(error**2)))
