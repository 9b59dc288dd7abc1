# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""FMUs as plants: a rod compiled from C against its exact solution, and one made by pythonfmu."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pdeloop
from pde_sim_node.build import build_plant
from pde_sim_node.plants import fmu
from pde_sim_node.plants.loading import as_plant, make
from pdeloop.cli import main
from pdeloop.messages.own_code import OwnCodeError
from tests.support.fmus import euler_step, exact_step, rod

pytestmark = [
    pytest.mark.skipif(
        importlib.util.find_spec("fmpy") is None, reason="FMPy is not installed: extra fmi"
    ),
    pytest.mark.skipif(
        shutil.which("cc") is None, reason="needs a C compiler, the command cc (make packages)"
    ),
]
ONCE = 'canBeInstantiatedOnlyOncePerProcess="true"'
SAVES = f'{ONCE} canGetAndSetFMUstate="true"'


def inputs(k: int) -> np.ndarray[Any, Any]:
    return np.array([[0.3 * k], [2.0]])


@pytest.mark.parametrize(
    ("version", "kind", "how"),
    [
        (2, "CoSimulation", {}),
        (3, "CoSimulation", {}),
        (2, "CoSimulation", {"options": SAVES}),
        (2, "ModelExchange", {}),
        (3, "ModelExchange", {}),
    ],
)
def test_it_steps_as_the_rod_does_up_to_the_last_sample(
    tmp_path: Path, version: int, kind: str, how: dict[str, str]
) -> None:
    made = pdeloop.from_fmu(
        rod(tmp_path, version, kind, **how), perturbed={"T0": 1.0}, start={"k": 3.0}
    )
    plant = as_plant(made)
    assert (plant.n_z, plant.n_a, plant.horizon, plant.sample_time) == (20, 1, 30, 0.1)
    T = plant.reset([3, 4]).copy()
    drawn = [1.0 + np.random.default_rng(seed).standard_normal() for seed in (3, 4)]
    assert np.array_equal(T[:, 7], drawn)
    step = exact_step if kind == "ModelExchange" else euler_step
    for k in range(plant.horizon):
        T = np.array([step(own, q, 3.0) for own, (q,) in zip(T, inputs(k), strict=True)])
        plant.step(inputs(k))
    assert np.abs(plant.states - T).max() < (2e-6 if kind == "ModelExchange" else 1e-13)
    assert plant.reset([-1])[0, 5] == 1.0


@pytest.mark.parametrize("reset", [0, 3, -1])
def test_episodes_have_the_same_bits_whether_it_can_be_reset_or_not(
    tmp_path: Path, reset: int
) -> None:
    fmu._resets_wholly.clear()
    plant = as_plant(
        pdeloop.from_fmu(rod(tmp_path, 2, "CoSimulation", reset=reset), perturbed={"T0": 1.0})
    )
    law = lambda k, z: -0.3 * z[:, :1]  # noqa: E731
    first = pdeloop.rollout(plant, law, [1, 2])
    again = pdeloop.rollout(plant, law, [2])
    assert np.array_equal(first.states[:, 1], again.states[:, 0])
    assert list(fmu._resets_wholly.values()) == [reset >= 0]


def test_a_refused_step_is_a_divergence_and_the_next_episode_a_good_one(tmp_path: Path) -> None:
    plant = as_plant(pdeloop.from_fmu(rod(tmp_path, 2, "CoSimulation"), outputs="T[3]", horizon=4))
    lost = pdeloop.rollout(plant, lambda k, z: np.full((1, 1), 2e6 * (k == 2)), [0])
    assert lost.costs.diverged_step.tolist() == [2]
    good = pdeloop.rollout(plant, lambda k, z: np.zeros((1, 1)), [0])
    assert good.costs.diverged_step.tolist() == [-1] and good.states[0, 0, 0] == 1.0


def test_one_that_can_be_made_only_once_has_one_environment_or_saves_its_state(
    tmp_path: Path,
) -> None:
    plant = as_plant(pdeloop.from_fmu(rod(tmp_path, 2, "CoSimulation", options=ONCE)))
    plant.reset([0])
    plant.step(np.ones((1, 1)))
    plant.reset([0, 1])
    with pytest.raises(OwnCodeError, match=r"only once in a process.*max_batch=1"):
        plant.step(np.ones((2, 1)))


