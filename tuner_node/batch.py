# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Batches of rollouts and their results, and the definition of a training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import repeat

import numpy as np

from pdeloop.messages.action_set import ANY_ACTION, ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.messages.topics import COMPLETED, MAX_GAIN, START_COLUMNS, CostColumn
from pdeloop.method.adapt import Context, Record, Rollout, RolloutResult, Trajectory
from pdeloop.method.laws import Affine, Law
from pdeloop.method.models.base import DEFAULTS, FieldModelSettings


class DispatchError(RuntimeError):
    """An episode that cannot be run: attempts used up, or a model that cannot be designed."""


class NoModelError(DispatchError, ValueError):
    """An exploration that gives no reduced model: the training ends there again if it is continued."""


class ContradictionError(DispatchError):
    """Something that the training has used was contradicted: it cannot be continued either."""


UNKNOWN_PLANT = -1
"""The plant's fingerprint before the first cost."""

MESSAGE_BYTES, EPISODE_BYTES = 2**23, 2**28
"""States that a message and, with the steps of an episode, a process holds; of one environment more."""


def most_environments(max_batch: int, state_size: int, horizon: int) -> int:
    """Environments of an episode, at most: fewer than `max_batch` where states are large.

    >>> most_environments(1024, 256, 300), most_environments(1024, 65536, 50)
    (435, 10)
    """
    row = 8 * max(state_size, 1)
    fitting = min(MESSAGE_BYTES // row, EPISODE_BYTES // (row * (horizon + 1)))
    return max(min(max_batch, fitting), 1)


def less_often(numbers: int) -> int:
    """Factor, 1 to 4, by which a message of this many numbers, or its request, is repeated less often.

    A plant keeps itself for a run whose tuner it hears every ten seconds.

    >>> less_often(1000), less_often(150_000), less_often(10**7)
    (1, 2, 4)
    """
    return min(max(numbers // 2**16, 1), 4)


@dataclass(frozen=True)
class Batch:
    """Rollouts wanted together; any split into episodes gives the same results.

    rows (R, 4), or (R, 5) with noise: the columns of `episode/start`; policies (R, *shape): theta of
    each, as messages have it (`Law.shape`), None for an exploratory batch, whose result is a model for
    each row; trajectories: whether the result has them.
    """

    rows: Array
    policies: Array | None
    trajectories: bool = False
    together: int = 1
    """Rows one after the other that one episode has to have, if it may have so many."""
    parted: int = 1
    """The same of rows that may not: the model of the first one is that of all."""

    @property
    def exploratory(self) -> bool:
        return self.policies is None

    def within(self, max_batch: int) -> Batch:
        """The batch, whose rows part where a plant has fewer environments: a machine has one."""
        if self.together <= max_batch:
            return self
        return replace(self, together=1, parted=self.together)

    def joined(self, models: Sequence[Array]) -> Array | None:
        """The models of all rows from those of its episodes; None if there are none.

        Rows that were parted may have models of different orders.
        """
        rows = [model for part in models for model in part]
        return np.stack([rows[i - i % self.parted] for i in range(len(rows))]) if rows else None


@dataclass(frozen=True)
class BatchResult:
    """Results of a batch of R rollouts.

    costs (R, 3): as CostColumn says; models (R, rows, n_s): after an exploration; plant: its
    fingerprint; trajectories and target (n_z,): where the batch asked for trajectories; steps:
    after how many its episodes ended.
    """

    costs: Array
    models: Array | None = None
    plant: int = UNKNOWN_PLANT
    trajectories: list[Trajectory] | None = None
    target: Array | None = None
    steps: frozenset[int] = frozenset()

    def rollouts(self) -> list[RolloutResult]:
        """Results in the form that optimisers take; meaningless for an exploration."""
        seen = self.trajectories if self.trajectories is not None else repeat(None)
        return [
            RolloutResult(
                float(cost[CostColumn.MEAN]), bool(cost[CostColumn.ENDED] != COMPLETED), trajectory
            )
            for cost, trajectory in zip(self.costs, seen, strict=False)
        ]


@dataclass(frozen=True)
class TrainingSettings:
    """The definition of a training apart from the problem; see pdeloop.messages.parameters.TUNER."""

    n_a: int
    seed: int
    seeds: int
    evaluation_fields: int
    evaluation_seed: int
    start: str
    exploration_variance: float
    identification_attempts: int
    rollouts: int
    """The budget of a seed before the closing evaluation, explorations and checks among them; 0:
    `adaptation` besides those."""
    adaptation: int
    step: int
    """Rollouts of the optimiser's first step."""
    state_weight: float
    action_weight: float
    trajectories: bool
    explorations: int = 1
    """Rollouts of an exploration, from as many initial fields."""
    noise: bool = False
    """True if rollouts get seeds for the plant's noise."""
    action_set: ActionSet = ANY_ACTION
    measurement_noise: float = 0.0
    """Standard deviation of the noise on every number of the states."""
    sensors: int = 0
    """Point sensors whose readings the states are; 0: the states are whole."""
    sensor_positions: Sequence[float] = ()
    """Of each sensor as a share of the domain; none: equally spaced."""
    actuator_positions: Sequence[float] = ()
    """Centres of the actuators as shares of the domain; none: equally spaced."""
    actuator_widths: Sequence[float] = ()
    """Width of each as a share of the domain; none: not declared."""
    cost: Sequence[str] = ()
    """The whole cost (`pdeloop.messages.cost.Cost.texts`) where the weights do not say it."""
    periodic: bool = True
    """True if the states are fields on one periodic axis."""
    line: bool = True
    """True if they are fields on one axis, or plain vectors."""
    shape: tuple[int, ...] = ()
    """Points of each axis, if they are fields on several; none: they are not."""
    model: Array | None = None
    """Rows of a reduced model to start from instead of identifying one."""
    field_models: FieldModelSettings = DEFAULTS
    """How models of the whole field are fitted and one is chosen."""
    law: type[Law] = Affine
    horizon: int = 1
    """Steps of an episode as the parameters have it, for a law with parameters for each of them."""

    @property
    def all_seeds(self) -> list[int]:
        """The seeds of the trainings side by side: seed, seed + 1, ..."""
        return list(range(self.seed, self.seed + self.seeds))


def stacked(policies: Sequence[Array]) -> Array:
    """Policies as one array; vectors of several lengths with zeros at their ends (`Law.extends`)."""
    if len({policy.shape for policy in policies}) == 1:
        return np.stack(policies)
    found = np.zeros((len(policies), max(policy.size for policy in policies)))
    for row, policy in zip(found, policies, strict=True):
        row[: policy.size] = policy
    return found


def batch_of(wanted: Sequence[tuple[int, Rollout]], trajectories: bool = False) -> Batch:
    """A batch of rollouts, each with the index of the model of its policy."""
    rows = np.empty((len(wanted), START_COLUMNS))
    for row, (model, rollout) in zip(rows, wanted, strict=True):
        row[:] = (rollout.field_seed, -1, 0.0, model)
    policies = stacked([rollout.policy for _, rollout in wanted])
    return Batch(rows, np.clip(policies, -MAX_GAIN, MAX_GAIN), trajectories)


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
        sensor_positions=settings.sensor_positions,
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
