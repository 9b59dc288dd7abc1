# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A small training with few sensors, up to its first rollouts."""

from __future__ import annotations

import copy
from functools import cache
from typing import Any

import numpy as np

import pdeloop
from pdeloop.episode import rollout
from pdeloop.messages.model_rows import ModelRows
from pdeloop.method.adapt import Context, ModelBased, Optimizer, Rollout, RolloutResult, Trajectory
from pdeloop.method.adapt.improve import ModelBasedSettings
from pdeloop.method.adapt.model_based_sensed import ModelBasedSensed
from pdeloop.method.laws import Law, Observer
from tests.support.sensed import SENSORS

Array = np.ndarray
N_A = 3
NOISE = 0.03
"""That is declared, so that fits end early; the plant has none."""


def rows_of(n_s: int, U: Array, n_a: int = N_A) -> ModelRows:
    """Of a law that does nothing."""
    rng = np.random.default_rng(2)
    A, B = 0.3 * rng.standard_normal((n_s, n_s)), rng.standard_normal((n_s, n_a))
    gains = np.zeros((n_a, n_s))
    return ModelRows(A=A, B=B, U=U, K_a=gains, K_b=gains, s_r=np.zeros(n_s))


@cache
def small() -> tuple[pdeloop.Problem, Context]:
    problem = pdeloop.problem("allen-cahn", sensors=SENSORS, horizon=10, exploration_variance=4.0)
    plant = problem.plant()
    explored = [problem.explore(seed) for seed in (0, 1)]
    U = np.random.default_rng(3).standard_normal((SENSORS, 10))
    law = Observer(rows_of(10, U, plant.n_a), plant.horizon)
    first, second = (Trajectory(states, actions) for states, actions in explored)
    context = Context(
        law.model.U,
        plant.target,
        plant.state_weight,
        plant.action_weight,
        plant.horizon,
        first,
        sensors=SENSORS,
        further=[second],
        law=law,
        noise=NOISE,
    )
    return problem, context


def measured(asked: Rollout, other: Law | None = None) -> RolloutResult:
    """Of the context's law, or another one."""
    problem, context = small()
    law = other or context.law
    assert law is not None
    theta, memory = law.parts(np.ravel(asked.policy)), law.memory_start()

    def act(k: int, y: Array) -> Array:
        nonlocal memory
        a = law.action(theta, y[0], memory, k)
        memory = law.memory_update(theta, y[0], memory, a, k)
        return a[None]

    episode = rollout(problem.plant(), act, [asked.field_seed])
    seen = Trajectory(episode.states[:, 0], episode.actions[:, 0])
    return RolloutResult(float(episode.costs.mean[0]), trajectory=seen)


def optimiser(rollouts: int = 3, judging: int = 1, first: Array | None = None) -> Optimizer:
    _, context = small()
    kind = ModelBased.for_context(context)
    assert kind is ModelBasedSensed
    settings = ModelBasedSettings(iterations=5, mixtures=2, judging=judging)
    law = context.law
    assert law is not None
    start = law.theta_start if first is None else first
    return kind(start, seed=0, rollouts=rollouts, settings=settings, context=context)


@cache
def _told(better: bool, **given: int) -> tuple[Optimizer, list[RolloutResult], dict[str, Any]]:
    own = optimiser(**given, first=_told(better=False)[0].policy if better else None)
    results = [measured(asked) for asked in own.ask()]
    return own, results, dict(own.tell(results))


def told(
    better: bool = False, **given: int
) -> tuple[Optimizer, list[RolloutResult], dict[str, Any]]:
    """A copy of an optimiser after its first rollouts, these, and its row: most of what it does.

    better: whether it began with a law that is better than no control.
    """
    return copy.deepcopy(_told(better, **given))
