"""Which noise a rollout meets: the seeds of the plant's noise, one for every row of a batch.

A rollout has a noise of its own, as an experiment has: two rollouts of an optimiser from one field
share the field and not the noise. In the closing evaluation all controllers meet the same noise on
a field, so that they compare. Every seed is a pure function of the training's seed and of where the
training stands, so an episode that is run again meets the noise it met before.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from tuner_node.seeds import Purpose, derive

PURPOSES = {
    "identify": Purpose.EXPLORATORY_NOISE,
    "check": Purpose.CHECK_NOISE,
    "adapt": Purpose.ADAPT_NOISE,
}
"""Of the phases in which every rollout has a noise of its own."""


def rollout_noise(
    purpose: Purpose, seeds: Sequence[int], owners: Sequence[int], counts: Sequence[int]
) -> list[int]:
    """A seed for every row.

    seeds: of the trainings; owners: the training of every row; counts: a number for every training
    that is never the same again for this purpose: its attempts, or the batches that its optimiser
    was told.
    """
    rows_of: Counter[int] = Counter()
    noise = []
    for m in owners:
        noise.append(derive(seeds[m], purpose, (counts[m] << 32) + rows_of[m]))
        rows_of[m] += 1
    return noise


def evaluation_noise(seed: int, fields: int) -> list[int]:
    """A seed for every field of an evaluation."""
    return [derive(seed, Purpose.EVALUATION_NOISE, i) for i in range(fields)]
