# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What stands between the field and its controller: noise, saturation and sensors, from theory."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

import pdeloop
from controller_node.policy import ProjectedLaw, excitation
from pde_sim_node.build import build_plant, fingerprint
from pde_sim_node.equations import Equation
from pde_sim_node.instruments import InstrumentedPlant, Noise, standard_normal
from pde_sim_node.lockstep import Lockstep
from pde_sim_node.plant import Instruments, Plant
from pde_sim_node.plants import SpectralPlant
from pde_sim_node.real_time import Timing
from pdeloop.in_process import LocalPair, train
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.frames import Frame, FrameError
from pdeloop.messages.grid import Grid
from pdeloop.messages.parameters import measured_size
from pdeloop.messages.topics import StartColumn
from tests.support.small import FEW_STEPS, parameters, same_bits, train_here
from tuner_node.build import build_training

GRID = {
    "n_a": 2,
    "width": 0.3,
    "horizon": 40,
    "state_weight": 1.0,
    "action_weight": 1.0,
    "sample_time": 0.02,
    "integration_time": 0.02,
}


@dataclass(frozen=True, kw_only=True)
class Heat(Equation):
    """u_t = D u_xx, from zero: L = -D k^2, no nonlinearity."""

    name = "heat"
    order = 2.0
    diffusivity: float = 0.0

    def linear_operator(self, k: np.ndarray) -> np.ndarray:
        return -self.diffusivity * k**2

    def multiplier(self, k: np.ndarray) -> np.ndarray:
        return np.zeros_like(k)

    @staticmethod
    def nonlinearity(u: float) -> float:
        return 0.0 * u

    def initial_field(self, x: np.ndarray, rng: np.random.Generator | None) -> np.ndarray:
        return np.zeros_like(x)

    def target(self, x: np.ndarray) -> np.ndarray:
        return np.cos(2 * np.pi * x / self.length)


def instrumented(
    equation: Equation | None = None, n_z: int = 32, grid: dict[str, Any] | None = None, **own: Any
) -> InstrumentedPlant:
    values = GRID | (grid or {})
    plant = SpectralPlant(equation or Heat(length=2.0), n_z=n_z, **values)
    return InstrumentedPlant(plant, Instruments(**own))


def run(plant: Plant, seeds: list[int], noise: list[int], actions: float = 0.0) -> np.ndarray:
    """Everything that the plant publishes, (T + 1, M, n)."""
    seen = [plant.reset(seeds, np.array(noise)).copy()]
    for _ in range(plant.horizon):
        seen.append(plant.step(np.full((len(seeds), plant.n_a), actions)).copy())
    return np.array(seen)


# Noise


def test_fields_instead_of_seeds_begin_the_same_episode() -> None:
    for changes in ({}, {"measurement_noise": 0.1, "sensors": 4}):
        drawn, given = (build_plant(parameters(**changes)) for _ in range(2))
        drawn.reset([7, -1])
        fields = drawn.states.copy()
        z = given.reset(fields)
        assert same_bits(given.states, fields)
        assert z.shape == (2, given.state_size)
        for plant in (drawn, given):
            plant.step(np.ones((2, plant.n_a)))
        assert same_bits(given.states, drawn.states)
        for refused in (fields[:, 1:], fields[:0], np.nan * fields):
            with pytest.raises(ValueError, match=r"initial fields must"):
                given.reset(refused)


def test_measurement_noise_is_white_gaussian_of_the_stated_deviation_and_moves_no_field() -> None:
    sigma = 0.3
    plant = instrumented(measurement_noise=sigma)
    v = run(plant, list(range(20)), list(range(100, 120)))  # the field is zero throughout
    assert not plant.states.any()
    count = v.size
    assert count > 25_000
    assert abs(v.mean()) < 4 * sigma / np.sqrt(count)
    assert abs(v.var() / sigma**2 - 1) < 4 * np.sqrt(2 / count)
    assert abs((v**4).mean() / sigma**4 - 3) < 4 * np.sqrt(96 / count)
    for a, b in ((v[1:], v[:-1]), (v[:, 1:], v[:, :-1]), (v[..., 1:], v[..., :-1])):
        assert abs(np.mean(a * b)) < 4 * sigma**2 / np.sqrt(a.size)


