# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The arrays of a checkpoint: back to the same state, or refused with nothing changed."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest

from pdeloop.in_process import LocalPair
from tests.support.small import CHECKED, FEW_STEPS, parameters
from tuner_node.build import build_training
from tuner_node.training_state import Arrays, arrays_of, restore

KINDS: dict[str, dict[str, Any]] = {
    "two_point": {"iterations": 2},
    CHECKED: {"rollouts": 9, **FEW_STEPS},
}


@cache
def values(optimizer: str) -> dict[str, Any]:
    small = {"seeds": 2, "evaluation_fields": 1, "horizon": 8, "n_z": 16}
    return parameters(optimizer=optimizer, **{**small, **KINDS[optimizer]})


@cache
def states(optimizer: str) -> list[Arrays]:
    """After each batch of a training, and before the first."""
    return list(states_of(values(optimizer)))


def states_of(values: dict[str, Any]) -> Iterator[Arrays]:
    training, pair = build_training(values), LocalPair(values)
    yield arrays_of(training)
    while (batch := training.next_batch()) is not None:
        training.finish(pair.run(batch))
        pair.follow(training)
        yield {name: array.copy() for name, array in arrays_of(training).items()}


def until_adapting(values: dict[str, Any]) -> Iterator[Arrays]:
    for state in states_of(values):
        yield state
        if str(state["phase"]) == "adapt":
            return


def at(optimizer: str, phase: str) -> Arrays:
    """The first state in a phase."""
    return next(dict(state) for state in states(optimizer) if str(state["phase"]) == phase)


def equal(a: Arrays, b: Arrays) -> bool:
    return a.keys() == b.keys() and all(
        a[name].dtype.kind == b[name].dtype.kind and np.array_equal(a[name], b[name]) for name in a
    )


@pytest.mark.parametrize("optimizer", KINDS)
def test_every_state_of_a_training_comes_back(optimizer: str) -> None:
    assert {str(s["phase"]) for s in states(optimizer)} >= {"identify", "check", "adapt", "done"}
    for state in states(optimizer):
        training = build_training(values(optimizer))
        restore(training, state)
        assert equal(arrays_of(training), state)


def test_every_state_of_a_training_of_one_seed_that_explores_twice_comes_back() -> None:
    own = parameters(optimizer="model_based", rollouts=6, horizon=8, n_z=16)
    for state in until_adapting(own):
        training = build_training(own)
        restore(training, state)
        assert equal(arrays_of(training), state)
    assert "further0.0.states" in state and "further0.1.states" not in state


@pytest.mark.parametrize(
    ("optimizer", "phase", "changes", "words"),
    [
        ("two_point", "adapt", {"phase": np.array("sleep")}, "its phase is 'sleep'"),
        ("two_point", "identify", {"pending": np.array([2])}, "seeds or attempts"),
        ("two_point", "identify", {"pending": np.array([-1])}, "seeds or attempts"),
        ("two_point", "identify", {"attempts": np.array([0, -1])}, "seeds or attempts"),
        ("two_point", "identify", {"pending": np.array([], dtype=int)}, "no seed to identify"),
        ("two_point", "check", {"pending": np.array([], dtype=int)}, "no seed to identify"),
        ("two_point", "check", {"models": None}, "no models"),
        ("two_point", "adapt", {"models": None}, "no models"),
        ("two_point", "done", {"evaluation": None}, "no evaluation"),
        ("two_point", "adapt", {"history": np.array(json.dumps([{"a": 1}]))}, "does not fit"),
        ("two_point", "identify", {"steps": np.array(-1)}, "number of steps"),
        ("two_point", "identify", {"steps": np.array(2**62)}, "number of steps"),
        ("two_point", "check", {"models": np.full((2, 33, 4), 1e200)}, "products are infinite"),
        ("two_point", "adapt", {"optimizer0.tells": np.array(-1)}, "does not fit"),
        (CHECKED, "adapt", {"target": None}, "no target"),
        (CHECKED, "check", {"exploration1": None}, "not all explorations"),
        (CHECKED, "adapt", {"target": np.zeros(15)}, "'target'"),
    ],
)
def test_a_state_in_which_no_training_can_be_is_refused_and_nothing_is_changed(
    optimizer: str, phase: str, changes: dict[str, Any], words: str
) -> None:
    state = at(optimizer, phase)
    for name, array in changes.items():
        state = {key: known for key, known in state.items() if not key.startswith(name)}
        state |= {} if array is None else {name: array}
    training = build_training(values(optimizer))
    before = arrays_of(training)
    with pytest.raises(ValueError, match=words):
        restore(training, state)
    assert equal(arrays_of(training), before)
