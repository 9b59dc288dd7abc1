# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Laws that plan on a model or have a network, over topics: the bits of one process."""

from __future__ import annotations

from pathlib import Path

import pytest

import pdeloop
from tests.support.loop_harness import Processes
from tests.support.planned import PLANNED, PROBLEM, trained
from tests.support.small import same_bits
from tests.support.small_loop import LIMIT
from tests.tools.test_own_law import policies

pytestmark = pytest.mark.topics


@pytest.mark.parametrize("law", PLANNED)
def test_it_is_trained_over_topics_to_the_bits_of_one_process_and_recomputed_from_a_bag(
    loop: Processes, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, law: str
) -> None:
    out, given = tmp_path / "run", {**PLANNED[law], "law": law}
    constants = given.pop("law_settings")
    words = [f"{name}={value}" for name, value in given.items()]
    words += [f"law_settings.{name}={value}" for name, value in constants.items()]
    flags = [word for setting in words for word in ("--set", setting)]
    record = ["--record"] * (law == "auto")  # the same training is recomputed from a bag of either
    loop.wait(loop.pdeloop("train", PROBLEM, *flags, *record, "--out", str(out)), LIMIT)
    here = pdeloop.load_run(trained(tmp_path_factory, law))
    assert here.result["history"][-1]["role"] == "judging"
    assert here.result["acting"][0]["law"] in ("predictive", "neural")
    assert same_bits(policies(out), here.policies)
    if record:
        verified = loop.wait(loop.pdeloop("bag", "verify", str(out)), LIMIT)
        assert "no difference, to the bit" in verified
