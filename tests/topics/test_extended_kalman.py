# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The law that estimates the field between few sensors, over topics: the bits of one process."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import pdeloop
from pdeloop.method.laws import ExtendedKalman
from tests.support.loop_harness import Processes
from tests.support.small import same_bits
from tests.support.small_loop import LIMIT
from tests.tools.test_own_law import policies

pytestmark = pytest.mark.topics

PARAMETERS = {
    "sensors": 8,
    "n_a": 3,
    "actuator_width": 0.2,
    "reduced_order": 4,
    "horizon": 10,
    "exploration_variance": 4.0,
    "rollouts": 5,
    "evaluation_fields": 2,
}
SETTINGS = {"optimizer_settings": {"iterations": 2, "mixtures": 1, "judging": 1}}


def test_it_is_trained_over_topics_to_the_bits_of_one_process_and_recomputed_from_a_bag(
    loop: Processes, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    words = [f"{name}={value}" for name, value in PARAMETERS.items()]
    words += [f"{of}.{name}={value}" for of, own in SETTINGS.items() for name, value in own.items()]
    flags = [word for setting in words for word in ("--set", setting)]
    loop.wait(loop.pdeloop("train", "allen-cahn", *flags, "--record", "--out", str(out)), LIMIT)
    here = pdeloop.train("allen-cahn", **PARAMETERS, **SETTINGS)
    law = here.laws[0]
    assert isinstance(law, ExtendedKalman) and law.estimates(here.policies[0])
    assert same_bits(policies(out), here.policies)
    verified = loop.wait(loop.pdeloop("bag", "verify", str(out)), LIMIT)
    assert "no difference, to the bit" in verified


def test_a_law_of_readings_for_any_quadratic_cost_has_the_bits_of_one_process(
    loop: Processes, tmp_path: Path
) -> None:
    """The controller sees the cost through the sensors, as the tuner does."""
    out, weights = tmp_path / "run", np.linspace(0.5, 1.5, 64)
    own = {"terminal_weight": 1.0, "state_weight": weights, "action_weight": [0.01, 0.02, 0.03]}
    own["target"] = np.linspace(0.0, 0.5, 10)[:, None] * weights  # which moves
    values = {**PARAMETERS, **SETTINGS, "n_z": 64, "cost": own}
    here = pdeloop.train("allen-cahn", **values, out=tmp_path / "here")
    assert len(here.laws[0].parts(here.policies[0])["b"]) == 10
    file = str(tmp_path / "here" / "parameters.yaml")
    loop.wait(loop.pdeloop("train", file, "--record", "--out", str(out)), LIMIT)
    assert same_bits(policies(out), here.policies)
    assert "no difference, to the bit" in loop.wait(loop.pdeloop("bag", "verify", str(out)), LIMIT)
