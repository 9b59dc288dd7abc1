# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop check`: steps, explorations and first laws, and what it refuses."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pdeloop
from controller_node.identification import DesignSettings, designed
from pde_sim_node.build import build_plant
from pdeloop import problem_check
from pdeloop.cli import FAILED, main
from pdeloop.in_process import LocalPair
from pdeloop.messages.model_rows import pack
from pdeloop.messages.topics import CostColumn
from pdeloop.method.laws.extended_kalman import ExtendedKalman
from pdeloop.method.laws.registry import laws_of
from pdeloop.problem_check import check, judged
from pdeloop.training_run import resolve
from tests.support.small import SMALL, parameters
from tuner_node.batch import Batch


def named(**changes: Any) -> dict[str, tuple[bool, str]]:
    return {found.name: (found.good, found.text) for found in check(parameters(**changes))}


def test_the_small_problem_is_good_and_a_coarse_step_is_not() -> None:
    fine, coarse = named(), named(integration_time=0.05)
    assert all(good for good, _ in fine.values()), fine
    assert set(fine) == {"integration step", "modes", "exploration", "order", "first law"}
    assert coarse["integration step"][0] is False
    assert "take 0.025 s or less" in coarse["integration step"][1]


def test_inputs_that_are_too_strong_for_a_plant_are_told() -> None:
    found = named(exploration_variance=1000.0, divergence_bound=3.2)
    assert "no control" not in found
    assert found["exploration"][1].endswith(": lower exploration_variance or integration_time")


def test_an_exploration_that_diverges_is_told() -> None:
    found = named(divergence_bound=0.5)
    assert found["exploration"][0] is False
    assert "6 of 6 explorations" in found["exploration"][1]
    assert "order" not in found


class Around(pdeloop.Dynamics):
    """States z+ = z + 0.02 z + a/10, drawn around the target, which is where they are on average."""

    n_z, n_a, horizon, sample_time = 4, 4, 40, 0.1
    spread = 1.0

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        half = self.spread * rng.standard_normal((1, 2))
        return np.vstack([half, -half]).ravel()

    def mean_state(self) -> np.ndarray:
        return np.zeros(4)

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        return 1.02 * z + 0.1 * a


class SometimesFar(Around):
    """The same; from one of the drawn states it leaves the bound."""

    divergence_bound = 5.0
    spread = 1.5


def findings_of(plant: pdeloop.Dynamics) -> dict[str, tuple[bool, str]]:
    values = pdeloop.problem(plant=plant).values
    return {found.name: (found.good, found.text) for found in check(values)}


def test_a_law_is_judged_on_drawn_states_where_their_mean_is_the_target() -> None:
    """From the mean, which is the target, no law costs less than no control, which costs nothing."""
    good, text = findings_of(Around())["first law"]
    none, law = (float(number) for number in re.findall(r"([\d.]+) with", text))
    assert good and none > 2 * law > 0


def test_one_drawn_state_whose_exploration_diverges_is_told() -> None:
    good, text = findings_of(SometimesFar())["exploration"]
    assert not good
    assert "1 of 6 explorations" in text


class Unstable(Around):
    """z+ = 1.2 z + a/10, which leaves the bound of 5 after about ten steps, whatever the inputs are."""

    divergence_bound = 5.0

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        return 1.2 * z + 0.1 * a


def test_a_plant_that_diverges_without_control_is_told_and_weaker_inputs_are_not_advised() -> None:
    plant = Unstable()
    drawn = [plant.initial_state(np.random.default_rng(seed)) for seed in range(5)]
    largest = max(np.abs(z).max() for z in drawn)
    first = int(np.argmax(largest * 1.2 ** np.arange(1, 41) > 5.0))
    found = findings_of(plant)
    assert found["no control"][0]
    assert (
        f"without control from 5 of 6 initial fields, the first at step {first} of 40"
        in (found["no control"][1])
    )
    good, text = found["exploration"]
    assert not good and "lower exploration_variance" not in text
    assert f"a horizon of {first} steps or fewer" in text


