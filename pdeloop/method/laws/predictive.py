# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law that plans its actions on a model of the plant: receding-horizon control."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from threading import get_ident
from typing import Any, ClassVar

import numpy as np

from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.array_files import checked_array, packed, unpacked
from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.method.laws.base import Law, Parts
from pdeloop.method.laws.extended_kalman import ExtendedKalman
from pdeloop.method.laws.linear import Extended
from pdeloop.method.laws.plans import Planner
from pdeloop.method.models.base import Arrays, FieldModel, model_of
from pdeloop.method.models.sensed import SensedModel
from pdeloop.method.settings import Settings, setting

LONGEST = 80
"""Steps of a plan, at most, unless the settings ask for more."""
MOST_NUMBERS = 130_000
"""Numbers of a model that a theta has room for: messages carry one for each environment."""
_MODEL = "model."
_KEPT_PLANS, _KEPT_PLANNERS = 4096, 8


@dataclass(frozen=True, kw_only=True)
class PredictiveSettings(Settings):
    """Constants of the law `predictive`."""

    steps: int = setting(
        0, "steps H of a plan; 0: the shortest of 20, 40 and 80 that suffices", 0, LONGEST
    )
    iterations: int = setting(2, "iterations of the search at a step", 0, 100)
    first_iterations: int = setting(60, "iterations of the first search from each start", 0, 1000)
    starts: int = setting(5, "plans that the first search begins from", 1, 100)


