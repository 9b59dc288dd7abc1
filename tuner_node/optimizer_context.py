# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The problem, as given to an optimiser that learns from trajectories."""

from __future__ import annotations

from collections.abc import Sequence

from loop_interfaces.arrays import Array
from loop_interfaces.cost import Cost
from loop_method.adapt import Context, Record, Trajectory
from loop_method.laws import Law
from loop_method.models.noise_level import noise_level
from tuner_node.batch import TrainingSettings


def undeclared_noise(settings: TrainingSettings, explorations: Sequence[Trajectory]) -> float:
    """The standard deviation of the noise that explorations show, where none was declared; 0: none."""
    fields = settings.trajectories and (settings.line or settings.shape) and not settings.sensors
    if settings.noise or not fields:  # also declared process noise
        return 0.0
    return noise_level([known.states for known in explorations])


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
        action_limit=settings.action_limit,
        noise=settings.measurement_noise or undeclared_noise(settings, [exploration, *further]),
        sensors=settings.sensors,
        actuator_positions=settings.actuator_positions,
        periodic=settings.periodic,
        line=settings.line,
        shape=settings.shape,
        further=further,
        # Where numbers and the target do not say it.
        cost=None if cost is None or cost.plain else cost,
        law=law,
        field_models=settings.field_models,
    )
