# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""--set NAME=VALUE reaches what it names, on each command that has it, or is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

import pdeloop
from pdeloop.cli import FAILED, main
from pdeloop.commands.settings import OWN_FLAGS, read_settings
from pdeloop.finished_run import load_run
from pdeloop.messages.parameters import table
from pdeloop.messages.spec import ParameterError
from tests.support.small import SMALL

QUICK = ("--set", "evaluation_fields=2", "--set", "optimizer=two-point")


def refused(capsys: pytest.CaptureFixture[str], words: str, *command: str) -> None:
    capsys.readouterr()
    assert main(list(command)) == FAILED
    told = capsys.readouterr().err
    assert words in told and told.count("\n") == 1


@pytest.mark.parametrize("spec", table(), ids=lambda spec: spec.name)
def test_every_parameter_can_be_set_to_its_default_or_has_a_flag(spec: object) -> None:
    name, default = spec.name, spec.default
    text = ",".join(map(str, default)) if isinstance(default, list) else str(default).lower()
    if name in OWN_FLAGS:
        with pytest.raises(ParameterError, match=f"give {OWN_FLAGS[name]}"):
            read_settings([f"{name}={text}"])
        return
    text = "0.5" if default == [] else text
    found = read_settings([f"{name}={text}"])[name]
    assert found == (default if default != [] else [0.5]) or str(found) == str(default)
    assert read_settings([f"--{name.replace('_', '-')}={text}"]) == {name: found}


@pytest.mark.parametrize(
    ("texts", "words"),
    [
        (["horizon"], "expected NAME=VALUE"),
        (["=3"], "expected NAME=VALUE"),
        (["horizont=3"], "did you mean 'horizon'"),
        (["horizon=1.5"], "expected a whole number"),
        (["horizon=0"], "expected a whole number of at least 1|from 1"),
        (["horizon=3", "horizon=4"], "given twice"),
        (["identification=magic"], "expected one of"),
        (["publish_clock=maybe"], "expected true or false"),
        (["out=x"], "give --out"),
    ],
)
def test_what_cannot_be_set_is_refused(texts: list[str], words: str) -> None:
    with pytest.raises(ParameterError, match=words) as failed:
        read_settings(texts)
    assert "\n" not in str(failed.value)


def test_what_a_plant_takes_may_be_a_text() -> None:
    texts = ["physical.chemistry=Chen2020", "physical.rate=1.5", "physical.warm=true"]
    assert read_settings(texts) == {
        "physical.chemistry": "Chen2020",
        "physical.rate": 1.5,
        "physical.warm": True,
    }


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("set") / "run"
    command = ["train", str(SMALL), "--in-process", "--iterations", "1", "--out", str(out)]
    assert main([*command, *QUICK, "--set", "learning-rate=0.002"]) == 0
    return out