class Predictive(Extended):
    """The first action of a plan that is improved at every step on a model of the field:

        a_k = P(K z_k + b_k + v_0),      v_0 .. v_{H-1} = argmin of the cost of the next H steps

    (`pdeloop.method.laws.plans`). An optimiser that identifies a model writes it into theta with all
    that plans need. Its memory is the plan for the next steps and the action applied last.

    Source: Rawlings, Mayne, Diehl, *Model Predictive Control*, 2nd ed., 2017, chapter 2.
    """

    name = "predictive"
    added = "plan"
    Settings = PredictiveSettings
    settings: ClassVar[PredictiveSettings] = PredictiveSettings()
    worth: ClassVar[float] = 0.0
    """Share of the cost of the law that it begins as that must be to be had on the model before
    rollouts are kept for a law that plans; 0: they always are."""
    fallbacks: int = 0
    """Steps so far at which the plan of `without` was better; for diagnostics, and of no effect."""

    def __init__(self, model: Any, horizon: int) -> None:
        super().__init__(model, horizon)
        self._planners: OrderedDict[tuple[int, bytes], Planner] = OrderedDict()
        self._plans: OrderedDict[bytes, tuple[Array, Array]] = OrderedDict()
        self._last: tuple[tuple[Array, ...], bytes] = (), b""

    @property
    def longest(self) -> int:
        """Steps of a plan in the memory."""
        return max(min(LONGEST, self.horizon), 1)

    @property
    def memory_size(self) -> int:  # type: ignore[override]
        return self.without.memory_size + (self.longest + 1) * self.n_a

    def theta_of(self, without: Array, planner: Planner) -> Array:
        """Theta of plans on a model; without: theta of the law that they are compared with.

        ValueError for a model of too many numbers.
        """
        arrays, cost, actions = self._kept(planner.model), planner.cost, planner.action_set
        if self.cost is None:
            arrays |= {
                "weights": np.array([float(cost.state_weight), float(cost.action_weight)]),
                "target": cost.target,
            }
        n_a = self.n_a
        arrays |= {
            "bounds": np.stack([np.broadcast_to(x, n_a) for x in (actions.low, actions.high)]),
            "zero_mean": np.array(actions.zero_mean),
            "around": np.array(planner.around),
            "terminal": np.array(planner.terminal),
            "search": np.array([planner.steps, planner.iterations, planner.first, planner.starts]),
        }
        if planner.regulated:
            arrays["regulated"] = np.array(True)
        if actions.rated:
            arrays["rate"] = np.broadcast_to(actions.rate, n_a)
        numbers = packed(arrays)
        if len(numbers) > MOST_NUMBERS:
            raise ValueError(
                f"its model has {len(numbers):,} numbers, and plans use at most {MOST_NUMBERS:,}"
            )
        return np.concatenate([np.ravel(without), numbers])

    def _kept(self, model: FieldModel) -> Arrays:
        """What theta has of the model besides the law without plans."""
        return {_MODEL + name: own for name, own in model.arrays().items()}

    def acting(self, theta: Array) -> str:
        return Predictive.name if self.is_extended(theta) else self.without.name

    def planner(self, theta: Parts) -> Planner:
        """The planner in theta; ValueError where its numbers are those of none."""
        # Its model may be used by one thread at a time.
        key = get_ident(), self._digest(theta)
        known = self._planners.get(key)
        if known is None:
            known = self._planners[key] = self._made(theta, unpacked(theta["plan"]))
            while len(self._planners) > _KEPT_PLANNERS:
                self._planners.popitem(last=False)
        return known

    def _digest(self, theta: Parts) -> bytes:
        """Of theta, worked out once for the same arrays, which the steps of an episode have."""
        arrays, (last, known) = tuple(theta.values()), self._last
        if len(arrays) != len(last) or any(a is not b for a, b in zip(arrays, last, strict=True)):
            known = _digest_of(arrays)
            self._last = arrays, known
        return known

    def _made(self, theta: Parts, arrays: Mapping[str, Any]) -> Planner:
        model = self._model(theta, arrays)
        n_z, n_a = model.n_z, self.n_a
        cost = self.cost
        if cost is None:
            q, r = checked_array(arrays, "weights", "f", (2,)).tolist()
            target = checked_array(arrays, "target", "f", (n_z,))
            cost = Cost(n_z, n_a, self.horizon, state_weight=q, action_weight=r, target=target)
        low, high = checked_array(arrays, "bounds", "f", (2, n_a), finite=False)
        zero_mean = bool(checked_array(arrays, "zero_mean", "b", ()))
        rate: Array = np.full(n_a, np.inf)
        if "rate" in arrays:
            rate = checked_array(arrays, "rate", "f", (n_a,), finite=False)
        steps, iterations, first, starts = checked_array(arrays, "search", "i", (4,)).tolist()
        if not (1 <= steps <= self.longest and iterations >= 0 and first >= 0 and starts >= 1):
            raise ValueError(f"its plans have {steps} steps; expected 1 to {self.longest}")
        return Planner(
            model,
            cost,
            ActionSet(n_a, low, high, zero_mean, rate=rate),
            *self.feedback_of_states(theta),
            around=bool(checked_array(arrays, "around", "b", ())),
            steps=steps,
            terminal=bool(checked_array(arrays, "terminal", "b", ())),
            iterations=iterations,
            first=first,
            starts=starts,
            regulated="regulated" in arrays,
        )

    def _model(self, theta: Parts, arrays: Mapping[str, Any]) -> FieldModel:
        """The model in theta; ValueError for one of another plant."""
        part = {name: own for name, own in arrays.items() if name.startswith(_MODEL)}
        model: FieldModel = model_of({n.removeprefix(_MODEL): own for n, own in part.items()})
        n_z, n_a = self.model.U.shape[0], self.n_a
        if (model.n_z, model.n_a) != (n_z, n_a):
            raise ValueError(f"its model has sizes {model.n_z}, {model.n_a}; expected {n_z}, {n_a}")
        return model

    def feedback_of_states(self, theta: Parts) -> tuple[Array, Array]:
        """K (n_a, n_z) and b of the law that plans are compared with, for states of the model."""
        K, b = self.feedback(theta)
        return np.ascontiguousarray(K @ self.model.U.T), b

    def action(self, theta: Parts, z: Array, memory: Array, k: int) -> Array:
        if not theta["plan"].any():
            return self.without.action(theta, z, self._split(memory)[0], k)
        return self._planned(theta, z, memory, k)[0]

    def memory_update(self, theta: Parts, z: Array, memory: Array, action: Array, k: int) -> Array:
        first, own = self._split(memory)
        after = np.zeros_like(own)
        if theta["plan"].any():
            _, plan = self._planned(theta, z, memory, k)
            after[: plan[1:].size] = plan[1:].ravel()
            after[-self.n_a :] = action
        if not len(first):
            return after
        return np.concatenate([self.without.memory_update(theta, z, first, action, k), after])

    def _split(self, memory: Array) -> tuple[Array, Array]:
        """The memory of the law without plans, and that of plans."""
        size = self.without.memory_size
        return memory[:size], memory[size:]

    def _state(self, theta: Parts, z: Array, memory: Array, k: int) -> Array:
        """The state (1, n_z) that a plan starts from."""
        return z[None]

    def followed(self, theta: Parts, z: Array, memory: Array, a: Array) -> Array:
        if not theta["plan"].any():
            return z
        after: Array = self.planner(theta).model.step(z[None], a[None])[0]
        return after

    def _planned(self, theta: Parts, z: Array, memory: Array, k: int) -> tuple[Array, Array]:
        """The action (n_a,) and its plan (H, n_a), kept for `memory_update` because it takes long."""
        key = self._digest(theta) + _digest_of((z, memory, np.array(k)))
        known = self._plans.get(key)
        if known is None:
            planner, H = self.planner(theta), self.longest
            first, own = self._split(memory)
            plan = own[: H * self.n_a].reshape(1, H, self.n_a)[:, : planner.steps]
            last = own[None, H * self.n_a :] if k else None
            start = self._state(theta, z, first, k)
            a, plan, fell = planner.step(plan, planner.after(start, last), k)
            self.fallbacks += int(fell[0])
            known = self._plans[key] = a[0], plan[0]
            while len(self._plans) > _KEPT_PLANS:
                self._plans.popitem(last=False)
        return known


