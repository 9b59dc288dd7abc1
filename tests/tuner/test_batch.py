# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""How many environments an episode may have, and whose model they have."""

from __future__ import annotations

import numpy as np
import pytest

from tuner_node.batch import EPISODE_BYTES, MESSAGE_BYTES, Batch, less_often, most_environments


@pytest.mark.parametrize("n_z", [1, 256, 65_536, 2_000_000])
@pytest.mark.parametrize("horizon", [1, 30, 1000])
def test_an_episode_has_as_many_environments_as_fit_and_at_least_one(
    n_z: int, horizon: int
) -> None:
    def fits(count: int) -> bool:
        states = 8 * n_z * count
        return states <= MESSAGE_BYTES and states * (horizon + 1) <= EPISODE_BYTES

    for most in (1024, 10**9):
        found = most_environments(most, n_z, horizon)
        assert fits(found) or found == 1
        assert found == most or not fits(found + 1)
    assert most_environments(1, n_z, horizon) == 1


def test_a_message_of_many_numbers_is_repeated_up_to_four_times_less_often() -> None:
    many = [0, 2**16 - 1, 2 * 2**16, 3 * 2**16, 4 * 2**16, 5 * 2**16, 10**9]
    assert [less_often(numbers) for numbers in many] == [1, 1, 2, 3, 4, 4, 4]


def test_rows_that_a_machine_of_one_environment_parts_have_the_model_of_their_first() -> None:
    asked = Batch(np.zeros((4, 4)), None, together=2)
    models = [np.full((1, 3, 2), float(i)) for i in range(4)]
    assert asked.within(2) is asked
    both = asked.joined([np.concatenate(models[:2]), np.concatenate(models[2:])])
    assert both is not None and both[:, 0, 0].tolist() == [0.0, 1.0, 2.0, 3.0]
    parted = asked.within(1).joined(models)
    assert parted is not None and parted[:, 0, 0].tolist() == [0.0, 0.0, 2.0, 2.0]
    assert asked.joined([]) is None
