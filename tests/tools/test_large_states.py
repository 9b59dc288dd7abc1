# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A training of a state of 16,384 numbers: what memory and files take is a multiple of a state."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

import pdeloop
from pdeloop.messages.arrays import Array
from pdeloop.messages.spec import ParameterError
from pdeloop.method.reduce.channels import state_faults
from pdeloop.training_run import check_messages, resolve
from tuner_node.batch import EPISODE_BYTES, MESSAGE_BYTES, most_environments
from tuner_node.build import build_training

N_Z, T, ROLLOUTS = 16_384, 16, 8
STATE = 8 * N_Z
"""Bytes of a state; a matrix of a state's size would be 16,384 of them."""


class Waves(pdeloop.Dynamics):
    """Five decaying waves and three inputs, on very many points."""

    n_z, n_a, horizon = N_Z, 3, T

    def __init__(self) -> None:
        x = np.arange(N_Z) / N_Z
        self._waves = np.array([np.cos(np.pi * i * x) for i in range(5)])
        self._decay = 0.95 + 0.04 * np.sin(2 * np.pi * x)

    def initial_state(self, rng: np.random.Generator) -> Array:
        drawn: Array = rng.standard_normal(5) @ self._waves
        return drawn

    def step(self, z: Array, a: Array) -> Array:
        after: Array = self._decay * z + 0.3 * a @ self._waves[:3]
        return after


def test_memory_and_files_of_a_training_are_a_multiple_of_a_state(tmp_path: Path) -> None:
    out = tmp_path / "run"
    tracemalloc.start()
    try:
        run = pdeloop.train(
            plant=Waves(), reduced_order=4, rollouts=ROLLOUTS, evaluation_fields=2, out=out
        )
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert run.costs["adapted"].mean() < 0.9 * run.costs["none"].mean()
    assert peak < 600 * STATE
    # Less than the states of all rollouts, as one basis serves them all.
    assert (out / "checkpoint").stat().st_size < 0.6 * ROLLOUTS * (T + 1) * STATE
    assert (out / "result.json").stat().st_size < 10_000


def test_copies_among_very_many_channels_are_found_without_a_matrix_of_their_size() -> None:
    states = np.random.default_rng(0).standard_normal((20, N_Z))
    states[:, 9_000], states[:, 12_000:12_500] = -2.0 * states[:, 5], states[:, 7:8]
    tracemalloc.start()
    try:
        (found,) = state_faults(states)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert found.startswith("z9001 is always -2 times z6, z12001 is always z8")
    assert found.endswith("and 495 more")
    assert peak < 200 * STATE


def test_an_episode_of_large_states_has_fewer_environments() -> None:
    assert most_environments(64, 128, 300) == 64
    most = most_environments(1024, 65_536, 50)
    assert most * 65_536 * 8 <= MESSAGE_BYTES and most * 51 * 65_536 * 8 <= EPISODE_BYTES
    assert most_environments(1024, 2**24, 1000) == 1
    assert most_environments(1024, 0, 0) == 1024  # not known


def test_models_that_no_message_can_hold_are_refused_before_anything_is_started() -> None:
    values = resolve("burgers", {"reduced_order": 12})
    training = build_training(values)
    values["n_z"] = 2**20  # as of a plant of one's own
    with pytest.raises(ParameterError, match="2 models of a state of 1048576 numbers are 25165824"):
        check_messages(values, training)
    check_messages({**values, "reduced_order": 8}, training)  # just as much as there is room for
