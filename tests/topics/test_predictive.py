# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The law that plans on a model where that pays, over topics: the bits of one process."""

from __future__ import annotations

from pathlib import Path

import pytest

import pdeloop
from tests.support.loop_harness import Processes
from tests.support.small import same_bits
from tests.support.small_loop import LIMIT
from tests.tools.test_own_law import policies

pytestmark = pytest.mark.topics

PARAMETERS = {
    "n_z": 32,
    "horizon": 40,
    "reduced_order": 8,
    "rollouts": 15,
    "evaluation_fields": 2,
    "law": "auto",
}
SETTINGS = {
    "law_settings": {"first_iterations": 20, "starts": 2},
}


def test_it_is_trained_over_topics_to_the_bits_of_one_process_and_recomputed_from_a_bag(
    loop: Processes, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    words = [f"{name}={value}" for name, value in PARAMETERS.items()]
    words += [f"{of}.{name}={value}" for of, own in SETTINGS.items() for name, value in own.items()]
    flags = [word for setting in words for word in ("--set", setting)]
    problem = "kuramoto-sivashinsky-22"
    loop.wait(loop.pdeloop("train", problem, *flags, "--record", "--out", str(out)), LIMIT)
    here = pdeloop.train(problem, **PARAMETERS, **SETTINGS)
    assert here.result["history"][-1]["role"] == "judging"
    assert here.laws[0].plans(here.policies[0])
    assert same_bits(policies(out), here.policies)
    verified = loop.wait(loop.pdeloop("bag", "verify", str(out)), LIMIT)
    assert "no difference, to the bit" in verified
