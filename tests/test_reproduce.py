"""The paper's experiment on the small problem: complete, continued to the bit, and its table."""

from __future__ import annotations

import json
import signal
import time

import numpy as np
import pytest

from loop_interfaces.topics import CostColumn
from pdeloop.in_process import LocalPair
from pdeloop.reproduce import experiment as reproduce
from tests.loop_harness import Processes, until
from tests.small import SMALL, parameters, same_bits, train_here
from tuner_node.batch import Batch
from tuner_node.seeds import Purpose, derive

LIMIT = 120.0


def reproduced(loop: Processes, out, *more: str) -> str:
    options = ("--seeds", "2", "--iterations", "4", "--out", str(out))
    return loop.wait(loop.pdeloop("reproduce", str(SMALL), *options, *more), LIMIT)


def test_every_number_is_that_of_the_trainings(loop, tmp_path):
    text = reproduced(loop, tmp_path / "out")
    assert "reproduce: 90 %" in text and "LQT-PO below LQT" in text
    (results,) = reproduce.load(tmp_path / "out")
    for start, name in (("lqt", "lqt_po"), ("zero", "pure_po")):
        training = train_here(parameters(seeds=2, iterations=4, start=start))
        with np.load(tmp_path / "out" / "small" / start / "curve.npz") as curve:
            assert same_bits(curve["policies"][-1], training.policies())
            assert curve["costs"].shape == (5, 2, 10)
            assert same_bits(curve["costs"][-1], training.evaluation[:, 2].copy())
        assert same_bits(results.costs[name], training.evaluation[:, 2].copy())
        assert same_bits(results.costs["none"], training.evaluation[:, 0].copy())
        assert same_bits(results.costs["lqt"], training.evaluation[:, 1].copy())
    assert np.array_equal(results.curves["lqt_po"][0], np.ones(2))
    row = results.row()
    ratio = 1 - results.costs["lqt_po"].mean(axis=1) / results.costs["lqt"].mean(axis=1)
    assert row["lqt_po"]["mean_of_ratios_percent"] == pytest.approx(100 * ratio.mean())
    saved = json.loads((tmp_path / "out" / "table.json").read_text())
    assert saved["rows"][0]["lqt"]["mean"] == row["lqt"]["mean"]


def test_the_curve_is_the_cost_of_each_iterations_policy(loop, tmp_path):
    reproduced(loop, tmp_path / "out")
    values = parameters()
    with (
        np.load(tmp_path / "out" / "small" / "lqt" / "curve.npz") as curve,
        np.load(tmp_path / "out" / "small" / "lqt" / "policy.npz") as final,
    ):
        pair = LocalPair(values)
        pair.use_models(final["model"])
        seeds = [derive(0, Purpose.EVALUATION_FIELD, i) for i in range(10)]
        for iteration in (0, 3):
            policy = curve["policies"][iteration][1]
            rows = np.array([(seed, -1, 0, 1) for seed in seeds], dtype=float)
            again = pair.run(Batch(rows, np.stack([policy] * 10))).costs[:, CostColumn.MEAN]
            assert same_bits(curve["costs"][iteration][1].copy(), again.copy())


def test_an_interrupted_reproduction_continues_to_the_same_bits(loop, tmp_path):
    options = ("--seeds", "3", "--iterations", "400", "--processes", "1")
    run = loop.pdeloop("reproduce", str(SMALL), *options, "--out", str(tmp_path / "a"))
    until(lambda: list((tmp_path / "a").glob("small/*/progress")), LIMIT, "saved progress")
    time.sleep(0.5)
    run.send_signal(signal.SIGINT)
    text = loop.wait(run, 10.0, code=130)
    assert f"continue with: pdeloop reproduce --out {tmp_path / 'a'}" in text
    until(lambda: loop.left_behind() == [], 2.0, "end of all processes")
    assert not (tmp_path / "a" / "table.json").exists()
    loop.wait(loop.pdeloop("reproduce", "--out", str(tmp_path / "a")), LIMIT)
    whole = loop.pdeloop("reproduce", str(SMALL), *options[:4], "--out", str(tmp_path / "b"))
    loop.wait(whole, LIMIT)
    for start in ("lqt", "zero"):
        with (
            np.load(tmp_path / "a" / "small" / start / "curve.npz") as a,
            np.load(tmp_path / "b" / "small" / start / "curve.npz") as b,
        ):
            for name in ("costs", "policies", "mean_field"):
                assert same_bits(a[name], b[name])


def test_what_cannot_be_done_is_one_line(loop, tmp_path):
    reproduced(loop, tmp_path / "out")
    other = loop.pdeloop("reproduce", "--seeds", "3", "--out", str(tmp_path / "out"))
    text = loop.wait(other, LIMIT, code=1)
    assert "asked for something else (seeds: 2 there, 3 now)" in text
    text = loop.wait(loop.pdeloop("reproduce", "nothing"), LIMIT, code=1)
    assert text.startswith("pdeloop: unknown problem 'nothing'")
    text = loop.wait(loop.pdeloop("report", str(tmp_path)), LIMIT, code=1)
    assert "holds neither a run nor a reproduction" in text
