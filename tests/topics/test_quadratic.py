"""The quadratic law over topics: the policy of one process, to the bit, and a bag that proves it."""

from __future__ import annotations

import pytest

from bringup.bags.verify import verify
from tests.loop_harness import Processes
from tests.small import SMALL, parameters, train_here
from tests.topics.test_loop import LIMIT, assert_same_training

pytestmark = pytest.mark.topics
OPTIONS = {"iterations": 12, "optimizer": "gauss_newton", "policy_features": "quadratic"}


def test_a_quadratic_law_over_topics_is_the_one_of_one_process(loop: Processes, tmp_path):
    words = [f"--{name.replace('_', '-')}={value}" for name, value in OPTIONS.items()]
    run = loop.pdeloop("train", str(SMALL), "--record", "--out", str(tmp_path / "run"), *words)
    loop.wait(run, LIMIT)
    here = train_here(parameters(**OPTIONS))
    n_s = here.models.shape[2]
    assert here.policies().shape[2] == 2 * n_s + n_s * (n_s + 1) // 2
    assert here.policies()[:, :, 2 * n_s :].any()
    assert_same_training(tmp_path / "run", here)
    report = verify(tmp_path / "run")
    assert report.count == 0
    assert not report.incomplete
    assert report.compared["actions"] > 0
    assert report.compared["policies"] > 0
