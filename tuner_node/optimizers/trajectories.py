# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The trajectories an optimiser remembers, and how they survive a checkpoint."""

from collections.abc import Mapping

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from tuner_node.optimizers.base import Array, Record, RolloutResult, State

GROWING = (
    *("record_stamps", "record_costs", "record_policies", "record_lengths"),
    *("record_states", "record_actions"),
)
"""Arrays of a state with a row a rollout, and with a row a sample."""


class Records:
    """The last rollouts, and older ones that are still referred to.

    Parameters
    ----------
    memory : int
        How many rollouts to remember.
    limit : float
        A diverged rollout counts until a state exceeds this magnitude.
    """

    def __init__(self, memory: int, limit: float) -> None:
        self._memory = memory
        self._limit = limit
        self._records: dict[int, Record] = {}
        self.count = 0

    def __getitem__(self, stamp: int) -> Record:
        return self._records[stamp]

    def all(self) -> list[Record]:
        """The remembered rollouts, oldest first."""
        return [self._records[stamp] for stamp in sorted(self._records)]

    def raise_limit(self, states: Array) -> None:
        """Accept magnitudes up to three times those of a trajectory from the start."""
        self._limit = max(self._limit, 3.0 * float(np.abs(states).max()))

    def add(self, policy: Array, result: RolloutResult, keep: set[int]) -> Record:
        """Remember a rollout; `keep` are the stamps that must not be forgotten."""
        states, actions = self.sound(result)
        cost = float(result.cost) if result.usable else float("inf")
        record = Record(np.array(policy), cost, states, actions, self.count)
        self._records[record.stamp] = record
        self.count += 1
        for stamp in list(self._records):
            if stamp < self.count - self._memory and stamp not in keep:
                del self._records[stamp]
        return record

    def state(self, n_z: int, n_a: int, gains: int) -> State:
        """The remembered rollouts as arrays; the episodes one after the other."""
        records = self.all()
        return {
            "record_stamps": np.array([r.stamp for r in records], dtype=np.int64),
            "record_costs": np.array([r.cost for r in records], dtype=np.float64),
            "record_policies": np.array([r.policy for r in records]).reshape(-1, n_a, gains),
            "record_lengths": np.array(
                [(len(r.states), len(r.actions)) for r in records], dtype=np.int64
            ).reshape(-1, 2),
            "record_states": np.concatenate([np.empty((0, n_z)), *(r.states for r in records)]),
            "record_actions": np.concatenate([np.empty((0, n_a)), *(r.actions for r in records)]),
            "record_count": np.array(self.count),
            "record_limit": np.array(self._limit),
        }

    def restore(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Remember what a `state` remembers; a ValueError if it does not add up."""
        lengths = state["record_lengths"].astype(np.int64)
        rollouts = {len(state[name]) for name in GROWING[:4]}
        samples = [len(state["record_states"]), len(state["record_actions"])]
        if (
            len(rollouts) > 1
            or (lengths < 0).any()
            or not set(lengths[:, 0] - lengths[:, 1]) <= {0, 1}
            or lengths.sum(axis=0).tolist() != samples
        ):
            raise ValueError("the remembered rollouts of the checkpoint do not add up.")
        ends = np.cumsum(lengths, axis=0)
        records = {}
        for i, stamp in enumerate(state["record_stamps"].astype(np.int64)):
            (z_end, a_end), (z_length, a_length) = ends[i], lengths[i]
            records[int(stamp)] = Record(
                state["record_policies"][i].astype(np.float64),
                float(state["record_costs"][i].item()),
                state["record_states"][z_end - z_length : z_end].astype(np.float64),
                state["record_actions"][a_end - a_length : a_end].astype(np.float64),
                int(stamp),
            )
        self._records = records
        self._limit = float(state["record_limit"].item())
        self.count = int(state["record_count"].item())

    def sound(self, result: RolloutResult) -> tuple[Array, Array]:
        """The states and actions that can be learned from, or a ValueError."""
        trajectory, usable = result.trajectory, result.usable
        if trajectory is None:
            raise ValueError(
                "this optimiser learns from trajectories, but a result has none; record the states "
                "and actions of the rollouts, or choose an optimiser that needs costs only."
            )
        states = np.array(trajectory.states, dtype=np.float64)
        actions = np.array(trajectory.actions, dtype=np.float64)
        if states.ndim != 2 or actions.ndim != 2 or len(states) - len(actions) not in (0, 1):
            raise ValueError(
                "a trajectory needs T or T + 1 states for T actions, but the shapes are "
                f"{states.shape} and {actions.shape}."
            )
        if usable:
            if not (np.isfinite(states).all() and np.isfinite(actions).all()):
                raise ValueError("a rollout that did not diverge must have a finite trajectory.")
            return states, actions
        with np.errstate(invalid="ignore"):
            bad = ~(np.abs(states).max(axis=1) <= self._limit)
        # A plant may hold the last state of a diverged environment.
        bad[1:] |= (states[1:] == states[:-1]).all(axis=1)
        length = int(np.argmax(bad)) if bad.any() else len(states)
        finite = np.isfinite(actions).all(axis=1)
        length = min(length, int(np.argmin(finite)) if not finite.all() else length)
        return states[:length], actions[: max(length - 1, 0)]


def denoised(states: Array, noise: float) -> Array:
    """A trajectory with the singular values that it would have without noise, nearest in the mean.

    Measurement noise is white in space and time, while the fields of a trajectory have much in common:
    few singular values are above 1 + sqrt(beta), in units of noise sqrt(n), which are those of the
    noise alone; those that are shrink to sqrt((y^2 - beta - 1)^2 - 4 beta) / y.

    Parameters
    ----------
    states : (T, n_z) array
        n is the larger of T and n_z, beta the smaller over it.
    noise : float
        Standard deviation of the noise on every number.

    References
    ----------
    Gavish, Donoho, "Optimal shrinkage of singular values", IEEE Trans. Inf. Theory 63, 2017.
    """
    if not states.size:
        return states
    left, values, right = scipy.linalg.svd(states, full_matrices=False)
    beta, unit = min(states.shape) / max(states.shape), noise * np.sqrt(max(states.shape))
    y = np.maximum(values / unit, 1.0 + np.sqrt(beta))
    shrunk = unit * np.sqrt(np.maximum((y**2 - beta - 1.0) ** 2 - 4.0 * beta, 0.0)) / y
    clean: Array = (left * shrunk) @ right
    return clean
