# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Delays of inputs are found in held-out steps, and the law of a plant with dead time is optimal."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import linalg

from pdeloop.log_effects import delay_text
from pdeloop.messages.cost import Cost
from pdeloop.messages.model_rows import ModelRows
from pdeloop.method.design.lqg import with_dead_time
from pdeloop.method.design.lqt import track
from pdeloop.method.laws.linear import Observer
from pdeloop.method.reduce.input_delay import shifted, study_delays
from pdeloop.method.reduce.reduced_model import ReducedModel

A = np.array([[0.9, 0.05, 0, 0], [0.05, 0.85, 0.05, 0], [0, 0.05, 0.85, 0.05], [0, 0, 0.05, 0.9]])
B = np.array([[0.1, 0.0], [0.02, 0.0], [0.0, 0.03], [0.0, 0.12]])
K = -np.array([[2.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 2.0]])


CASES: list[dict[str, Any]] = [{}, {"noise": 0.5}, {"held": 10}, {"noise": 0.0}]


def logged(
    delays: tuple[int, int],
    *,
    noise: float = 0.02,
    process: float = 0.0,
    feedback: float = 0.0,
    held: int = 1,
    seed: int = 0,
    steps: int = 200,
    drawn: float = 10.0,
) -> tuple[np.ndarray, np.ndarray]:
    rng, z, a = np.random.default_rng(seed), np.zeros((steps + 1, 4)), np.zeros((steps, 2))
    excitation = np.zeros(2)
    for k in range(steps):
        again = drawn * rng.normal(size=2)
        excitation = again if k % held == 0 else excitation
        a[k] = excitation + feedback * K @ z[k]
        acting = [a[k - n, j] if k >= n else 0.0 for j, n in enumerate(delays)]
        z[k + 1] = A @ z[k] + B @ acting + process * rng.normal(size=4)
    return z + noise * rng.normal(size=z.shape), a


@pytest.mark.parametrize(
    ("delays", "case"),
    [
        *(((0, 0), case) for case in CASES),
        *(((0, 3), case) for case in CASES),
        *((delays, {}) for delays in ((1, 1), (3, 3), (10, 10), (4, 1))),
    ],
)
def test_the_delay_of_each_input_is_found(delays: tuple[int, int], case: dict[str, Any]) -> None:
    z, a = logged(delays, **case)
    assert study_delays([(z, a)]).best == delays
    # The same with each input logged a row late.
    assert study_delays([(z[1:-1], a[:-2])]).best == tuple(n - 1 for n in delays)


@pytest.mark.parametrize("late", [(1, 1), (6, 6), (0, 2), (1, 3)])
@pytest.mark.parametrize("held", [1, 10])
def test_inputs_logged_some_rows_late_are_not_taken_for_feedback(
    late: tuple[int, int], held: int
) -> None:
    z, a = logged((0, 0), held=held, steps=400)
    written = np.stack(
        [a[np.maximum(np.arange(400) - n, 0), j] for j, n in enumerate(late)], axis=1
    )
    assert study_delays([(z, written)]).best == tuple(-n for n in late)


@pytest.mark.parametrize("dither", [0.1, 1.0])
@pytest.mark.parametrize("held", [1, 10])
@pytest.mark.parametrize("seed", range(2))
def test_a_law_with_weak_excitation_is_not_logged_late(dither: float, held: int, seed: int) -> None:
    """The states say more of each input than the inputs do of them."""
    for noise in (0.0, 0.02):
        known = logged(
            (0, 0), drawn=dither, process=0.3, feedback=1.0, noise=noise, held=held, seed=seed
        )
        assert study_delays([known]).best == (0, 0)


def test_a_dead_time_beyond_the_range_is_looked_for_further_on_or_said_to_be_unclear() -> None:
    assert study_delays([logged((12, 12), held=5, steps=400)]).best == (12, 12)
    found = study_delays([logged((12, 12), held=5, steps=85)])
    assert found.best == found.at_end * 2 == (10, 10)
    text = delay_text(found)
    assert "at least 10 rows later" in text and "how many rows is not clear" in text


