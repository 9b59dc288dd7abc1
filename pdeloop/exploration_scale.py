# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The size of exploratory actions, from what the inputs of a plant of one's own do to its state.

Each input is held in an episode from the initial state of seed 0, with the size that is explored. Its
share is what it changes, relative to the distance of the state from the target without it,

    s_j = rms |E (z_k^j - z_k)| / rms |E z_k - w_k|,

with the residual E z - w of the cost, so that units of states, actions and time do not matter. Inputs
without two bounds whose share is below LITTLE or above FAR are scaled to MODERATE, with no more than
what costs as much as the state does without them: a law that is better than no control costs less.

With noise sigma on the state, a size is at least the one with which a regression finds what the input
does at once (`tuner_node.build.least_variance`), as far as its share is at most 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pde_sim_node.plant import Plant
from pde_sim_node.plants.dynamics_plant import DynamicsPlant
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.messages.own_code import OwnCodeError
from pdeloop.method.reduce.channels import listed
from tuner_node.build import WIDER, least_variance

LITTLE, MODERATE, FAR = 0.01, 0.3, 10.0
"""Shares: too small to explore with, that of a scaled input, too large."""
SHORT = 10
"""Steps after which an input that changes the state enough is known to do so."""
TRIALS, MOST, DEAD = 10, 1e3, 30.0
"""Sizes of an input that are tried, the largest factor from one to the next, and the factor where
nothing moves: it may be a dead band."""
RESTS = 1e-9
"""Distance of a state from the target, in units of the divergence bound, that rounding explains."""


