# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The estimators that know the plant, by which trainings with few sensors are measured."""

from __future__ import annotations

import numpy as np
import pytest

import pdeloop
from benchmarks.estimator import ExtendedKalmanLaw, PosteriorMeanLaw
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
