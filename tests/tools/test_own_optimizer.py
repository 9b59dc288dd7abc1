# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""An optimiser of one's own in a file: in Python and by the command, and never run by a file alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import pdeloop
from pdeloop.cli import main
from pdeloop.method.adapt import RolloutResult
from pdeloop.method.adapt.registry import OWN_OPTIMIZERS
from tests.support.interpreter import ROOT
from tests.support.small import SMALL, same_bits
from tuner_node.build import build_training
from tuner_node.optimizer_parameters import training_parameters
from tuner_node.run_folder import RunFolder

FILE = ROOT / "examples" / "random_search.py"
OWN = f"{FILE}:RandomSearch"
BUDGET = {"rollouts": 19, "evaluation_fields": 2, "optimizer_settings": {"size": 0.1}}
FLAGS = ["--rollouts", "19", "--evaluation-fields", "2", "--set", "optimizer_settings.size=0.1"]


@pytest.fixture(autouse=True)
def nothing_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(OWN_OPTIMIZERS.variable, "")


def policies(folder: Path) -> np.ndarray:
    with np.load(folder / "policy.npz") as arrays:
        return np.asarray(arrays["policy"])


def test_it_trains_in_python_and_by_the_command_to_the_same_bits(tmp_path, monkeypatch) -> None:
    run = pdeloop.train(str(SMALL), optimizer=OWN, **BUDGET)
    monkeypatch.setenv(OWN_OPTIMIZERS.variable, "")
    out = tmp_path / "run"
    words = ["train", str(SMALL), "--optimizer", OWN, *FLAGS, "--in-process", "--out", str(out)]
    assert main(words) == 0
    assert same_bits(policies(out), run.policies)
    assert RunFolder(out).values()["optimizer_settings.size"] == 0.1
    assert RunFolder(out).values()["optimizer"] == OWN


@pytest.mark.parametrize("over_topics", [False, pytest.param(True, marks=pytest.mark.topics)])
def test_its_class_may_be_given_in_place_of_its_name(tmp_path: Path, over_topics: bool) -> None:
    kind = OWN_OPTIMIZERS.load(OWN)
    run = pdeloop.train(
        str(SMALL), optimizer=kind, over_topics=over_topics, out=tmp_path / "run", **BUDGET
    )
    assert same_bits(run.policies, pdeloop.train(str(SMALL), optimizer=OWN, **BUDGET).policies)
    assert RunFolder(tmp_path / "run").values()["optimizer"] == OWN


def test_what_is_neither_a_class_nor_a_name_is_refused() -> None:
    for word in ("optimizer", "law", "equation"):
        with pytest.raises(ValueError, match=f"{word} is 3; expected a class, or a name like"):
            pdeloop.train(str(SMALL), **{word: 3})
    with pytest.raises(ValueError, match="HalfDone does not define"):
        pdeloop.train(str(SMALL), optimizer=HalfDone)


class HalfDone(pdeloop.StepOptimizer):
    """Without the two methods that it needs."""

    name = "half_done"


def test_it_keeps_what_costs_less_on_the_same_field() -> None:
    """An accepted change fell: the history of the update agrees with the policy that comes out."""
    kind = OWN_OPTIMIZERS.load(OWN)
    start = np.ones((2, 4))
    search = kind(start, seed=3, rollouts=40, settings=kind.Settings())
    while not search.done:
        before, asked = search.policy, search.ask()
        assert [r.field_seed for r in asked] == [asked[0].field_seed] * 2
        costs = [float(np.sum(rollout.policy**2)) for rollout in asked]
        row = search.tell([RolloutResult(c) for c in costs])
        assert row["updated"] == (costs[1] < costs[0])
        assert same_bits(search.policy, asked[1].policy if row["updated"] else before)
    assert np.sum(search.policy**2) < np.sum(start**2)


def test_after_a_checkpoint_it_goes_on_to_the_same_bits() -> None:
    kind = OWN_OPTIMIZERS.load(OWN)

    def made():
        return kind(np.ones((2, 4)), seed=3, rollouts=20, settings=kind.Settings())

    def step(search) -> None:
        search.tell([RolloutResult(float(np.sum(r.policy**2))) for r in search.ask()])

    whole, part = made(), made()
    for _ in range(10):
        step(whole)
    for _ in range(4):
        step(part)
    rest = made()
    rest.restore(part.state())
    for _ in range(6):
        step(rest)
    assert rest.done and same_bits(rest.policy, whole.policy)
    assert whole.ask() == []


def test_a_file_alone_does_not_run_it(tmp_path: Path, capsys, monkeypatch) -> None:
    (tmp_path / "own.py").write_text(FILE.read_text())
    problem = tmp_path / "own.yaml"
    own = "optimizer: own.py:RandomSearch"
    problem.write_text(SMALL.read_text().replace("optimizer: two_point", own))
    out = tmp_path / "run"
    words = ["train", str(problem), "--rollouts", "9", "--in-process", "--out", str(out)]
    assert main(words) == 1
    assert "is code, which is not run merely because a file names it" in capsys.readouterr().err
    assert not out.exists()
    assert main([*words, "--optimizer", f"{tmp_path}/own.py:RandomSearch"]) == 0
    monkeypatch.setenv(OWN_OPTIMIZERS.variable, "")
    with pytest.raises(ValueError, match="is code"):
        build_training(RunFolder(out).values())


def test_an_interrupted_run_of_it_is_continued_when_it_is_named_again(
    tmp_path: Path, capsys, monkeypatch
) -> None:
    out = tmp_path / "run"
    pdeloop.train(str(SMALL), optimizer=OWN, out=out, **BUDGET)
    whole = policies(out)
    (out / "result.json").unlink()
    (out / "policy.npz").unlink()
    monkeypatch.setenv(OWN_OPTIMIZERS.variable, "")
    resume = ["train", "--resume", str(out), "--in-process"]
    assert main(resume) == 1
    assert "--optimizer" in capsys.readouterr().err
    assert main([*resume, "--optimizer", "other.py:Other"]) == 1
    assert "leave it out, or name the run's" in capsys.readouterr().err
    assert main([*resume, "--optimizer", OWN]) == 0
    assert same_bits(policies(out), whole)


def test_a_setting_out_of_its_range_is_refused() -> None:
    OWN_OPTIMIZERS.allow(OWN)
    with pytest.raises(
        ValueError, match=r"'optimizer_settings.size' is -1; expected a number from"
    ):
        training_parameters(str(SMALL), {"optimizer": OWN, "optimizer_settings": {"size": -1}})


def test_the_documents_code_is_that_of_the_example() -> None:
    page = (ROOT / "docs" / "bring-your-own.md").read_text()
    code = page.partition("## An optimiser")[2].partition("```python\n")[2].partition("```")[0]
    assert code and code in FILE.read_text()
