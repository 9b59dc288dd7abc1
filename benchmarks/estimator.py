# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks estimator`: the cost with few readings under an estimator that knows the plant.

A law of the whole field acts on the estimate of an extended Kalman filter that has the true plant and
the distribution of initial fields. What is lost against the law on the field itself is the price of the
sensors and of their noise, and no model's. Costs are those of a closing evaluation.

The law is the best affine one by exact gradients: without noise (`benchmarks.bounds`), whose gains in
directions that no field takes are anything, or with some noise on what it sees; of these the one that
costs least with the estimator on other fields.

As the plant has no process noise, errors stay in the directions that the initial ones have: the filter
carries x and S with the covariance S S^T, and

    S <- S D^{-1/2},  x <- x + S S^T H^T (y - H x) / sigma^2,   D = I + S^T H^T H S / sigma^2

at a reading y = H x + noise, and x <- f(x, a), S <- (df/dx) S, by differences, at a step.

The best static law, a_k = K y_k + b of the newest readings alone, is found in the same way on as many
fields: a law with memory is worth having where it costs less.

A front that few sensors see only when it passes makes the filter diverge. With `draws` the law
acts on the posterior mean over as many draws of the initial field instead, each advanced by the true
plant.

References
----------
Anderson, Moore, "Optimal Filtering", 1979, section 8.2 (extended Kalman filter). Pham, Verron, Roubaud,
"A singular evolutive extended Kalman filter for data assimilation in oceanography", J. Marine Systems
16, 1998 (a covariance of low rank).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy import linalg

import pdeloop
from benchmarks.bounds import (
    TRAINING_SEED,
    best_law,
    closed_loop,
    evaluation_seeds,
    initial_fields,
    law_costs,
    loop_of,
)
from benchmarks.families.cases import case_of
from pde_sim_node.build import build_plant
from pde_sim_node.instruments import InstrumentedPlant
from pde_sim_node.plant import Plant
from pdeloop.episode import Law, rollout
from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.improve import ModelBasedSettings, curvature_of, improve
from pdeloop.process.one_thread import one_thread

__all__ = ["run", "text"]

SAMPLES = 400
"""Initial fields that their mean and covariance are taken from."""
KEPT = 1.0 - 1e-6
"""Share of their variance whose directions the filter carries."""
LEAST_NOISE = 1e-3
"""Standard deviation of a reading that the filter assumes at least."""
INFLATION = 1.01
"""Factor of S in a step: what the linearisation forgets."""
FIELDS = 10
"""Held-out fields, and as many on which the law is chosen."""
SEEN_NOISE = (0.0, 0.05, 0.2)
"""Standard deviations of the noise on each number of U^T z under which a law is optimised."""
DIFFERENCE = 1e-4
"""Step of the differences along the columns of S, relative to them."""


class ExtendedKalmanLaw:
    """A law of the whole field on the estimate of the extended Kalman filter above.

    sensed: the plant that is controlled; true: the same without instruments; law: a_k of fields
    (M, n_z); initial: fields of the distribution, (n, n_z).
    """

    def __init__(self, sensed: InstrumentedPlant, true: Plant, law: Law, initial: Array) -> None:
        self._true, self._law = true, law
        self._positions = sensed.positions
        self._scale = np.sqrt(true.n_z / sensed.state_size)
        self._sigma = max(sensed.instruments.measurement_noise, LEAST_NOISE)
        self._mean = initial.mean(axis=0)
        deviations = (initial - self._mean) / np.sqrt(len(initial) - 1)
        _, values, rows = linalg.svd(deviations, full_matrices=False)
        share = np.cumsum(values**2) / np.sum(values**2)
        kept = int(np.searchsorted(share, KEPT)) + 1
        self._factor = rows[:kept] * values[:kept, None]

    def __call__(self, k: int, states: Array) -> Array:
        count, positions = len(states), self._positions
        if k == 0:
            self._x = np.tile(self._mean, (count, 1))
            self._S = np.tile(self._factor, (count, 1, 1))  # columns of S as rows
        y = states[:, : positions.size] / self._scale
        for m in range(count):
            H = self._S[m][:, positions] / self._sigma
            values, vectors = linalg.eigh(np.eye(len(H)) + H @ H.T)
            missed = H @ (y[m] - self._x[m, positions]) / self._sigma
            self._x[m] += (vectors @ ((vectors.T @ missed) / values)) @ self._S[m]
            self._S[m] = (vectors / np.sqrt(values)) @ vectors.T @ self._S[m]
        actions = self._law(k, self._x)
        r = self._S.shape[1]
        moved = self._x[:, None] + DIFFERENCE * self._S
        every = np.concatenate([self._x, moved.reshape(count * r, -1)])
        held = np.concatenate([actions, np.repeat(actions, r, axis=0)])
        after, _ = self._true.evaluate(every, held)
        self._x = after[:count].copy()
        self._S = INFLATION * (after[count:].reshape(self._S.shape) - self._x[:, None]) / DIFFERENCE
        return actions


