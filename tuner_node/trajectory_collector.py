"""Collects the trajectories of an episode from the ordinary `state` and `action` topics. Pure.

A sample that was lost is never interpolated: the episode has no trajectories then, and is run again. So
it is when a sample comes twice with different content: which of them was the plant's would be chance.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.frames import Frame
from loop_interfaces.topics import COMPLETED
from tuner_node.optimizers import Trajectory

Array = NDArray[np.float64]


@dataclass
class TrajectoryCollector:
    """The samples of one episode of one pair, by (plant, step)."""

    run: int = -1
    episode: int = -1
    contradiction: str = ""
    """Why the episode cannot be used, if two different samples came for one step."""
    used: bool = False
    """Whether the trajectories were taken: what comes now is only compared."""
    _states: dict[tuple[int, int], Array] = field(default_factory=dict)
    _actions: dict[tuple[int, int], Array] = field(default_factory=dict)

    def state(self, frame: Frame) -> None:
        """Take z_k; repeated ones are equal."""
        self._take(self._states, frame, "states")

    def action(self, frame: Frame) -> None:
        """Take a_k."""
        self._take(self._actions, frame, "actions")

    def _take(self, known: dict[tuple[int, int], Array], frame: Frame, what: str) -> None:
        if (frame.run, frame.episode) != (self.run, self.episode):
            return
        key = frame.plant, frame.step
        if key not in known:
            if not self.used:
                known[key] = frame.values.copy()
        elif not np.array_equal(known[key], frame.values):
            self.contradiction = (
                f"two different {what} came for step {frame.step} of episode {frame.episode}"
            )

    def lost(self, plant: int, steps: int, n_z: int) -> int:
        """How many of the samples z_0..z_T, of n_z numbers each, and a_0..a_{T-1} are missing."""
        states: int = sum(
            p == plant and k <= steps and values.shape[1] == n_z
            for (p, k), values in self._states.items()
        )
        actions = sum(p == plant and k < steps for p, k in self._actions)
        return 2 * steps + 1 - states - actions

    def trajectories(self, plant: int, steps: int, ended: Array) -> list[Trajectory]:
        """The trajectory of every environment; one that diverged at step k ends with z_k.

        ended (M,): as in CostColumn.ENDED. Only when `lost` says that nothing is missing.
        """
        self.used = True
        states = np.stack([self._states[plant, k] for k in range(steps + 1)])
        actions = np.stack([self._actions[plant, k] for k in range(steps)])
        return cut(states, actions, ended)


def cut(states: Array, actions: Array, ended: Array) -> list[Trajectory]:
    """The trajectories of the M environments of an episode, each up to where it ended.

    states (T+1, M, n_z), actions (T, M, n_a), ended (M,).
    """
    steps = len(actions)
    last = [steps if end == COMPLETED else int(end) for end in ended]
    return [
        Trajectory(
            np.ascontiguousarray(states[: k + 1, m]),
            np.ascontiguousarray(actions[:k, m]),
        )
        for m, k in enumerate(last)
    ]
