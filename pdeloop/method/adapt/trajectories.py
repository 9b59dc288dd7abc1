# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The trajectories an optimiser remembers, how they survive a checkpoint, and large states in them.

Large states are coordinates in an orthonormal basis of the measured ones, as states of one plant have
much in common: with orthonormal rows W that span them, U and the target, z = W^T x, and all that a
linear law, a model and a quadratic cost need of z is in x: s = U^T z = (W^T U)^T x, and |z - z_r| =
|x - W^T z_r|. Norms and white noise are the same in both. W grows with later rollouts; work, memory and
checkpoints grow with n_z for W alone. An optimiser that works on them is made by `InCoordinates`.

References
----------
Sirovich, Quart. Appl. Math. 45, 1987 (snapshots). Brand, Linear Algebra Appl. 415, 2006 (a basis that
grows).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from pdeloop.messages.array_files import Arrays, checked_array
from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.method.adapt.base import (
    Context,
    Optimizer,
    Record,
    Rollout,
    RolloutResult,
    Row,
    State,
    Trajectory,
    numbers_of,
    part_of,
)
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


_ROWS, _OWN = "basis", "own."


class InCoordinates(Optimizer):
    """What `make` makes of a context, for states as coordinates; context: of whole states."""

    name = "in_coordinates"

    def __init__(self, make: Callable[[Context], Optimizer], context: Context) -> None:
        self.basis = SnapshotBasis(np.ascontiguousarray(context.U.T))
        self.basis.extend(context.target[None])
        self._noise = context.noise
        explorations = [self._seen(known) for known in context.every_exploration]
        measured = [
            replace(record, states=self._seen(Trajectory(record.states, record.actions)).states)
            for record in context.measured
        ]
        whole = context.cost
        self._cost = None if whole is None else CostInCoordinates(whole, self.basis)
        law, U = context.with_constants, self.basis.coordinates(context.U.T).T
        own = replace(
            context,
            U=U,
            target=self.basis.coordinates(context.target[None])[0],
            exploration=explorations[0],
            further=explorations[1:],
            measured=measured,
            periodic=False,
            line=False,
            shape=(),
            cost=self._cost,
            law=law and type(law)(replace(law.model, U=U), law.horizon),
        )
        self._own = make(own)

    @property
    def policy(self) -> Array:
        """See `Optimizer`, as all that follows."""
        return self._own.policy

    @property
    def tells(self) -> int:
        return self._own.tells

    @property
    def done(self) -> bool:
        return self._own.done

    def ask(self) -> list[Rollout]:
        return self._own.ask()

    def tell(self, results: Sequence[RolloutResult]) -> Row:
        seen = [
            replace(result, trajectory=result.trajectory and self._seen(result.trajectory))
            for result in results
        ]
        if self._cost:
            self._cost.make()
        return self._own.tell(seen)

    def state(self) -> State:
        return {_ROWS: self.basis.rows} | {
            _OWN + name: array for name, array in self._own.state().items()
        }

    def restore(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        n_z = self.basis.rows.shape[1]
        rows = checked_array(state, _ROWS, "f", (None, n_z))
        if len(rows) > CAPACITY:
            raise ValueError(f"'{_ROWS}' has {len(rows)} rows; expected at most {CAPACITY}")
        self.basis.rows = rows
        if self._cost:
            self._cost.make()
        self._own.restore(part_of(state, _OWN))

    def _seen(self, trajectory: Trajectory) -> Trajectory:
        """In coordinates, with the basis extended by new directions."""
        if isinstance(trajectory, LowRankTrajectory):
            known, modes = trajectory.coordinates, trajectory.modes
            self.basis.extend(modes * linalg.norm(known, axis=0)[:, None], self._noise)
            return Trajectory(known @ self.basis.coordinates(modes), trajectory.actions)
        if np.isfinite(trajectory.states).all():
            self.basis.extend(trajectory.states, self._noise)
        return Trajectory(self.basis.coordinates(trajectory.states), trajectory.actions)


class CostInCoordinates(Cost):
    """A cost of whole states z = W x, of their coordinates x.

    |E W x - w_k|^2 = |R x - Q^T w_k|^2 + |w_k - Q Q^T w_k|^2 with E W = Q R, made again as W grows.
    """

    def __init__(self, whole: Cost, basis: SnapshotBasis) -> None:
        self._whole, self._basis, self._rows = whole, basis, np.empty((0, 0))
        self.make()

    def make(self) -> None:
        """Make it for the present W."""
        whole, rows = self._whole, self._basis.rows
        if rows is self._rows:
            return
        self._rows, W = rows, rows.T
        (R, aims), (last, aim) = (self._squares(W, terminal=terminal) for terminal in (False, True))
        target = np.column_stack([aims, np.repeat(aim, len(aims), axis=0)])
        super().__init__(
            CAPACITY,
            whole.n_a,
            whole.horizon,
            action_weight=whole.action_weight,
            action_target=whole.action_target,
            output=np.vstack([R, last]),
            target=target[0] if whole.target.ndim == 1 else target,
            state_weight=np.repeat([1.0, 0.0], [len(R), len(last)]),
            terminal_weight=np.repeat([0.0, 1.0], [len(R), len(last)]),
        )
        self.field_target = self._basis.coordinates(whole.field_target[None])[0]

    @property
    def state_weights(self) -> None:
        """Models are judged by all coordinates alike."""

    def _squares(self, W: Array, *, terminal: bool) -> tuple[Array, Array]:
        """R, and its aims Q^T w_k as rows, both with one number more for what no x can reach."""
        E = self._whole.residual(W, terminal=terminal)
        w = np.atleast_2d(self._whole.residual_target(terminal=terminal))
        with one_thread():
            Q, R = linalg.qr(E, mode="economic")
            aims = w @ Q
            beyond = linalg.norm(w - aims @ Q.T, axis=1)
        whole = np.zeros((len(R) + 1, CAPACITY))
        whole[: len(R), : W.shape[1]] = R
        return whole, np.column_stack([aims, beyond])


def is_large(context: Context) -> bool:
    """True if an optimiser sees coordinates in place of the states."""
    return len(context.target) > LARGE
