"""What is seen of one pair: its newest samples, costs and gains, and the numbers made of them. Pure.

Frames of the loop's topics go in; named numbers, a profile and a space-time picture come out.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loop_interfaces import model_rows
from loop_interfaces.frames import Frame, Recent
from loop_interfaces.topics import COMPLETED, START_COLUMNS, CostColumn, StartColumn
from viewer_node.spacetime import SpaceTime

Array = NDArray[np.float64]
MAX_KEPT = 64
"""Episodes whose policies are remembered until their costs come."""
SLOW = 1.0
"""Seconds after which an episode is shown while it runs; shorter ones when they are over."""

SCALARS = {
    "cost": "mean stage cost of the last adapted policies (neither zero nor the LQT gains)",
    "cost_no_control": "mean stage cost of the last rollouts without control",
    "cost_lqt": "mean stage cost of the last rollouts with the LQT gains",
    "reduction": "100 (1 - cost / cost_lqt), in percent",
    "stage_cost": "l_k = q |z_k - z_r|^2 + r |a_k|^2 of the newest sample",
    "tracking_error": "root of the mean square of z_k - z_r of the newest sample",
    "final_error": "the same at the last step of the last episode",
    "action_norm": "|a_k| of the newest sample",
    "gain_norm": "Frobenius norm of the present gains [K_a K_b]",
    "gain_change": "Frobenius norm of their difference to the LQT gains, relative to these",
    "step": "k of the newest sample",
}
"""Names of the numbers, published below `view/`, and what they are."""


@dataclass(frozen=True)
class Profile:
    """Field and target over the domain: x (n_z,), z (n_z,), target (n_z,) or None."""

    x: Array
    z: Array
    target: Array | None


@dataclass
class _Episode:
    """The gains of an episode's environments, and the LQT gains that they belong to, if known."""

    policy: Array | None
    lqt: Array | None


