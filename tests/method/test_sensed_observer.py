# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The model of the field between sensors under laws with an observer."""

from __future__ import annotations

import numpy as np

from pdeloop.method.adapt import Context, Record, Trajectory
from pdeloop.method.adapt.sensed_loop import SensedLoop, sensed_loop
from pdeloop.method.laws import Observer
from pdeloop.method.models.sensed import (
    COEFFICIENTS,
    TERMS,
    Actuators,
    SensedModel,
    interpolated,
    sensed_model,
    unknowns,
)
from tests.support.sensed import PLACES, SENSORS
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


CUBIC = equation(z1_x0=5.0, z1_x2=0.5, z3_x0=-5.0)


def model_with(shared: Array, noise: float) -> SensedModel:
    return sensed_model(shared, PLACES, ACTUATORS, 4.0, noise=noise)


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
    explored = Trajectory(np.ones((T + 1, SENSORS)), none)
    context = Context(U, target, 1.0, 0.1, T, explored, sensors=SENSORS, law=Observer(rows, T))
    return sensed_loop(context, model)


def test_a_rollout_that_ended_early_begins_where_its_first_readings_say() -> None:
    loop = loop_of(model_with(CUBIC, 0.0))
    readings = np.vstack(
        [np.cos(2 * np.pi * np.arange(SENSORS) / SENSORS), np.full(SENSORS, np.nan)]
    )
    lost = Record(np.zeros(1), np.inf, readings, np.zeros((1, N_A)))
    assert same_bits(loop.beginnings([lost])[0], interpolated(readings[0], PLACES))


def test_a_simulation_far_beyond_what_was_read_has_no_cost() -> None:
    """Else a model that diverges without control would promise more than there is to save."""
    field_of_ones = np.ones(loop_of(model_with(CUBIC, 0.0)).model.n_z)[None]
    costs = []
    for rate in (5.0, 60.0):  # the field grows to 3 and to 1.6e5 times what was read
        loop = loop_of(model_with(equation(z1_x0=rate), 0.0))
        costs.append(loop.costs(loop.no_control, field_of_ones)[0])
    assert np.isfinite(costs[0])
    assert costs[1] == np.inf