class Deaf(Around):
    """The same, on which the second and the last input have no effect."""

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        return 1.02 * z + 0.1 * a * [1, 0, 1, 0]


class Numb(Deaf):
    """The same without any effect of the inputs."""

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        return 0.9 * z


class Undefined(Around):
    """The same, with a step that divides 0 by 0."""

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        return np.full(4, np.nan)


class Dear(Around):
    """The same, with inputs that cost more than they save."""

    action_weight = 1e6


class Resting(Around):
    """The same, already at the target."""

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        return np.zeros(4)


def test_inputs_without_effect_are_named() -> None:
    assert "actuators" not in findings_of(Around())
    assert findings_of(Deaf())["actuators"] == (
        False,
        "actuators [1, 3] do not move the state: check how step uses its argument a",
    )
    good, text = findings_of(Numb())["actuators"]
    assert not good and text.startswith("no action moves the state")
    good, text = findings_of(Undefined())["actuators"]
    assert not good and "what is not finite" in text


class Sticky(Around):
    """The same with valves that do not answer to small actions."""

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        return super().step(z, np.where(np.abs(a) < 1.5, 0.0, a))


def test_inputs_that_only_large_actions_move_are_told() -> None:
    good, text = findings_of(Sticky())["actuators"]
    assert not good and text.startswith(
        "no explored action moves the state, larger ones do: set an"
    )


class Bounded(Around):
    """The same with a saturation of its own, at a third of the exploration's standard deviation."""

    def actuated(self, a: np.ndarray) -> np.ndarray:
        return 0.1 * np.tanh(10.0 * a)


class Heated(Around):
    """The same with declared bounds, far below the actions of a law without them."""

    action_low, action_high = -0.05, 0.1


class Balanced(Around):
    """The same, whose actions have no mean, which a model of them knows."""

    zero_mean = True


def test_an_exploration_beyond_the_bounds_of_the_actuators_is_told() -> None:
    good, text = findings_of(Bounded())["bounds"]
    share = float(re.match(r"[\d.]+", text)[0])
    assert not good and 90 < share <= 100 and text.endswith("lower exploration_variance")
    assert "bounds" not in findings_of(Balanced()) and "bounds" not in findings_of(Around())


def test_actions_of_the_first_law_at_declared_bounds_are_told() -> None:
    found = findings_of(Heated())
    assert "bounds" not in found and "saturation" not in findings_of(Around())
    share = float(
        re.match(r"([\d.]+) % of the actions of the first law", found["saturation"][1])[1]
    )
    assert 50 < share <= 100


def test_a_law_that_does_next_to_nothing_is_not_a_matter_of_the_order() -> None:
    text = findings_of(Dear())["first law"][1]
    assert "lower action_weight" in text and "another order" not in text
    good, text = findings_of(Resting())["first law"]
    assert not good and "at the target; draw others" in text


@pytest.mark.parametrize(
    ("none", "law", "good", "words"),
    [
        (9.0, 1.0, True, ""),
        (9.0, 8.9, True, "almost no effect"),
        (9.0, 99.0, False, "another order"),
    ],
)
def test_the_first_law_is_judged_by_what_it_saves(
    none: float, law: float, good: bool, words: str
) -> None:
    found, hint = judged(none, law)
    assert found == good and words in hint and bool(words) == bool(hint)


def test_a_first_law_that_need_not_be_begun_with_is_not_bad() -> None:
    assert judged(9.0, 99.0, compared=True)[0] and judged(9.0, 1.0, compared=True) == (True, "")
    assert judged(9.0, 9.1, compared=True)[0] and not judged(9.0, 9.1)[0]
    assert not judged(np.inf, np.inf, compared=True)[0]
    values = {**resolve("kdv", {"sensors": 8}), "horizon": 40}
    good, text = next((f.good, f.text) for f in check(values) if f.name == "first law")
    assert good and "does not help; the adaptation compares it" in text


