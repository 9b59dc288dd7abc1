"""Every random choice of a training is a pure function of (seed, purpose, index).

So a run that was interrupted, restarted, batched or distributed draws what an undisturbed one does.

Where the plant has noise, a rollout has a seed of its own for it, as an experiment has: two rollouts of
an optimiser from one field share the field and not the noise. In the closing evaluation all controllers
have the same noise on a field, so that they compare.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from enum import IntEnum

import numpy as np

from loop_interfaces.parameters import MAX_SEED


class Purpose(IntEnum):
    """What a seed is for; the numbers are part of the results' reproducibility."""

    EXPLORATORY_FIELD = 1
    EXCITATION = 2
    EVALUATION_FIELD = 3
    CHECK_FIELD = 4
    EXPLORATORY_NOISE = 5
    CHECK_NOISE = 6
    ADAPT_NOISE = 7
    EVALUATION_NOISE = 8


def derive(seed: int, purpose: Purpose, index: int = 0) -> int:
    """A seed in [0, 2^53) for `purpose`, from NumPy's SeedSequence of (seed, purpose, index)."""
    words = np.random.SeedSequence([seed, int(purpose), index]).generate_state(1, np.uint64)
    return int(words[0]) % (MAX_SEED + 1)


NOISE = {
    "identify": Purpose.EXPLORATORY_NOISE,
    "check": Purpose.CHECK_NOISE,
    "adapt": Purpose.ADAPT_NOISE,
}
"""Of the phases in which every rollout has noise of its own."""


def rollout_noise(
    purpose: Purpose, seeds: Sequence[int], owners: Sequence[int], counts: Sequence[int]
) -> list[int]:
    """The seed of the noise of every row of a batch.

    Parameters
    ----------
    purpose : Purpose
        One of NOISE.
    seeds : sequence of int
        Of the trainings.
    owners : sequence of int
        Index of the training of every row.
    counts : sequence of int
        For every training a number that is never the same again for this purpose: its attempts, or how
        many batches its optimiser has had.

    Examples
    --------
    >>> first, second, other = rollout_noise(Purpose.ADAPT_NOISE, [3, 4], [0, 0, 1], [0, 0])
    >>> first == derive(3, Purpose.ADAPT_NOISE, 0) != second == derive(3, Purpose.ADAPT_NOISE, 1)
    True
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
