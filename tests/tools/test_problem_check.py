# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop check`: modes and steps against theory, and what it refuses."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import scipy.fft

import pdeloop
from controller_node.identification import DesignSettings, design
from loop_interfaces.model_rows import pack
from loop_interfaces.problem import load_parameters
from loop_interfaces.topics import CostColumn
from loop_method.laws.calls import laws_of
from loop_method.laws.extended_kalman import ExtendedKalman
from pde_sim_node.build import build_plant
from pde_sim_node.equations import LinearEquation
from pde_sim_node.plants import SpectralPlant
from pde_sim_node.plants.convection import Convection
from pde_sim_node.plants.loading import as_plant
from pde_sim_node.plants.reactions import Plate
from pdeloop import problem_check, unstable_modes
from pdeloop.cli import FAILED, main
from pdeloop.control_effect import judged
from pdeloop.in_process import LocalPair
from pdeloop.problem_check import check
from pdeloop.training_run import resolve
from pdeloop.unstable_modes import (
    REACHED,
    controllability,
    controllability_by_powers,
    observability,
)
from tests.support.plants import plant_of
from tests.support.small import SMALL, parameters
from tuner_node.batch import Batch
from tuner_node.build import compares_first_law


@dataclass(frozen=True, kw_only=True)
class Growing(LinearEquation):
    """u_t = u + 0.2 u_xx on [0, 2 pi): the waves 0, 1 and 2 grow."""

    name: ClassVar[str] = "growing"
    order: ClassVar[float] = 2.0
    length: float = 2 * np.pi

    def linear_operator(self, k: Any) -> Any:
        return 1.0 - 0.2 * k**2

    def initial_field(self, x: Any, rng: Any) -> Any:
        return np.cos(x)

    def target(self, x: Any) -> Any:
        return np.zeros_like(x)


def plant(n_a: int, width: float) -> SpectralPlant:
    return plant_of(Growing(), n_z=32, n_a=n_a, width=width, sample_time=0.1, horizon=5)


def test_the_unstable_modes_are_those_of_the_operator_and_enough_actuators_reach_them() -> None:
    found = controllability(plant(5, 0.1))
    assert found.waves[:, 0].tolist() == [0, 1, 1, 2, 2]
    np.testing.assert_allclose(found.growth, [1.0, 0.8, 0.8, 0.2, 0.2], atol=1e-7)
    assert found.margins.min() > 0.1


@pytest.mark.parametrize(("n_a", "lost"), [(1, [1, 2]), (2, [1, 2]), (4, [2])])
def test_waves_on_which_equally_spaced_actuators_have_one_phase_are_not_reached(
    n_a: int, lost: list[int]
) -> None:
    """A pair cos, sin of one growth rate needs two columns of B, and they see wave n_a / 2 as one."""
    found = controllability(plant(n_a, 0.1))
    assert sorted(set(found.waves[found.margins < 1e-6, 0].tolist())) == lost


@pytest.mark.parametrize(("sensors", "lost"), [(1, [1, 2]), (2, [1, 2]), (4, [2]), (5, [])])
def test_waves_of_which_equally_spaced_sensors_see_one_phase_are_not_observed(
    sensors: int, lost: list[int]
) -> None:
    """As for actuators. Of two waves that look alike between them, the growth tells which it is."""
    found = observability(plant(1, 0.1), plant(1, 0.1).grid.measured(sensors))
    np.testing.assert_allclose(found.growth, [1.0, 0.8, 0.8, 0.2, 0.2], atol=1e-7)
    assert sorted(set(found.waves[found.margins < REACHED, 0].tolist())) == lost


def test_the_margin_of_sensors_does_not_depend_on_the_sampling_time() -> None:
    margins = [
        observability(as_sampled, as_sampled.grid.measured(1)).margins[0]
        for as_sampled in (
            plant_of(Growing(), n_z=32, n_a=1, width=0.1, sample_time=time, horizon=5)
            for time in (0.1, 0.01)
        )
    ]
    assert margins[1] == pytest.approx(margins[0], rel=0.1) and margins[0] > 0.05


