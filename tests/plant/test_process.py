# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Plants that programs serve: the examples, and programs that end, are late or answer nonsense."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pdeloop
from pde_sim_node.plants.loading import as_plant, make
from pdeloop.cli import main
from pdeloop.messages.own_code import OwnCodeError
from tests.support.interpreter import ROOT

EXAMPLES = ROOT / "examples" / "processes"
PYTHON = f"{sys.executable} {EXAMPLES / 'rod.py'}"


def expected(z: Any, a: float) -> list[float]:
    lower = z[1] + 0.1 * (z[0] - z[1])
    return [z[0] + 0.1 * (a + lower - z[0]), lower]


def program(folder: Path, body: str) -> str:
    """A command of a program that declares two numbers and an actuator, and answers as `body` says."""
    path = folder / "served.py"
    path.write_text(
        "import json, os, sys, time\n"
        'print(\'{"n_z": 2, "n_a": 1, "horizon": 6}\', flush=True)\n'
        "k = 0\n"
        "for line in sys.stdin:\n"
        "    request = json.loads(line)\n"
        "    k = k + 1 if 'step' in request else 0\n"
        "    z = [float(k), 0.0]\n"
        f"    {body}\n"
        "    print(json.dumps({'z': z}), flush=True)\n"
    )
    return f"{sys.executable} {path}"


@pytest.mark.parametrize("language", ["python", "c"])
def test_the_examples_step_as_they_say(tmp_path: Path, language: str) -> None:
    command = PYTHON
    if language == "c":
        if shutil.which("cc") is None:
            pytest.skip("needs a C compiler, the command cc (make packages)")
        command = str(tmp_path / "rod")
        subprocess.run(["cc", "-O2", "-o", command, EXAMPLES / "rod.c"], check=True)
    plant = as_plant(pdeloop.from_process(command))
    assert (plant.n_z, plant.n_a, plant.horizon, plant.sample_time) == (2, 1, 40, 0.1)
    z = plant.reset([3, 4]).copy()
    assert z[0, 0] != z[1, 0]
    for a in (0.3, -0.7, 0.1):
        z = np.array([expected(own, a) for own in z])
        assert np.allclose(plant.step(np.full((2, 1), a)), z, rtol=1e-14)
    again = plant.reset([4])
    assert np.array_equal(again, as_plant(pdeloop.from_process(command)).reset([4]))


def test_a_command_trains_on_it(tmp_path: Path) -> None:
    words = ["--in-process", "--rollouts", "6", "--optimizer", "two_point", "--set"]
    words += ["evaluation_fields=2", "--out", str(tmp_path / "run")]
    assert main(["train", "--plant", f"process:{PYTHON}", *words]) == 0
    run = pdeloop.load_run(tmp_path / "run")
    assert run.values["problem"] == "rod"
    assert run.costs["lqt"].mean() < run.costs["none"].mean()
    with pytest.raises(ValueError, match="not run merely because a file names it"):
        make({"plant": "process:python other.py"})


def test_a_program_that_ends_is_started_again_and_the_episode_repeated(tmp_path: Path) -> None:
    once = tmp_path / "once"
    dies = f"if k == 3 and not os.path.exists('{once}'): open('{once}', 'w'); sys.exit(3)"
    plant = as_plant(pdeloop.from_process(program(tmp_path, dies)))
    episode = pdeloop.rollout(plant, lambda k, z: np.ones((1, 1)), [0])
    assert once.exists()
    assert episode.states[:, 0, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]


def test_a_training_whose_program_stays_away_is_continued_with_the_same_bits(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken, begun, own = (tmp_path / name for name in ("broken", "begun", "rod.py"))
    source, step = (EXAMPLES / "rod.py").read_text(), "    else:\n"
    assert source.count(step) == 1
    own.write_text(
        source.replace(
            step,
            f"        print(file=open({str(begun)!r}, 'a'))\n"
            f"        import os; os.path.exists({str(broken)!r}) "
            f"and len(open({str(begun)!r}).readlines()) > 6 and sys.exit(3)\n{step}",
        )
    )
    plant = ["--plant", f"process:{sys.executable} {own}"]
    words = ["--in-process", "--rollouts", "12", "--optimizer", "two_point", "--set"]
    words += ["evaluation_fields=2", "--set", "max_batch=1"]
    broken.touch()
    assert main(["train", *plant, *words, "--out", str(tmp_path / "run")]) == 1
    told = capsys.readouterr().err
    assert "has ended, with exit code 3" in told and "--resume" in told
    broken.unlink()
    assert main(["train", *plant, "--in-process", "--resume", str(tmp_path / "run")]) == 0
    assert main(["train", *plant, *words, "--out", str(tmp_path / "whole")]) == 0
    continued, whole = (pdeloop.load_run(tmp_path / name) for name in ("run", "whole"))
    assert np.array_equal(continued.policies[0], whole.policies[0])
    assert np.array_equal(continued.costs["adapted"], whole.costs["adapted"])


@pytest.mark.parametrize(
    ("body", "told"),
    [
        ("if k == 3: sys.exit(3)", "has ended, with exit code 3"),
        ("if k == 3: time.sleep(60)", "has not answered for 2 s"),
        ("z = z[:1] if k == 3 else z", r"must answer {\"z\": \[...\]} with 2 numbers"),
        ("print('hello', flush=True)", "expected one JSON object a line"),
    ],
)
def test_what_a_program_does_wrong_is_told_in_a_sentence(
    tmp_path: Path, body: str, told: str
) -> None:
    plant = as_plant(pdeloop.from_process(program(tmp_path, body), timeout=2.0))
    with pytest.raises(OwnCodeError, match=told):
        pdeloop.rollout(plant, lambda k, z: np.ones((1, 1)), [0])


def test_a_program_that_declares_no_plant_is_refused(tmp_path: Path) -> None:
    for text, told in {
        "print('{}')": "'n_z' is missing",
        'print(\'{"n_z": 1, "n_a": 1, "n_x": 2}\')': "unknown is 'n_x'",
        "": "has ended, with exit code 0",
    }.items():
        path = tmp_path / f"{len(text)}.py"
        path.write_text(text)
        with pytest.raises((ValueError, RuntimeError), match=told):
            pdeloop.from_process([sys.executable, str(path)])
    with pytest.raises(ValueError, match="cannot be started"):
        pdeloop.from_process("no-such-program")
