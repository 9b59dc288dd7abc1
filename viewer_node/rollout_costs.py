# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Assigns costs to controllers, by the gains that were published. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages import model_rows
from pdeloop.messages.arrays import Array
from pdeloop.messages.frames import Frame
from pdeloop.messages.topics import COMPLETED, START_COLUMNS, CostColumn, StartColumn

Key = TypeVar("Key")
MAX_KEPT = 100
"""Episodes whose gains are remembered until their costs come."""
MAX_BYTES = 2**26
"""Most remembered items of each kind."""
MAX_MODELS = 4
"""Generations of models."""


@dataclass(frozen=True)
class Rollouts:
    """The rollouts of a finished episode, one for each of its M environments.

    explores: whether it was an exploration; controllers (M,): 'none', 'lqt' or 'adapted', the keys
    of pdeloop.messages.controllers, empty for an exploration, if the policy is not known, and in a
    comparison with no control for a rollout from a field that no control did not have; mean
    (M,): stage costs; completed (M,): whether they did not diverge; models (M,): indices of the
    reduced models; fields (M,): seeds of the initial fields.
    """

    explores: bool
    controllers: NDArray[np.str_]
    mean: Array
    completed: NDArray[np.bool_]
    models: NDArray[np.int64]
    fields: NDArray[np.int64]

    def mean_cost(self, controller: str) -> float | None:
        """Mean over the completed rollouts of one controller; None if there are none."""
        if not len(self.controllers):
            return None
        rows = self.completed & (self.controllers == controller)
        return float(self.mean[rows].mean()) if rows.any() else None

    def compared(self, *controllers: str) -> dict[str, float]:
        """The mean costs of these controllers, if each was completed on the same fields; else empty."""
        if not len(self.controllers):
            return {}
        rows = {name: self.completed & (self.controllers == name) for name in controllers}
        fields = {frozenset(self.fields[own].tolist()) for own in rows.values()}
        if len(fields) > 1 or not all(fields):
            return {}
        return {name: float(self.mean[own].mean()) for name, own in rows.items()}


def remember(known: dict[Key, Frame], key: Key, frame: Frame, most: int = MAX_KEPT) -> None:
    """Keep a frame as the newest; of more than `most`, or than MAX_BYTES, the oldest ones go."""
    known.pop(key, None)
    room = MAX_BYTES - frame.values.nbytes
    while known and (len(known) >= most or sum(f.values.nbytes for f in known.values()) > room):
        del known[next(iter(known))]
    known[key] = frame


class RolloutCosts:
    """Joins starts, policies, models and costs, in whatever order they come."""

    def __init__(self) -> None:
        # By run and episode: of several episodes all starts may come before all costs.
        self._starts: dict[tuple[int, int], Frame] = {}
        self._policies: dict[tuple[int, int], Frame] = {}
        self._models: dict[tuple[int, int], Frame] = {}
        self._explored = 0
        """The run that was seen from its exploration on."""
        self._first: dict[tuple[int, int], dict[int, Array]] = {}
        """By run and generation of models: the first theta of each, where a law has no gains."""

    def start(self, frame: Frame) -> None:
        """Take the start of an episode."""
        if frame.values.shape[1] in (START_COLUMNS, len(StartColumn)):
            remember(self._starts, (frame.run, frame.episode), frame)
            self._explored = frame.run if _explores(frame) else self._explored

    def policy(self, frame: Frame) -> None:
        """Take the gains of an episode."""
        remember(self._policies, (frame.run, frame.episode), frame)

    def model(self, frame: Frame) -> None:
        """Take a run's reduced models, which have the LQT gains in them."""
        remember(self._models, (frame.run, frame.step), frame, MAX_MODELS)

    def cost(self, frame: Frame) -> Rollouts | None:
        """The controllers behind the costs of an episode; None if its start is not known."""
        ids = frame.run, frame.episode
        start, policy = self._starts.get(ids), self._policies.get(ids)
        if start is None or len(start.values) != len(frame.values):
            return None
        empty = np.empty(0, np.str_)
        controllers = empty if policy is None else self._controllers(start, policy.values)
        fields = start.values[:, StartColumn.SEED].astype(np.int64)
        if (none := controllers == "none").any():
            controllers = np.where(np.isin(fields, fields[none]), controllers, "")
        return Rollouts(
            _explores(start),
            controllers,
            frame.values[:, CostColumn.MEAN],
            frame.values[:, CostColumn.ENDED] == COMPLETED,
            start.values[:, StartColumn.MODEL].astype(np.int64),
            fields,
        )

    def controller(self, run: int, episode: int, environment: int) -> str:
        """The controller in an environment: a key of pdeloop.messages.controllers, or 'exploration'.

        Empty if it is not known.
        """
        start, policy = self._starts.get((run, episode)), self._policies.get((run, episode))
        if start is not None and _explores(start):
            return "exploration"
        if start is None or policy is None or environment >= len(policy.values):
            return ""
        controllers = self._controllers(start, policy.values)
        return str(controllers[environment]) if len(controllers) else ""

    def gains(self, environment: int) -> tuple[Array | None, Array | None]:
        """Gains of an environment in the newest episode, and its LQT gains; None where not known."""
        ids, start = next(reversed(self._starts.items()), ((0, 0), None))
        policy = self._policies.get(ids)
        if start is None or policy is None or len(start.values) != len(policy.values):
            return None, None
        row = min(environment, len(policy.values) - 1)
        lqt = self._lqt(start, policy.values)
        return policy.values[row], None if lqt is None else lqt[row]

    def _controllers(self, start: Frame, policy: Array) -> NDArray[np.str_]:
        """The controller of each environment, empty in an exploration."""
        if _explores(start) or len(policy) != len(start.values):
            return np.empty(0, dtype=np.str_)
        theta = policy.reshape(len(policy), -1)
        zero = ~theta.any(axis=1)
        lqt = self._lqt(start, policy)
        same = np.zeros_like(zero)
        if lqt is not None:
            same = (policy == lqt).reshape(theta.shape).all(axis=1)
        return np.where(zero, "none", np.where(same, "lqt", "adapted"))

    def _lqt(self, start: Frame, policy: Array) -> Array | None:
        """The first law of an episode's environments, LQT gains if its models are known."""
        which = start.values[:, StartColumn.MODEL].astype(np.int64)
        if policy.ndim != 3:
            first, none = (
                self._first_of(start, policy, which.tolist()),
                np.full(policy.shape[1:], np.nan),
            )
            return np.stack([first.get(m, none) for m in which.tolist()]) if first else None
        model = self._models.get((start.run, start.step))
        if model is None:
            return None
        if which.min() < 0 or which.max() >= len(model.values):
            return None
        try:
            known = {m: model_rows.unpack(model.values[m], policy.shape[1]) for m in set(which)}
        except ValueError:
            return None
        lqt = np.stack([known[m].policy for m in which])
        return lqt if lqt.shape == policy.shape else None

    def _first_of(self, start: Frame, policy: Array, which: list[int]) -> dict[int, Array]:
        """Theta of each model in the first episode after an exploration, where they are of one law."""
        key = start.run, start.step
        episodes = [episode for run, episode in self._policies if run == start.run]
        if key in self._first or start.run != self._explored or min(episodes) < start.episode:
            return self._first.get(key, {})
        found: dict[int, Array] = {}
        for m, theta in zip(which, policy, strict=True):
            if theta.any() and not np.array_equal(found.setdefault(m, theta), theta):
                return {}
        self._first = {key: found}
        return found


def _explores(start: Frame) -> bool:
    return bool((start.values[:, StartColumn.EXCITATION] >= 0).any())
