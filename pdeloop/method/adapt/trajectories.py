# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The trajectories an optimiser remembers, and how they survive a checkpoint.

Large states are coordinates in an orthonormal basis of the measured ones, as states of one plant have
much in common: with orthonormal rows W that span them, z = W^T x, and all that a linear law, a model
and a quadratic cost need of z is in x. Norms and white noise are the same in both. Work and memory then
grow with n_z for W alone.

References
----------
Sirovich, Quart. Appl. Math. 45, 1987 (snapshots). Brand, Linear Algebra Appl. 415, 2006 (a basis that
grows).
"""

from collections.abc import Sequence

import numpy as np
from scipy import linalg

from pdeloop.messages.array_files import Arrays, checked_array
from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.base import Record, Rollout, RolloutResult, State, Trajectory, numbers_of
from pdeloop.process.one_thread import one_thread

LARGE = 2048
"""States of more numbers than this are kept as coordinates."""
CAPACITY = 256
"""Rows of a basis, at most, and numbers of its coordinates; those without a row are 0."""
ROUNDED, OUTSIDE = 1e-12, 1e-4
"""Singular values, relative to the norm of all, below which a direction of a trajectory is rounding,
and one outside of the basis is left out."""


def factored(states: Array) -> tuple[Array, Array]:
    """C (N, r) and orthonormal rows V (r, n_z) with states (N, n_z) = C V, strongest first."""
    with one_thread():  # a threaded LAPACK rounds differently
        left, values, right = linalg.svd(states, full_matrices=False)
    kept = max(int(np.count_nonzero(values > ROUNDED * linalg.norm(values))), 1)
    return left[:, :kept] * values[:kept], np.ascontiguousarray(right[:kept])


class SnapshotBasis:
    """Orthonormal rows (r, n_z), extended by the components of new states outside their span."""

    def __init__(self, rows: Array) -> None:
        self.rows = rows

    def extend(self, states: Array, noise: float = 0.0) -> None:
        """Add the directions of states (N, n_z) that are outside, as long as there is room.

        noise: standard deviation of white noise on every number, whose own directions tell nothing.
        """
        room = CAPACITY - len(self.rows)
        if room <= 0 or not len(states):
            return
        with one_thread():
            left = states - (states @ self.rows.T) @ self.rows
            # Again, as the first time leaves rounding errors of what is inside.
            left -= (left @ self.rows.T) @ self.rows
            _, values, right = linalg.svd(left, full_matrices=False)
            floor = OUTSIDE * linalg.norm(states)
            floor = max(floor, noise * (np.sqrt(states.shape[1]) + np.sqrt(len(states))))
            new = right[: min(int(np.count_nonzero(values > floor)), room)]
        if len(new):
            self.rows = np.vstack([self.rows, new])

    def coordinates(self, states: Array) -> Array:
        """x of states (N, n_z), (N, CAPACITY)."""
        found = np.zeros((len(states), CAPACITY))
        with one_thread():
            found[:, : len(self.rows)] = states @ self.rows.T
        return found


class LowRankTrajectory(Trajectory):
    """A trajectory whose states are products of coordinates (L, r) and orthonormal modes (r, n_z)."""

    coordinates: Array
    modes: Array

    def __init__(self, coordinates: Array, modes: Array, actions: Array) -> None:
        for name, array in ("coordinates", coordinates), ("modes", modes), ("actions", actions):
            object.__setattr__(self, name, array)

    @property
    def states(self) -> Array:
        """The states, made anew each time."""
        with one_thread():
            whole: Array = self.coordinates @ self.modes
        return whole


def kept(states: Array, actions: Array) -> Trajectory:
    """A trajectory to keep, with large states as factors; states may be a view."""
    if states.shape[1] > LARGE and np.isfinite(states).all():
        return LowRankTrajectory(*factored(states), actions)
    return Trajectory(np.ascontiguousarray(states), actions)


def trajectory_arrays(name: str, trajectory: Trajectory | Record) -> State:
    """A trajectory as arrays of a checkpoint."""
    if isinstance(trajectory, LowRankTrajectory):
        parts = {"coordinates": trajectory.coordinates, "modes": trajectory.modes}
        parts["actions"] = trajectory.actions
        return {f"{name}.{part}": array for part, array in parts.items()}
    return {f"{name}.states": trajectory.states, f"{name}.actions": trajectory.actions}


def taken_trajectory(arrays: Arrays, name: str, n_z: int | None, n_a: int) -> Trajectory:
    """The trajectory of that name, or a ValueError. n_z: None if it is not known."""
    actions = checked_array(arrays, f"{name}.actions", "f", (None, n_a))
    if f"{name}.modes" in arrays:
        modes = checked_array(arrays, f"{name}.modes", "f", (None, n_z))
        states = checked_array(arrays, f"{name}.coordinates", "f", (None, len(modes)))
        found: Trajectory = LowRankTrajectory(states, modes, actions)
    else:
        states = checked_array(arrays, f"{name}.states", "f", (None, n_z))
        found = Trajectory(states, actions)
    if len(states) - len(actions) not in (0, 1):
        raise ValueError(f"'{name}' has {len(states)} states and {len(actions)} actions")
    return found


def is_kept(arrays: Arrays, name: str) -> bool:
    """True if there is a trajectory of that name."""
    return f"{name}.actions" in arrays


def record_arrays(name: str, record: Record) -> State:
    """A measured rollout as arrays of a checkpoint."""
    own: State = {
        f"{name}.policy": record.policy,
        f"{name}.cost": np.array(record.cost),
        f"{name}.field_seed": np.array(record.field_seed),
    }
    return own | trajectory_arrays(name, record)


def taken_record(
    arrays: Arrays,
    name: str,
    n_z: int | None,
    n_a: int,
    shape: tuple[int | None, ...],
    stamp: int = -1,
) -> Record:
    """The rollout of that name with a policy of this shape, or a ValueError."""
    policy = checked_array(arrays, f"{name}.policy", "f", shape)
    cost = float(checked_array(arrays, f"{name}.cost", "f", (), finite=False))
    field_seed = int(checked_array(arrays, f"{name}.field_seed", "i", ()))
    known = taken_trajectory(arrays, name, n_z, n_a)
    return Record(policy, cost, known.states, known.actions, stamp, field_seed)


class Records:
    """The rollouts of an optimiser; a diverged one counts until a state exceeds the limit."""

    def __init__(self, limit: float) -> None:
        self._limit = limit
        self._records: list[Record] = []

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self._records)

    def all(self) -> list[Record]:
        """The rollouts, oldest first."""
        return self._records.copy()

    def add(self, rollouts: list[Rollout], results: Sequence[RolloutResult]) -> list[Record]:
        """Remember rollouts; a ValueError, and none of them, where nothing can be learned from one."""
        added = []
        for stamp, (rollout, result) in enumerate(zip(rollouts, results, strict=True), self.count):
            cost = float(result.cost) if result.usable else np.inf
            known = np.array(rollout.policy), cost, *self._samples(result)
            added.append(Record(*known, stamp, rollout.field_seed))
        self._records += added
        return added

    def state(self) -> State:
        """The remembered rollouts as arrays."""
        arrays: State = {"count": np.array(self.count), "limit": np.array(self._limit)}
        for record in self._records:
            arrays |= record_arrays(f"record{record.stamp}", record)
        return arrays

    def restore(self, arrays: Arrays, n_z: int, n_a: int, shape: tuple[int, ...]) -> None:
        """Restore the content of a `state`, with policies of this shape; ValueError if it is none."""
        count, limit = numbers_of(arrays, {"count": "i", "limit": "f"}).values()
        self._records = [
            taken_record(arrays, f"record{n}", n_z, n_a, shape, n) for n in range(count)
        ]
        self._limit = limit

    def _samples(self, result: RolloutResult) -> tuple[Array, Array]:
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
