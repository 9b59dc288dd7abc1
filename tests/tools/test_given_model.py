# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Trainings that begin from the matrices of a model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy  # whose signal module loads when it is used

import pdeloop
from pdeloop.cli import FAILED, main

A = np.array([[0.9, 0.05, 0.0], [0.05, 0.85, 0.05], [0.0, 0.05, 0.9]])
B = np.array([[0.1, 0.0], [0.02, 0.03], [0.0, 0.12]])
D = np.array([0.1, 0.2, 0.1])


class Rod(pdeloop.Dynamics):
    n_z, n_a, horizon, sample_time = 3, 2, 40, 0.5
    target, action_weight = np.array([8.0, 5.0, 8.0]), 1e-3

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        return rng.standard_normal(3)

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        return A @ z + B @ a + D


def first_law(model: Any, **options: Any) -> float:
    run = pdeloop.train(plant=Rod(), model=model, optimizer="two_point", rollouts=2, **options)
    return float(run.costs["lqt"].mean())


def test_the_first_law_is_that_of_the_matrices(tmp_path: Path) -> None:
    """It costs what LQ tracking with the true A, B and d costs, in any coordinates, from any source."""
    plant = pdeloop.problem(plant=Rod()).plant()
    K, b = pdeloop.track_horizon(A, B, plant.cost, np.eye(3), D)
    run = pdeloop.train(
        plant=Rod(),
        model=pdeloop.ReducedModel(A, B, d=D),
        optimizer="two_point",
        rollouts=2,
        out=tmp_path / "run",
    )
    best = pdeloop.rollout(plant, lambda k, Z: Z @ K[k].T + b[k], *run.evaluation).costs.mean.mean()
    found = run.costs["lqt"].mean()
    assert best <= found < 1.02 * best
    T = np.diag([1.0, 20.0, 0.3])
    back = np.linalg.inv(T)
    units = pdeloop.ReducedModel(back @ A @ T, back @ B, U=T, d=back @ D)
    assert first_law(units) == pytest.approx(found, rel=1e-9)
    units.save(tmp_path / "own.npz")
    assert first_law(tmp_path / "own.npz") == pytest.approx(found, rel=1e-9)
    # The run is complete without the file that it was given.
    again = pdeloop.load_run(tmp_path / "run")
    assert again.values["model"] == str(tmp_path / "run" / "model.npz")
    with np.load(again.values["model"]) as kept:
        assert np.array_equal(kept["d"], D) and np.array_equal(kept["A"], A)


def test_a_state_space_system_is_sampled_as_the_plant_is() -> None:
    rates = np.diag([-0.2, -0.3, -0.1])
    system = scipy.signal.StateSpace(rates, B, np.eye(3), np.zeros((3, 2)))
    sampled = scipy.signal.cont2discrete((rates, B, np.eye(3), np.zeros((3, 2))), Rod.sample_time)
    assert first_law(system) == pytest.approx(
        first_law(pdeloop.ReducedModel(*sampled[:2])), rel=1e-9
    )


def test_refusals_say_what_is_true(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wide = pdeloop.ReducedModel(np.eye(5) / 2, np.ones((5, 2)), C=np.eye(3, 5))
    for model, options, words in (
        (
            pdeloop.ReducedModel(A[:2, :2], B[:2]),
            {},
            "of a state of 2 numbers .* plant has 3 and 2",
        ),
        (pdeloop.ReducedModel(A, B[:, :1]), {}, "3 numbers and 1 inputs"),
        (wide, {}, "outputs do not determine its state, for which a law needs a filter"),
        (pdeloop.ReducedModel(A, B), {"law": "observer"}, "filter gain, which A and B alone"),
        (3, {}, "model is 3; expected a ReducedModel"),
    ):
        with pytest.raises(ValueError, match=words):
            first_law(model, **options)
    np.savez(tmp_path / "own.npz", A=A * 1j, B=B)
    words = ["train", "burgers", "--in-process", "--model", str(tmp_path / "own.npz")]
    assert main([*words, "--out", str(tmp_path / "run")]) == FAILED
    error = capsys.readouterr().err
    assert "A of a reduced model must be an array of real numbers, got complex128" in error
    assert error.count("\n") == 1 and not (tmp_path / "run").exists()
