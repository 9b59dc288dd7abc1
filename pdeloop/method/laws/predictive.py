# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law that plans its actions on a model of the plant: receding-horizon control."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from threading import get_ident
from time import perf_counter
from typing import Any, ClassVar

import numpy as np

from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.array_files import checked_array
from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.method.laws.affine import Affine
from pdeloop.method.laws.base import Law, Parts
from pdeloop.method.laws.extended_kalman import ExtendedKalman
from pdeloop.method.laws.plans import Planner
from pdeloop.method.models.base import Arrays, FieldModel
from pdeloop.method.models.files import model_of, packed, unpacked
from pdeloop.method.models.sensed import SensedModel
from pdeloop.method.settings import Settings, setting

LONGEST = 80
"""Steps of a plan, at most, unless the settings ask for more."""
MOST_NUMBERS = 50_000
"""Numbers of a model that a theta has room for: messages carry one for each environment."""
TIMED = 12
"""Steps that are timed."""
_MODEL = "model."
_KEPT_PLANS, _KEPT_PLANNERS = 4096, 8


@dataclass(frozen=True, kw_only=True)
class PredictiveSettings(Settings):
    """Constants of the law `predictive`."""

    steps: int = setting(
        0,
        "steps H of a plan; 0: the shortest of 20, 40 and 80 that suffices on the model",
        0,
        LONGEST,
    )
    iterations: int = setting(2, "iterations of the search at a step", 0, 100)
    first_iterations: int = setting(60, "iterations of the first search from each start", 0, 1000)
    starts: int = setting(5, "plans that the first search begins from", 1, 100)