def test_wrong_names_and_sizes_are_named(tmp_path: Path) -> None:
    path = rod(tmp_path, 2, "CoSimulation")
    for message, given in {
        r"no output 'T3'; did you mean 'T\[\d": {"outputs": "T3"},
        "no input 'u'": {"inputs": "u"},
        "'k' of the FMU is no input but of causality parameter": {"inputs": "k"},
        r"start value of 'T0' is 'cold'; expected a number": {"start": {"T0": "cold"}},
        r"no parameter 'T00'; did you mean 'T0'": {"start": {"T00": 1.0}},
        "a variable named 'horizon'": {"start": {"horizon": 3}},
    }.items():
        with pytest.raises(ValueError, match=message):
            pdeloop.from_fmu(path, **given)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="target must be a number, 20 numbers"):
        as_plant(pdeloop.from_fmu(path, target=[1.0, 2.0]))
    with pytest.raises(ValueError, match="cannot read the FMU"):
        pdeloop.from_fmu(tmp_path / "other.fmu")
    (tmp_path / "text.fmu").write_text("no archive")
    with pytest.raises(ValueError, match="is not an FMU that FMPy can read"):
        pdeloop.from_fmu(tmp_path / "text.fmu")
    calculated = as_plant(pdeloop.from_fmu(path, start={"T[1]": 2.0}))
    with pytest.raises(OwnCodeError, match=r"does not allow 'T\[1\]' to be set"):
        calculated.reset([0])


def test_a_file_that_names_an_fmu_does_not_run_it(tmp_path: Path) -> None:
    path = rod(tmp_path, 2, "CoSimulation")
    values = {"plant": str(path)}
    with pytest.raises(
        ValueError, match="is code, which is not run merely because a file names it"
    ):
        make(values)
    given = pdeloop.problem(
        plant=str(path), physical={"target": 0.5, "perturbed": "T0", "spread": 1}
    )
    plant = build_plant(given.values)
    assert (
        plant.target.tolist() == [0.5] * 20 and given.values["problem"] == "rod-2-co-simulation-00"
    )
    own = pdeloop.from_fmu(path, target=0.5, perturbed={"T0": 1.0})
    assert pdeloop.problem(plant=own).values["plant"] == str(path)


def test_the_fingerprint_is_that_of_the_content_wherever_it_lies(tmp_path: Path) -> None:
    path = rod(tmp_path, 2, "CoSimulation")
    (tmp_path / "elsewhere").mkdir()
    moved = shutil.copy(path, tmp_path / "elsewhere" / "same.fmu")
    first, same, other = (
        as_plant(pdeloop.from_fmu(where, start={"k": k})).definition.fingerprint
        for where, k in ((path, 4.0), (moved, 4.0), (path, 5.0))
    )
    assert first == same != other


def test_a_command_trains_on_one_made_by_pythonfmu(tmp_path: Path, capsys: Any) -> None:
    """A rod of twenty segments in Python, from its start values drawn, to a target."""
    slave = Path(__file__).parents[1] / "support" / "rod_slave.py"
    if importlib.util.find_spec("pythonfmu") is None:
        pytest.skip("pythonfmu is not installed: extra fmi")
    build = [sys.executable, "-m", "pythonfmu", "build", "-f", slave, "-d", tmp_path]
    subprocess.run(build, check=True, capture_output=True)
    words = ["train", "--plant", str(tmp_path / "RodSlave.fmu"), "--in-process", "--rollouts", "8"]
    words += ["--set", "fmu.inputs=q1,q2", "--set", "fmu.target=0.5", "--set", "fmu.perturbed=T0"]
    words += ["--set", "fmu.spread=1", "--set", "horizon=20", "--set", "evaluation_fields=2"]
    words += ["--optimizer", "two_point", "--out", str(tmp_path / "run")]
    assert main(words) == 0
    run = pdeloop.load_run(tmp_path / "run")
    assert run.costs["lqt"].mean() < 0.7 * run.costs["none"].mean()
