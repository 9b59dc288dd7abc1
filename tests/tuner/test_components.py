# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Sensors of a plant of two components, both of which each of them measures."""

from __future__ import annotations

import numpy as np
import pytest

from pde_sim_node.build import build_plant
from pdeloop.in_process import LocalPair
from pdeloop.messages.parameters import measured_size
from pdeloop.training_run import resolve
from tuner_node.build import build_training, few_sensors
from tuner_node.run_folder import model_of


def test_numbers_and_noise_of_a_message_are_those_of_all_components() -> None:
    given = {"n_z": 32, "sensors": 4, "horizon": 20, "reduced_order": 4, "measurement_noise": 0.1}
    values = resolve("wave", given)
    plant = build_plant(values)
    assert measured_size(values) == plant.state_size == 8
    rest = np.zeros((4000, plant.n_z))
    noisy = plant.reset(rest, np.arange(len(rest)))
    assert noisy.std() == pytest.approx(build_training(values).settings.measurement_noise, rel=0.02)


def test_sensors_at_every_point_measure_the_whole_state() -> None:
    given = {"n_z": 32, "horizon": 20, "reduced_order": 4}
    assert few_sensors(resolve("wave", {**given, "sensors": 15})) == 15
    assert few_sensors(resolve("wave", {**given, "sensors": 16})) == 0


def test_models_of_a_run_are_read_where_the_tuner_was_not_told_the_components() -> None:
    given = {"n_z": 32, "sensors": 4, "horizon": 40, "reduced_order": 4, "law": "observer"}
    values = resolve("wave", given)
    batch = build_training(values).next_batch()
    assert batch is not None
    models = LocalPair(values).run(batch).models
    assert models is not None
    for known in (values, {**values, "grid": ""}):
        model = model_of(models[0], known)
        assert model.U.shape == (8, 4) and model.L is not None