def scaled_exploration(plant: Plant, values: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters of the exploration of a plant with these parameters that differ from those."""
    true, admissible = getattr(plant, "plant", plant), ActionSet.of(values)
    noise, given = values["measurement_noise"], values["exploration_variance"]
    free = ~np.isfinite(admissible.high - admissible.low) & (not given)
    if values["exploration_scale"] or not isinstance(true, DynamicsPlant):
        return {}
    if not (noise or free.any()):
        return {}
    variance = given or admissible.exploration_variance
    own = np.sqrt(variance) * admissible.exploration_scale
    try:
        found = Responses(true, admissible).sizes(own, free, noise)
    except OwnCodeError:  # a training says so where it matters
        return {}
    if np.array_equal(found, own):
        return {}
    scale = [float(f"{size:.3g}") for size in found]
    return {"exploration_scale": scale, "exploration_variance": max(scale) ** 2}


def scale_remark(values: Mapping[str, Any]) -> str:
    """Which actuators are explored with more than ten times the default size, or less than a tenth."""
    default = ActionSet.of({**values, "exploration_scale": []})
    own = np.sqrt(default.exploration_variance) * default.exploration_scale
    scaled = np.array(values["exploration_scale"] or own)
    told = [
        f"actuator {j} with a standard deviation of {scaled[j]:.3g} instead of {own[j]:.3g}"
        for j in np.flatnonzero(np.abs(np.log(scaled / own)) > np.log(10.0)).tolist()
    ]
    return f"  exploring {listed(told)}, for what its actions do to the state" if told else ""


class Responses:
    """What each input of a plant changes alone, the others at rest, or mid-range between two bounds."""

    def __init__(self, plant: Plant, admissible: ActionSet) -> None:
        self._plant, self._admissible = plant, admissible
        self._two = np.isfinite(admissible.high - admissible.low)
        least = admissible.project(plant.cost.action_target)
        self._rest = np.where(self._two, admissible.exploration_mean, least)
        self._still: dict[int, Array] = {}

    def sizes(self, own: Array, free: NDArray[np.bool_], noise: float) -> Array:
        """The sizes (n_a,) of actions to explore with; free: the inputs whose own size may be off."""
        admissible, found = self._admissible, own.copy()
        weights = np.diag(self._plant.cost.action_matrix)
        widest = np.where(self._two, WIDER * admissible.exploration_variance, np.inf) ** 0.5
        for j in np.flatnonzero(free | bool(noise)).tolist():
            low, high, dead = LITTLE, FAR, 0.0
            for _ in range(TRIALS):
                share, distance = self.share(j, found[j])
                most = distance / np.sqrt(weights[j])
                if not free[j] or np.isnan(share) or low <= share <= high:
                    break
                if share < LITTLE and most <= found[j] * (LITTLE / share if share else 1.0):
                    break  # no law would use it
                low, high = 0.9 * MODERATE, 1.1 * MODERATE
                if share == 0.0:
                    dead = found[j]
                    found[j] = min(DEAD * dead, most)
                    continue
                factor = 0.1 if np.isinf(share) else np.clip(MODERATE / share, 1.0 / MOST, MOST)
                found[j] = min(dead + factor * (found[j] - dead), most)
            if share < LITTLE:
                found[j] = own[j]
            if noise and (gain := self.gain(j, found[j])):
                steps = self._plant.horizon
                least = least_variance(noise=noise, steps=steps, sample_time=gain, width=1.0, n_z=1)
                most = found[j] / min(share, 1.0) if share > 0.0 else np.inf
                most = min(most, widest[j] * admissible.exploration_scale[j])
                found[j] = max(found[j], min(np.sqrt(least), most))
        return np.full_like(found, np.median(found)) if admissible.zero_mean else found

    def share(self, j: int, size: float) -> tuple[float, float]:
        """s_j of an input held at this size, and the distance that it is relative to.

        inf: the plant diverges with it alone, in less than half the time; NaN: nothing is known, as the
        state is at the target.
        """
        cost, share, distance = self._plant.cost, np.nan, 0.0
        for steps in (SHORT, self._plant.horizon):
            if steps not in self._still:
                self._still[steps] = self._held(self._actions(), steps)
            still, moved = self._still[steps], self._held(self._actions(j, size), steps)
            away = np.abs(still - self._plant.target).max(initial=0.0)
            after = np.minimum(np.arange(1, 1 + len(still)), self._plant.horizon - 1)
            distance = _size(cost.residual(still.T).T - cost.residual_target()[after])
            if away <= RESTS * self._plant.divergence_bound or not distance:
                continue
            both = min(len(moved), len(still))
            if 2 * both < len(still):
                return np.inf, distance
            share = _size(cost.residual((moved[:both] - still[:both]).T).T) / distance
            if share >= LITTLE:
                break
        return share, distance

    def gain(self, j: int, size: float) -> float:
        """The norm of what an input of this size changes in a step, for each unit of it."""
        still, moved = self._actions(), self._actions(j, size)
        changed = np.linalg.norm(self._held(moved, 1) - self._held(still, 1))
        alone = self._admissible.applied(np.stack([moved, still])[:, None])
        applied = np.linalg.norm(alone[0] - self._admissible.applied(still[None]))
        return float(changed / applied) if applied else 0.0

    def _actions(self, j: int = 0, size: float = 0.0) -> Array:
        """Those of no input moved, or with one moved to where a bound leaves room."""
        actions = self._rest.copy()
        actions[j] += size if actions[j] + size <= self._admissible.high[j] else -size
        return actions

    def _held(self, actions: Array, steps: int) -> Array:
        """z_1, z_2, ... under actions (n_a,), until the plant diverges or the episode ends."""
        plant, states = self._plant, []
        plant.reset(np.zeros(1, dtype=np.int64))
        for _ in range(min(steps, plant.horizon)):
            z = plant.step(actions[None])[0].copy()
            if plant.episode_costs().diverged_step[0] >= 0:
                break
            states.append(z)
        return np.array(states).reshape(-1, plant.n_z)


def _size(rows: Array) -> float:
    """rms of the norms of rows (n, n_r); 0 of none."""
    return float(np.sqrt(np.square(rows).sum() / max(len(rows), 1)))
