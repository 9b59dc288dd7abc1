"""Other laws over topics: the policy of one process, to the bit, and a bag that proves it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pdeloop.bags.verify import verify
from tests.loop_harness import Processes
from tests.small import SMALL, parameters, train_here
from tests.topics.test_loop import LIMIT, assert_same_training
from tuner_node.training import Training

pytestmark = pytest.mark.topics
OPTIONS = {"iterations": 12, "optimizer": "gauss_newton"}


def same_over_topics(loop: Processes, tmp_path: Any, **options: Any) -> Training:
    """The training in one process, which is that over topics, and the recorded one."""
    options = OPTIONS | options
    words = [f"--{name.replace('_', '-')}={value}" for name, value in options.items()]
    run = loop.pdeloop("train", str(SMALL), "--record", "--out", str(tmp_path / "run"), *words)
    loop.wait(run, LIMIT)
    here = train_here(parameters(**options))
    assert_same_training(tmp_path / "run", here)
    report = verify(tmp_path / "run")
    assert report.count == 0
    assert not report.incomplete
    assert report.compared["actions"] > 0
    assert report.compared["policies"] > 0
    return here


def test_a_quadratic_law_over_topics_is_the_one_of_one_process(loop: Processes, tmp_path):
    here = same_over_topics(loop, tmp_path, policy_features="quadratic")
    n_s = here.models.shape[2]
    assert here.policies().shape[2] == 2 * n_s + n_s * (n_s + 1) // 2
    assert here.policies()[:, :, 2 * n_s :].any()


def test_a_basis_that_grows_on_the_way_does_so_over_topics_too(loop: Processes, tmp_path):
    here = same_over_topics(loop, tmp_path, extra_modes=2, seeds=2)
    narrow = train_here(parameters(**OPTIONS, seeds=2))
    n_s = narrow.models.shape[2]
    assert here.models.shape[2] == n_s + 2
    for wide, own in zip(here.models, narrow.models, strict=True):
        U = wide[: here.target.size]
        assert np.array_equal(U[:, :n_s], own[: here.target.size])
        assert pytest.approx(np.eye(n_s + 2), abs=1e-10) == U.T @ U
    assert here.policies()[:, :, n_s : n_s + 2].any()
