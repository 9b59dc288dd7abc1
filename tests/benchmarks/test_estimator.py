# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The estimators that know the plant, by which trainings with few sensors are measured."""

from __future__ import annotations

import numpy as np
import pytest

import pdeloop
from benchmarks.bounds import TRAINING_SEED, evaluation_seeds
from benchmarks.estimator import ExtendedKalmanLaw, PosteriorMeanLaw, static_law
from pde_sim_node.instruments import InstrumentedPlant
from pdeloop.episode import rollout

Array = np.ndarray


@pytest.mark.parametrize("kind", [ExtendedKalmanLaw, PosteriorMeanLaw])
def test_an_estimator_finds_the_field_between_the_sensors(
    kind: type[ExtendedKalmanLaw | PosteriorMeanLaw],
) -> None:
    """That of the episode is among the fields of the prior, and its readings have little noise."""
    given = {"horizon": 30}
    true = pdeloop.problem("allen-cahn", **given).plant()
    sensed = pdeloop.problem("allen-cahn", sensors=8, measurement_noise=0.02, **given).plant()
    assert isinstance(sensed, InstrumentedPlant)
    initial = true.reset(np.arange(20)).copy()
    seen: list[Array] = []

    def law(k: int, fields: Array) -> Array:
        seen.append(fields.copy())
        return np.full((len(fields), true.n_a), 2.0 * np.sin(k))

    rollout(sensed, kind(sensed, true, law, initial), [3])
    own = rollout(true, lambda k, z: np.full((1, true.n_a), 2.0 * np.sin(k)), [3]).states[:-1, 0]
    off = np.linalg.norm(np.array(seen)[:, 0] - own, axis=1) / np.linalg.norm(own, axis=1)
    assert off[-1] < 0.05


def test_the_best_law_of_the_newest_readings_is_an_optimum_of_their_gains() -> None:
    given = {"horizon": 20, "sensors": 8}
    sensed = pdeloop.problem("allen-cahn", **given).plant()
    assert isinstance(sensed, InstrumentedPlant)
    found = static_law(sensed, "allen-cahn", given, 4)

    def cost(scale: float, offset: float = 0.0) -> float:
        fields = evaluation_seeds(TRAINING_SEED, 4)  # those that it is made for
        own = rollout(sensed, lambda k, z: scale * found(k, z) + offset, fields, keep=False)
        return float(own.costs.mean.mean())

    least = cost(1.0)
    assert least < 0.6 * cost(0.0)
    others = (cost(0.9), cost(1.1), cost(1.0, 0.3), cost(1.0, -0.3))
    assert all(least < other for other in others)