def _digest_of(arrays: Sequence[Array]) -> bytes:
    seen = hashlib.blake2b(digest_size=16)
    for array in arrays:
        seen.update(np.ascontiguousarray(array).data)
    return seen.digest()


class Auto(Predictive):
    """`Predictive` where the model says that more than 3 % of the cost is to be had; else `without`."""

    name = "auto"
    worth = 0.03


class PredictiveKalman(Predictive):
    """`Predictive` from the field that an extended Kalman filter estimates between few sensors.

    It begins as the law `extended_kalman`, whose estimate x_k a plan starts from, on the equation that
    its filter integrates, and is compared with a_k = K_e x_k + b.
    """

    name = "predictive_kalman"
    filtered = True
    from_readings = ExtendedKalman.from_readings

    @cached_property
    def without(self) -> Law:
        return ExtendedKalman(self.model, self.horizon)

    @property
    def kalman(self) -> ExtendedKalman:
        """The law without plans."""
        assert isinstance(self.without, ExtendedKalman)
        return self.without

    def _kept(self, model: FieldModel) -> Arrays:
        return {}

    def _model(self, theta: Parts, arrays: Mapping[str, Any]) -> FieldModel:
        known = self.kalman.filter(theta)
        if known is None or not theta["K_e"].any():
            raise ValueError("it has no filter whose estimates a plan could start from")
        return known.model

    def feedback_of_states(self, theta: Parts) -> tuple[Array, Array]:
        return np.ascontiguousarray(theta["K_e"]), theta["b"]

    def _state(self, theta: Parts, z: Array, memory: Array, k: int) -> Array:
        found = self.kalman.estimate(theta, z, memory, k)
        return np.full((1, self.kalman.points), np.nan) if found is None else found[0]

    def followed(self, theta: Parts, z: Array, memory: Array, a: Array) -> Array:
        model = self.planner(theta).model if theta["plan"].any() else None
        if not isinstance(model, SensedModel):
            return z
        return model.observation @ self.kalman.prediction(self._split(memory)[0])


class AutoKalman(PredictiveKalman):
    """As `Auto`, with few sensors."""

    name = "auto_kalman"
    worth = Auto.worth
