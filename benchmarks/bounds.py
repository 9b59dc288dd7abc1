# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The best affine law and the best known inputs: `python -m benchmarks optimum` and `general`.

Both are those of a training's closed loop with the plant itself in place of its model, so that action
limits and measurement noise count, and with exact derivatives:

- the law a = K_a U^T z + b of least mean cost over many initial fields, with U as a training begins
  with it, by the descent of the trainings (`pdeloop.method.adapt.improve`), repeated with new
  coordinates until it gains nothing more, from the first law or from zero, whichever leads further,
- the inputs of least cost for known initial fields, without noise, as a_k = K_a U^T z_k + b + v_k
  around that law, by L-BFGS on all v_k: where the plant is unstable, the cost is a gentler function of
  v than of a. It is a local optimum, and there are many on chaotic and front-forming plants: of each
  field the cheapest of several descents counts, which begin at that law, at drawn inputs, and at
  receding-horizon control of the plant itself, around that law or the LQ law of the whole state.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

import pdeloop
from benchmarks.descent import Descent, descend
from benchmarks.families.cases import Case
from benchmarks.true_model import TrueModel
from benchmarks.warm_start import warm_start
from pde_sim_node.build import build_plant
from pde_sim_node.plant import Plant
from pdeloop.episode import rollout
from pdeloop.in_process import LocalPair
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.messages.parameters import INSTRUMENTS
from pdeloop.method.adapt.closed_loop import ClosedLoop
from pdeloop.method.adapt.improve import ModelBasedSettings, curvature_of, improve
from pdeloop.method.adapt.model_based_predictive import around, rests
from pdeloop.method.adapt.verdict import cheapest
from pdeloop.method.laws.plans import Planner, planned, simulated
from pdeloop.method.laws.predictive import LONGEST
from pdeloop.method.seeds import Purpose, derive
from pdeloop.process.one_thread import one_thread

__all__ = [
    "TRAINING_SEED",
    "best_inputs",
    "best_law",
    "bounds_of",
    "closed_loop",
    "evaluation_seeds",
    "initial_fields",
    "inputs_cost",
    "law_costs",
    "loop_of",
]

TRAINING_SEED = 7000
"""Draws the fields that a law is optimised on: no evaluation uses it."""
ITERATIONS = 300
"""Of one descent to a law at most."""
LAW_TOLERANCE = 1e-3
"""Gain, relative to the cost, below which a law is not improved further."""
COARSER = 10.0
"""The same on some of the fields, per tolerance."""
HORIZONS = (8, 4, 2)
"""Divisors of the horizon."""
ROUNDS = 6
"""Descents from one law at most, each in the coordinates of the one before."""
INPUTS_TOLERANCE = 2e-3
"""Of `descend`, for the inputs."""
INPUTS_ITERATIONS = 400
"""Of plans of whole episodes, at most."""


def evaluation_seeds(seed: int, fields: int) -> list[int]:
    """The initial fields of a closing evaluation."""
    return [derive(seed, Purpose.EVALUATION_FIELD, i) for i in range(fields)]


def bounds_of(case: Case, seed: int, held_out: Sequence[int]) -> dict[str, Array]:
    """The costs from each held-out field of the best affine law and of the best inputs.

    seed: of the training whose basis and first law are taken; held_out: seeds of the fields.
    """
    values = dict(pdeloop.problem(case.base or None, seed=seed, **case.parameters()).values)
    with one_thread(), np.errstate(all="ignore"):
        plant, loop, first = loop_of(values, values["optimizer"])
        own = initial_fields(plant, evaluation_seeds(TRAINING_SEED, case.law_fields))
        theta = best_law(loop, first, own)
        affine = law_costs(plant, loop, theta, held_out)
        known = initial_fields(plant, held_out)
        inputs, _ = best_inputs(loop, theta, known)
    return {"affine": affine, "limit": np.minimum(inputs, planned_inputs(loop, theta, known))}


def loop_of(values: Mapping[str, Any], optimizer: str) -> tuple[Plant, ClosedLoop, Array]:
    """The plant of a training with this optimiser, its closed loop, and its first law."""
    plant = build_plant(values)
    training = warm_start(values, LocalPair(values, plant), optimizer)
    loop = closed_loop(values, training.laws()[0].model.U)
    return plant, loop, loop.theta(training.warm_starts()[0])


def closed_loop(values: Mapping[str, Any], U: Array) -> ClosedLoop:
    """That of laws of U^T z with the plant that has these parameters."""
    ideal = build_plant({**values, **{spec.name: spec.default for spec in INSTRUMENTS}})
    return ClosedLoop(
        U,
        plain_cost(ideal, ideal.horizon),
        ActionSet.of(values),
        model=TrueModel(ideal),
        noise=values["measurement_noise"],
    )


def plain_cost(of: Plant | Cost, horizon: int) -> Cost:
    """A cost of numbers and a constant target over a horizon."""
    weights = {"state_weight": of.state_weight, "action_weight": of.action_weight}
    return Cost(of.n_z, of.n_a, horizon, **weights, target=of.target)