@pytest.mark.parametrize("seed", range(2))
def test_feedback_and_idle_inputs_are_no_delay(seed: int) -> None:
    for known in (
        logged((0, 0), process=10.0, feedback=1.0, seed=seed, steps=1000),
        logged((0, 0), process=1.0, feedback=1.0, seed=seed),
        logged((0, 0), feedback=1.0, seed=seed),
    ):
        assert study_delays([known]).best == (0, 0)
    z, a = logged((0, 0), process=1.0, seed=seed)
    assert study_delays([(z, np.random.default_rng(9).normal(size=a.shape))]).best == (0, 0)


@pytest.mark.parametrize("late", [0, 3])
@pytest.mark.parametrize("seed", range(2))
def test_an_input_without_effect_that_follows_the_state_is_not_logged_late(
    late: int, seed: int
) -> None:
    """The next row of it tells the next state exactly; the other input is held, and moves the plant."""
    rng, z, a = np.random.default_rng(seed), np.zeros((501, 4)), np.zeros((500, 2))
    for k in range(500):
        held = a[k - 1, 0] if k and rng.random() > 0.1 else rng.normal()
        a[k] = held, -z[max(k - late, 0), 3]
        z[k + 1] = A @ z[k] + B[:, 0] * held + 0.05 * rng.normal(size=4)
    assert study_delays([(z, a)]).best == (0, 0)


def test_a_delay_that_hardly_lowers_the_errors_is_none() -> None:
    """Slow sensors of two of four states: 1.06 to 1.09 times smaller, and there is no dead time."""
    for seed in range(6):
        rng, lag = np.random.default_rng(seed), 0.8
        x, z, a = np.zeros(4), np.zeros((501, 4)), np.zeros((500, 2))
        for k in range(500):
            a[k] = rng.normal(size=2) if k % 20 == 0 else a[k - 1]
            x = A @ x + B @ a[k] + 0.02 * rng.normal(size=4)
            z[k + 1] = lag * z[k] + (1.0 - lag) * x
        seen = z[:, [0, 3]] + 0.05 * rng.normal(size=(501, 2))
        assert study_delays([(seen, a)]).best == (0, 0)


def test_the_gain_is_the_ratio_of_errors() -> None:
    # At the wrong delay the error of each state is the effect of its input, 10 |B|, at the right one
    # the noise of a measurement and of its prediction.
    z, a = logged((2, 2), steps=4000)
    wrong = 100.0 * np.diag(B @ B.T)
    found = study_delays([(z, a)])
    right = 0.02**2 * (1.0 + np.diag(A @ A.T))
    assert found.gain == pytest.approx(np.sqrt(np.mean(wrong / right)), rel=0.03)
    text = delay_text(found, sample_time=0.5)
    assert "2 rows later" in text and "dead time of 1 s" in text and "--input-delay=2" in text
    assert delay_text(study_delays([(z, a)], (2, 2))) == ""
    assert "one row earlier" in delay_text(study_delays([(z, a)], (3, 3)))