@pytest.mark.parametrize(
    ("n_z", "sample_time", "steps"), [(32, 0.02, 40), (32, 0.005, 160), (64, 0.02, 40)]
)
def test_process_noise_has_the_same_statistics_on_any_grid(
    n_z: int, sample_time: float, steps: int
) -> None:
    """Without dynamics a Fourier mode is a Brownian motion: E|c_k|^2 = sigma^2 t / L."""
    sigma, length, envs = 0.2, 2.0, 200
    times = {"sample_time": sample_time, "integration_time": sample_time, "horizon": steps}
    plant = instrumented(n_z=n_z, grid=times, process_noise=sigma)
    run(plant, [0] * envs, list(range(envs)))
    modes = np.fft.rfft(plant.states, axis=1)[:, 1:9] / n_z
    expected = sigma**2 * steps * sample_time / length
    # |c_k|^2 is exponentially distributed: its standard deviation is its mean.
    assert abs((np.abs(modes) ** 2).mean() / expected - 1) < 4 / np.sqrt(8 * envs)


def test_process_noise_comes_to_the_stationary_variance_of_the_heat_equation() -> None:
    """c_k is an Ornstein-Uhlenbeck process, sampled: variance s^2 / (1 - exp(-2 D k^2 dt))."""
    sigma, D, length, envs = 0.2, 0.5, 2.0, 300
    plant = instrumented(
        Heat(length=length, diffusivity=D), grid={"horizon": 120}, process_noise=sigma
    )
    run(plant, [0] * envs, list(range(envs)))
    k = 2 * np.pi * np.arange(1, 6) / length
    modes = np.fft.rfft(plant.states, axis=1)[:, 1:6] / plant.n_z
    dt = plant.sample_time
    expected = sigma**2 * dt / length / (1 - np.exp(-2 * D * k**2 * dt))
    error = (np.abs(modes) ** 2).mean(axis=0) / expected - 1
    assert np.abs(error).max() < 4 / np.sqrt(envs)


def test_noise_is_a_pure_function_of_its_seeds_whatever_stands_beside() -> None:
    plant = instrumented(measurement_noise=0.1, process_noise=0.1)
    together = run(plant, [3, 4, -1], [10, 11, 12], 0.5)
    again = run(plant, [3, 4, -1], [10, 11, 12], 0.5)
    assert same_bits(together, again)
    swapped = run(plant, [-1, 3], [12, 10], 0.5)
    assert same_bits(swapped[:, 0], together[:, 2])
    assert same_bits(swapped[:, 1], together[:, 0])
    other = run(plant, [3, 4, -1], [13, 11, 12], 0.5)
    assert same_bits(other[:, 1:], together[:, 1:])
    assert not (other[:, 0] == together[:, 0]).any()


def test_draws_of_different_seeds_steps_and_kinds_are_different() -> None:
    arguments = [(1, 2, 3, Noise.MEASUREMENT), (2, 2, 3, Noise.MEASUREMENT)]
    arguments += [(1, 1, 3, Noise.MEASUREMENT), (1, 2, 4, Noise.MEASUREMENT)]
    arguments += [(1, 2, 3, Noise.PROCESS), (2**53 - 1, -1, 3, Noise.PROCESS)]
    draws = np.array([standard_normal(*own, 50) for own in arguments])
    assert len(np.unique(draws)) == draws.size
    assert np.abs(np.corrcoef(draws) - np.eye(len(draws))).max() < 0.6


def test_the_cost_is_that_of_the_true_field() -> None:
    noisy, quiet = instrumented(measurement_noise=5.0), instrumented(action_limit=1e6)
    run(noisy, [1, 2], [1, 2], 0.3)
    run(quiet, [1, 2], [1, 2], 0.3)
    assert same_bits(noisy.episode_costs().total, quiet.episode_costs().total)


def test_a_forcing_beyond_the_bound_is_a_divergence_of_one_environment() -> None:
    plant = instrumented(process_noise=1.0, grid={"divergence_bound": 3.0, "horizon": 400})
    seen = run(plant, list(range(8)), list(range(8)))
    assert np.abs(seen).max() <= 3.0
    steps = plant.episode_costs().diverged_step
    assert (steps >= 0).any() and len(set(steps.tolist())) > 1
    m = int(np.argmax(steps))
    held = seen[steps[m] + 1 :, m]
    assert (held == held[0]).all()


# Limits of the actions


def test_actions_saturate_in_the_field_and_in_the_cost() -> None:
    plant, bare = instrumented(action_limit=0.5), instrumented(measurement_noise=1e-300)
    for given, applied in ((3.0, 0.5), (-3.0, -0.5), (0.2, 0.2)):
        run(plant, [1], [0], given)
        run(bare, [1], [0], applied)
        assert same_bits(plant.states, bare.states)
        assert same_bits(plant.episode_costs().mean, bare.episode_costs().mean)