def test_the_whole_state_observes_every_wave_alike() -> None:
    found = observability(plant(1, 0.1), np.arange(32))
    np.testing.assert_allclose(found.margins, 1.0, atol=1e-6)


@pytest.mark.parametrize(
    ("equilibrium", "growth"),
    [(1, [0.1308, 0.1308, 0.0824, 0.0824]), (2, [0.139] * 2), (3, [0.0933] * 2)],
)
def test_four_actuators_reach_the_unstable_modes_of_the_equilibria(
    equilibrium: int, growth: list[float]
) -> None:
    """Rates of Cvitanovic, Davidchack, Siminos (2010); a shift of the field keeps its size."""
    values = load_parameters("kuramoto-sivashinsky-22", {"physical.equilibrium": equilibrium})
    found = controllability(build_plant(values))
    grows = found.growth > 1e-3
    np.testing.assert_allclose(np.sort(found.growth[grows])[::-1], growth, atol=2e-4)
    assert found.margins[grows].min() > 0.2


class GrowingPlate(pdeloop.Dynamics):
    """Between walls, cos(i pi y) cos(j pi x / 2) grows at 1 - 0.9 i^2 - 0.2 j^2.

    The only actuator is in the middle, so what is odd in y or in x is out of its reach.
    """

    horizon, sample_time, n_a = 5, 0.1, 1

    def __init__(self) -> None:
        walls = {"periodic": False, "walls": False}
        y, x = pdeloop.Axis("y", 1.0, 6, **walls), pdeloop.Axis("x", 2.0, 8, **walls)
        self.grid = pdeloop.Grid((y, x))
        rates = 1.0 - 0.9 * np.arange(6.0)[:, None] ** 2 - 0.2 * np.arange(8.0) ** 2
        self.factors = np.exp(0.1 * rates)
        away = (y.points[:, None] - 0.5) ** 2 + (x.points - 1.0) ** 2
        self.supports = np.exp(-away / 0.1).reshape(-1, 1)

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        return np.zeros(48)

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        waves = scipy.fft.dctn(z.reshape(6, 8), norm="ortho")
        advanced = scipy.fft.idctn(self.factors * waves, norm="ortho").ravel()
        return advanced + 0.1 * (self.supports * a).sum(axis=1)


def test_modes_between_walls_are_told_by_their_half_waves() -> None:
    found = controllability(as_plant(GrowingPlate()))
    assert {tuple(row) for row in found.waves.tolist()} == {(0, 0), (0, 1), (0, 2), (1, 0)}
    np.testing.assert_allclose(found.growth, [1.0, 0.8, 0.2, 0.1], atol=1e-6)
    assert (found.margins < 1e-6).tolist() == [False, True, False, True]
    finding = problem_check._actuators(as_plant(GrowingPlate()))
    assert not finding.good
    assert "do not reach the half waves (0, 1), (1, 0) along y, x: move" in finding.text


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
        "actuators [1, 3] do not move the state: see what step does with its a",
    )
    good, text = findings_of(Numb())["actuators"]
    assert not good and text.startswith("no action moves the state")


class Bounded(Around):
    """The same with bounds of a third of the exploration's standard deviation, and without a mean."""

    action_low, action_high, zero_mean = -0.1, 0.1, True


class Balanced(Around):
    """The same, whose actions have no mean, which a model of them knows."""

    zero_mean = True


def test_an_exploration_beyond_the_bounds_of_the_actuators_is_told() -> None:
    good, text = findings_of(Bounded())["bounds"]
    share = float(re.match(r"[\d.]+", text)[0])
    assert not good and 90 < share <= 100 and text.endswith("lower exploration_variance")
    assert "bounds" not in findings_of(Balanced()) and "bounds" not in findings_of(Around())


