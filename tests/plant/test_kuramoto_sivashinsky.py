# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The two published Kuramoto-Sivashinsky plants: growth rates, conservation, order."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from pde_sim_node.plants.kuramoto_sivashinsky_eight import KuramotoSivashinskyEight
from pde_sim_node.plants.kuramoto_sivashinsky_four import KuramotoSivashinskyFour


def _wave(plant: Any, number: int) -> tuple[Any, float]:
    k = 2 * math.pi * number / plant.grid.axes[0].length
    return np.cos(k * plant.grid.axes[0].points), k


@pytest.mark.parametrize("number", [1, 3, 9])
def test_small_waves_grow_at_the_rate_of_their_linear_part(number: int) -> None:
    """By (1 + dt l / 2) / (1 - dt l / 2) a step, l = k^2 - k^4, in the spectral scheme of the one."""
    plant = KuramotoSivashinskyEight()
    wave, k = _wave(plant, number)
    z, half = 1e-9 * wave[None], 0.5 * plant.sample_time * (k**2 - k**4)
    for _ in range(20):
        z = plant.step(z, np.zeros((1, 8)))
    assert np.abs(z[0] - 1e-9 * ((1 + half) / (1 - half)) ** 20 * wave).max() < 1e-16


def test_small_waves_grow_at_the_exact_rate_at_sixth_order() -> None:
    errors = []
    for points in (16, 32):
        plant = KuramotoSivashinskyFour(points)
        wave, k = _wave(plant, 2)
        z = plant.step(1e-7 * wave[None], np.zeros((1, 4)))[0] / 1e-7
        errors.append(float(np.abs(z - math.exp(0.25 * (k**2 - k**4)) * wave).max()))
    assert errors[1] < 1e-6 and 5.5 < np.log2(errors[0] / errors[1]) < 6.8, errors


def test_the_mean_of_the_field_is_that_of_what_the_inputs_bring() -> None:
    plant = KuramotoSivashinskyEight(burn_in=200)
    z = plant.initial_state(np.random.default_rng(0))[None]
    a = np.linspace(-1.0, 1.0, 8)[None]
    brought = plant.sample_time * float(plant.supports.mean(axis=0) @ a[0])
    after = plant.step(plant.step(z, a), a)
    assert after.mean() == pytest.approx(z.mean() + 2 * brought, abs=1e-14)


@pytest.mark.parametrize("plant", [KuramotoSivashinskyEight(), KuramotoSivashinskyFour()])
def test_finer_time_steps_converge(plant: Any) -> None:
    """At second order the one; the other's own error at its steps is that of rounding."""
    x = plant.grid.axes[0].points
    z = (np.sin(2 * np.pi * x / x[-1]) ** 2 * np.cos(x))[None]
    a = np.linspace(-0.5, 1.0, plant.n_a)[None]
    found, steps = [], round(0.5 / plant.sample_time)
    for _ in range(3):
        u = z
        for _ in range(steps):
            u = plant.step(u, a)
        found.append(u[0])
        plant = plant.refined()
    errors = [float(np.abs(u - found[-1]).max()) for u in found[:-1]]
    if isinstance(plant, KuramotoSivashinskyEight):
        assert errors[0] < 2e-2 and errors[0] / errors[1] > 4.5  # 5 = (1 - 1/16) / (1/4 - 1/16)
    else:
        assert max(errors) < 1e-4, errors


def test_both_plants_agree_where_both_resolve_the_same_equation() -> None:
    """With whole jets of one shape, on a field that 64 points and both schemes resolve."""
    four = KuramotoSivashinskyFour(wrapped=True)
    eight = KuramotoSivashinskyEight(viscosity=(2 * math.pi / 22.0) ** 2, substeps=64)
    wave, _ = _wave(four, 1)
    z = (0.5 * wave)[None]
    one, other = z, z
    for _ in range(8):
        one = four.step(one, np.zeros((1, 4)))
        for _ in range(5):
            other = eight.step(other, np.zeros((1, 8)))
    assert np.abs(one - other).max() < 2e-3 < 0.05 < np.abs(one - z).max()


def test_the_first_jet_is_half_of_one_unless_distances_are_wrapped() -> None:
    """As measured on the released environment: integrals 0.425 and 0.632, peak 0.631."""
    dx = 22.0 / 64
    half, whole = (KuramotoSivashinskyFour(wrapped=w).supports for w in (False, True))
    assert half[:, 0].sum() * dx == pytest.approx(0.425, abs=5e-4)
    assert whole[:, 0].sum() * dx == pytest.approx(0.634, abs=2e-3)
    assert half[0, 0] == pytest.approx(0.631, abs=1e-3)
    assert np.abs(half - whole)[:, 1:].max() < 1e-20


def test_starts_are_on_the_attractor_and_batches_change_nothing() -> None:
    plant = KuramotoSivashinskyEight()
    starts = np.stack([plant.initial_state(np.random.default_rng(s)) for s in range(4)])
    assert 0.9 < np.sqrt(np.mean(starts**2)) < 1.4  # 1.14 over many
    a = np.random.default_rng(0).uniform(-1, 1, (4, 8))
    both = plant.step(starts, a)
    for m in range(4):
        assert np.array_equal(plant.step(starts[m : m + 1], a[m : m + 1])[0], both[m])


def test_an_action_may_be_held_over_several_time_steps_and_actuators_may_begin_elsewhere() -> None:
    plant, held = (
        KuramotoSivashinskyEight(first=1 / 16),
        KuramotoSivashinskyEight(first=1 / 16, sample_time=0.5, substeps=10),
    )
    rng = np.random.default_rng(0)
    z, a = rng.standard_normal((1, 64)), rng.uniform(-1.0, 1.0, (1, 8))
    after = held.step(z, a)
    for _ in range(10):
        z = plant.step(z, a)
    assert np.array_equal(z, after)
    usual = KuramotoSivashinskyEight().supports
    assert np.allclose(plant.supports, np.roll(usual, 4, axis=0), atol=1e-12)


@pytest.mark.parametrize(
    ("kind", "arguments", "words"),
    [
        (KuramotoSivashinskyEight, {"points": 63}, "points must be even, got 63"),
        (
            KuramotoSivashinskyEight,
            {"viscosity": math.nan},
            "viscosity must be positive and finite",
        ),
        (KuramotoSivashinskyEight, {"sample_time": 0.0}, "sample_time must be positive and finite"),
        (KuramotoSivashinskyEight, {"first": math.nan}, "first must be a finite number, got nan"),
        (KuramotoSivashinskyFour, {"points": 8}, "points must be at least 16, got 8"),
        (KuramotoSivashinskyFour, {"bound": -1.0}, "bound must be positive and finite, got -1.0"),
    ],
)
def test_unusable_arguments_are_named(kind: Any, arguments: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        kind(**arguments)
