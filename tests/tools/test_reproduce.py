# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The paper's experiment on the small problem: complete, continued to the bit, and its table."""

from __future__ import annotations

import json
import shutil
from io import BytesIO

import numpy as np
import pytest

from pdeloop.cli import main
from pdeloop.finished_run import interval, reduction
from pdeloop.in_process import LocalPair
from pdeloop.messages.topics import CostColumn
from pdeloop.method.seeds import Purpose, derive
from pdeloop.reproduction import LEARNED, beside_the_paper, reproduction_in, runs_of
from pdeloop.study.results import read_study, writing
from pdeloop.study.table import beside_no_control, rows
from tests.support.small import parameters, same_bits, train_here
from tests.support.small_study import contents
from tuner_node.batch import Batch


def test_what_costs_no_less_than_no_control_is_named():
    row = {"problem": "p", "variant": "lqt_po", "none": 4.0, "lqt": 2.0, "cost": 1.0, "worst": 1.5}
    assert beside_no_control([row]) == []
    poor = {**row, "lqt": 8.0}
    words = (
        "p: LQT costs 8, at least as much as no control (4); a reduction against it says little."
    )
    assert beside_no_control([poor, {**poor, "variant": "pure_po"}]) == [words]
    assert beside_no_control([{**row, "worst": 4.5}]) == [
        "p: LQT-PO in its worst seed costs 4.5, at least as much as no control (4)."
    ]
    assert beside_no_control([{**row, "cost": 4.0, "worst": 4.5}]) == [
        "p: LQT-PO costs 4, at least as much as no control (4)."
    ]
    assert (
        beside_no_control([{**row, "cost": None, "worst": None}]) == []
    )  # the table says diverged


def test_every_number_is_that_of_the_trainings(reproduction):
    out, text = reproduction
    for words in ("below LQT", "LQT-PO", "pure PO", "model-based", "bootstrap"):
        assert words in text, words
    study = reproduction_in(out)
    runs, files = runs_of(study, out, "small"), contents(out)
    for name, how in LEARNED.items():
        budget = {"rollouts": 16} if how["optimizer"] == "model_based" else {"iterations": 8}
        training = train_here(parameters(seeds=2, identification="dmdc", **how, **budget))
        for seed in range(2):
            with np.load(BytesIO(files[f"small/{name}/{seed}/curve.npz"])) as curve:
                assert same_bits(curve["policies"][-1], training.policies()[seed].copy())
                assert same_bits(curve["costs"][-1], training.evaluation[seed, 2].copy())
                start = training.evaluation[seed, 0 if how["start"] == "zero" else 1]
                assert same_bits(curve["costs"][0], start.copy())
                assert curve["rollouts"][-1] == training.budget.paid[seed]
        assert same_bits(runs[name].policies, training.policies())
        assert runs[name].result["history"] == sorted(training.history, key=lambda row: row["seed"])
        assert same_bits(runs[name].costs["adapted"], training.evaluation[:, 2].copy())
        assert same_bits(runs[name].warm, runs["lqt_po"].warm)
        assert same_bits(runs[name].costs["lqt"], runs["lqt_po"].costs["lqt"])
    row, *_ = rows(study, out)
    lqt, adapted = (runs["lqt_po"].costs[name].mean(axis=1) for name in ("lqt", "adapted"))
    below = row["below_lqt_percent"]
    assert below["mean_of_ratios"] == pytest.approx(100 * (1 - adapted / lqt).mean(), abs=1e-9)
    assert below["ratio_of_means"] == pytest.approx(
        100 * (1 - adapted.mean() / lqt.mean()), abs=1e-9
    )
    low, high = below["ratio_interval"]
    assert low <= below["ratio_of_means"] <= high
    saved = json.loads((out / "table.json").read_text())
    assert saved["rows"][0]["lqt"] == row["lqt"] == pytest.approx(lqt.mean())


def test_the_curve_is_the_cost_of_each_policy(reproduction):
    out, _ = reproduction
    values, files = parameters(), contents(out)
    for name in ("lqt_po", "model_based"):
        kept = (BytesIO(files[f"small/{name}/1/{file}.npz"]) for file in ("curve", "policy"))
        with np.load(next(kept)) as curve, np.load(next(kept)) as final:
            pair = LocalPair(values)
            pair.use_models(final["model"])
            seeds = [derive(0, Purpose.EVALUATION_FIELD, i) for i in range(10)]
            for at in (0, 3, len(curve["costs"]) - 1):
                policy = curve["policies"][at]
                rows = np.array([(seed, -1, 0, 0) for seed in seeds], dtype=float)
                again = pair.run(Batch(rows, np.stack([policy] * 10))).costs[:, CostColumn.MEAN]
                assert same_bits(curve["costs"][at].copy(), again.copy())
            assert (np.diff(curve["rollouts"]) >= 0).all()


