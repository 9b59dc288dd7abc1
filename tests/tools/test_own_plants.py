# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Plants of a user's own, by name and as objects: what they are trained, checked and refused with."""

from __future__ import annotations

import importlib.util
import json
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import pdeloop
from pde_sim_node.build import build_plant, complete
from pde_sim_node.plants import DynamicsPlant, loading
from pde_sim_node.plants.loading import OWN_PLANTS
from pdeloop.cli import main
from pdeloop.messages.own_code import OwnCodeError
from pdeloop.messages.problem import load_parameters, read_problem
from pdeloop.method.models import selection as kinds
from tests.support.interpreter import ROOT, python
from tests.support.small import FEW_FITS, FEW_STEPS, same_bits

PLANTS = ROOT / "examples" / "plants"
LINEAR, PLATE = f"{PLANTS}/random_linear.py:RandomLinear", f"{PLANTS}/plate.py:Plate"
BUDGET = ("--rollouts", "9", "--evaluation-fields", "2", "--reduced-order", "6", "--in-process")
OWN = """
import numpy as np
import pdeloop

class Rod(pdeloop.Dynamics):
    n_z, n_a, horizon, sample_time = 5, 2, 6, 0.5
    target = 1.0

    def __init__(self, loss: float = 0.1, steps: int = 2, label: str = "rod"):
        if loss < 0:
            raise ValueError("loss is negative")
        self.loss, self.steps = loss, steps

    def initial_state(self, rng):
        return rng.standard_normal(5)

    def step(self, z, a):
        return (1 - self.loss) ** self.steps * z + np.repeat(a, [2, 3])

class Needy(Rod):
    def __init__(self, length):
        super().__init__()

class Bare(pdeloop.Plant):
    n_z, n_a, horizon, sample_time = 5, 2, 6, 0.5

    def step(self, z, a):
        return z

def rods(count: int = 2):
    return Rod(0.1 * count)

def nothing():
    return 3

NUMBER = 3
"""


