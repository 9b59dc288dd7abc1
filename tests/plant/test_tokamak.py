# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The example of Gym-TORAX: the open loop's return, gain against heating, and failures as ends."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pdeloop

pytestmark = [
    pytest.mark.skipif(
        importlib.util.find_spec("gymtorax") is None,
        reason="Gym-TORAX is not installed: extra tokamak",
    ),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),  # in its imports
    pytest.mark.filterwarnings("ignore::UserWarning"),
]
EXAMPLE = Path(__file__).parents[2] / "examples" / "plants" / "tokamak_gymtorax.py"


@pytest.fixture(scope="module")
def plants() -> Any:
    """The plant with the reward as its cost, and the one with targets."""
    spec = importlib.util.spec_from_file_location("tokamak_gymtorax", EXAMPLE)
    assert spec is not None and spec.loader is not None
    with pytest.MonkeyPatch.context() as patched:
        module = importlib.util.module_from_spec(spec)
        patched.setitem(sys.modules, "tokamak_gymtorax", module)
        spec.loader.exec_module(module)
        yield module.rewarded(), module.ramp()


def episode(plant: Any, beam: float, current: float, waves: float) -> Any:
    action = np.array([[beam, current, waves]])
    return pdeloop.rollout(plant, lambda k, z: action, [0])


def test_names_bounds_and_rate_limits_are_those_of_the_example(plants: Any) -> None:
    for plant in plants:
        assert (plant.n_z, plant.n_a, plant.horizon) == (19, 3, 150)
        assert plant.action_set.low.tolist() == [0.0, -1.0, 0.0]
        assert plant.action_set.rate.tolist() == [np.inf, 0.1, np.inf]
    assert np.flatnonzero(plants[1].target).size == 3


def test_the_open_loop_returns_what_it_does_without_us_and_less_heating_gains_more(
    plants: Any,
) -> None:
    whole = episode(plants[0], 1.0, 0.0, 1.0)
    assert whole.whole and -whole.costs.total[0] == pytest.approx(3.263, abs=5e-4)
    less = episode(plants[0], 0.5, 0.0, 0.5)
    assert -less.costs.total[0] > 3.5
    # The keys are sorted: H98, and then log(1 + Q) / log 11.
    gains = [11.0 ** own.states[-1, 0, 1] - 1.0 for own in (less, whole)]
    assert gains[0] > 1.4 * gains[1] and gains[1] == pytest.approx(6.87, abs=0.01)


def test_a_step_that_fails_ends_the_rollout_and_the_end_of_the_scenario_does_not(
    plants: Any,
) -> None:
    """Almost without a current q exceeds the bound of the observation, 100."""
    plant = plants[0]
    inner = plant._first
    inner.reset(seed=0)
    names = list(inner.action_space)
    low = {**dict.fromkeys(names, np.ones(1)), "current": np.array([-5.0])}
    ends = []
    for _ in range(150):
        *_, reward, failed, over, _ = inner.step(low)
        ends.append((failed, over))
        if failed or over:
            break
    assert reward == -1000.0 and ends[-1] == (True, False) and len(ends) < 150
