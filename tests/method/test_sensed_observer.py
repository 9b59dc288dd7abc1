# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law with an observer that is designed and improved on a model of the field between sensors."""

from __future__ import annotations

import numpy as np
import pytest

from pdeloop.method.adapt import Context, Record, Trajectory
from pdeloop.method.adapt.belief import Belief
from pdeloop.method.adapt.improve import ModelBasedSettings
from pdeloop.method.adapt.model_based_sensed import cheapest, weighted
from pdeloop.method.adapt.sensed_loop import (
    SensedLoop,
    WholeFieldLaw,
    compensators,
    law_theta,
    sensed_loop,
    whole_field_law,
)
from pdeloop.method.laws import Observer
from pdeloop.method.models.base import model_of
from pdeloop.method.models.sensed import (
    COEFFICIENTS,
    TERMS,
    Actuators,
    SensedModel,
    interpolated,
    sensed_model,
    unknowns,
)
from tests.support.sensed import SENSORS
from tests.support.sensed_optimiser import N_A, rows_of
from tests.support.small import same_bits

Array = np.ndarray
T = 24
ACTUATORS = Actuators((np.arange(N_A) + 0.5) / N_A, np.zeros(N_A))


def equation(**terms: float) -> Array:
    """Unknowns of an equation with these terms, like z1 for z and z0_x2 for its second derivative."""
    shared = np.zeros(unknowns(N_A))
    for name, value in terms.items():
        p, j = (int(part) for part in name[1:].split("_x"))
        shared[TERMS.index((p, j))] = value
    shared[COEFFICIENTS] = 5.0  # the strength of the actuators
    return shared


LINEAR = equation(z1_x0=1.5, z1_x1=0.5, z1_x2=0.5)
CUBIC = equation(z1_x0=5.0, z1_x2=0.5, z3_x0=-5.0)


def model_with(shared: Array, noise: float) -> SensedModel:
    return sensed_model(shared, SENSORS, ACTUATORS, 4.0, noise=noise)


def field(model: SensedModel, seed: int) -> Array:
    x = np.arange(model.n_z) / model.n_z
    a, b, c = np.random.default_rng(seed).standard_normal(3)
    drawn: Array = 0.3 * a + b * np.cos(2 * np.pi * x) + c * np.sin(4 * np.pi * x)
    return drawn


def loop_of(model: SensedModel, n_s: int = 10) -> SensedLoop:
    """With a law whose coordinates are any, and more than there are sensors."""
    rng = np.random.default_rng(1)
    U = rng.standard_normal((SENSORS, n_s))
    rows = rows_of(n_s, U)
    target, none = np.zeros(SENSORS), np.zeros((T, N_A))
    explored = Trajectory(np.zeros((T + 1, SENSORS)), none)
    context = Context(U, target, 1.0, 0.1, T, explored, sensors=SENSORS, law=Observer(rows, T))
    return sensed_loop(context, model)


def test_a_compensator_does_the_same_in_the_coordinates_of_the_law() -> None:
    loop, n_s, rng = loop_of(model_with(LINEAR, 0.1)), 10, np.random.default_rng(5)
    guess, B = rng.standard_normal((n_s, SENSORS)), rng.standard_normal((n_s, N_A))
    K, D, b = rng.standard_normal((N_A, n_s)), rng.standard_normal((N_A, SENSORS)), np.ones(N_A)
    F, G, c = (
        0.2 * rng.standard_normal((n_s, n_s)),
        rng.standard_normal((n_s, SENSORS)),
        np.ones(n_s),
    )
    law = loop.law
    theta = law.parts(
        loop.policy(law_theta(loop, B, guess, (K, D, b), (F, G, c)), np.zeros(law.size))
    )
    readings = rng.standard_normal((6, SENSORS))
    x, memory = guess @ readings[0], law.memory_start()
    for k, y in enumerate(readings):
        a = K @ x + D @ y + b
        np.testing.assert_allclose(law.action(theta, y, memory, k), a, rtol=1e-6, atol=1e-6)
        memory = law.memory_update(theta, y, memory, a, k)
        x = F @ x + G @ y + c + B @ a


def whole_law(model: SensedModel, count: int) -> tuple[SensedLoop, WholeFieldLaw, Array, Array]:
    """A loop, the law of the whole field from so many initial fields, and these with their weights."""
    loop, fields = loop_of(model), np.stack([field(model, seed) for seed in range(count)])
    every, weights = weighted(fields, np.empty((0, model.n_z)))
    law = whole_field_law(loop, every, weights, ModelBasedSettings(iterations=20), 10)
    assert law is not None
    return loop, law, every, weights


@pytest.mark.parametrize("shared", [LINEAR, CUBIC])
def test_the_designed_law_is_near_to_that_of_the_whole_field(shared: Array) -> None:
    """With little noise the readings tell the state, so that the estimate costs little."""
    loop, whole, every, weights = whole_law(model_with(shared, 0.02), 6)
    best = float(whole.simulation.costs.mean())
    law = cheapest(loop, list(compensators(loop, whole, ModelBasedSettings())), every, weights)
    none = float(loop.costs(loop.no_control, every).mean())
    own = float(loop.costs(law, every).mean())
    assert best < 0.9 * none
    assert own - best < 0.25 * (none - best)


def test_the_designed_law_of_the_newest_readings_is_an_optimum_of_their_gains() -> None:
    loop, whole, every, weights = whole_law(model_with(CUBIC, 0.3), 4)
    static = list(compensators(loop, whole, ModelBasedSettings(least_gain=1e-5)))[1]
    n_s, cost = len(loop.law.model.A), float(loop.costs(static, every) @ weights)
    assert not static[:N_A, n_s : 2 * n_s].any()  # of no estimate
    for scale, offset in ((0.8, 0.0), (1.2, 0.0), (1.0, 0.1), (1.0, -0.1)):
        other = static.copy()
        other[:N_A, :n_s] *= scale
        other[:N_A, -1] += offset
        assert float(loop.costs(other, every) @ weights) > cost


def test_the_model_survives_a_checkpoint() -> None:
    model = model_with(CUBIC, 0.3)
    again = Belief.of(Belief(model, 0.01).state())
    assert again is not None and isinstance(again.model, SensedModel)
    z, a = field(model, 1)[None], np.ones((1, N_A))
    assert same_bits(again.model.step(z, a), model.step(z, a))
    assert same_bits(again.model.shared, CUBIC) and again.model.noise == 0.3
    assert isinstance(model_of(model.arrays()), SensedModel)


def test_a_rollout_that_ended_early_begins_where_its_first_readings_say() -> None:
    loop = loop_of(model_with(CUBIC, 0.0))
    readings = np.vstack(
        [np.cos(2 * np.pi * np.arange(SENSORS) / SENSORS), np.full(SENSORS, np.nan)]
    )
    lost = Record(np.zeros(1), np.inf, readings, np.zeros((1, N_A)))
    assert same_bits(loop.beginnings([lost])[0], interpolated(readings[0]))