@pytest.fixture(autouse=True)
def nothing_is_allowed(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv(OWN_PLANTS.variable, "")
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield
    loading._objects.clear()


@pytest.fixture
def own(tmp_path: Path) -> Path:
    path = tmp_path / "own.py"
    path.write_text(OWN)
    return path


def values_of(path: Path, name: str = "Rod", **given: Any) -> dict[str, Any]:
    return complete(load_parameters("", {"plant": OWN_PLANTS.allow(f"{path}:{name}"), **given}))[1]


def policies(folder: Path) -> np.ndarray:
    with np.load(folder / "policy.npz") as arrays:
        return np.asarray(arrays["policy"])


# By name


def test_what_a_plant_says_itself_stands_in_the_parameters(own: Path) -> None:
    values = values_of(own, **{"physical.loss": 1, "horizon": 9})
    assert (values["n_z"], values["n_a"], values["horizon"], values["sample_time"]) == (
        5,
        2,
        9,
        0.5,
    )
    assert (values["problem"], values["equation"], values["reduced_order"]) == ("rod", "", 0)
    own_parameters = {k: v for k, v in values.items() if k.startswith("physical.")}
    assert own_parameters == {"physical.loss": 1.0, "physical.steps": 2, "physical.label": "rod"}
    plant = build_plant(values)
    assert isinstance(plant, DynamicsPlant) and plant.dynamics.loss == 1.0  # type: ignore[attr-defined]
    assert plant.horizon == 9 and plant.target.tolist() == [1.0] * 5


def test_explorations_are_around_the_actions_that_cost_nothing() -> None:
    class Heated(Ageing):
        n_a, action_low, action_high = 3, 0.0, 8.0
        action_target = np.array([3.0, 0.0, 8.0])

    problem = pdeloop.problem(plant=Heated(1.0))
    assert problem.values["exploration_mean"] == [3.0, 2.0, 6.0]  # two standard deviations inside
    given = pdeloop.problem(plant=Heated(1.0), exploration_mean=[1.0, 1.0, 1.0])
    assert given.values["exploration_mean"] == [1.0, 1.0, 1.0]
    Heated.action_target = 0.0
    assert not pdeloop.problem(plant=Heated(1.0)).values["exploration_mean"]


def test_a_function_may_make_the_plant(own: Path) -> None:
    values = values_of(own, "rods", **{"physical.count": 3.0})
    assert values["physical.count"] == 3 and type(values["physical.count"]) is int
    plant = build_plant(values)
    assert isinstance(plant, DynamicsPlant) and plant.dynamics.loss == pytest.approx(0.3)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("name", "given", "words"),
    [
        (
            "Rod",
            {"physical.width": 1.0},
            "'physical.width' of .*own.py:Rod; known: loss, steps, label",
        ),
        (
            "Rod",
            {"physical.loss": -1.0},
            "own.py:Rod' cannot be made: .*own.py, line 11: .*negative",
        ),
        (
            "Needy",
            {},
            "cannot be made: missing a required argument: 'length'; give it as 'physical",
        ),
        ("nothing", {}, "must be a class derived from pdeloop.Dynamics, or make one .* got 3"),
        (
            "Bare",
            {},
            "Bare is derived from pdeloop.Plant, .* lacks .* derive it from pdeloop.Dynamics",
        ),
        ("NUMBER", {}, "must be a class or a function, got 3"),
        ("Ring", {}, "there is no 'Ring' in"),
        ("Rod", {"n_z": 6}, "'n_z' is 6, but the plant .*own.py:Rod has 5; leave it out"),
        (
            "Rod",
            {"sample_time": 0.1},
            "'sample_time' is 0.1, but the plant .* has 0.5; leave it out",
        ),
        ("Rod", {"equation": "burgers"}, "'equation' and 'plant' are both given"),
        ("Rod", {"physical.label": "object of a Python program: x"}, "in that program alone"),
    ],
)
def test_a_plant_that_cannot_be_made_is_told_why(
    own: Path, name: str, given: dict[str, Any], words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        values_of(own, name, **given)


def test_an_object_of_the_interface_alone_is_refused_wherever_a_plant_is_taken() -> None:
    class Bare(pdeloop.Plant):
        n_z, n_a = 5, 2

    for use in (
        lambda plant: pdeloop.train(plant=plant),
        lambda plant: pdeloop.rollout(plant, lambda k, z: z, [0]),
        pdeloop.Gradients,
    ):
        with pytest.raises(ValueError, match=r"Bare is derived from pdeloop\.Plant, .* lacks"):
            use(Bare())


def test_a_file_without_its_class_is_told_what_is_missing(own: Path) -> None:
    with pytest.raises(
        ValueError, match=r"own.py' is a file; name the class in it as well, as .*own.py:Cl"
    ):
        OWN_PLANTS.load(str(own))


def test_code_that_only_a_file_names_is_not_run(own: Path, tmp_path: Path, capsys: Any) -> None:
    problem = own.with_name("rod.yaml")
    problem.write_text("/**: {ros__parameters: {plant: 'own.py:Rod', physical: {loss: 0.3}}}")
    own.write_text(f"open({str(tmp_path / 'mark')!r}, 'w').close()\n{OWN}")
    assert main(["check", str(problem)]) == 1
    told = capsys.readouterr().err
    assert f"the plant '{own}:Rod' is code, which is not run merely because a file names it" in told
    assert not (tmp_path / "mark").exists()
    assert main(["check", str(problem), "--plant", f"{own}:Rod"]) in (0, 1)
    assert (tmp_path / "mark").exists()
    assert "first law" in capsys.readouterr().out


def test_an_installed_package_offers_plants_by_name(
    own: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    about = own.parent / "rods-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: rods\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[pdeloop.plants]\nsteel-rod = own:Rod\n")
    monkeypatch.syspath_prepend(str(own.parent))
    try:
        _, values = complete(load_parameters("", {"plant": "steel-rod"}))
        assert values["problem"] == "steel-rod" and values["n_z"] == 5
        with pytest.raises(
            ValueError, match=r"unknown plant 'copper-rod': give one of interval, .*steel-rod, or"
        ):
            complete(load_parameters("", {"plant": "copper-rod"}))
    finally:
        sys.modules.pop("own", None)


# One training, however it is asked for


@pytest.mark.parametrize(
    ("name", "given", "method"),
    [
        (LINEAR, {"radius": 0.9}, {"identification": "regression", "optimizer": "two_point"}),
        (PLATE, {"nx": 6, "ny": 4}, {"horizon": 15, **FEW_STEPS}),
    ],
)
def test_python_and_the_command_line_train_to_the_same_bits(
    name: str,
    given: dict[str, Any],
    method: dict[str, Any],
    tmp_path: Path,
    capsys: Any,
    undrawn: None,
) -> None:
    problem = tmp_path / "own.yaml"
    problem.write_text(json.dumps({"/**": {"ros__parameters": {"physical": given, **method}}}))
    assert (
        main(["train", str(problem), "--plant", name, *BUDGET, "--out", str(tmp_path / "a")]) == 0
    )
    how = {"rollouts": 9, "evaluation_fields": 2, "reduced_order": 6, **method}
    by_name = pdeloop.train(plant=name, **{f"physical.{k}": v for k, v in given.items()}, **how)
    made = vars(loading.OWN_PLANTS._load_file(name.partition(":")[0]))[name.rpartition(":")[2]]
    by_object = pdeloop.train(plant=made(**given), **how, out=tmp_path / "b")
    expected = policies(tmp_path / "a")
    assert same_bits(by_name.policies, expected) and same_bits(by_object.policies, expected)
    assert by_object.costs["adapted"].mean() < by_object.costs["none"].mean()
    there = [json.loads((tmp_path / run / "result.json").read_text())["plant"] for run in "ab"]
    assert there[0] == there[1] > 0
    assert read_problem(tmp_path / "a" / "parameters.yaml")["plant"] == name

    # What a run is followed by.
    for command in (["evaluate"], ["report"]):
        monkeypatched = [*command, str(tmp_path / "a")]
        assert main([*monkeypatched, "--plant", name]) == 0
    capsys.readouterr()
    assert main(["evaluate", str(tmp_path / "a"), "--plant", f"{PLANTS}/other.py:Other"]) == 1
    assert "but that of the run is" in capsys.readouterr().err


def test_an_object_whose_arguments_no_file_can_hold_is_trained_in_its_program_alone(
    tmp_path: Path, own: Path, capsys: Any
) -> None:
    made = vars(OWN_PLANTS._load_file(str(own)))["Needy"](np.eye(3))
    how = {"rollouts": 9, "evaluation_fields": 2, "reduced_order": 2}
    run = pdeloop.train(plant=made, out=tmp_path / "run", **how)
    assert run.values["physical.length"].startswith("object of a Python program: ")
    assert build_plant(run.values).dynamics is made  # type: ignore[attr-defined]
    loading._objects.clear()
    assert main(["evaluate", str(tmp_path / "run"), "--plant", f"{own}:Needy"]) == 1
    assert "'physical.length' of" in capsys.readouterr().err


def test_rollouts_and_gymnasium_take_a_plant_of_ones_own() -> None:
    made = vars(OWN_PLANTS._load_file(f"{PLANTS}/random_linear.py"))["RandomLinear"]()
    zero = np.zeros((2, 4))
    episode = pdeloop.rollout(made, lambda k, z: zero, [0, 1])
    assert episode.states.shape == (41, 2, 64)
    import pdeloop.environments as environments

    env = environments.Environment(made)
    observation, _ = env.reset(seed=1)
    assert np.array_equal(observation, episode.states[0, 1])
    total = 0.0
    for k in range(40):
        observation, reward, terminated, truncated, _ = env.step(zero[0])
        total += reward
        assert not terminated and truncated == (k == 39)
    assert np.array_equal(observation, episode.states[40, 1])
    assert total == pytest.approx(-episode.costs.total[1])
    many = environments.VectorEnvironment(made, num_envs=2)
    assert isinstance(many, gymnasium.vector.VectorEnv)
    assert np.array_equal(many.reset(seed=0)[0], episode.states[0])


# What goes wrong on the way


BREAKS = OWN.replace(
    "        return (1 - self.loss)",
    "        if abs(z).sum() > 2.5 and a.any():\n            raise RuntimeError('no licence')\n"
    "        return (1 - self.loss)",
)


def test_a_plant_that_fails_ends_the_training_with_its_cause_and_loses_nothing(
    own: Path, tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    own.write_text(BREAKS)
    run = tmp_path / "run"
    name = f"{own}:Rod"
    assert main(["train", "--plant", name, *BUDGET[:4], "--in-process", "--out", str(run)]) == 1
    told = capsys.readouterr().err.splitlines()[-1]
    assert f"Rod.step fails: {own}, line 19: RuntimeError: no licence" in told
    told, _, again = told.removesuffix(")").partition("continue with: pdeloop ")
    assert again == f"train --resume {run} --in-process --plant {name}"
    monkeypatch.delenv("PDELOOP_PLANTS")  # as in the next process
    assert main(shlex.split(again)) == 1
    assert "RuntimeError: no licence" in capsys.readouterr().err.splitlines()[-1]
    assert (run / "parameters.yaml").exists()


class Breaking(pdeloop.Dynamics):
    """Fails in a step with an action, but for the first ones."""

    n_z, n_a, horizon, stateful = 2, 1, 10, True
    lasts, taken = 0, 0

    def initial_state(self, rng: np.random.Generator) -> Any:
        self.z = rng.normal(size=2)
        return self.z

    def step(self, z: Any, a: Any) -> Any:
        Breaking.taken += bool(a.any())
        if Breaking.taken > self.lasts:
            raise RuntimeError("no licence")
        self.z = 0.9 * self.z + 0.1 * a
        return self.z


class LateBreaking(Breaking):
    """After the exploration."""

    lasts = 40


def test_a_failure_of_a_training_that_is_not_kept_is_not_to_be_continued(tmp_path: Path) -> None:
    with pytest.raises(OwnCodeError, match=r"no licence$"):  # nothing was done that could be kept
        pdeloop.train(plant=Breaking())
    Breaking.taken = 0
    with pytest.raises(OwnCodeError, match=r"no licence \(give out=FOLDER, in which") as told:
        pdeloop.train(plant=LateBreaking())
    assert "resume" not in str(told.value)
    out = tmp_path / "run"
    with pytest.raises(OwnCodeError, match=rf"\(continue with: .* --resume {out} --in-process"):
        pdeloop.train(plant=Breaking(), out=out)


class Ageing(pdeloop.Dynamics):
    """Answers otherwise from rollout to rollout."""

    n_z, n_a, horizon, stateful = 2, 1, 10, True

    def __init__(self, factor: float) -> None:
        self.pole, self.factor = 0.9, factor

    def initial_state(self, rng: np.random.Generator) -> Any:
        self.pole *= self.factor
        return rng.standard_normal(2)

    def step(self, z: Any, a: Any) -> Any:
        return self.pole * z + a[0]


@pytest.mark.parametrize("factor", [0.999, 1.0])
def test_a_plant_that_drifts_is_found_by_its_first_rollout(
    factor: float, recwarn: pytest.WarningsRecorder
) -> None:
    plant = DynamicsPlant(Ageing(factor))
    run = pdeloop.train(plant=plant, rollouts=5, evaluation_fields=2, optimizer="two_point")
    (repeated,) = run.result["repeated"]
    assert (repeated["now"] == repeated["then"]) == (factor == 1.0)
    assert repeated["now"] <= repeated["then"]
    assert any("(it drifts," in str(one.message) for one in recwarn) == (factor < 1.0)


def test_a_program_that_trains_when_it_is_loaded_as_a_plant_is_stopped(own: Path) -> None:
    own.write_text(OWN + "\npdeloop.train(plant=Rod(), rollouts=9)\n")
    with pytest.raises(ValueError, match="trains while it is being imported") as told:
        values_of(own)
    assert isinstance(told.value.__cause__, RuntimeError)
    assert not isinstance(told.value.__cause__, OwnCodeError)


def test_a_class_of_an_unregistered_module_is_refused_with_the_way_to_name_it(own: Path) -> None:
    """As with importlib, without the line that puts the module into sys.modules."""
    spec = importlib.util.spec_from_file_location("unregistered", own)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    with pytest.raises(ValueError, match=r"'unregistered'.* give .*'path/to/file.py:Rod'"):
        pdeloop.problem(plant=module.Rod())


def test_a_script_trains_its_own_class_and_names_its_file(tmp_path: Path) -> None:
    script = tmp_path / "own.py"
    script.write_text(
        OWN + "\nif __name__ == '__main__':\n"
        "    few = {'rollouts': 9, 'reduced_order': 2, 'optimizer': 'two_point'}\n"
        "    run = pdeloop.train(plant=Rod(loss=0.2), **few)\n"
        "    print(run.values['plant'], run.values['physical.loss'], run.result['plant'])\n"
    )
    name, loss, number = python(str(script)).stdout.split()
    assert (name, float(loss)) == (f"{script}:Rod", 0.2)
    plant = build_plant(values_of(script, **{"physical.loss": 0.2}))
    assert plant.definition.fingerprint == int(number)


def test_the_page_shows_the_example_as_it_is() -> None:
    page = (ROOT / "docs" / "bring-your-own.md").read_text()
    (code,) = re.findall(
        r"```python\n(import numpy[^`]*class RandomLinear.*?)```", page, flags=re.DOTALL
    )
    assert code.strip() in (PLANTS / "random_linear.py").read_text()


def test_no_model_of_a_field_on_one_axis_is_fitted_to_a_plate(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its points have other neighbours; linear models in modes or of all numbers know of none."""
    for name in ("fit_spectral", "fit_finite_difference"):
        monkeypatch.setattr(kinds, name, lambda *_, **__: pytest.fail("was fitted"))
    settings = {"optimizer": "model_based", "horizon": 30}
    settings |= {"physical.nx": 6, "physical.ny": 4, **FEW_FITS}
    settings["field_model_settings.largest_degree"] = 3
    run = pdeloop.train(plant=PLATE, rollouts=12, evaluation_fields=2, **settings)
    assert run.costs["adapted"].mean() < run.costs["lqt"].mean()


@pytest.mark.parametrize("where", ["__init__", "initial_state"])
def test_a_plant_that_changes_the_working_directory_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    other, plant = tmp_path / "other", tmp_path / "mover.py"
    other.mkdir()
    own = OWN.split("class Needy")[0]
    method = next(line for line in own.splitlines() if f"def {where}" in line)
    plant.write_text(
        own.replace(method, f"{method}\n        __import__('os').chdir({str(other)!r})")
    )
    monkeypatch.chdir(tmp_path)
    for out in (["--out", "run"], []):
        monkeypatch.chdir(tmp_path)
        words = ["train", "--plant", f"{plant}:Rod", "--rollouts", "6", "--in-process"]
        assert main([*words, "--evaluation-fields", "2", *out]) == 0
    assert Path.cwd() == other and not list(other.iterdir())
    assert (tmp_path / "run" / "result.json").exists()
    assert len(list((tmp_path / "runs").glob("*/result.json"))) == 1
