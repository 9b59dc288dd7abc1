# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Copies and pickles of plants continue an episode with the same bits, here and in another process."""

from __future__ import annotations

import copy
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pdeloop
from pde_sim_node.plant import Plant
from pdeloop.api import Problem
from pdeloop.messages.problem import shipped_problems
from tests.support.small import SMALL, same_bits

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "swift_hohenberg" / "swift_hohenberg.py"
INSTRUMENTS = {
    "process_noise": 0.01,
    "measurement_noise": 0.1,
    "sensors": 4,
    "sensor_delays": 3,
    "action_limit": 0.5,
}


def pickled(given: Any) -> Any:
    return pickle.loads(pickle.dumps(given))


WAYS = pytest.mark.parametrize("again", [copy.deepcopy, pickled])


def advance(plant: Plant, steps: int) -> list[np.ndarray]:
    """What the plant publishes under actions that are a function of the step alone."""
    seen = []
    for _ in range(steps):
        k = plant.step_index
        actions = 0.3 * np.sin(np.arange(plant.batch * plant.n_a) + k)
        seen.append(plant.step(actions.reshape(plant.batch, plant.n_a)).copy())
    return seen


def assert_same(one: Plant, other: Plant) -> None:
    assert one.step_index == other.step_index
    for name in ("states", "actions", "totals", "target", "supports"):
        assert same_bits(getattr(one, name), getattr(other, name)), name
    assert np.array_equal(one.diverged_step, other.diverged_step)


@WAYS
@pytest.mark.parametrize("problem", shipped_problems())
def test_a_copy_of_a_plant_continues_its_episode_to_the_bit(
    problem: str, again: Callable[[Any], Any]
) -> None:
    plant = pdeloop.problem(problem, n_z=64, horizon=6).plant(2)
    advance(plant, 2)
    other = again(plant)
    assert_same(plant, other)
    for ours, theirs in zip(advance(plant, 4), advance(other, 4), strict=True):
        assert same_bits(ours, theirs)
    assert_same(plant, other)


@WAYS
def test_a_copy_of_an_instrumented_plant_has_its_noise_delays_and_limits(
    again: Callable[[Any], Any],
) -> None:
    plant = pdeloop.problem("burgers", n_z=32, horizon=9, **INSTRUMENTS).plant(3)
    plant.reset([4, 5, 6], np.arange(3))
    advance(plant, 4)
    plant.restart(np.array([1]), [8])
    other = again(plant)
    for ours, theirs in zip(advance(plant, 5), advance(other, 5), strict=True):
        assert same_bits(ours, theirs)
    assert_same(plant, other)


def test_a_deep_copy_and_its_original_do_not_touch_each_other() -> None:
    plant = pdeloop.problem("burgers", n_z=32, horizon=9).plant(2)
    advance(plant, 2)
    other, before = copy.deepcopy(plant), plant.states.copy()
    del plant._step  # whose memory the copy must not need
    advance(other, 3)
    assert same_bits(plant.states, before) and plant.step_index == 2 and other.step_index == 5
    other.reset([1, 2, 3, 4])  # of another size
    assert len(advance(other, 1)[0]) == 4


def test_a_copy_remembers_what_diverged() -> None:
    plant = pdeloop.problem("burgers", n_z=32, horizon=9).plant(2)
    plant.step(np.array([np.zeros(6), np.full(6, 1e6)]))
    other = pickled(plant)
    advance(plant, 2), advance(other, 2)
    assert other.episode_costs().diverged_step.tolist() == [-1, 0]
    assert_same(plant, other)


def test_a_copied_problem_is_the_same_problem() -> None:
    problem = pdeloop.problem(SMALL, n_a=3, physical={"viscosity": 2e-3})
    for again in (copy.deepcopy, pickled):
        other: Problem = again(problem)
        assert other.values == problem.values and other.given == problem.given
        assert same_bits(advance(other.plant(), 2)[1], advance(problem.plant(), 2)[1])


CHILD = """
import pickle, sys
from tests.plant.test_copies import advance
plant = pickle.load(sys.stdin.buffer)
sys.stdout.buffer.write(pickle.dumps((plant, advance(plant, 3))))
"""


def continued_elsewhere(plant: Plant) -> tuple[Plant, list[np.ndarray]]:
    done = subprocess.run(
        [sys.executable, "-c", CHILD],
        input=pickle.dumps(plant),
        capture_output=True,
        check=True,
        timeout=120,
        env={**os.environ, "PYTHONPATH": str(ROOT)},  # the working directory may be left out
    )
    found: tuple[Plant, list[np.ndarray]] = pickle.loads(done.stdout)
    return found


def test_another_process_continues_a_pickled_plant_of_code_from_a_file(tmp_path: Path) -> None:
    file = tmp_path / "own.py"
    file.write_text(EXAMPLE.read_text())
    given: dict[str, Any] = {"equation": f"{file}:SwiftHohenberg", "n_z": 32, "horizon": 6}
    plant = pdeloop.problem("kuramoto-sivashinsky", **given, **INSTRUMENTS).plant(2)
    advance(plant, 2)
    other, theirs = continued_elsewhere(plant)
    for ours, own in zip(advance(plant, 3), theirs, strict=True):
        assert same_bits(ours, own)
    assert_same(plant, other)
    theirs, ours = other.plant.equation, plant.plant.equation
    assert type(theirs) is type(ours) and theirs == ours
    kept = pickle.dumps(plant)
    file.write_text(EXAMPLE.read_text() + "\n")
    with pytest.raises(ValueError, match=r"own.py' has changed since the plant was pickled"):
        pickle.loads(kept)
