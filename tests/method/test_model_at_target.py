# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A model at an unstable target, from rollouts most of which run away from it."""

from __future__ import annotations

import numpy as np

from pdeloop.method.models import Measured
from pdeloop.method.models.linear import fit_linear
from pdeloop.method.models.selection import Selection
from pdeloop.method.reduce.reduced_model import Samples

TARGET = np.array([0.5, 0.2])


def step(z: np.ndarray, a: np.ndarray) -> np.ndarray:
    """A concentration and a temperature; the target is a middle steady state between two others."""
    c, t = z - TARGET
    rate = 0.1 * np.tanh(t / 0.1)
    return z + 0.1 * np.array([-c - rate, 2.0 * rate - 0.5 * t + 0.5 * c + a[0]])


def explored(count: int) -> list[Measured]:
    """Rollouts of random actions from about the target; a rough law holds every second one there."""
    rng, found = np.random.default_rng(5), []
    for i in range(count):
        states, actions = [TARGET + 0.15 * rng.standard_normal(2)], []
        for _ in range(60):
            held = -4.0 * (i % 2) * (states[-1][1:] - TARGET[1:])
            actions.append(held + 0.2 * rng.standard_normal(1))
            states.append(step(states[-1], actions[-1]))
        found.append(Measured(np.array(states), np.array(actions)))
    return found


def slopes() -> tuple[np.ndarray, np.ndarray]:
    """A and B at the target, by central differences."""
    z, a, h = TARGET, np.zeros(1), 1e-6
    A = [(step(z + h * e, a) - step(z - h * e, a)) / (2.0 * h) for e in np.eye(2)]
    return np.array(A).T, ((step(z, a + h) - step(z, a - h)) / (2.0 * h))[:, None]


def test_the_model_is_linear_and_of_what_is_near_to_the_target() -> None:
    A, B = slopes()
    assert np.abs(np.linalg.eigvals(A)).max() > 1.1
    found = Selection(target=TARGET, accepted=0.05).select(explored(12))
    assert found is not None and found.predicts
    own = found.model.linearise(TARGET, np.zeros(1))
    assert np.abs(own[0] - A).max() < 0.07 * np.abs(A).max()
    assert np.abs(own[1] - B).max() < 0.04 * np.abs(B).max()


def test_weights_are_those_of_least_squares() -> None:
    """Steps with weights 2 and 1 are as those of which the former are there twice."""
    rng = np.random.default_rng(1)
    before, actions, after = (rng.standard_normal((30, n)) for n in (3, 1, 3))
    weights = np.repeat([2.0, 1.0], 15)
    twice = np.r_[np.arange(15), np.arange(30)]
    own = fit_linear(Samples(before, actions, after), kind="k", ridge=1e-6, weights=weights)
    other = fit_linear(Samples(before[twice], actions[twice], after[twice]), kind="k", ridge=1e-6)
    assert own is not None and other is not None
    for name in ("A", "B", "constant"):
        np.testing.assert_allclose(getattr(own, name), getattr(other, name), rtol=1e-9, atol=1e-12)
