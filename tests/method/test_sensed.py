# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A differential equation, its actuators and the fields are found from a few point sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

import pdeloop
from pdeloop.episode import rollout
from pdeloop.method.models import sensed_fit
from pdeloop.method.models.sensed import (
    Actuators,
    SensedEquation,
    coefficients_of,
    grid_points,
    interpolated,
    sensed_model,
)
from pdeloop.method.models.sensed_fit import fit_sensed, part_by_part
from pdeloop.method.models.sensed_growth import Found
from pdeloop.method.models.sensed_problem import SensedProblem
from pdeloop.method.models.sensed_unknowns import COEFFICIENTS, SHARED, TERMS, unknowns
from pdeloop.method.models.settings import (
    DEFAULTS,
    SENSED_HELD_RIDGE,
    SENSED_HOPELESS,
    SENSED_REPRODUCED,
)
from pdeloop.method.models.spectral import SpectralModel
from tests.support.sensed import DECLARED, SENSORS, equally_spaced, readings_of
from tests.support.small import same_bits

Array = np.ndarray
FIELD = 11
FEW_ITERATIONS = replace(DEFAULTS, sensed_iterations=2)
"""For readings that no equation explains, on which iterations are spent in vain."""


def _fitted(problem: pdeloop.Problem, seed: int) -> tuple[SpectralModel, Array, float]:
    """From an exploration and a rollout without control."""
    plant = problem.plant()
    explored, actions = problem.explore(seed)
    uncontrolled = rollout(plant, lambda k, y: np.zeros((1, plant.n_a)), [FIELD])
    readings = np.stack([explored[:-1], uncontrolled.states[:-1, 0]])
    positions = problem.values["actuator_positions"]
    actuators = (
        Actuators(np.array(positions), np.zeros(plant.n_a))
        if positions
        else equally_spaced(plant.n_a)
    )
    with threadpool_limits(1):
        shared, fields, error = fit_sensed(
            readings,
            [actions, uncontrolled.actions[:, 0]],
            actuators,
            problem.values["measurement_noise"] * _scale(problem),
        )
    return sensed_model(shared, SENSORS, actuators, _largest(fields)), fields, error


def _largest(fields: Array) -> float:
    return float(np.abs(fields).max())


def _step(model: SpectralModel, z: Array, a: Array) -> Array:
    """One state a sampling time later."""
    return model.step(z[None], a[None])[0]


def test_the_cost_of_a_rollout_tells_of_the_field_between_the_sensors() -> None:
    problem = pdeloop.problem("allen-cahn", sensors=SENSORS, horizon=18)
    plant = problem.plant()
    explored, excited = problem.explore(1000)
    uncontrolled = rollout(plant, lambda k, y: np.zeros((1, plant.n_a)), [FIELD])
    readings = np.stack([explored[:-1], uncontrolled.states[:-1, 0]])
    actions = [excited, uncontrolled.actions[:, 0]]
    distance = float(uncontrolled.costs.mean[0]) / (plant.state_weight * SENSORS)

    def off(*known: Array) -> float:
        """The relative error of the simulated distance from the target."""
        with threadpool_limits(1):
            actuators = equally_spaced(plant.n_a)
            shared, fields, error = fit_sensed(readings, actions, actuators, 0.0, None, *known)
        assert error < 1e-5
        model = sensed_model(shared, SENSORS, actuators, _largest(fields))
        z, target, squares = fields[1], interpolated(plant.target), []
        for action in actions[1]:
            squares.append(np.mean((z - target) ** 2))
            z = _step(model, z, action)
        return abs(float(np.mean(squares)) / distance - 1.0)

    told = off(plant.target, np.array([np.nan, distance]))
    assert told < 1e-3 and off() > 10.0 * told


def _scale(problem: pdeloop.Problem) -> float:
    """What the published readings are multiplied by."""
    return float(np.sqrt(problem.values["n_z"] / SENSORS))


