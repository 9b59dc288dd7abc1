# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Laws that plan on a model or have a network, over topics: the bits of one process."""

from __future__ import annotations

from pathlib import Path

import pytest

import pdeloop
from tests.support.loop_harness import Processes
from tests.support.small import same_bits
from tests.support.small_loop import LIMIT
from tests.tools.test_own_law import policies

pytestmark = pytest.mark.topics

PARAMETERS = {"n_z": 32, "horizon": 40, "reduced_order": 8, "rollouts": 15, "evaluation_fields": 2}
LAWS = {"auto": {"first_iterations": 20, "starts": 2}, "neural": {"neurons": 16, "iterations": 150}}


@pytest.mark.parametrize("law", LAWS)
def test_it_is_trained_over_topics_to_the_bits_of_one_process_and_recomputed_from_a_bag(
    loop: Processes, tmp_path: Path, law: str
) -> None:
    out = tmp_path / "run"
    words = [f"{name}={value}" for name, value in {**PARAMETERS, "law": law}.items()]
    words += [f"law_settings.{name}={value}" for name, value in LAWS[law].items()]
    flags = [word for setting in words for word in ("--set", setting)]
    problem = "kuramoto-sivashinsky-22"
    loop.wait(loop.pdeloop("train", problem, *flags, "--record", "--out", str(out)), LIMIT)
    here = pdeloop.train(problem, **PARAMETERS, law=law, law_settings=LAWS[law])
    assert here.result["history"][-1]["role"] == "judging"
    assert here.result["acting"][0]["law"] in ("predictive", "neural")
    assert same_bits(policies(out), here.policies)
    verified = loop.wait(loop.pdeloop("bag", "verify", str(out)), LIMIT)
    assert "no difference, to the bit" in verified
