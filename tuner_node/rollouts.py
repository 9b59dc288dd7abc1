# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The rollouts of a training's phases other than those of its optimisers. Pure.

All of them are functions of the training's seeds and of how often a seed has explored.
"""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.messages.topics import StartColumn
from pdeloop.method.adapt import Rollout
from pdeloop.method.seeds import Purpose, derive, evaluation_noise
from tuner_node.batch import TrainingSettings
from tuner_node.void_exploration import variance

CHECK = 2
"""Rollouts of a check: no control and the warm start, on one sampled field."""
EVALUATED = ("none", "lqt", "adapted")
"""The controllers of the closing evaluation, in the order of its rows."""
NOISE = {
    "identify": Purpose.EXPLORATORY_NOISE,
    "check": Purpose.CHECK_NOISE,
    "adapt": Purpose.ADAPT_NOISE,
}
"""Purpose of the noise seeds in the phases where each rollout has its own noise."""


def explorations(
    settings: TrainingSettings, pending: Sequence[int], attempts: Sequence[int], void: Sequence[int]
) -> Array:
    """The rows of `episode/start` of the explorations of each of the m pending seeds, (m E, 4).

    pending: their indices; attempts, void: how often each of all seeds has explored before, with a
    model and because the plant diverged.
    """
    E = settings.explorations
    rows = [
        (
            derive(settings.all_seeds[m], Purpose.EXPLORATORY_FIELD, number),
            derive(settings.all_seeds[m], Purpose.EXCITATION, number),
            variance(settings, void[m]),
            m,
        )
        for m in pending
        for number in range(E * (attempts[m] + void[m]), E * (attempts[m] + void[m] + 1))
    ]
    return np.array(rows, dtype=np.float64)


def checks(
    settings: TrainingSettings, pending: Sequence[int], warm: Array
) -> list[tuple[int, Rollout]]:
    """No control and the warm start of each pending seed on the same field.

    warm (S, *shape): the warm starts of all seeds. Each rollout comes with the index of its seed.
    """
    return [
        (m, Rollout(policy, derive(settings.all_seeds[m], Purpose.CHECK_FIELD)))
        for m in pending
        for policy in (np.zeros_like(warm[m]), warm[m])
    ]


def evaluations(
    settings: TrainingSettings, warm: Array, adapted: Array
) -> list[tuple[int, Rollout]]:
    """The controllers of EVALUATED for every seed on the fields of the evaluation.

    warm, adapted (S, *shape): the policies. Each rollout comes with the index of its seed.
    """
    fields = [
        derive(settings.evaluation_seed, Purpose.EVALUATION_FIELD, i)
        for i in range(settings.evaluation_fields)
    ]
    return [
        (m, Rollout(policy, field_seed))
        for m in range(settings.seeds)
        for policy in (np.zeros_like(warm[m]), warm[m], adapted[m])
        for field_seed in fields
    ]


def noise_seeds(
    settings: TrainingSettings, phase: str, rows: Array, counts: Sequence[int], again: Sequence[int]
) -> list[int]:
    """The seed of the noise of every row (R, 4) of a batch of that phase.

    counts: for every training a number that is never the same again in the phase, its attempts or how
    many batches its optimiser has had. In the evaluation all controllers share the noise, and the
    first rollouts of the trainings `again` have theirs once more.
    """
    if phase == "evaluate":
        fields = evaluation_noise(settings.evaluation_seed, settings.evaluation_fields)
        first = [derive(settings.all_seeds[m], NOISE["adapt"], 0) for m in again]
        return first + fields * (settings.seeds * len(EVALUATED))
    rows_of: Counter[int] = Counter()
    noise = []
    for m in rows[:, StartColumn.MODEL].astype(int).tolist():
        index = (counts[m] << 32) + rows_of[m]
        noise.append(derive(settings.all_seeds[m], NOISE[phase], index))
        rows_of[m] += 1
    return noise
