# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Every random choice of a training is a pure function of (seed, purpose, index).

So a run that was interrupted, restarted, batched or distributed draws what an undisturbed one does.

Where the plant has noise, a rollout has a seed of its own for it, as an experiment has: two rollouts of
an optimiser from one field share the field and not the noise. In the closing evaluation all controllers
have the same noise on a field, so that they compare.
"""

from enum import IntEnum

import numpy as np

from pdeloop.messages.parameters import MAX_SEED

# Large constants: NumPy pads a short seed sequence with zeros, so [seed, stream, 0] would equal the
# [seed, step] of another user of the same seed if the stream were a small number.
DIRECTION_STREAM = 0x5448455441  # "THETA"
_FIELD_STREAM = 0x4649454C44  # "FIELD"


class Purpose(IntEnum):
    """Purposes of seeds; their numbers are part of the results' reproducibility."""

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


def evaluation_noise(seed: int, fields: int) -> list[int]:
    """A seed for every field of an evaluation."""
    return [derive(seed, Purpose.EVALUATION_NOISE, i) for i in range(fields)]


def field_seed(seed: int, index: int) -> int:
    """The seed of an optimiser's initial field of this number, in [0, 2^53)."""
    return int(np.random.default_rng([seed, _FIELD_STREAM, index]).integers(MAX_SEED + 1))