class PosteriorMeanLaw:
    """A law of the whole field on its posterior mean given all readings so far.

    The arguments are those of `ExtendedKalmanLaw`; the prior is uniform on the initial fields. As they
    are few, what the best of them misses beyond the noise counts as noise.
    """

    def __init__(self, sensed: InstrumentedPlant, true: Plant, law: Law, initial: Array) -> None:
        self._true, self._law, self._initial = true, law, initial
        self._positions = sensed.positions
        self._scale = np.sqrt(true.n_z / sensed.state_size)
        self._sigma = max(sensed.instruments.measurement_noise, LEAST_NOISE)

    def __call__(self, k: int, states: Array) -> Array:
        (n, n_z), positions, count = self._initial.shape, self._positions, len(states)
        if k == 0:
            self._fields = np.tile(self._initial, (count, 1, 1))
            self._misfit = np.zeros((count, n))
        y = states[:, None, : positions.size] / self._scale
        self._misfit += np.sum((self._fields[:, :, positions] - y) ** 2, axis=2)
        least = self._misfit.min(axis=1, keepdims=True)
        variance = np.maximum(self._sigma**2, least / ((k + 1) * positions.size))
        weights = np.exp((least - self._misfit) / (2.0 * variance))
        weights /= weights.sum(axis=1, keepdims=True)
        actions = self._law(k, np.einsum("mn,mnz->mz", weights, self._fields))
        held = np.repeat(actions, n, axis=0)
        after, _ = self._true.evaluate(self._fields.reshape(-1, n_z), held)
        self._fields = after.reshape(self._fields.shape)
        return actions


def run(
    problems: Sequence[str] = ("burgers", "allen-cahn", "kdv"),
    *,
    sensors: Sequence[int] = (8, 16),
    noise: Sequence[float] = (0.0, 0.03, 0.1),
    seed: int = 0,
    fields: int = 24,
    evaluation: int = 0,
    draws: int = 0,
) -> list[dict[str, Any]]:
    """Measure the cost with an estimator that knows the true plant.

    Parameters
    ----------
    problems
        Names of problems or of cases of `benchmarks.families`, or YAML files.
    sensors
        Numbers of sensors.
    noise
        Standard deviations of the noise of a reading.
    seed
        Seed of the training whose modes the law of the whole field uses.
    fields
        Number of initial fields on which this law is optimised.
    evaluation
        Seed of the ten held-out fields.
    draws
        Number of initial fields in the posterior mean; 0: the extended Kalman filter.
    """
    estimator = PosteriorMeanLaw if draws else ExtendedKalmanLaw
    rows = []
    seeds, others = evaluation_seeds(evaluation, FIELDS), evaluation_seeds(TRAINING_SEED, FIELDS)
    # Laws on the way to a better one may overflow.
    with one_thread(), np.errstate(all="ignore"):
        for problem in problems:
            true, candidates, known = _whole(problem, seed, fields, seeds)
            drawn = evaluation_seeds(TRAINING_SEED, draws or SAMPLES)
            initial = true.reset(np.array(drawn)).copy()
            for count in sensors:
                for sigma in noise:
                    given = {"sensors": count, "measurement_noise": sigma}
                    sensed = build_plant(values_of(problem, given))
                    assert isinstance(sensed, InstrumentedPlant)
                    laws = [estimator(sensed, true, law, initial) for law in candidates]
                    tuned = [_cost(sensed, law, others) for law in laws]
                    cost = _cost(sensed, laws[int(np.argmin(tuned))], seeds)
                    law = static_law(sensed, problem, given, fields)
                    case = {**known, "sensors": count, "noise": sigma}
                    rows.append({**case, "static": _cost(sensed, law, seeds), "estimator": cost})
    return rows