def test_the_law_and_the_exploration_saturate_and_change_nothing_inside() -> None:
    rng = np.random.default_rng(0)
    U, z_r = np.linalg.qr(rng.standard_normal((10, 3)))[0], rng.standard_normal(10)
    free, limited = ProjectedLaw([U], z_r), ProjectedLaw([U], z_r, ActionSet(limit=0.7))
    policies, states = rng.standard_normal((5, 4, 6)), rng.standard_normal((5, 10))
    free.set(policies)
    limited.set(policies)
    a, held = free.actions(states), limited.actions(states)
    inside = np.abs(a) <= 0.7
    assert inside.any() and not inside.all()
    assert same_bits(held[inside], a[inside])
    assert same_bits(held[~inside], 0.7 * np.sign(a[~inside]))
    for balanced in (False, True):
        own = ActionSet(4, [-0.1, 0.0, -np.inf, -1.0], [0.2, 0.5, np.inf, 0.3], balanced)
        bounded = ProjectedLaw([U], z_r, own)
        bounded.set(policies)
        assert same_bits(bounded.actions(states), own.project(a))
    drawn = excitation(1, 2, 200, 1.0)
    assert same_bits(excitation(1, 2, 200, 1.0, ActionSet(limit=0.3)), np.clip(drawn, -0.3, 0.3))


# Sensors


def test_sensors_at_every_point_without_delay_are_the_full_state() -> None:
    values = parameters(sensors=32, sensor_delays=1)
    sensed, full = build_plant(values), build_plant(parameters())
    assert isinstance(sensed, InstrumentedPlant)
    assert sensed.state_size == full.state_size == 32
    assert same_bits(sensed.target, full.target)
    a = run(sensed, [1, 2], [0, 0], 0.3)
    b = run(full, [1, 2], [0, 0], 0.3)
    assert same_bits(a, b)
    for optimizer in ("two_point", "model_based"):
        few = FEW_STEPS if optimizer == "model_based" else {}
        options = {"optimizer": optimizer, "rollouts": 9, **few}
        first = train_here(parameters(**options))
        second = train_here(parameters(**options, sensors=32, sensor_delays=1))
        assert same_bits(first.policies(), second.policies())


def test_the_published_state_is_the_history_of_the_sensors() -> None:
    plant = instrumented(Heat(length=2.0, diffusivity=0.01), sensors=4, sensor_delays=3)
    n_y, d = 4, 3
    assert plant.positions.tolist() == [4, 12, 20, 28]
    scale = np.sqrt(32 / (n_y * d))
    rng = np.random.default_rng(0)
    published, fields = [plant.reset([1]).copy()], [plant.states.copy()]
    for _ in range(6):
        published.append(plant.step(rng.standard_normal((1, 2))).copy())
        fields.append(plant.states.copy())
    for k, own in enumerate(published):
        for j in range(d):
            y = scale * fields[max(k - j, 0)][:, plant.positions]
            assert np.array_equal(own[:, j * n_y : (j + 1) * n_y], y)
    y_r = np.cos(2 * np.pi * plant.plant.x / 2.0)[plant.positions]
    np.testing.assert_allclose(plant.target[: n_y * d], scale * np.tile(y_r, d))


def test_the_weight_of_the_measurements_is_that_of_the_stage_cost() -> None:
    """Over a smooth field that rests, q |o - o_r|^2 is q |z - z_r|^2."""
    plant = instrumented(sensors=8, sensor_delays=4)
    o = plant.reset([0])
    error = float(np.sum((o - plant.target) ** 2))
    field_error = float(np.sum((plant.states - np.cos(2 * np.pi * plant.plant.x / 2.0)) ** 2))
    assert error == pytest.approx(field_error, rel=1e-12)


def test_sensors_are_equally_spaced_and_as_many_as_wanted() -> None:
    for n_z in (32, 100):
        for n_y in range(1, n_z + 1):
            positions = Grid.interval(1.0, n_z).equally_spaced(n_y)
            gaps = np.diff(positions)
            assert len(set(positions.tolist())) == n_y
            assert positions[0] >= 0 and positions[-1] < n_z
            assert n_y == 1 or gaps.max() - gaps.min() <= 1
    with pytest.raises(ValueError, match="at most the 32 grid points"):
        instrumented(sensors=33)


# What they change elsewhere: nothing when they are off


@pytest.mark.parametrize(
    "options",
    [
        {"measurement_noise": 0.1},
        {"process_noise": 0.1},
        {"action_limit": 1.0},
        {"sensors": 8},
        {"sensors": 8, "sensor_delays": 2},
    ],
)
def test_every_option_makes_another_plant(options: dict[str, Any]) -> None:
    known = fingerprint(parameters())
    assert fingerprint(parameters(**options)) != known
    assert fingerprint(parameters(sensor_delays=9)) == known  # without sensors it has no meaning
    assert type(build_plant(parameters())) is SpectralPlant
    assert type(build_plant(parameters(**options))) is InstrumentedPlant


