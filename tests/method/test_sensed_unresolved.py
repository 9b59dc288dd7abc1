# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What the grid between few sensors does not resolve counts as noise, also where none is declared."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

import pdeloop
from loop_interfaces.actuators import extents
from loop_method.adapt import Context, Record, Trajectory
from loop_method.adapt.sensed_loop import sensed_from
from loop_method.models.sensed import SHARED, SensedModel
from loop_method.models.settings import DEFAULTS
from pdeloop.episode import rollout
from tests.support.sensed import SENSORS

FEW_ITERATIONS = replace(DEFAULTS, sensed_iterations=8, sensed_last_iterations=20)
T = 16


def test_narrow_actuators_are_not_taken_for_unequal_ones() -> None:
    """Twelve that are alike, three spacings of the grid wide, of which eight sensors see edges."""
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

    def found(unresolved: float) -> SensedModel:
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
            field_models=replace(FEW_ITERATIONS, sensed_unresolved=unresolved),
        )
        with threadpool_limits(1):
            known = sensed_from(context, records, None)
        assert known is not None
        return known[0]

    taken, counted = found(0.0), found(DEFAULTS.sensed_unresolved)
    size = np.sqrt(np.mean([np.mean(record.acted_from**2) for record in records]))
    assert counted.noise >= DEFAULTS.sensed_unresolved * size > taken.noise
    assert np.std(counted.shared[SHARED:]) < 0.5 * np.std(taken.shared[SHARED:])