def values_of(problem: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """All parameters of a problem with these of its own."""
    case = case_of(problem)
    return dict(pdeloop.problem(case.base or None, **case.parameters(), **given).values)


def static_law(
    sensed: InstrumentedPlant, problem: str, given: Mapping[str, Any], fields: int
) -> Law:
    """The law a_k = K y_k + b of the newest readings of least cost over as many initial fields."""
    values = values_of(problem, given)
    readings = np.eye(values["n_z"])[:, sensed.positions]
    loop = closed_loop(values, readings)
    initial = initial_fields(sensed.plant, evaluation_seeds(TRAINING_SEED, fields))
    theta = best_law(loop, np.zeros((loop.model.n_a, sensed.positions.size + 1)), initial)
    scale = np.sqrt(values["n_z"] / sensed.state_size)
    K, b = theta[:, :-1] / scale, loop.constant_feature * theta[:, -1]
    return partial(_affine, K=K, b=b)


def _whole(
    problem: str, seed: int, fields: int, seeds: Sequence[int]
) -> tuple[Plant, list[Law], dict[str, Any]]:
    """The plant, laws of the whole field, and their costs on held-out fields."""
    own = {"seed": seed, "optimizer": "two_point", "identification": "regression"}
    values = values_of(problem, own)
    true, loop, first = loop_of(values, "two_point")
    initial = initial_fields(true, evaluation_seeds(TRAINING_SEED, fields))
    theta = best_law(loop, first, initial)
    whole = float(law_costs(true, loop, theta, seeds).mean())
    laws: list[Law] = []
    for noise in SEEN_NOISE:
        loop = replace(loop, noise=noise)
        if noise:
            every = np.full(fields, 1.0 / fields)
            better = improve(loop, theta, initial, every, curvature_of(loop), ModelBasedSettings())
            theta = theta if better is None else better.theta
        K, b = theta[:, :-1] @ loop.U.T, loop.constant_feature * theta[:, -1]
        laws.append(partial(_affine, K=K, b=b))
    none = partial(_affine, K=np.zeros((true.n_a, true.n_z)), b=np.zeros(true.n_a))
    return true, laws, {"problem": problem, "none": _cost(true, none, seeds), "whole": whole}


def _affine(k: int, z: Array, *, K: Array, b: Array) -> Array:
    a: Array = z @ K.T + b
    return a


def _cost(plant: Plant, law: Law, seeds: Sequence[int]) -> float:
    return float(rollout(plant, law, seeds, keep=False).costs.mean.mean())


def text(rows: Sequence[Mapping[str, Any]]) -> str:
    """A line for each case."""
    lines = ["problem               sensors  noise  no control  whole field  static  estimator"]
    lines += [
        f"{row['problem']:20}  {row['sensors']:7}  {row['noise']:5.2f}  {row['none']:10.4g}  "
        f"{row['whole']:11.4g}  {row['static']:6.4g}  {row['estimator']:9.4g}"
        for row in rows
    ]
    return "\n".join(lines)
