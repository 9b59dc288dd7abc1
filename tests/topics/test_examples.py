# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The examples of docs/bring-your-own.md, run as the page says."""

from __future__ import annotations

import importlib.util
import json
import re
import shlex
import signal
import time
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pde_sim_node.build import build_plant
from pde_sim_node.equations import ALLOWED, OWN_EQUATIONS, Equation
from pdeloop.cli import main
from pdeloop.messages.model_rows import unpack
from pdeloop.messages.problem import load_parameters
from pdeloop.method.seeds import Purpose, derive
from tests.support.loop_harness import ROOT, Processes, until
from tests.support.small_loop import LIMIT
from tests.support.undrawn import report
from tests.topics.test_foreign import PLANT, documented_command

pytestmark = pytest.mark.topics
PAGE = (ROOT / "docs" / "bring-your-own.md").read_text()
EXAMPLES = ROOT / "examples"


def commands(mark: str) -> list[list[str]]:
    """The lines of the shell block of the page that contains `mark`, as words."""
    blocks = re.findall(r"```sh\n(.*?)```", PAGE, flags=re.DOTALL)
    (block,) = [block for block in blocks if mark in block]
    return [shlex.split(line) for line in block.replace("\\\n", " ").splitlines()]


def ros_arguments(mark: str, start: str, which: int = 0) -> list[str]:
    """The ROS arguments of the line of that block that begins with `start`."""
    found = [line for line in commands(mark) if line[: len(start.split())] == start.split()]
    given = found[which][found[which].index("--ros-args") + 1 :]
    return [str(ROOT / word) if word.startswith("config/") else word for word in given]


