# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Gauss-Newton where rollouts diverge, from checkpoints, and with what it refuses."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
import pytest

from loop_method.adapt import GaussNewton, Rollout, RolloutResult, Trajectory
from tests.support.lifted_plant import Plant, T, make, mean_cost, measure, same_state


def diverged(plant: Plant, rollout: Rollout, tail: str) -> RolloutResult:
    result = plant.run(rollout.policy, rollout.field_seed)
    assert result.trajectory is not None
    states, actions = result.trajectory.states.copy(), result.trajectory.actions.copy()
    if tail == "nan":
        states[9:], actions[9:] = np.nan, np.nan
    elif tail == "frozen":
        states[9:] = states[9]
    elif tail == "huge":
        states[9:] *= 1e30
    elif tail == "empty":
        states, actions = states[:1], actions[:0]
    return RolloutResult(1e9 if tail != "nan" else np.nan, True, Trajectory(states, actions))


@pytest.mark.parametrize("tail", ["nan", "frozen", "huge", "empty"])
def test_a_diverged_candidate_stays_out_of_the_policy_and_of_the_model(tail: str) -> None:
    plant = Plant()
    optimizer = make(plant, rollouts=16)
    optimizer.tell(measure(plant, optimizer.ask()))
    before = optimizer.policy
    for _ in range(3):
        row = optimizer.tell([diverged(plant, optimizer.ask()[0], tail)])
        assert row["diverged"] == 1
        assert row["accepted"] is False
        assert json.dumps(row, allow_nan=False)
    assert np.array_equal(optimizer.policy, before)
    kept = [a for name, a in optimizer.state().items() if name.endswith(".states")]
    assert sum(map(len, kept)) < 4 * (T + 1)
    start = mean_cost(plant, before)
    while not optimizer.done:
        optimizer.tell(measure(plant, optimizer.ask()))
    assert mean_cost(plant, optimizer.policy) < start


def test_a_warm_start_that_diverges_is_halved_until_it_does_not() -> None:
    plant = Plant()
    wild = 8.0 * plant.best
    optimizer = make(plant, wild)
    results = measure(plant, optimizer.ask())
    assert all(result.diverged for result in results)
    row = optimizer.tell(results)
    assert "cost" not in row
    assert np.array_equal(optimizer.ask()[0].policy, 0.5 * wild)
    while not optimizer.done:
        row = optimizer.tell(measure(plant, optimizer.ask()))
        assert json.dumps(row, allow_nan=False)
    assert mean_cost(plant, optimizer.policy) < 1.1 * mean_cost(plant, plant.best)


def test_only_divergence_never_moves_the_policy() -> None:
    plant = Plant()
    optimizer = make(plant, rollouts=12)
    before = optimizer.policy
    while not optimizer.done:
        optimizer.tell([diverged(plant, rollout, "nan") for rollout in optimizer.ask()])
    assert np.array_equal(optimizer.policy, before)


def test_a_restored_training_ends_with_the_same_bits() -> None:
    plant = Plant(bend=0.1)

    def step(optimizer: GaussNewton) -> dict[str, Any]:
        asked = optimizer.ask()
        results = measure(plant, asked)
        if optimizer.tells == 4:
            results[0] = diverged(plant, asked[0], "nan")
        return optimizer.tell(results)

    # What a step leaves follows from what is kept before it, so restoring may come anywhere.
    whole = make(plant, rollouts=17)
    while not whole.done:
        stored = io.BytesIO()
        np.savez(stored, **whole.state())
        stored.seek(0)
        again = make(plant, rollouts=17)
        with np.load(stored, allow_pickle=False) as arrays:
            again.restore(dict(arrays))
        assert step(again) == step(whole)
        assert same_state(again, whole)
    assert whole.tells > 8


def test_continues_from_a_checkpoint_with_the_names_of_an_older_version() -> None:
    plant = Plant()
    optimizer = make(plant)
    for _ in range(3):
        optimizer.tell(measure(plant, optimizer.ask()))
    older = optimizer.state()
    older["others"] = older.pop("compared")
    again = make(plant)
    again.restore(older)
    assert same_state(again, optimizer)


def test_refuses_foreign_checkpoints() -> None:
    plant = Plant()
    optimizer = make(plant)
    optimizer.tell(measure(plant, optimizer.ask()))
    good = optimizer.state()
    with pytest.raises(ValueError, match="no array 'candidate'"):
        make(plant).restore({"policy": optimizer.policy})
    with pytest.raises(ValueError, match=r"no array 'record1\.states'"):
        make(plant).restore({k: v for k, v in good.items() if k != "record1.states"})
    with pytest.raises(ValueError, match=r"expected 'record1\.states'"):
        make(plant).restore(good | {"record1.states": good["record1.states"][:, :0]})
    with pytest.raises(ValueError, match="states and"):
        make(plant).restore(good | {"record1.states": good["record1.states"][:1]})
    with pytest.raises(ValueError, match=r"lacks: \[1\]"):
        make(plant).restore(good | {"stamps": np.array([0, 2])})


def test_needs_sound_trajectories_and_stays_as_it_was_without() -> None:
    plant = Plant()
    optimizer = make(plant)
    good = measure(plant, optimizer.ask())
    trajectory = good[0].trajectory
    assert trajectory is not None
    broken = Trajectory(trajectory.states * np.nan, trajectory.actions)
    short = Trajectory(trajectory.states[:-4], trajectory.actions)
    for bad, message in (
        (RolloutResult(1.0), "learns from trajectories"),
        (RolloutResult(1.0, False, broken), "finite trajectory"),
        (RolloutResult(1.0, False, short), "T or T"),
    ):
        with pytest.raises(ValueError, match=message):
            optimizer.tell([*good[:2], bad])
    assert optimizer.tells == 0
    assert len(optimizer.ask()) == 3
    optimizer.tell(good)
    with pytest.raises(ValueError, match="one result per rollout, 1, but got 3"):
        optimizer.tell(good)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rollouts": 0}, "rollouts must be positive"),
        ({"policy": np.zeros((2, 6))}, "does not match a basis"),
        ({"policy": np.zeros((3, 8))}, "exploratory trajectory must have"),
    ],
)
def test_refuses_bad_parameters(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(Plant(), **changes)
