# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What the grid between few sensors does not resolve counts as noise, also where none is declared."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

import pdeloop
from pdeloop.episode import rollout
from pdeloop.messages.actuators import extents
from pdeloop.method.adapt import Context, Record, Trajectory
from pdeloop.method.adapt.sensed_loop import sensed_from
from pdeloop.method.models.base import DEFAULTS
from pdeloop.method.models.sensed import COEFFICIENTS, SHARED, SensedModel
from tests.support.sensed import SENSORS

T = 12
Array = np.ndarray


def found(share: float) -> tuple[SensedModel, float]:
    """The model of three rollouts of twelve actuators, and the size of their readings.

    The actuators are three spacings of the grid wide, so that eight sensors see their edges.
    """
    problem = pdeloop.problem("allen-cahn-modes", sensors=SENSORS, horizon=T)
    plant, rng = problem.plant(), np.random.default_rng(0)
    assert plant.supports is not None
    centres, widths = extents(plant.supports)
    nothing, records = np.zeros((plant.n_a, 2 * SENSORS)), []
    for seed in range(3):
        actions = 2.0 * bool(seed) * rng.standard_normal((T, plant.n_a))
        seen = rollout(plant, lambda k, y, a=actions: a[k][None], [seed])
        cost = float(seen.costs.mean[0])
        records.append(Record(nothing, cost, seen.states[:, 0], seen.actions[:, 0]))

    context = Context(
        np.eye(SENSORS),
        plant.target,
        plant.state_weight,
        plant.action_weight,
        T,
        Trajectory(records[0].states, records[0].actions),
        sensors=SENSORS,
        actuator_positions=centres.tolist(),
        actuator_widths=widths.tolist(),
        field_models=replace(DEFAULTS, sensed_unresolved=share),
    )
    with threadpool_limits(1):
        known = sensed_from(context, records, None)
    assert known is not None
    size = float(np.sqrt(np.mean([np.mean(record.acted_from**2) for record in records])))
    return known[0], size


def differences(model: SensedModel) -> Array:
    """Of the strengths from each other, as shares of their mean."""
    own = model.shared[COEFFICIENTS] + model.shared[SHARED:]
    return own / own.mean() - 1.0


def test_narrow_actuators_are_not_taken_for_unequal_ones() -> None:
    """They are where less counts as noise than the grid leaves."""
    share = DEFAULTS.sensed_unresolved
    (taken, _), (counted, size) = found(share / 5.0), found(share)
    assert counted.noise >= share * size > taken.noise
    assert np.std(differences(counted)) < 0.05 and np.std(differences(taken)) > 0.5