@pytest.mark.parametrize("n", [1, 3])
def test_the_law_of_a_dead_time_is_that_of_the_predicted_state(n: int) -> None:
    P = linalg.solve_discrete_are(A, B, np.eye(4), 0.01 * np.eye(2))
    gain = -np.linalg.solve(0.01 * np.eye(2) + B.T @ P @ B, B.T @ P @ A)
    none, target = np.zeros((2, 4)), np.array([2.0, 1.5, 1.5, 2.0])
    weights: dict[str, Any] = {"state_weight": 1.0, "action_weight": 0.01}
    rows = ModelRows(A, B, np.eye(4), none, none, np.zeros(4))
    found = with_dead_time(rows, (n, n), Cost(4, 2, 1, **weights))
    powers = [np.linalg.matrix_power(A, i) for i in range(n + 1)]
    expected = np.zeros((2, 4 + 2 * n))
    expected[:, :4] = gain @ powers[n]
    for i in range(n):  # a_{k-1-i}
        for j in range(2):
            expected[:, 4 + n * j + i] = gain @ powers[i] @ B[:, j]
    np.testing.assert_allclose(found.K_a, expected, atol=1e-9)
    # On the plant: nothing can be done about the first n steps, and the rest costs what it does
    # without a delay.
    start = np.array([1.0, -1.0, 2.0, 0.5])
    cost, _ = cost_with_delay(found, n, start)
    free = [power @ start for power in powers]
    least = sum(float(z @ z) for z in free[:n]) + float(free[n] @ P @ free[n])
    assert cost == pytest.approx(least, rel=1e-9)
    # To a target it comes to rest where the law without a delay does.
    at_target = with_dead_time(
        replace(rows, s_r=target), (n, n), Cost(4, 2, 1, target=target, **weights)
    )
    _, last = cost_with_delay(at_target, n, start)
    direct = track(ReducedModel(A, B), **weights)
    rest = np.linalg.solve(np.eye(4) - A - B @ direct.K_a, B @ direct.K_b @ target)
    np.testing.assert_allclose(last, rest, atol=1e-9)


def test_the_law_of_a_dead_time_begins_with_the_inputs_of_the_rest() -> None:
    """At rest under 50 and 60 per cent, which is the target: nothing is to be done."""
    held, none, weights = np.array([50.0, 60.0]), np.zeros((2, 4)), {"state_weight": 1.0}
    rest = np.linalg.solve(np.eye(4) - A, B @ held)
    cost = Cost(4, 2, 1, **weights, action_weight=1e-9, target=rest)
    rows = ModelRows(A, B, np.eye(4), none, none, rest)
    law = Observer(with_dead_time(rows, (3, 0), cost, held), 1)
    first = law.action(law.parts(law.theta_start), rest, law.memory_start(), 0)
    np.testing.assert_allclose(first, held, rtol=1e-4)


def cost_with_delay(model: ModelRows, n: int, z: np.ndarray) -> tuple[float, np.ndarray]:
    """The law `observer` on the plant whose actions act n steps late: cost, last state."""
    law = Observer(model, 600)
    theta, memory, late, cost = (
        law.parts(law.theta_start),
        law.memory_start(),
        [np.zeros(2)] * n,
        0.0,
    )
    for k in range(600):
        a = law.action(theta, z, memory, k)
        memory = law.memory_update(theta, z, memory, a, k)
        cost += float(z @ z + 0.01 * a @ a)
        late.append(a)
        z = A @ z + B @ late.pop(0)
    return cost, z


def test_shifts_need_rows() -> None:
    z, a = logged((0, 0), steps=5)
    with pytest.raises(ValueError, match="no trajectory has more steps"):
        shifted([(z, a)], (5, 0))


@pytest.mark.parametrize(("noise", "held"), [(3.0, 1), (3.0, 5), (1.0, 12), (2.0, 5)])
def test_a_delay_that_the_data_do_not_tell_from_others_is_not_clear(
    noise: float, held: int
) -> None:
    found = [study_delays([logged((3, 3), noise=noise, held=held, seed=s)]) for s in range(10)]
    sure = [study.best for study in found if any(study.best) and not study.alike]
    assert set(sure) <= {(3, 3)}
    for study in found:
        assert ("not clear" in delay_text(study)) == bool(study.alike)
        assert study.best not in study.alike
    if held > 1:  # neighbouring delays have nearly the same inputs
        assert any(study.alike for study in found)


def test_a_delay_with_little_noise_is_clear() -> None:
    assert study_delays([logged((3, 3))]).alike == ()
