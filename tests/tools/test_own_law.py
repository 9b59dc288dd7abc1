# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law of one's own: trained, continued, evaluated, exported, and never run by a file alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import pdeloop
from pdeloop.cli import main
from pdeloop.evaluation import evaluate
from pdeloop.finished_run import load_run
from pdeloop.in_process import LocalPair
from pdeloop.method.adapt import Rollout, StepOptimizer
from pdeloop.method.adapt.registry import OWN_OPTIMIZERS
from pdeloop.method.laws import Affine
from pdeloop.method.laws.registry import OWN_LAWS, along
from pdeloop.report.data import ReportData, of_run
from pdeloop.report.page import _facts, _of_problem
from tests.support.interpreter import ROOT
from tests.support.made_once import made_once
from tests.support.small import SMALL, same_bits
from tests.tools.test_own_optimizer import OWN as RANDOM_SEARCH
from tests.tools.test_own_optimizer import policies
from tuner_node.build import build_training
from tuner_node.run_folder import RunFolder
from tuner_node.run_store import RunWriter

FILE = ROOT / "examples" / "laws" / "saturating.py"
OWN = f"{FILE}:Saturating"
BUDGET = {"rollouts": 15, "evaluation_fields": 2}
FLAGS = ["--rollouts", "15", "--evaluation-fields", "2"]
N_A, N_S, LIMIT = 4, 4, 0.5


@pytest.fixture(autouse=True)
def nothing_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(OWN_LAWS.variable, "")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of the law of one's own."""

    def make(folder: Path) -> Path:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv(OWN_LAWS.variable, "")
            return pdeloop.train(str(SMALL), law=OWN, out=folder / "run", **BUDGET).folder

    return made_once(tmp_path_factory, "own-law", make)