def test_a_start_may_carry_seeds_of_the_noise() -> None:
    protocol = Lockstep(
        build_plant(parameters(measurement_noise=0.1)),
        Timing(action_timeout=0.1, max_repeats=3, run_hold=10.0),
    )

    def start(episode: int, *noise: float) -> Frame:
        return Frame(1, episode, 0, 0.0, np.array([[3.0, -1.0, 0.0, 0.0, *noise]]))

    first, second, third = (
        protocol.start(start(i + 1, *noise), 0.0)[-1].frame.values.copy()
        for i, noise in enumerate([(5.0,), (6.0,), (5.0,)])
    )
    assert same_bits(first, third)
    assert not (first == second).any()
    bare = protocol.start(start(4), 0.0)[-1].frame.values
    assert not (bare == first).any()
    for wrong in (-1.0, 0.5):
        with pytest.raises(FrameError, match="noise seeds"):
            protocol.start(start(5, wrong), 0.0)


@pytest.mark.parametrize("kind", ["measurement_noise", "process_noise"])
def test_rollouts_have_a_noise_of_their_own_and_the_evaluation_one_for_all_controllers(
    kind: str,
) -> None:
    noise: dict[str, Any] = {kind: 0.05}
    values = parameters(**noise, iterations=4, seeds=2, evaluation_fields=3)
    training, seen = build_training(values), []
    original = training.finish

    def watched(result: Any) -> Any:
        batch = training.next_batch()
        assert batch is not None
        seen.append((training.phase, batch.rows.copy()))
        return original(result)

    training.finish = watched  # type: ignore[method-assign]
    train(training, LocalPair(values), lambda row: None)
    adapt = np.concatenate([rows for phase, rows in seen if phase != "evaluate"])
    assert len(np.unique(adapt[:, StartColumn.NOISE])) == len(adapt)
    (closing,) = (rows for phase, rows in seen if phase == "evaluate")
    table = closing[2:, StartColumn.NOISE].reshape(2, 3, 3)
    # The first rollouts of both, once more.
    first = next(rows for phase, rows in seen if phase == "adapt")
    columns = [StartColumn.SEED, StartColumn.NOISE]
    assert (closing[:2, columns] == first[[0, len(first) // 2]][:, columns]).all()
    assert (table == table[0, 0]).all() and len(np.unique(table)) == 3
    assert build_training(parameters()).next_batch().rows.shape == (1, 4)  # type: ignore[union-attr]


@pytest.mark.parametrize("optimizer", ["two_point", "model_based"])
def test_noisy_trainings_are_the_same_again_and_in_any_batch(optimizer: str) -> None:
    options = {
        "measurement_noise": 0.05,
        "process_noise": 0.02,
        "action_limit": 0.8,
        "sensors": 10,
        "sensor_delays": 3,
        "optimizer": optimizer,
        "rollouts": 13,
        "horizon": 10,
        **(FEW_STEPS if optimizer == "model_based" else {}),
    }
    both = train_here(parameters(seeds=2, **options), max_batch=3)
    alone = train_here(parameters(seed=1, **options))
    assert same_bits(alone.policies()[0], both.policies()[1])
    assert same_bits(alone.evaluation[0], both.evaluation[1])


@pytest.mark.parametrize("named", [{"plant": "fitzhugh-nagumo"}, {"source": "wave"}, {}])
@pytest.mark.parametrize(("sensors", "delays"), [(0, 1), (10, 1), (5, 2)])
def test_the_tuner_expects_as_many_readings_with_as_much_noise_as_the_plant_publishes(
    named: dict[str, Any], sensors: int, delays: int
) -> None:
    options: dict[str, Any] = {"sensors": sensors, "sensor_delays": delays, "law": "affine"}
    values = pdeloop.problem(**named, **options, measurement_noise=0.1).values
    seeds = np.arange(100)
    noisy, exact = (
        build_plant({**values, "measurement_noise": noise}).reset(seeds, seeds).copy()
        for noise in (0.1, 0.0)
    )
    assert measured_size(values) == noisy.shape[1]
    expected = build_training(values).settings.measurement_noise
    assert np.std(noisy - exact) == pytest.approx(expected, rel=0.1)


def test_an_instrument_is_only_ideal_without_any() -> None:
    ideal = Instruments(sensor_delays=7)
    assert ideal.ideal
    for name in ("measurement_noise", "process_noise", "action_limit", "sensors"):
        assert not replace(ideal, **{name: 1}).ideal