def example(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_controller_of_ones_own_is_tuned(loop: Processes, tmp_path: Path) -> None:
    source = (EXAMPLES / "saturated_controller.py").read_text()
    assert not re.search(r"import (pde_sim_node|controller_node|pdeloop)", source)
    mark = "examples/saturated_controller.py"
    loop.node("pde_sim_node", *ros_arguments(mark, "pde_sim_node"))
    controller = ros_arguments(mark, "python examples/saturated_controller.py")
    loop.start(str(EXAMPLES / "saturated_controller.py"), "--ros-args", *controller)
    out = tmp_path / "run"
    tuner = loop.node("tuner_node", *ros_arguments(mark, "tuner_node"), "-p", f"out:={out}")
    text = loop.wait(tuner, 10 * LIMIT)  # 15 000 samples: a minute of a free machine at the most

    result = json.loads((out / "result.json").read_text())
    assert result["controller"] == {"nodes": ["/saturated_controller"], "law": "not seen"}
    refused = loop.wait(loop.pdeloop("evaluate", str(out)), LIMIT, code=1)
    assert (
        "the control law of the run was not the built-in one (its controller: /saturated" in refused
    )
    shown = report(loop, out, LIMIT)
    assert "not shown: Behaviour" in shown and "(its controller: /saturated_controller)" in shown
    assert (out / "report" / "training-curves.png").exists()

    with np.load(out / "policy.npz") as arrays:
        first, adapted = arrays["lqt"][0], arrays["policy"][0]
    module = example("saturated_controller")
    assert np.array_equal(first, np.tile([module.P, module.F], (6, 1)))
    # The costs that came over the topics are those of the law on the plant.
    plant = build_plant(load_parameters("burgers", {}))
    seeds = [derive(0, Purpose.EVALUATION_FIELD, i) for i in range(10)]

    def cost(policy: np.ndarray) -> float:
        z = plant.reset(seeds)
        for _ in range(plant.horizon):
            actions = module.law(np.repeat(policy[None], 10, axis=0), z, plant.target)
            assert np.abs(actions).max() <= module.A_MAX
            z = plant.step(actions)
        return float(plant.episode_costs().mean.mean())

    (found,) = re.findall(r"seed 0: cost [\d.]+ without control, [\d.]+ with LQT, .* adapted", text)
    # A policy of zeros is no control for this law, too.
    expected = [cost(0 * first), cost(first), cost(adapted)]
    told = [result["mean_cost"][name] for name in ("none", "lqt", "adapted")]
    np.testing.assert_allclose(told, expected, rtol=1e-9)
    assert expected[2] < expected[1] < expected[0]
    assert found in PAGE


def test_a_pde_of_ones_own_trains_from_its_file(
    tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv(ALLOWED, "")  # which the command line sets
    (command,) = [line for line in commands("--seed 0") if line[0] == "pdeloop"]
    without = [word for word in command[1:] if "Hohenberg" not in word and word != "--equation"]
    here = ["--in-process", "--out", str(tmp_path / "run")]
    assert main([*without, *here]) == 1
    assert "unknown equation 'swift-hohenberg'" in capsys.readouterr().err
    assert main([*command[1:], *here]) == 0
    (line,) = re.findall(r"seed 0: cost .*LQT, .* adapted", capsys.readouterr().out)
    assert line in PAGE
    # The run's folder names the file, which alone is not enough.
    monkeypatch.setenv(ALLOWED, "")
    assert main(["evaluate", str(tmp_path / "run")]) == 1
    said = capsys.readouterr().err
    assert re.match(
        r"pdeloop: the equation '.*' is code, which is not run merely because a file", said
    )
    equation = command[command.index("--equation") :][:2]
    assert main(["evaluate", str(tmp_path / "run"), *equation]) == 0


def test_a_pde_of_ones_own_is_offered_by_its_package() -> None:
    """As the page says; what an entry point leads to is in tests/plant/test_equations.py."""
    project = tomllib.loads((EXAMPLES / "swift_hohenberg" / "pyproject.toml").read_text())
    ((name, value),) = project["project"]["entry-points"]["pdeloop.equations"].items()
    assert f'[project.entry-points."pdeloop.equations"]\n{name} = "{value}"' in PAGE
    (module,) = project["tool"]["setuptools"]["py-modules"]
    assert issubclass(
        OWN_EQUATIONS.load(f"{EXAMPLES}/swift_hohenberg/{value.replace(module, module + '.py')}"),
        Equation,
    )


def test_a_model_from_a_bag_of_a_foreign_plant_starts_a_training(
    loop: Processes, tmp_path: Path
) -> None:
    mark = "pdeloop identify --bag lab"
    loop.start(str(PLANT), name="linear_plant")
    loop.node("controller_node", *documented_command("controller_node"))
    recorder = loop.node("recorder_node", *ros_arguments(mark, "recorder_node"))
    out = f"out:={tmp_path / 'first'}"
    tuner = loop.node("tuner_node", *ros_arguments(mark, "tuner_node"), "-p", out)
    loop.wait(tuner, 5 * LIMIT)
    recorder.send_signal(signal.SIGINT)
    recorder.wait(LIMIT)
    (identify,) = [line for line in commands(mark) if line[:2] == ["pdeloop", "identify"]]
    loop.wait(loop.pdeloop(*identify[1:]), LIMIT)

    with np.load(tmp_path / "model.npz") as arrays, np.load(tmp_path / "first/policy.npz") as run:
        rows, live = arrays["model"], run["model"]
    assert np.array_equal(rows, live), "one exploratory episode: the controller's own model"
    second = tmp_path / "second"
    tuner = loop.node(
        "tuner_node", *ros_arguments(mark, "tuner_node", which=1), "-p", f"out:={second}"
    )
    text = loop.wait(tuner, 5 * LIMIT)
    assert "identify" not in [row.get("name") for row in events(second)]
    with np.load(second / "policy.npz") as arrays:
        assert np.array_equal(arrays["model"], rows)
        assert np.array_equal(arrays["lqt"][0], unpack(rows[0], n_a=2).policy)
    assert "seed 0: cost 0.6007 without control, 0.2407 with LQT" in text


def events(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "progress.jsonl").read_text().splitlines()]


def test_the_rehearsal_in_real_time(loop: Processes, tmp_path: Path) -> None:
    mark = "real_time_factor:=1.0"
    plant = loop.node("pde_sim_node", *ros_arguments(mark, "pde_sim_node"))
    loop.node("controller_node", *ros_arguments(mark, "controller_node"))
    tuner = loop.node(
        "tuner_node", *ros_arguments(mark, "tuner_node"), "-p", f"out:={tmp_path / 'run'}"
    )
    began = time.monotonic()
    loop.wait(tuner, 5 * LIMIT)
    # 9 episodes: exploration, 2 iterations of 2 rollouts, the first again, 3 controllers on 1 field.
    assert time.monotonic() - began > 9 * 20 * 0.05
    until(lambda: "real time:" in loop.output(plant), LIMIT, "summary of the plant")
    said = "real time: 180 states every 50 ms"
    assert said in loop.output(plant), loop.output(plant)
    assert said in PAGE