def test_with_few_sensors_the_first_law_is_that_of_a_training_with_its_filter() -> None:
    values = resolve(str(SMALL), {"sensors": 8, "optimizer": "model_based", "rollouts": 20})
    made, settings = build_plant(values), DesignSettings.of(values)
    explored = problem_check._explore(made, values)
    rows = designed([(explored.states[:, 1], explored.actions[:, 1])], made.target, settings).rows
    assert rows.L is not None
    pair = LocalPair(values)
    pair.use_models(pack(rows)[None])
    [law] = laws_of(ExtendedKalman, [rows], made.horizon)
    fields = np.array([(i, -1, 0, 0, i) for i in range(problem_check.DRAWN)], dtype=np.float64)
    policies = np.repeat(law.theta_start.reshape(1, *law.shape), len(fields), axis=0)
    there = pair.run(Batch(fields, policies)).costs[:, CostColumn.MEAN].mean()
    first = problem_check._first_law(made, rows, settings)
    assert problem_check._drawn_fields_cost(made, first) == there


def test_sensors_and_other_parameters_may_be_given(capsys: pytest.CaptureFixture[str]) -> None:
    given = ["--sensors", "2", "--set", "horizon=12"]
    assert main(["check", "allen-cahn", *given]) == FAILED
    told = capsys.readouterr().out
    assert re.search(
        r"BAD  sensors: .* the sensors do not observe the modes of wave number \d", told
    )
    assert main(["check", str(SMALL), "--sensors", "9999"]) == FAILED
    assert "9999" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "wrong"),
    [
        (["burgers", "--n-a", "2"], "--n-a applies only to the check of a node"),
        (["burgers", "--patience", "10"], "--patience applies only to the check of a node"),
        (["burgers", "--network"], "--network applies only to the check of a node"),
        (["plant", "--n-z", "8"], "--n-z applies only to the check of a node (controller)"),
        (["plant", "--sensors", "8"], "--sensors applies only to the check of a problem's FILE"),
        (["plant", "--set", "horizon=9"], "--set applies only to the check of a problem's FILE"),
        (
            ["tuner", "--equation", "burgers"],
            "--equation applies only to the check of a problem's FILE",
        ),
        (
            ["plant", "--picture", "x.png"],
            "--picture applies only to the check of a problem's FILE",
        ),
    ],
)
def test_an_option_of_the_other_check_is_refused(
    words: list[str], wrong: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["check", *words])
    assert ended.value.code == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"pdeloop check: error: {wrong}")


@pytest.mark.parametrize(
    "words",
    [
        ["--n-a", "-3"],
        ["--n-a", "1000000000000"],
        ["--n-a", "2.5"],
        ["--patience", "inf"],
        ["--patience", "nan"],
        ["--limit", "0"],
    ],
)
def test_a_number_out_of_its_range_is_refused(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["check", "plant", *words])
    assert ended.value.code == 2
    told = capsys.readouterr().err
    assert f"{words[0]}: expected a " in told and told.endswith(f", got {words[1]}\n")


def test_a_picture_that_cannot_be_written_is_refused_before_the_check(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", "burgers", "--picture", str(tmp_path / "none" / "x.png")]) == FAILED
    told = capsys.readouterr()
    assert not told.out and "No such file" in told.err


class Forgetful(pdeloop.Dynamics):
    """A step that is another one each time, or in a batch."""

    n_z, n_a, horizon, batched = 4, 1, 12, True

    def __init__(self, how: str = "counts") -> None:
        self.how, self.calls = how, 0

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        return rng.standard_normal(4)

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        self.calls += self.how == "counts"
        shared = np.zeros_like(z) if self.how == "counts" else z.mean(axis=0)
        return 0.5 * z + a + 0.1 * shared + 1e-3 * self.calls


@pytest.mark.parametrize(
    ("how", "told"),
    [
        ("counts", "another result when it is computed again"),
        ("shares", "depends on the other states"),
    ],
)
def test_a_step_that_cannot_be_repeated_is_bad(how: str, told: str) -> None:
    first = next(iter(check(pdeloop.problem(plant=Forgetful(how)).values)))
    assert first.name == "repeatability" and not first.good and told in first.text