def test_train_takes_parameters_without_a_flag(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = yaml.safe_load((trained / "parameters.yaml").read_text())["/**"]["ros__parameters"]
    assert values["learning_rate"] == 0.002 and values["evaluation_fields"] == 2
    out = ("--in-process", "--out", str(tmp_path / "run"))
    twice = ("--seed", "3", "--set", "seed=4")
    refused(capsys, "parameter 'seed' is given twice", "train", str(SMALL), *twice, *out)
    refused(capsys, "add --view", "train", str(SMALL), "--set", "view_rate=5", *out)
    bad = ("--set", "physical.viscositi=1")
    refused(capsys, "viscositi", "train", str(SMALL), *bad, *out)
    bad = ("--set", "physical.viscosity=thick")
    refused(capsys, "expected a number", "train", str(SMALL), *bad, *out)
    assert not (tmp_path / "run").exists()


def test_evaluate_has_the_policies_under_another_parameter(
    trained: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def costs(*words: str) -> dict[str, np.ndarray]:
        capsys.readouterr()
        main(["evaluate", str(trained), "--fields", "2", "--json", *words])
        return {name: np.array(v) for name, v in json.loads(capsys.readouterr().out).items()}

    plain, heavy = costs(), costs("--set", "state_weight=2", "--set", "action_weight=2")
    run = load_run(trained)
    assert run.values["state_weight"] == run.values["action_weight"] == 1.0
    for name, own in plain.items():  # the same law, so that the cost is twice as much
        np.testing.assert_allclose(heavy[name], 2 * own, rtol=1e-12)
    thick = costs("--set", "physical.viscosity=0.1")
    assert (thick["none"] != plain["none"]).all()
    for setting, words in (
        ("rollouts=20", "'rollouts' has no effect on trained policies"),
        ("n_a=2", "the changed plant has"),
        ("n_z=64", "the changed plant has"),
        ("physical.depth=1", "depth"),
        ("equation=kdv", "'equation' has no effect on trained policies"),
        ("optimizer_settings.fields=5", "has no effect on trained policies"),
    ):
        refused(capsys, words, "evaluate", str(trained), "--set", setting)


@pytest.mark.usefixtures("forked_workers")
def test_study_and_reproduce_set_a_parameter_of_all_trainings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = tmp_path / "study.yaml", tmp_path / "study"
    study = {
        "problems": [str(SMALL)],
        "variants": {"one": {"iterations": 1, "optimizer": "two_point"}},
        "settings": {"evaluation_fields": 5},
    }
    file.write_text(yaml.safe_dump(study))
    words = ("--processes", "1", "--set", "evaluation_fields=2", "--set", "horizon=10")
    words += ("--run-folders",)
    assert main(["study", str(file), "--out", str(out), *words]) == 0
    (parameters,) = out.glob("*/one/0/parameters.yaml")
    values = yaml.safe_load(parameters.read_text())["/**"]["ros__parameters"]
    assert values["evaluation_fields"] == 2 and values["horizon"] == 10
    fresh = str(tmp_path / "other")
    for words, told in (
        (("--set", "iterations=2"), "set by variant 'one' itself"),
        (("--set", "seed=2"), "give its 'seeds' instead"),
    ):
        refused(capsys, told, "study", str(file), "--out", fresh, *words)
    refused(capsys, "with its own parameters", "study", "--out", str(out), "--set", "horizon=9")
    for words, told in (
        (("--set", "seeds=2"), "give --seeds"),
        (("--set", "optimizer=two_point"), "set by variant 'lqt_po' itself"),
        (("--set", "horizons=2"), "did you mean 'horizon'"),
    ):
        refused(capsys, told, "reproduce", str(SMALL), "--out", fresh, *words)
    assert not Path(fresh).exists()


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("dmdc_rank=5", "applies to the identification dmdc, but this one is regression"),
        ("dmdc_order=5", "applies to the identification dmdc"),
        ("sensor_delays=2", "there are no sensors"),
        ("real_time_factor=1", "applies to nodes"),
        ("pin=1", "applies to nodes"),
        ("action_timeout=0.1", "applies to nodes"),
        ("max_attempts=3", "applies to nodes"),
        ("plant_fingerprint=3", "how the training is started"),
    ],
)
def test_train_refuses_what_would_change_nothing(
    setting: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ("--in-process", "--out", str(tmp_path / "run"))
    refused(capsys, words, "train", str(SMALL), "--set", setting, *out)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "parameters",
    [
        {"resume": True},
        {"recorder": "required"},
        {"pairs": ["a"]},
        {"bag": "x"},
        {"view_rate": 3.0},
        {"real_time_factor": 1.0},
        {"optimizer": "model_based", "learning_rate": 0.1, "rollouts": 20},
        {"optimizer": "model_based", "smoothing_radius": 0.1, "rollouts": 20},
    ],
)
def test_the_python_interface_refuses_what_would_change_nothing(
    parameters: dict[str, object],
) -> None:
    with pytest.raises(ValueError, match="has no effect here: "):
        pdeloop.train(str(SMALL), **parameters)


def test_what_is_of_one_field_or_of_noise_is_refused_elsewhere(
    trained: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--mean-field", "--fields", "3")
    refused(capsys, "--mean-field is one field", "evaluate", str(trained), *words)
    plant = pdeloop.problem(str(SMALL), horizon=2).plant()
    none = np.zeros((2, plant.n_a))
    for noise in ("x", [1], [0.5, 1.5]):
        with pytest.raises(ValueError, match="expected 2 whole numbers, a seed for each"):
            pdeloop.rollout(plant, lambda k, z: none, [0, 1], noise)