class LoopView:
    """Follows the loop of one pair.

    length: L of the domain; horizon: steps of an episode as far as known; state_weight q and
    action_weight r as in the stage cost. Set `environment` to choose the one that is shown; of a
    smaller episode the last one is.
    """

    def __init__(
        self, *, length: float, horizon: int, state_weight: float, action_weight: float
    ) -> None:
        self.environment = 0
        self.samples = 0
        self.run, self.episode, self.step = 0, -1, -1
        self._length = length
        self._weights = state_weight, action_weight
        self._horizon = horizon
        self._targets: dict[int, Array] = {}
        self._plant = 0
        self._models: tuple[int, int, Array] | None = None
        self._starts, self._policies = Recent(MAX_KEPT), Recent(MAX_KEPT)
        self._episodes: OrderedDict[tuple[int, int], _Episode] = OrderedDict()
        self._state: Array | None = None
        self._action: Array | None = None
        self._acted = -1
        self._picture: SpaceTime | None = None
        self._finished: SpaceTime | None = None
        self._began = 0.0
        self._numbers: dict[str, float] = {}

    def target(self, frame: Frame) -> None:
        """Take z_r of a plant."""
        if len(self._targets) >= MAX_KEPT:
            self._targets.clear()
        self._targets[frame.plant] = frame.values.copy()

    def model(self, frame: Frame) -> None:
        """Take a run's reduced models, which have the LQT gains in them."""
        self._models = frame.run, frame.step, frame.values.copy()
        if (newest := self._starts.newest) is not None:
            self._join(newest)

    def start(self, frame: Frame) -> None:
        """Learn of an episode."""
        if frame.values.shape[1] in (START_COLUMNS, len(StartColumn)):
            self._starts.add(frame)
            self._join(frame)

    def policy(self, frame: Frame) -> None:
        """Take the gains of an episode."""
        self._policies.add(frame)
        self._join(frame)

    def state(self, frame: Frame, now: float) -> None:
        """Take a sample z_k; now: monotonic s."""
        if (frame.run, frame.episode) != (self.run, self.episode) or self._picture is None:
            self.run, self.episode = frame.run, frame.episode
            self._picture = SpaceTime(frame.values.shape[1], self._horizon)
            self._began = now
        self.samples += 1
        self.step, self._plant = frame.step, frame.plant
        self._state = self._chosen(frame.values)
        self._picture.put(frame.step, self._state)

    def action(self, frame: Frame) -> None:
        """Take a sample a_k."""
        if (frame.run, frame.episode) != (self.run, self.episode):
            return
        self._action, self._acted = self._chosen(frame.values), frame.step
        target = self._targets.get(frame.plant)
        self._numbers["action_norm"] = float(np.sqrt(np.sum(self._action**2)))
        if self._state is not None and frame.step == self.step and target is not None:
            q, r = self._weights
            error = self._state - target
            self._numbers["stage_cost"] = float(q * error @ error + r * self._action @ self._action)

    def cost(self, frame: Frame) -> None:
        """Take an episode's costs."""
        if (frame.run, frame.episode) == (self.run, self.episode):
            self._finished = self._picture
            if frame.step == self.step and (error := self._error()) is not None:
                self._numbers["final_error"] = error
        known = self._episodes.get((frame.run, frame.episode))
        if known is None or known.policy is None or len(known.policy) != len(frame.values):
            return
        completed = frame.values[:, CostColumn.ENDED] == COMPLETED
        mean = frame.values[:, CostColumn.MEAN]
        zero = ~known.policy.any(axis=(1, 2))
        lqt = np.zeros_like(zero)
        if known.lqt is not None:
            lqt = (known.policy == known.lqt).all(axis=(1, 2)) & ~zero
        for name, rows in (
            ("cost_no_control", zero),
            ("cost_lqt", lqt),
            ("cost", ~zero & ~lqt),
        ):
            if (rows & completed).any():
                self._numbers[name] = float(mean[rows & completed].mean())
        if "cost" in self._numbers and self._numbers.get("cost_lqt", 0.0) > 0.0:
            share = self._numbers["cost"] / self._numbers["cost_lqt"]
            self._numbers["reduction"] = 100.0 * (1.0 - share)

    def numbers(self) -> dict[str, float]:
        """The numbers of SCALARS that are known by now."""
        found = dict(self._numbers)
        if self._state is not None:
            found["step"] = float(self.step)
        if (error := self._error()) is not None:
            found["tracking_error"] = error
        return found

    def profile(self) -> Profile | None:
        """The newest field of the chosen environment; None before the first."""
        if self._state is None:
            return None
        n_z = len(self._state)
        target = self._targets.get(self._plant)
        if target is not None and len(target) != n_z:
            target = None
        x = np.arange(n_z, dtype=np.float64) * (self._length / n_z)
        return Profile(np.asarray(x, dtype=np.float64), self._state, target)

    def picture(self, now: float) -> NDArray[np.uint8] | None:
        """Space-time picture as colours (rows, n_z, 3): time downwards, white is zero.

        Of the episode that runs, if it has for longer than SLOW, else of the last that is over.
        """
        shown = self._picture if now - self._began > SLOW else self._finished or self._picture
        return shown.colours() if shown is not None else None

    def _chosen(self, values: Array) -> Array:
        chosen: Array = values[min(self.environment, len(values) - 1)].copy()
        return chosen

    def _error(self) -> float | None:
        target = self._targets.get(self._plant)
        if self._state is None or target is None or len(target) != len(self._state):
            return None
        return float(np.sqrt(np.mean((self._state - target) ** 2)))

    def _join(self, frame: Frame) -> None:
        """Note the gains of an episode once its start and its policy are both there."""
        start, policy = self._starts.of(frame), self._policies.of(frame)
        if start is None or policy is None or len(start.values) != len(policy.values):
            return
        key = (start.run, start.episode)
        lqt = self._lqt(start, policy.values)
        self._episodes[key] = _Episode(policy.values.copy(), lqt)
        while len(self._episodes) > MAX_KEPT:
            self._episodes.popitem(last=False)
        gains = self._chosen(policy.values)
        self._numbers["gain_norm"] = float(np.sqrt(np.sum(gains**2)))
        if lqt is not None and (size := float(np.sqrt(np.sum(self._chosen(lqt) ** 2)))) > 0.0:
            change = float(np.sqrt(np.sum((gains - self._chosen(lqt)) ** 2)))
            self._numbers["gain_change"] = change / size

    def _lqt(self, start: Frame, policy: Array) -> Array | None:
        """The LQT gains of an episode's environments, if its models are known."""
        if self._models is None or self._models[:2] != (start.run, start.step):
            return None
        models = self._models[2]
        which = start.values[:, StartColumn.MODEL].astype(np.int64)
        if which.min() < 0 or which.max() >= len(models):
            return None
        try:
            gains = [model_rows.unpack(models[m], policy.shape[1]).policy for m in which]
        except ValueError:
            return None
        lqt = np.stack(gains)
        return lqt if lqt.shape == policy.shape else None