def test_the_kdv_equation_is_found_from_eight_sensors() -> None:
    """u_t = -u_xxx + 3 (u^2)_x on a domain of length 20; the soliton is not seen in the beginning."""
    problem = pdeloop.problem("kdv", sensors=SENSORS, horizon=50)
    plant = problem.plant()
    model, fields, error = _fitted(problem, 1000)
    assert error < 1e-5
    transport, diffusion, dispersion, quadratic = _coefficients(model)
    assert dispersion == pytest.approx(-1 / 20**3, rel=0.02)
    assert quadratic * _scale(problem) == pytest.approx(3 / 20, rel=0.02)
    assert abs(transport) < 1e-3 and abs(diffusion) < 5e-5
    plant.reset([FIELD])
    true = _scale(problem) * plant.states[0, :: plant.n_z // fields.shape[1]]
    assert np.linalg.norm(fields[1] - true) < 0.01 * np.linalg.norm(true)


def test_noise_does_not_hide_the_allen_cahn_equation() -> None:
    """u_t = 0.0025 u_xx + 5 u - 5 u^3 on a domain of length 2."""
    problem = pdeloop.problem("allen-cahn", sensors=SENSORS, horizon=40, measurement_noise=0.03)
    model, _, error = _fitted(problem, 1000)
    assert error < 1e-4
    small, none = 1e-3, np.zeros(model.B.shape[1])
    still = _step(model, np.zeros(len(model.B)), none)
    growth = (_step(model, np.full(len(model.B), small), none) - still) / small
    assert np.mean(growth) == pytest.approx(np.exp(0.05), rel=0.015)


def test_actuators_need_not_be_equally_spaced() -> None:
    positions = [0.1, 0.22, 0.55]
    strong = {"actuator_positions": positions, "n_a": 3, "exploration_variance": 4.0}
    problem = pdeloop.problem("allen-cahn", sensors=SENSORS, horizon=30, **strong)
    model, _, error = _fitted(problem, 1000)
    assert error < 1e-4
    x = np.arange(len(model.B)) / len(model.B)
    effect = np.abs(model.B)
    np.testing.assert_allclose(x @ effect / effect.sum(axis=0), positions, atol=0.02)


def _coefficients(model: SpectralModel) -> Array:
    """c_11, c_12, c_13, c_21 per second, of a sampling time of 0.01 s."""
    small, n = 1e-4, len(model.B)
    x = np.arange(n) / n
    none = np.zeros(model.B.shape[1])
    still = _step(model, np.zeros(n), none)

    def effect(z: Array) -> Array:
        """dz/dt in Fourier space."""
        return np.fft.rfft(_step(model, z, none) - still - z) / (0.01 * n / 2)

    one, two = (effect(small * np.cos(2 * np.pi * k * x))[k] / small for k in (1, 2))
    k = 2 * np.pi
    # i k c_1 - k^2 c_2 - i k^3 c_3 at the first two wavenumbers.
    transport, dispersion = np.linalg.solve(
        [[k, -(k**3)], [2 * k, -8 * k**3]], [one.imag, two.imag]
    )
    (diffusion,) = np.linalg.lstsq(np.array([[3 * k**2]]), np.array([one.real - two.real]))[0]
    bent = effect(0.01 * np.cos(k * x))
    quadratic = bent[2].imag / (2 * k * 0.5 * 0.01**2)
    return np.array([transport, diffusion, dispersion, quadratic])


def test_the_burgers_equation_is_found_from_fronts() -> None:
    """u_t = -u u_x + nu u_xx; nu is that of a coarse grid."""
    problem = pdeloop.problem("burgers", sensors=16, horizon=10, measurement_noise=0.03)
    plant = problem.plant()
    explored, actions = problem.explore(1000)
    uncontrolled = rollout(plant, lambda k, y: np.zeros((1, plant.n_a)), [FIELD])
    scale, actuators = np.sqrt(plant.n_z / 16), equally_spaced(plant.n_a)
    with threadpool_limits(1):
        shared, _, error = fit_sensed(
            [explored[:-1], uncontrolled.states[:-1, 0]],
            [actions, uncontrolled.actions[:, 0]],
            actuators,
            0.03 * scale,
            settings=replace(DEFAULTS, sensed_iterations=6, sensed_last_iterations=15),
        )
    assert error < SENSED_REPRODUCED
    square = SensedEquation(shared, grid_points(16), actuators).symbols[1]
    # -1/2 (u^2)_x of readings that are scaled, in a sampling time of 0.05.
    assert square[1].imag == pytest.approx(-0.05 * np.pi / scale, rel=0.15)


def test_what_a_part_of_a_rollout_does_not_determine_may_come_back_over_a_longer_one() -> None:
    """Ridges of a part follow from its readings alone; over whole rollouts they add up."""
    rng = np.random.default_rng(3)
    readings, actions = rng.standard_normal((1, 12, 4)), rng.standard_normal((1, 12, 2))
    known = np.zeros(4), np.full(1, np.nan)
    problem = SensedProblem(readings, actions, equally_spaced(2), 0.5, *known)
    shared = 0.1 * rng.standard_normal(unknowns(2))
    dispersion = TERMS.index((1, 3))

    def ridges(steps: int, before: float) -> Array:
        problem.prior.precision = np.full(len(shared), before)
        return problem._relevant(shared, problem.interpolated(), steps)

    assert same_bits(ridges(6, 0.0), ridges(6, 1e6))
    assert ridges(12, 1e6)[dispersion] > 2.0 * ridges(12, 0.0)[dispersion]


def test_noise_does_not_make_short_waves_grow() -> None:
    """The readings are noise: a fit may only take it for fields of a well-posed equation."""
    rng = np.random.default_rng(1)
    readings, actions = rng.standard_normal((1, 20, 4)), rng.standard_normal((1, 20, 2))
    known = np.zeros(4), np.full(1, np.nan)
    problem = SensedProblem(readings, actions, equally_spaced(2), 0.1, *known)
    with threadpool_limits(1):
        shared = problem.fit(np.zeros(problem.shared), problem.interpolated())[1]
    assert shared[TERMS.index((1, 2))] >= 0.0 >= shared[TERMS.index((3, 0))]
    growth = SensedEquation(shared, grid_points(4), equally_spaced(2)).symbols[0].real
    assert growth[-2] <= growth[0]


def test_readings_that_no_equation_explains_are_given_up_early() -> None:
    rng = np.random.default_rng(0)
    readings, actions = rng.standard_normal((2, 40, 4)), rng.standard_normal((2, 40, 2))
    simulated = []

    class Counted(SensedProblem):
        def _residuals(
            self, shared: Array, fields: Array, steps: int, varied: Sequence[int] = ()
        ) -> Array:
            simulated.append(steps)
            return super()._residuals(shared, fields, steps, varied)

    with pytest.MonkeyPatch.context() as patch, threadpool_limits(1):
        patch.setattr(sensed_fit, "SensedProblem", Counted)
        _, fields, error = fit_sensed(
            list(readings), list(actions), equally_spaced(2), settings=FEW_ITERATIONS
        )
    assert error == np.inf and np.isfinite(fields).all()
    assert max(simulated) < 40


def test_actuators_have_the_declared_width_unless_readings_say_otherwise() -> None:
    n, shared = grid_points(SENSORS), np.zeros(unknowns(3))
    centres, unequal = equally_spaced(3).centres, np.array([0.1, 0.2, 0.05])
    for actuators, widths in (
        (Actuators(centres, unequal), unequal),
        (equally_spaced(3), 0.5 / 3),
    ):
        supports = SensedEquation(shared, n, actuators).supports
        np.testing.assert_allclose(supports.mean(axis=0), widths)


def test_noise_at_the_beginning_of_rollouts_moves_no_actuator() -> None:
    """What an equation does would be taken for it; over whole rollouts each may be where it is."""
    rng, actuators, sigma = np.random.default_rng(5), DECLARED, 0.1
    shared = np.zeros(unknowns(3))
    shared[[TERMS.index((1, 0)), COEFFICIENTS]] = 1.0, 5.0
    shared[SHARED:] = 0.0, 3.0, -3.0
    model = sensed_model(shared, SENSORS, actuators, 4.0)
    actions = 5.0 * rng.standard_normal((2, 30, 3))
    readings = np.stack([readings_of(model, own, np.zeros(model.n_z)) for own in actions])
    readings += sigma * rng.standard_normal(readings.shape)
    found = []

    class Recorded(SensedProblem):
        def fit(self, *given: Array, **options: Any) -> tuple[float, Array, Array]:
            found.append(super().fit(*given, **options))
            return found[-1]

    problem = Recorded(readings, actions, actuators, sigma, np.zeros(SENSORS), np.full(2, np.nan))
    with threadpool_limits(1):
        last = part_by_part(problem, shared, problem.interpolated())[1]
    before = found[0][1]
    assert np.abs(before[COEFFICIENTS + 1 :]).max() < 0.1
    np.testing.assert_allclose(last[SHARED:], [0.0, 3.0, -3.0], atol=1.0)
    fits = len(found)
    given_up = part_by_part(problem, shared, problem.interpolated(), -1.0)
    assert np.isinf(given_up[0]) and len(found) == fits + 1 and not problem.prior.place_ridge


def test_two_noisy_rollouts_are_not_the_last_word_on_an_equation() -> None:
    """It is fitted to all rollouts from their beginning, from what two suggest and from nothing.

    So is an equation of earlier rollouts, from which no descent may lead to a likelier one. Of errors
    that are all below the noise the least is no better: the likeliest unknowns are taken.
    """
    rng, actuators = np.random.default_rng(6), DECLARED
    readings, actions = rng.standard_normal((3, 12, SENSORS)), rng.standard_normal((3, 12, 3))
    starts: list[Array] = []
    mosts: list[tuple[float, ...]] = []
    spreads: list[Array | None] = []
    likelier, dispersion = np.zeros(unknowns(3)), TERMS.index((1, 3))

    def recorded(problem: SensedProblem, start: Array, *given: Any) -> tuple[float, Array, Array]:
        starts.append(start)
        mosts.append(given[1:])
        spreads.append(problem.prior.spread)
        return worse, likelier, np.zeros_like(problem.interpolated())

    ridges, guess = [], sensed_fit._first_guess

    def guessed(problem: SensedProblem, *given: Any) -> Found:
        ridges.append(problem.prior.place_ridge)
        return guess(problem, *given)

    compared: list[tuple[SensedProblem, Array]] = []
    told: list[float] = []
    truly = SensedProblem.implausibility

    def off(problem: SensedProblem, x: Array, fields: Array) -> float:
        spreads.append(problem.prior.spread)
        compared.append((problem, fields))
        return told.pop(0) if told else abs(x[0] - wanted)

    with pytest.MonkeyPatch.context() as patch, threadpool_limits(1):
        patch.setattr(sensed_fit, "part_by_part", recorded)
        patch.setattr(sensed_fit, "_first_guess", guessed)
        patch.setattr(SensedProblem, "implausibility", off)
        # Of noise alone, which any equation explains.
        few = {"settings": replace(FEW_ITERATIONS, sensed_starts=1, sensed_varying=1.0)}
        worse, wanted = 1.0, 0.0
        shared, fields, _ = fit_sensed(readings, actions, actuators, 1.0, None, **few)
        assert same_bits(shared, likelier) and len(starts) == 2
        worse, wanted = 0.0, 1e9
        shared, fields, _ = fit_sensed(readings, actions, actuators, 1.0, None, **few)
        assert shared.any() and len(starts) == 4
        again = fit_sensed(readings, actions, actuators, 1.0, shared, **few)[0]
        assert again.any() and len(starts) == 5
        for guessed_start, start in ((starts[2], starts[3]), (shared, starts[4])):
            assert start[dispersion] == guessed_start[dispersion] and np.sum(start != 0.0) <= 1
        fit_sensed(readings, actions, actuators, 1.0, shared, near=fields, **few)
        assert len(starts) == 5
        # Given up: what it had reached is no fit.
        worse, wanted = np.inf, 0.0
        again = fit_sensed(readings, actions, actuators, 1.0, shared, **few)[0]
        assert again.any() and len(starts) == 6
        assert mosts == [(), (SENSED_HOPELESS,)] * 2 + [(SENSED_HOPELESS,)] * 2
        # A spread that followed from an earlier equation holds neither a third fit nor the choice.
        every_other = replace(few["settings"], sensed_compared=6)
        worse, known = 0.0, {"settings": every_other, "spread": np.full(33, 0.1)}
        for nats, chosen in ((25.0, again), (35.0, likelier)):
            gain = 2.0 * nats * compared[-1][0].noise / (readings.size / 2)
            told[:], spreads[:] = [0.0, 1.0, gain, 0.0], []
            found, kept, _ = fit_sensed(readings, actions, actuators, 1.0, shared, **known)
            assert found.any() == chosen.any() and not told
            assert [own is None for own in spreads] == [False] * 3 + [True] * 3
            # For the comparison it has its likeliest fields, and it keeps those that the spread held.
            problem, likeliest = compared[-2]
            problem.prior.spread = None
            if found.any():
                held = coefficients_of(kept)
                assert truly(problem, found, likeliest) < truly(problem, found, held)
    # What two of them have to say of each actuator is noise.
    assert ridges == [SENSED_HELD_RIDGE] * 2
    # Nobody says where those of a plant of one's own are.
    free = SensedProblem(readings, actions, equally_spaced(3), 1.0, readings[0, 0], np.ones(3))
    assert not free.holds


def test_the_likeliest_unknowns_are_so_whatever_a_fit_found_relevant() -> None:
    """The shift of actuators without strength changes no reading: all it costs is the prior."""
    rng = np.random.default_rng(8)
    readings, actions = rng.standard_normal((2, 12, SENSORS)), rng.standard_normal((2, 12, 3))
    nowhere = np.zeros(SENSORS), np.full(2, np.nan)
    problem = SensedProblem(readings, actions, DECLARED, 0.5, *nowhere)
    shared, fields = np.zeros(unknowns(3)), problem.interpolated()
    before = problem.implausibility(shared, fields)
    shared[COEFFICIENTS + 1] = 3.0
    moved = problem.implausibility(shared, fields)
    # With errors as shares of the readings' mean square, each of the readings counts 1 / number.
    variance = 0.5**2 / np.sum(readings**2)
    assert moved - before == pytest.approx(variance * (3.0 / 10.0) ** 2, rel=1e-3)
    problem.prior.place_ridge = 7.0
    problem.fit(shared, fields, lengths=[4])
    assert problem.implausibility(shared, fields) == moved