def test_it_trains_in_python_and_by_the_command_to_the_same_bits(
    finished: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    words = ["train", str(SMALL), "--law", OWN, *FLAGS, "--in-process", "--out", str(out)]
    assert main(words) == 0
    assert same_bits(policies(out), policies(finished))
    assert policies(out).shape == (1, N_A * N_S + N_A)
    assert RunFolder(out).values()["law"] == OWN
    assert RunFolder(out).result()["controller"]["law"] == "saturating"
    assert RunFolder(out).result()["changed"] == [True]
    with np.load(out / "policy.npz") as arrays:
        assert str(arrays["law"]) == "saturating"


def test_a_class_of_the_program_is_a_law(finished: Path) -> None:
    saturating = OWN_LAWS.load(OWN)
    assert same_bits(
        pdeloop.train(str(SMALL), law=saturating, **BUDGET).policies, policies(finished)
    )
    with pytest.raises(ValueError, match="does not define action"):
        pdeloop.train(str(SMALL), law=type("Half", (pdeloop.Law,), {"start": lambda self: {}}))


def test_its_parameters_are_those_of_its_actions(finished: Path) -> None:
    OWN_LAWS.allow(OWN)
    run = load_run(finished)
    (law,), theta = run.laws, run.policies[0]
    parts = law.parts(theta)
    assert {name: part.shape for name, part in parts.items()} == {"K": (N_A, N_S), "b": (N_A,)}
    z = np.linspace(-1.0, 1.0, len(run.models[0].U))
    expected = LIMIT * np.tanh((parts["K"] @ (run.models[0].U.T @ z) + parts["b"]) / LIMIT)
    np.testing.assert_allclose(law.action(parts, z, np.zeros(0), 0), expected, rtol=1e-12)
    assert same_bits(run.warm[0], law.theta_start)
    assert same_bits(law.parts(run.warm[0])["K"], run.models[0].K_a)


def test_an_interrupted_run_of_it_is_continued_when_it_is_named_again(
    finished: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """From a checkpoint in the middle of the adaptation."""
    out = tmp_path / "run"
    OWN_LAWS.allow(OWN)
    interrupt_after(out, RunFolder(finished).values(), batches=5)
    monkeypatch.setenv(OWN_LAWS.variable, "")
    resume = ["train", "--resume", str(out), "--in-process"]
    assert main(resume) == 1
    assert "--law" in capsys.readouterr().err
    assert main([*resume, "--law", "other.py:Other"]) == 1
    assert "leave it out, or name the run's" in capsys.readouterr().err
    assert main([*resume, "--law", OWN]) == 0
    assert same_bits(policies(out), policies(finished))


def interrupt_after(folder: Path, values: dict, batches: int) -> None:
    """Carry out so many batches of a run in a new folder, as a process that is then killed."""
    RunFolder(folder).create(values)
    training, pair = build_training(values), LocalPair(values)
    writer = RunWriter(folder, values, training, warn=print)
    for _ in range(batches):
        pair.follow(training)
        batch = training.next_batch()
        assert batch is not None
        for row in training.finish(pair.run(batch)):
            writer.note(row)
    assert training.phase == "adapt" and training.optimizers[0].tells
    writer.keep(now=0.0, force=True)


def test_evaluate_report_and_export_know_it(
    finished: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for named, parts in ([], 0), (["--law", OWN], 2):  # code that is not named is not run
        file = tmp_path / f"{parts}.npz"
        assert main(["export", str(finished), "--out", str(file), *named]) == 0
        with np.load(file) as arrays:
            assert len([name for name in arrays if name.startswith("theta.")]) == parts
        monkeypatch.setenv(OWN_LAWS.variable, "")
    assert main(["evaluate", str(finished), "--fields", "2"]) == 1
    assert "is code, which is not run merely because a file names it" in capsys.readouterr().err
    assert main(["evaluate", str(finished), "--fields", "2", "--law", OWN]) == 0
    run = load_run(finished)
    costs = evaluate(run, fields=2, seed=run.values["evaluation_seed"])
    for name, there in run.costs.items():
        assert same_bits(costs[name], there)
    data = of_run(run)
    assert not data.missing and len(data.behaviours) == 3
    assert ("Law", OWN) in _facts(ReportData(finished, [data]))
    assert [name for name, *_ in _of_problem(data)] == ["small-behaviour", "small-orders"]
    assert main(["export", str(finished), "--out", str(tmp_path / "law.npz")]) == 0
    with np.load(tmp_path / "law.npz") as arrays:
        assert str(arrays["law"]) == OWN
        assert same_bits(arrays["theta"], run.policies[0])
        assert same_bits(arrays["theta.b"], run.laws[0].parts(run.policies[0])["b"])
        assert same_bits(arrays["U"], run.models[0].U)
    capsys.readouterr()
    assert main(["export", str(finished), "--out", str(tmp_path / "law.c")]) == 1
    assert "cannot be written in C; write its parameters as .npz" in capsys.readouterr().err
    assert not (tmp_path / "law.c").exists()
    with pytest.raises(ValueError, match="this figure shows the gains"):
        pdeloop.plot_gains(run)


def test_a_file_alone_does_not_run_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own.py").write_text(FILE.read_text())
    problem = tmp_path / "own.yaml"
    problem.write_text(SMALL.read_text() + "    law: own.py:Saturating\n")
    out = tmp_path / "run"
    words = ["train", str(problem), *FLAGS, "--in-process", "--out", str(out)]
    assert main(words) == 1
    assert "is code, which is not run merely because a file names it" in capsys.readouterr().err
    assert not out.exists()
    assert main([*words, "--law", f"{tmp_path}/own.py:Saturating"]) == 0
    monkeypatch.setenv(OWN_LAWS.variable, "")
    with pytest.raises(ValueError, match="is code"):
        build_training(RunFolder(out).values())


def test_an_optimizer_of_gains_refuses_another_law_in_one_sentence(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    adapted = (
        "affine, observer, extended_kalman, feedforward, predictive, auto, neural, predictive_kalman "
        "and auto_kalman"
    )
    words = ["train", str(SMALL), "--law", OWN, "--optimizer", "model_based"]
    assert main([*words, "--in-process", "--out", str(tmp_path / "run")]) == 1
    told = capsys.readouterr().err
    assert f"adapts only {adapted}, but the law is '{OWN}'" in told
    assert "such as two_point" in told
    assert told.count("\n") == 1 and not (tmp_path / "run").exists()


@pytest.mark.parametrize("optimizer", ["two_point", RANDOM_SEARCH])
def test_a_law_with_a_model_is_refused_with_an_optimizer_that_does_not_know_it(
    optimizer: str,
) -> None:
    """It would change the equation in theta by chance."""
    with pytest.raises(
        ValueError, match=r"which the optimizer '.*' does not support; choose model_based"
    ):
        pdeloop.train(str(SMALL), law="extended_kalman", optimizer=optimizer, **BUDGET)


@pytest.mark.parametrize("law", ["feedforward", "observer"])
def test_an_optimizer_of_ones_own_knows_theta_alone(law: str) -> None:
    # The entries of F and G are much larger than gains, to which the size of a change is relative.
    small = {"optimizer_settings": {"size": 0.005 if law == "observer" else 0.05}}
    run = pdeloop.train(str(SMALL), law=law, optimizer=RANDOM_SEARCH, **BUDGET, **small)
    assert run.result["changed"] == [True]
    assert (run.costs["adapted"] <= 1.2 * run.costs["lqt"]).all()


class Observing(StepOptimizer):
    """Learns from trajectories: it holds their actions against those of the law that it is told."""

    name = "observing"
    needs_trajectories = True

    def rollouts(self):
        moved = self.policy + 0.1 * self.generator.standard_normal(self.policy.shape)
        return [Rollout(moved, self.field_seed)]

    def update(self, results):
        (result,), (rollout,) = results, self.rollouts()
        states, actions = result.trajectory.states[:-1], result.trajectory.actions
        expected = along(self.context.law, rollout.policy, states, actions)
        np.testing.assert_allclose(actions, np.clip(expected, -0.2, 0.2), atol=1e-12)
        self.policy = rollout.policy
        return {"differs": float(np.abs(actions).max())}


def test_an_optimizer_that_sees_trajectories_is_told_the_law(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Through limits of the actions and noise, from which the memory follows as in the loop."""
    monkeypatch.setenv(OWN_OPTIMIZERS.variable, "")
    limits = {"action_limit": 0.2, "measurement_noise": 0.01}
    optimizer = f"{__file__}:Observing"
    run = pdeloop.train(str(SMALL), law="observer", optimizer=optimizer, **BUDGET, **limits)
    assert len(run.result["history"]) == 12
    assert max(row["differs"] for row in run.result["history"]) == 0.2


class Filtering(pdeloop.Law):
    """Feedback of an estimate with a filter gain of its own; not derived from the shipped observer."""

    filtered = True

    @property
    def memory_size(self) -> int:  # type: ignore[override]
        return len(self.model.A)

    def start(self):
        return {"K": self.model.K_a, "L": self.model.L}

    def action(self, theta, z, memory, k):
        return theta["K"] @ self._estimate(theta, z, memory)

    def memory_update(self, theta, z, memory, action, k):
        return self.model.A @ self._estimate(theta, z, memory) + self.model.B @ action

    def _estimate(self, theta, z, memory):
        return memory + theta["L"] @ (self.reduced(z) - memory)


@pytest.mark.parametrize("identification", ["subspace", "regression"])
def test_a_law_of_ones_own_declares_that_it_has_a_filter_gain(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, identification: str
) -> None:
    """Its run is read without its code; without the declaration there is no such identification."""
    own = {"law": Filtering, "optimizer": "two_point", "identification": identification}
    run = pdeloop.train(str(SMALL), **own, out=tmp_path / "run", **BUDGET)
    assert run.laws[0].parts(run.warm[0])["L"].shape == (N_S, N_S)
    monkeypatch.setenv(OWN_LAWS.variable, "")
    again = load_run(tmp_path / "run")
    gain = again.models[0].L
    assert gain is not None and gain.any() and same_bits(gain, run.models[0].L)
    assert len(again.models[0].U) == run.values["n_z"]
    with monkeypatch.context() as patch, pytest.raises(ValueError, match="does not use"):
        patch.setattr(Filtering, "filtered", False)
        pdeloop.train(str(SMALL), **own | {"identification": "subspace"}, **BUDGET)


def test_a_model_for_a_law_of_ones_own_is_identified_with_its_filter_gain(tmp_path: Path) -> None:
    """From measurements, by the command; the file alone names the class."""
    (tmp_path / "own.py").write_text(
        "import pdeloop\n\n\nclass Own(pdeloop.Law):\n    filtered = True\n\n"
        "    def start(self):\n        return {'K': self.model.K_a @ self.model.L}\n\n"
        "    def action(self, theta, z, memory, k):\n        return theta['K'] @ self.reduced(z)\n"
    )
    words = ["identify", "--data", str(ROOT / "examples" / "measurements.csv"), "--order", "3"]
    held = {}
    for law in ("affine", f"{tmp_path / 'own.py'}:Own"):
        assert main([*words, "--law", law, "--out", str(tmp_path / "model.npz")]) == 0
        with np.load(tmp_path / "model.npz") as model:
            held[law] = "L" in model
    assert list(held.values()) == [False, True]


def test_parameters_for_each_step_fit_one_horizon(tmp_path: Path) -> None:
    run = pdeloop.train(str(SMALL), law="feedforward", out=tmp_path / "run", **BUDGET)
    assert run.policies.shape == (1, N_A * N_S + 30 * N_A)
    fields = {"fields": 2, "seed": 0}
    assert evaluate(run, **fields, changes={"physical.viscosity": 0.02})["lqt"].shape == (1, 2)
    with pytest.raises(ValueError, match=r"parameters of shape \(216,\) for the changed plant"):
        evaluate(run, **fields, changes={"horizon": 50})


class Proportional(Affine):
    """Gains that start at half of those of LQ tracking: a law with the affine one's compiled form."""

    name = "proportional"

    def start(self):
        return {name: 0.5 * part for name, part in super().start().items()}


class Scaled(pdeloop.Law):
    """a = c_j times the LQ-tracking law in actuator j: few parameters, and a compiled form."""

    name, compiled = "scaled", True

    def start(self):
        return {"c": np.ones(N_A)}

    def action(self, theta, z, memory, k):
        model = self.model
        return theta["c"] * (model.K_a @ self.reduced(z) + model.K_b @ model.s_r)

    def gains(self, theta):
        return theta[:, None] * self.model.policy


def test_a_law_with_a_compiled_form_is_computed_by_it_and_exported_as_gains(tmp_path: Path) -> None:
    affine = pdeloop.train(str(SMALL), out=tmp_path / "affine", **BUDGET)
    run = pdeloop.train(str(SMALL), law=Scaled, out=tmp_path / "run", **BUDGET)
    assert run.policies.shape == (1, N_A) and run.result["changed"] == [True]
    assert same_bits(run.costs["lqt"], affine.costs["lqt"])
    written = tmp_path / "law.npz"
    assert main(["export", str(run.folder), "--out", str(written)]) == 0
    with np.load(written) as arrays:
        found = np.hstack([arrays["K_a"], arrays["K_b"]])
    assert same_bits(found, run.policies[0][:, None] * run.models[0].policy)
    assert main(["export", str(run.folder), "--out", str(tmp_path / "law.c")]) == 0


def test_a_law_derived_from_the_affine_one_has_its_matrix(tmp_path: Path) -> None:
    run = pdeloop.train(str(SMALL), law=Proportional, out=tmp_path / "run", **BUDGET)
    assert run.policies.shape == (1, N_A, 2 * N_S)
    assert same_bits(run.warm[0], 0.5 * run.models[0].policy)
    costs = evaluate(run, fields=2, seed=run.values["evaluation_seed"])
    assert same_bits(costs["adapted"], run.costs["adapted"])


def test_the_documents_code_is_that_of_the_example() -> None:
    page = (ROOT / "docs" / "bring-your-own.md").read_text()
    code = page.partition("## A control law")[2].partition("```python\n")[2].partition("```")[0]
    assert code and code in FILE.read_text()
