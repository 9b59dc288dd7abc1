# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""An optimiser of one's own over topics: the bits of one process."""

from __future__ import annotations

from pathlib import Path

import pytest

import pdeloop
from pdeloop.method.adapt.registry import OWN_OPTIMIZERS
from tests.support.loop_harness import Processes
from tests.support.small import SMALL, same_bits
from tests.support.small_loop import LIMIT
from tests.tools.test_own_optimizer import BUDGET, FLAGS, OWN, policies

pytestmark = pytest.mark.topics


def test_it_trains_over_topics_to_the_bits_of_one_process(
    loop: Processes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    words = [str(SMALL), "--optimizer", OWN, *FLAGS, "--out", str(out)]
    loop.wait(loop.pdeloop("train", *words), LIMIT)
    monkeypatch.setenv(OWN_OPTIMIZERS.variable, "")
    assert same_bits(policies(out), pdeloop.train(str(SMALL), optimizer=OWN, **BUDGET).policies)
