"""The rollouts that the phases of a training want, beside those that the optimisers ask for. Pure.

All of them are functions of the training's seeds and of how often a seed has explored.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.topics import StartColumn
from tuner_node.batch import TrainingSettings
from tuner_node.optimizers import Rollout
from tuner_node.seeds import NOISE, Purpose, derive, evaluation_noise, rollout_noise

Array = NDArray[np.float64]
CHECK_FIELDS = 1
"""Sampled fields on which a warm start must beat no control."""
EXPLORATION = 1
"""Rollouts of an exploration."""
CHECK = 2 * CHECK_FIELDS
"""Rollouts of a check: no control and the warm start."""
CONTROLLERS = ("none", "lqt", "adapted")
"""The controllers of the closing evaluation, in the order of its rows."""


def explorations(
    settings: TrainingSettings, pending: Sequence[int], attempts: Sequence[int]
) -> Array:
    """The rows of `episode/start` of an exploration for each of the pending seeds, (m, 4).

    Parameters
    ----------
    settings : TrainingSettings
        Of the training.
    pending : sequence of int
        Indices of the m seeds.
    attempts : sequence of int
        How often each of all seeds has explored before.
    """
    seeds = settings.all_seeds
    rows = [
        [
            derive(seeds[m], Purpose.EXPLORATORY_FIELD, attempts[m]),
            derive(seeds[m], Purpose.EXCITATION, attempts[m]),
            settings.exploration_variance,
            m,
        ]
        for m in pending
    ]
    return np.array(rows, dtype=np.float64)


def checks(
    settings: TrainingSettings, pending: Sequence[int], warm: Array
) -> list[tuple[int, Rollout]]:
    """No control and the warm start of each pending seed on the same fields.

    warm (S, n_a, 2 n_s): the warm starts of all seeds. Each rollout comes with the index of its seed.
    """
    return [
        (m, Rollout(policy, derive(settings.all_seeds[m], Purpose.CHECK_FIELD, i)))
        for m in pending
        for policy in (np.zeros_like(warm[m]), warm[m])
        for i in range(CHECK_FIELDS)
    ]


def evaluations(
    settings: TrainingSettings, warm: Array, adapted: Array
) -> list[tuple[int, Rollout]]:
    """The CONTROLLERS of every seed on the fields of the evaluation.

    warm, adapted (S, n_a, 2 n_s): the policies. Each rollout comes with the index of its seed.
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
    settings: TrainingSettings, phase: str, rows: Array, counts: Sequence[int]
) -> list[int]:
    """The seed of the noise of every row of a batch.

    Parameters
    ----------
    settings : TrainingSettings
        Of the training.
    phase : str
        In which the batch is wanted.
    rows : (R, 4) array
        The rows of the batch.
    counts : sequence of int
        As of seeds.rollout_noise; of no meaning in the evaluation, where all controllers share it.
    """
    if phase == "evaluate":
        fields = evaluation_noise(settings.evaluation_seed, settings.evaluation_fields)
        return fields * (settings.seeds * len(CONTROLLERS))
    owners = rows[:, StartColumn.MODEL].astype(int).tolist()
    return rollout_noise(NOISE[phase], settings.all_seeds, owners, counts)