def law_costs(plant: Plant, loop: ClosedLoop, theta: Array, held_out: Sequence[int]) -> Array:
    """The costs of a law from the fields with these seeds, on the plant itself."""
    K, b = theta[:, :-1] @ loop.U.T, loop.constant_feature * theta[:, -1]
    noise = np.arange(len(held_out))
    return rollout(plant, lambda _, z: z @ K.T + b, held_out, noise, keep=False).costs.mean


def initial_fields(plant: Plant, seeds: Sequence[int]) -> Array:
    """The initial fields with these seeds, (F, n_z)."""
    plant.reset(np.array(seeds), np.zeros(len(seeds), dtype=np.int64))
    return plant.states.copy()


def best_law(
    loop: ClosedLoop, first: Array, fields: Array, tolerance: float = LAW_TOLERANCE
) -> Array:
    """The law of least mean cost, from the best of some laws to begin with.

    Descents on a quarter of the fields say which leads furthest: that from the first law, or that from
    zero over growing horizons. Of a chaotic plant the cost of a long rollout has many local optima, and
    that of a short one few.
    """
    few = fields[: -(-len(fields) // 4)]
    coarse, fine = (
        ModelBasedSettings(iterations=ITERATIONS, least_gain=gain)
        for gain in (COARSER * tolerance, tolerance)
    )
    zero = grown = np.zeros_like(first)
    for part in HORIZONS:
        short = replace(loop, cost=plain_cost(loop.cost, max(loop.horizon // part, 1)))
        grown = descended(short, grown, few, coarse)
    near = [descended(loop, theta, few, coarse) for theta in (first, grown)]
    even = np.full(len(fields), 1.0 / len(fields))
    start = cheapest(loop, [first, zero, *near], fields, even)
    return descended(loop, start, fields, fine)


def descended(loop: ClosedLoop, theta: Array, fields: Array, settings: ModelBasedSettings) -> Array:
    """The law after repeated descents, each in the coordinates of where the last one ended."""
    even, curvature = np.full(len(fields), 1.0 / len(fields)), curvature_of(loop)
    for _ in range(ROUNDS):
        better = improve(loop, theta, fields, even, curvature, settings)
        if better is None:
            break
        theta = better.theta
        if better.before - better.after <= settings.least_gain * better.after:
            break
    return theta


def best_inputs(
    loop: ClosedLoop, theta: Array, fields: Array, tolerance: float = INPUTS_TOLERANCE
) -> tuple[Array, Descent]:
    """The cost of the best inputs from each of the fields, known and without noise, (F,).

    And the descent of their mean, from the inputs of a law.
    """
    loop = replace(loop, noise=0.0)
    start = np.zeros((loop.horizon, len(fields), loop.model.n_a))
    admissible = loop.action_set
    if admissible.bounded:
        # Without the law, as what is added to an action that saturates has no effect.
        start, theta = loop.simulate(theta, fields).actions, np.zeros_like(theta)

    def balanced(v: Array) -> tuple[float, Array]:
        cost, gradient = _mean(*inputs_cost(loop, theta, admissible.project(v), fields))
        return cost, admissible.pull_back(v, gradient)[0]

    found = descend(
        balanced if admissible.zero_mean else lambda v: _mean(*inputs_cost(loop, theta, v, fields)),
        start,
        tolerance=tolerance,
        action_set=admissible,
    )
    inputs = admissible.project(found.x) if admissible.zero_mean else found.x
    return inputs_cost(loop, theta, inputs, fields)[0], found


def planned_inputs(loop: ClosedLoop, theta: Array, fields: Array) -> Array:
    """The cost of the best inputs that plans on the plant lead to, from each of the fields, (F,).

    Those are plans of whole episodes from several starts, and receding ones of LONGEST steps. Both are
    improved until they gain nothing more.
    """
    T, (K, b) = loop.horizon, (theta[:, :-1] @ loop.U.T, loop.constant_feature * theta[:, -1])
    plain = Planner(
        loop.model,
        loop.cost,
        loop.action_set,
        np.ascontiguousarray(K),
        b,
        around=True,
        steps=T,
        terminal=rests(loop.model, loop.cost, fields),
        first=INPUTS_ITERATIONS,
    )
    least: Array = np.full(len(fields), np.inf)
    for way in around(plain):
        start = way.after(fields)
        whole = way.begin(start)[1]
        receding = replace(way, steps=min(LONGEST, T), first=Planner.first)
        costs, states, actions = simulated(receding, fields, planned(receding))
        further = way.improved(way.deviations(states, actions), start, 0, INPUTS_ITERATIONS)[1]
        least = np.minimum.reduce([least, whole / T, costs, further / T])
    return least


def _mean(costs: Array, gradient: Array) -> tuple[float, Array]:
    return float(costs.mean()), gradient / len(costs)


def inputs_cost(loop: ClosedLoop, theta: Array, v: Array, fields: Array) -> tuple[Array, Array]:
    """J of a_k = theta [U^T z_k; 1] + v_k from each of the fields, (F,), and dJ/dv, as v (T, F, n_a).

    Infinite, with a gradient of zero, where a simulation is not finite.
    """
    costs, slopes, _ = loop.slopes(theta, fields, v.swapaxes(0, 1))
    if not (np.isfinite(costs).all() and np.isfinite(slopes).all()):
        return np.full(len(fields), np.inf), np.zeros_like(v)
    return costs, slopes.swapaxes(0, 1)