class Predictive(Law):
    """The first action of a plan that is improved at every step on a model of the field:

        a_k = P(K z_k + b + v_0),        v_0 .. v_{H-1} = argmin of the cost of the next H steps

    (`pdeloop.method.laws.plans`). It begins as the affine law, without a model. An optimiser that
    identifies one writes it into theta, with the cost, the admissible actions, H and the constants of
    the search: `model_based` does. theta is then longer than `size`; zeros at its end mean nothing.

    Its memory is the plan for the next steps, the action applied last, and how often the affine law's
    plan was the cheaper one on the model, so that the search began with that.

    Source: Rawlings, Mayne, Diehl, *Model Predictive Control*, 2nd ed., 2017, chapter 2.
    """

    name = "predictive"
    extends = True
    needs_model = True
    Settings = PredictiveSettings
    settings: ClassVar[PredictiveSettings] = PredictiveSettings()
    base: ClassVar[type[Law]] = Affine
    """The law that it begins as, and stays where nothing better is found."""
    worth: ClassVar[float] = 0.0
    """Share of the affine law's cost that must be to be had on the model before rollouts are kept for a
    law that plans; 0: they always are."""

    def __init__(self, model: Any, horizon: int) -> None:
        super().__init__(model, horizon)
        self.without_plans = self.base(model, horizon)
        """The law without a plan, whose parts and memory come first."""
        self._planners: OrderedDict[tuple[int, bytes], Planner] = OrderedDict()
        self._plans: OrderedDict[bytes, tuple[Array, Array, bool]] = OrderedDict()

    @property
    def longest(self) -> int:
        """Steps of a plan in the memory."""
        return max(min(LONGEST, self.horizon), 1)

    @property
    def memory_size(self) -> int:  # type: ignore[override]
        return self.without_plans.memory_size + (self.longest + 1) * self.n_a + 1

    def memory_start(self) -> Array:
        own = np.zeros((self.longest + 1) * self.n_a + 1)
        return np.concatenate([self.without_plans.memory_start(), own])

    def start(self) -> Parts:
        """The parts of the law without plans, and no plan."""
        return {**self.without_plans.start(), "plan": np.zeros(0)}

    def parts(self, theta: Array) -> Parts:
        """Those of the law without plans are its beginning; the rest is `plan`."""
        size = self.without_plans.size
        return {**self.without_plans.parts(theta[:size]), "plan": theta[size:]}

    def vector(self, parts: Parts) -> Array:
        return np.concatenate([self.without_plans.vector(parts), parts["plan"]])

    def theta_of(self, without_plans: Array, planner: Planner) -> Array:
        """Theta of plans on a model; without_plans: theta of the law that they are compared with.

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
        return np.concatenate([np.ravel(without_plans), numbers])

    def _kept(self, model: FieldModel) -> Arrays:
        """What theta has of the model besides the law without plans."""
        return {_MODEL + name: own for name, own in model.arrays().items()}

    def plans(self, theta: Array) -> bool:
        """Whether this theta has a model to plan on."""
        return bool(theta[self.without_plans.size :].any())

    def acting(self, theta: Array) -> str:
        """The name of the law that a theta is one of."""
        return Predictive.name if self.plans(theta) else self.base.name

    def has_gains(self, theta: Array) -> bool:
        """Without a model it is the law that it began as, to the bit."""
        size = self.without_plans.size
        return not self.plans(theta) and self.without_plans.has_gains(theta[:size])

    def gains(self, theta: Array) -> Array:
        return self.without_plans.gains(theta[: self.without_plans.size])

    def planner(self, theta: Parts) -> Planner:
        """The planner in theta; ValueError where its numbers are those of none."""
        # Its model may be used by one thread at a time.
        key = get_ident(), self.vector(theta).tobytes()
        known = self._planners.get(key)
        if known is None:
            known = self._planners[key] = self._made(theta, unpacked(theta["plan"]))
            while len(self._planners) > _KEPT_PLANNERS:
                self._planners.popitem(last=False)
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
            *self._feedback(theta),
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

    def _feedback(self, theta: Parts) -> tuple[Array, Array]:
        """K and b of a = K z + b for states of the model."""
        K: Array = np.ascontiguousarray(theta["K_a"] @ self.model.U.T)
        return K, theta["K_b"] @ self.model.s_r

    def action(self, theta: Parts, z: Array, memory: Array, k: int) -> Array:
        if not theta["plan"].any():
            return self.without_plans.action(theta, z, self._split(memory)[0], k)
        return self._planned(theta, z, memory, k)[0]

    def memory_update(self, theta: Parts, z: Array, memory: Array, action: Array, k: int) -> Array:
        first, own = self._split(memory)
        after = np.zeros_like(own)
        if theta["plan"].any():
            _, plan, fell = self._planned(theta, z, memory, k)
            after[: plan[1:].size] = plan[1:].ravel()
            after[-1 - self.n_a : -1] = action
            after[-1] = memory[-1] + fell
        if not len(first):
            return after
        return np.concatenate([self.without_plans.memory_update(theta, z, first, action, k), after])

    def _split(self, memory: Array) -> tuple[Array, Array]:
        """The memory of the law without plans, and that of plans."""
        size = self.without_plans.memory_size
        return memory[:size], memory[size:]

    def _state(self, theta: Parts, z: Array, memory: Array, k: int) -> Array:
        """The state (1, n_z) that a plan starts from."""
        return z[None]

    def step_times(self, theta: Array, z: Array, steps: int = TIMED) -> tuple[float, float]:
        """Seconds of the first step from a state (n_z,), and of one of the next, in the median.

        The state follows the law's own model; without one it stays.
        """
        own = type(self)(self.model, self.horizon)
        own.cost = self.cost
        parts, memory, took = own.parts(theta), own.memory_start(), list[float]()
        model = own.planner(parts).model if own.plans(theta) else None
        for k in range(max(min(steps, self.horizon), 2)):
            began = perf_counter()
            a = own.action(parts, z, memory, k)
            memory = own.memory_update(parts, z, memory, a, k)
            took.append(perf_counter() - began)
            z = z if model is None else self._measured(model, z, memory, a)
        return took[0], float(np.median(took[1:]))

    def _measured(self, model: FieldModel, z: Array, memory: Array, a: Array) -> Array:
        """What follows the measurement z and the action a on the model; memory: after that step."""
        after: Array = model.step(z[None], a[None])[0]
        return after

    def _planned(self, theta: Parts, z: Array, memory: Array, k: int) -> tuple[Array, Array, bool]:
        """The action (n_a,), its plan (H, n_a), and whether that came from the affine law.

        The same for the same arguments: it is kept for `memory_update` because it takes long.
        """
        seen = hashlib.blake2b(digest_size=16)
        for part in (*theta.values(), z, memory, np.array(k)):
            seen.update(np.ascontiguousarray(part).data)
        key = seen.digest()
        known = self._plans.get(key)
        if known is None:
            planner, H = self.planner(theta), self.longest
            first, own = self._split(memory)
            plan = own[: H * self.n_a].reshape(1, H, self.n_a)[:, : planner.steps]
            last = own[None, H * self.n_a : -1] if k else None
            start = self._state(theta, z, first, k)
            a, plan, fell = planner.step(plan, planner.after(start, last), k)
            known = self._plans[key] = a[0], plan[0], bool(fell[0])
            while len(self._plans) > _KEPT_PLANS:
                self._plans.popitem(last=False)
        return known


class Auto(Predictive):
    """`Predictive` where the model says that more than 3 % of the cost is to be had; else `Affine`."""

    name = "auto"
    worth = 0.03


class PredictiveKalman(Predictive):
    """`Predictive` from the field that an extended Kalman filter estimates between few sensors.

    It begins as the law `extended_kalman`, and what that law knows is a part of its own theta and
    memory: a plan starts from its estimate x_k, on the equation that its filter integrates, and is
    compared with a_k = K_e x_k + b.
    """

    name = "predictive_kalman"
    base = ExtendedKalman
    filtered = True
    from_readings = ExtendedKalman.from_readings

    @property
    def kalman(self) -> ExtendedKalman:
        """The law without plans."""
        assert isinstance(self.without_plans, ExtendedKalman)
        return self.without_plans

    def _kept(self, model: FieldModel) -> Arrays:
        return {}

    def _model(self, theta: Parts, arrays: Mapping[str, Any]) -> FieldModel:
        known = self.kalman.filter(theta)
        if known is None or not theta["K_e"].any():
            raise ValueError("it has no filter whose estimates a plan could start from")
        return known.model

    def _feedback(self, theta: Parts) -> tuple[Array, Array]:
        return np.ascontiguousarray(theta["K_e"]), theta["b"]

    def _state(self, theta: Parts, z: Array, memory: Array, k: int) -> Array:
        found = self.kalman.estimate(theta, z, memory, k)
        return np.full((1, self.kalman.points), np.nan) if found is None else found[0]

    def _measured(self, model: FieldModel, z: Array, memory: Array, a: Array) -> Array:
        assert isinstance(model, SensedModel)
        return self.kalman.prediction(self._split(memory)[0])[model.seen]


class AutoKalman(PredictiveKalman):
    """As `Auto`, with few sensors."""

    name = "auto_kalman"
    worth = Auto.worth