def test_a_law_that_does_next_to_nothing_is_not_a_matter_of_the_order() -> None:
    text = findings_of(Dear())["first law"][1]
    assert "lower action_weight" in text and "another order" not in text
    good, text = findings_of(Resting())["first law"]
    assert not good and "at the target; draw others" in text


@pytest.mark.parametrize(
    ("none", "law", "good", "words"),
    [
        (9.0, 1.0, True, ""),
        (9.0, 8.9, True, "next to nothing"),
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
    delayed = {"sensors": 8, "sensor_delays": 32, "optimizer": "gauss_newton"}
    assert compares_first_law(resolve("allen-cahn", delayed))
    assert not compares_first_law(resolve("allen-cahn", {"optimizer": "gauss_newton"}))
    values = resolve("kdv", {"sensors": 8})
    good, text = next((f.good, f.text) for f in check(values) if f.name == "first law")
    assert good and "does not help; the adaptation compares it" in text


def test_with_few_sensors_the_first_law_is_that_of_a_training_with_its_filter() -> None:
    values = resolve(str(SMALL), {"sensors": 8, "optimizer": "model_based", "rollouts": 20})
    made, settings = build_plant(values), DesignSettings.of(values)
    explored = problem_check._explore(made, values)
    rows = design([(explored.states[:, 1], explored.actions[:, 1])], made.target, settings)
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
    assert re.search(r"BAD  sensors: .* these are not observed: all of wave number \d", told)
    assert main(["check", str(SMALL), "--sensors", "9999"]) == FAILED
    assert "9999" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "wrong"),
    [
        (["burgers", "--n-a", "2"], "--n-a: only for the check of a node"),
        (["burgers", "--patience", "10"], "--patience: only for the check of a node"),
        (["burgers", "--network"], "--network: only for the check of a node"),
        (["plant", "--n-z", "8"], "--n-z: only for the check of a node (controller)"),
        (["plant", "--sensors", "8"], "--sensors: only for the check of a problem's FILE"),
        (["plant", "--set", "horizon=9"], "--set: only for the check of a problem's FILE"),
        (["tuner", "--equation", "burgers"], "--equation: only for the check of a problem's FILE"),
        (["plant", "--picture", "x.png"], "--picture: only for the check of a problem's FILE"),
    ],
)
def test_an_option_of_the_other_check_is_refused(
    words: list[str], wrong: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["check", *words])
    assert ended.value.code == 2
    assert (
        capsys.readouterr()
        .err.splitlines()[-1]
        .startswith(f"pdeloop check: error: leave out {wrong}")
    )


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


@pytest.mark.parametrize("plant", [Plate(10, 8, across=1, up=1), Convection(10)])
def test_of_a_large_state_the_leading_modes_are_those_of_the_whole_matrix(
    plant: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One actuator in the middle of a plate does not reach what is odd about it."""
    made = as_plant(plant)
    whole, leading = controllability(made), controllability_by_powers(made)
    np.testing.assert_allclose(leading.growth, whole.growth, atol=1e-5)
    assert leading.waves.tolist() == whole.waves.tolist()
    lost = whole.margins < REACHED
    assert (leading.margins < REACHED).tolist() == lost.tolist()
    assert lost.sum() == (3 if isinstance(plant, Plate) else 0)
    positions = made.grid.measured(6)
    whole = observability(made, positions)
    monkeypatch.setattr(unstable_modes, "MAX_LINEARISED", 0)
    leading = observability(made, positions)
    np.testing.assert_allclose(leading.growth, whole.growth, atol=1e-5)
    np.testing.assert_allclose(leading.margins, whole.margins, atol=1e-4)


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
        ("counts", "another one when it is computed again"),
        ("shares", "depends on the other states"),
    ],
)
def test_a_step_that_cannot_be_repeated_is_bad(how: str, told: str) -> None:
    first = next(iter(check(pdeloop.problem(plant=Forgetful(how)).values)))
    assert first.name == "repeatability" and not first.good and told in first.text
