# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The projected control law, for a batch of environments that each have their own policy.

    a = K_a U^T z + K_b U^T z_r,        policy = [K_a K_b], shape (n_a, 2 n_s)

and the nearest admissible action in place of it. It is computed by `controller_node.law`.
"""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controller_node.law import LAW, control, padded
from pdeloop.jit.simd import whole_lanes
from pdeloop.messages.action_set import ANY_ACTION, ActionSet
from pdeloop.messages.arrays import Array, read_only
from pdeloop.messages.topics import StartColumn

IndexArray = NDArray[np.int64]


class ProjectedLaw:
    """The projected law of M environments. Call `set` before the first `actions`.

    models: the bases U that environments can use, all of one shape; target (n_z,): the target field
    z_r; action_set: admissible actions. Anything malformed raises a ValueError and leaves the law as it
    was.
    """

    def __init__(
        self, models: Sequence[ArrayLike], target: ArrayLike, action_set: ActionSet = ANY_ACTION
    ) -> None:
        bases = [np.asarray(basis, dtype=np.float64) for basis in models]
        shapes = {basis.shape for basis in bases}
        if len(shapes) != 1 or bases[0].ndim != 2 or 0 in bases[0].shape:
            raise ValueError(
                f"models must be one or more bases of one shape (n_z, n_s), but the shapes are "
                f"{[basis.shape for basis in bases]}."
            )
        self._bases = padded(np.stack(bases))
        self._n_z, self._n_s = bases[0].shape
        z_r = np.asarray(target, dtype=np.float64)
        if z_r.shape != (self._n_z,):
            raise ValueError(
                f"the model is of a state of {self._n_z} numbers, but the target has the shape "
                f"{z_r.shape}; give a model of this plant"
            )
        if not np.isfinite(self._bases).all() or not np.isfinite(z_r).all():
            raise ValueError(
                "models and target must be finite, but there is NaN or infinity in them."
            )
        self._plan = np.zeros(1, LAW)
        plan = self._plan[0]
        plan["n_z"], plan["n_s"] = self._n_z, self._n_s
        plan["bases"] = self._bases.ctypes.data
        self.action_set = ANY_ACTION
        # The reduced targets come from the same kernel as the reduced states: an identity for the
        # feedback.
        count = len(bases)
        self._reduced_targets = np.zeros((count, self._n_s))
        self._shape = (0, 0)
        identity = np.broadcast_to(np.eye(self._n_s), (count, self._n_s, self._n_s))
        self._take(np.concatenate([identity] * 2, axis=2), np.arange(count))
        control(self._plan, read_only(np.tile(z_r, (count, 1))), self._reduced_targets)
        self.action_set = action_set
        self._set = False

    @property
    def plan(self) -> np.void:
        """The plan that `controller_node.law` carries out until the next `set`."""
        plan: np.void = self._plan[0]
        return plan

    @property
    def n_a(self) -> int:
        """Actuators of the policies that were set."""
        return self._shape[1]

    @property
    def reduced_targets(self) -> Array:
        """s_r = U^T z_r of every model, shape (models, n_s)."""
        return self._reduced_targets.copy()

    def set(self, policies: ArrayLike, model_index: ArrayLike | None = None) -> None:
        """Take the policies of the next episode.

        policies (M, n_a, 2 n_s): [K_a K_b] of every environment; model_index ((M,) array of int,
        optional): which of the models an environment projects with; the first one if not given.
        """
        gains = np.asarray(policies, dtype=np.float64)
        columns = 2 * self._n_s
        if gains.ndim != 3 or 0 in gains.shape or gains.shape[2] != columns:
            raise ValueError(
                f"policies must have shape (environments, actuators, {columns}) for {self._n_s} "
                f"modes, but the shape is {gains.shape}."
            )
        if not np.isfinite(gains).all():
            raise ValueError("policies must be finite, but there is NaN or infinity in them.")
        count = gains.shape[0]
        index = checked_index(model_index, count, len(self._bases))
        self._take(gains, index)
        self._set = True

    def _take(self, gains: Array, index: IndexArray) -> None:
        # A plain sum over the modes, one environment next to the other.
        constant: Array = np.zeros(gains.shape[:2])
        for j in range(self._n_s):
            constant += gains[:, :, self._n_s + j] * self._reduced_targets[index, j, None]
        feedback = gains[:, :, : self._n_s].transpose(0, 2, 1)
        self._shape = gains.shape[:2]
        self._model_index = index.astype(np.int64)
        self._gains = padded(constant), padded(feedback)
        plan = self._plan[0]
        plan["n_a"] = gains.shape[1]
        plan["index"] = self._model_index.ctypes.data
        plan["constant"], plan["feedback"] = (array.ctypes.data for array in self._gains)
        self._scratch = np.zeros(4 * whole_lanes(self._n_s) + whole_lanes(gains.shape[1]))
        plan["scratch"] = self._scratch.ctypes.data
        own = self.action_set  # actions of mean zero are projected as they are
        bounds = (-np.inf, np.inf) if own.zero_mean else (own.low, own.high)
        self._bounds = [np.broadcast_to(bound, gains.shape[1]).copy() for bound in bounds]
        plan["low"], plan["high"] = (array.ctypes.data for array in self._bounds)

    def actions(self, states: ArrayLike) -> Array:
        """The actions that answer the states.

        states (M, n_z): the fields at t_k. An environment whose field is not finite gets an action that
        is not finite and does not disturb the others. Returns (M, n_a) array: the actions held over
        [t_k, t_{k+1}).
        """
        if not self._set:
            raise ValueError("the law has no policies yet; call set() before actions().")
        z = read_only(states)
        shape = self._shape
        if z.shape != (shape[0], self._n_z):
            raise ValueError(
                f"states must have shape ({shape[0]}, {self._n_z}), one field per policy, but the "
                f"shape is {z.shape}."
            )
        actions: Array = np.empty(shape)
        control(self._plan, z, actions)
        return self.action_set.project(actions) if self.action_set.zero_mean else actions


def checked_index(model_index: ArrayLike | None, count: int, models: int) -> IndexArray:
    """Index of the model that each of `count` policies belongs to: 0 if not given."""
    index = np.zeros(count, dtype=np.int64) if model_index is None else np.array(model_index)
    if index.shape != (count,) or not np.issubdtype(index.dtype, np.integer):
        raise ValueError(
            f"model_index must be {count} integers, one per policy, but it has shape "
            f"{index.shape} and type {index.dtype}."
        )
    if index.min() < 0 or index.max() >= models:
        raise ValueError(
            f"model_index must lie in 0 .. {models - 1}, but it holds {index.min()} "
            f".. {index.max()}."
        )
    return index


def excitations(rows: Array, step: int, n_a: int, action_set: ActionSet = ANY_ACTION) -> Array:
    """The exploratory actions of a step, (M, n_a); rows (M, 4) or (M, 5): of `episode/start`."""
    drawn = rows[:, [StartColumn.EXCITATION, StartColumn.VARIANCE]].tolist()
    return np.stack([excitation(int(s), step, n_a, v, action_set) for s, v in drawn])


def excitation(
    seed: int, step: int, n_a: int, variance: float, action_set: ActionSet = ANY_ACTION
) -> Array:
    """The exploratory action (n_a,) of one step, of a draw of N(0, variance I).

    A pure function of (seed, step), so that a step that is answered twice gets the same action
    twice. With rate limits it is after the actions of all steps before.
    """
    if seed < 0 or step < 0 or n_a < 1:
        raise ValueError(
            f"excitation needs seed >= 0, step >= 0 and n_a >= 1, but got seed {seed}, step "
            f"{step}, n_a {n_a}."
        )
    if not (np.isfinite(variance) and variance >= 0.0):
        raise ValueError(f"variance must be finite and not negative, but it is {variance}.")
    if action_set.rated:
        steps = 1 << step.bit_length()  # twice the draws in all, if steps are asked for in order
        found: Array = _explored(seed, steps, n_a, variance, action_set)[step].copy()
        return found
    return action_set.explored(_draw(seed, step, n_a, variance))


def _draw(seed: int, step: int, n_a: int, variance: float) -> Array:
    draw: Array = np.random.default_rng([seed, step]).standard_normal(n_a)
    return math.sqrt(variance) * draw


@lru_cache(maxsize=64)
def _explored(seed: int, steps: int, n_a: int, variance: float, action_set: ActionSet) -> Array:
    """The exploratory actions (steps, n_a) within rate limits."""
    draws = [_draw(seed, k, n_a, variance) for k in range(steps)]
    return action_set.applied(action_set.explored(np.stack(draws)))
