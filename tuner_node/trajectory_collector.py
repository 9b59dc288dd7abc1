# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Collects the trajectories of an episode from the ordinary `state` and `action` topics. Pure.

A lost sample is never interpolated: the episode has no trajectories, and is run again. The same holds
if two samples of a step differ, because it is unknown which of them was the plant's.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.messages.frames import KEPT_ARRAY, Frame, FrameError
from pdeloop.messages.topics import COMPLETED, episode_name
from pdeloop.method.adapt import Trajectory
from pdeloop.method.adapt.trajectories import kept

MAX_BYTES = 2**30
"""Most bytes kept of the samples of one episode."""


@dataclass
class TrajectoryCollector:
    """The samples of one episode of one pair, by (plant, step)."""

    run: int = -1
    episode: int = -1
    contradiction: str = ""
    """Why the episode cannot be used, if two different samples came for one step."""
    used: bool = False
    """True once the trajectories were taken: what comes now is only compared."""
    nbytes: int = 0
    """Size of the samples that are kept, and of what keeps them."""
    _samples: dict[str, dict[tuple[int, int], Array]] = field(
        default_factory=lambda: {"states": {}, "actions": {}}
    )

    def take(self, what: str, frame: Frame) -> None:
        """Take a sample z_k ("states") or a_k ("actions"). FrameError if there is no room for it."""
        if (frame.run, frame.episode) != (self.run, self.episode):
            return
        known, key = self._samples[what], (frame.plant, frame.step)
        if key not in known:
            if self.used:
                return
            size = frame.values.nbytes + KEPT_ARRAY
            if self.nbytes + size > MAX_BYTES:
                raise FrameError(
                    f"expected at most {MAX_BYTES} bytes of samples of one episode; if they are all "
                    "of this run's plant, lower max_batch"
                )
            known[key], self.nbytes = frame.values.copy(), self.nbytes + size
        elif not np.array_equal(known[key], frame.values):
            self.contradiction = (
                f"two different {what} arrived for step {frame.step} of episode "
                f"{episode_name(frame.episode)}"
            )

    def lost(self, plant: int, steps: int, n_z: int) -> int:
        """Number of missing samples z_0..z_T, of n_z numbers each, and a_0..a_{T-1}."""
        states: int = sum(
            p == plant and k <= steps and values.shape[1] == n_z
            for (p, k), values in self._samples["states"].items()
        )
        actions = sum(p == plant and k < steps for p, k in self._samples["actions"])
        return 2 * steps + 1 - states - actions

    def trajectories(self, plant: int, steps: int, ended: Array) -> list[Trajectory]:
        """The trajectory of every environment; one that diverged at step k ends with z_k.

        ended (M,): as in CostColumn.ENDED. Only when `lost` says that nothing is missing.
        """
        self.used = True
        states = [self._samples["states"][plant, k] for k in range(steps + 1)]
        actions = [self._samples["actions"][plant, k] for k in range(steps)]
        return cut(states, actions, ended)


def cut(
    states: Array | Sequence[Array], actions: Array | Sequence[Array], ended: Array
) -> list[Trajectory]:
    """The trajectories of the M environments of an episode, each up to where it ended.

    states T+1 of (M, n_z), actions T of (M, n_a), ended (M,).
    """
    steps = len(actions)
    last = [steps if end == COMPLETED else int(end) for end in ended]
    return [
        kept(
            np.array([z[m] for z in states[: k + 1]]),
            np.array([a[m] for a in actions[:k]]).reshape(k, actions[0].shape[1]),
        )
        for m, k in enumerate(last)
    ]
