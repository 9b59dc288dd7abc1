# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The problem, as given to an optimiser that learns from trajectories."""

from __future__ import annotations

from collections.abc import Sequence

from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.method.adapt import Context, Record, Trajectory
from pdeloop.method.laws import Law
from tuner_node.batch import TrainingSettings


def context_of(
    settings: TrainingSettings,
    law: Law,
    target: Array,
    exploration: Trajectory,
    further: Sequence[Trajectory],
    measured: Sequence[Record],
) -> Context:
    """The context of one seed.

    exploration: the one that its model was identified from; further: others; measured: the rollouts
    that checked its first law.
    """
    cost = Cost.parse(settings.cost)
    return Context(
        U=law.model.U,
        target=target,
        state_weight=settings.state_weight,
        action_weight=settings.action_weight,
        horizon=len(exploration.actions),
        exploration=exploration,
        measured=measured,
        action_set=settings.action_set,
        noise=settings.measurement_noise,
        sensors=settings.sensors,
        actuator_positions=settings.actuator_positions,
        actuator_widths=settings.actuator_widths,
        periodic=settings.periodic,
        line=settings.line,
        shape=settings.shape,
        further=further,
        # Where numbers and the target do not say it.
        cost=None if cost is None or cost.plain else cost,
        law=law,
        field_models=settings.field_models,
    )