def test_the_interval_covers_the_truth_as_often_as_it_says():
    """Twenty seeds, drawn 200 times from a known distribution of costs."""
    rng = np.random.default_rng(3)
    hits = 0
    for _ in range(200):
        lqt = rng.lognormal(0.0, 0.3, (20, 1))
        found = reduction(0.7 * lqt * rng.lognormal(-0.005, 0.1, (20, 1)), lqt)
        low, high = found.mean_interval
        hits += low <= 30.0 <= high
    assert 0.85 <= hits / 200 <= 0.99


def test_the_interval_is_that_of_scipy():
    import scipy.stats

    rng = np.random.default_rng(4)

    def ratio(a, b, axis):
        return a.mean(axis=axis) / b.mean(axis=axis)

    for n in (2, 5, 12):
        pair = rng.lognormal(size=n), rng.lognormal(size=n)
        for samples, statistic in ((pair, ratio), (pair[:1], np.mean)):
            how = {"paired": True, "method": "percentile", "random_state": np.random.default_rng(0)}
            expected = scipy.stats.bootstrap(samples, statistic, **how).confidence_interval
            assert interval(samples, statistic) == (expected.low, expected.high)
    assert interval((np.ones(1),), np.mean) is None


def test_a_reduction_leaves_out_seeds_that_diverged_and_knows_no_interval_of_one():
    lqt, own = np.array([[2.0, 2.0], [4.0, 4.0]]), np.array([[1.0, 1.0], [1e9, 1.0]])
    found = reduction(own, lqt)
    assert (found.seeds, found.ratio_of_means, found.ratio_interval) == (1, 50.0, None)
    assert reduction(own[1:], lqt[1:]) is None
    better = reduction(np.array([[1.0], [6.0]]), np.array([[2.0], [8.0]]))
    assert (better.ratio_of_means, better.mean_of_ratios) == (
        pytest.approx(30),
        pytest.approx(37.5),
    )


@pytest.mark.parametrize(
    ("ratio", "mean", "words"),
    [
        ((20.0, 30.0), (20.0, 30.0), "within the interval of the ratio of the means and that of"),
        ((20.0, 27.0), (20.0, 30.0), "within the interval of the mean of the ratios here"),
        ((-5.0, 20.0), (0.0, 21.0), "outside both intervals here"),
        (None, None, "one seed cannot be compared with that"),
    ],
)
def test_the_table_says_where_the_papers_figure_lies(ratio, mean, words):
    below = {"ratio_interval": ratio, "mean_interval": mean}
    row = {"problem": "burgers", "variant": "lqt_po", "below_lqt_percent": below}
    others = {**row, "problem": "wave"}, {**row, "variant": "pure_po"}
    (sentence,) = beside_the_paper([row, *others, {**row, "below_lqt_percent": None}])
    assert words in sentence


@pytest.mark.usefixtures("forked_workers")
def test_an_interrupted_reproduction_continues_to_the_same_bits(reproduction, tmp_path, capsys):
    whole, _ = reproduction
    out = tmp_path / "out"
    shutil.copytree(whole, out, ignore=shutil.ignore_patterns("report"))
    (out / "table.json").unlink()
    with writing(out, read_study(out)) as results:
        results.forget(["small/lqt_po/1"])
    assert main(["reproduce", "--out", str(out), "--processes", "1", "--json"]) == 0
    captured = capsys.readouterr()
    assert "\x1b" not in captured.err
    rows = json.loads((out / "table.json").read_text())["rows"]
    assert json.loads(captured.out) == {"folder": str(out), "rows": rows, "failures": []}
    assert (out / "table.json").read_bytes() == (whole / "table.json").read_bytes()
    assert contents(out) == contents(whole)


def test_what_cannot_be_done_is_one_line(reproduction, tmp_path, capsys):
    out, _ = reproduction
    for words, said in (
        (["reproduce", "--seeds", "3", "--out", str(out)], f"{out} holds another study"),
        (["reproduce", "nothing"], "unknown problem 'nothing'"),
        (["report", str(tmp_path)], "holds neither a run nor a reproduction"),
    ):
        assert main(words) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("pdeloop: ") and said in line


def test_another_study_is_no_reproduction(reproduction, tmp_path):
    assert reproduction_in(tmp_path) is None
    asked = json.loads((reproduction[0] / "study.json").read_text())
    (tmp_path / "study.json").write_text(json.dumps(asked))
    assert reproduction_in(tmp_path) is not None
    (tmp_path / "study.json").write_text(json.dumps(asked | {"variants": {"default": {}}}))
    assert reproduction_in(tmp_path) is None
