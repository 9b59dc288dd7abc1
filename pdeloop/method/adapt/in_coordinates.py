# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""An optimiser for large states, which works on their coordinates in a basis.

With orthonormal rows W that span U, the target and the measured states, x = W^T z contains all that an
optimiser needs: s = U^T z = (W^T U)^T x, and |z - z_r| = |x - W^T z_r|. W grows with later
rollouts (`pdeloop.method.adapt.trajectories`); nothing else in a checkpoint grows with the size of a
state.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from pdeloop.messages.array_files import checked_array
from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.method.adapt.base import (
    Context,
    Optimizer,
    Rollout,
    RolloutResult,
    Row,
    State,
    Trajectory,
    part_of,
)
from pdeloop.method.adapt.trajectories import CAPACITY, LARGE, LowRankTrajectory, SnapshotBasis
from pdeloop.process.one_thread import one_thread

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
