# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Logs of a rod between two valves as people have them give its poles, whatever their zero."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pdeloop.data_file import read_measurements
from pdeloop.identification import Identified, identify_data

A = np.diag([0.86, 0.74, 0.74, 0.86]) + 0.12 * (np.eye(4, k=1) + np.eye(4, k=-1))
B = np.zeros((4, 2))
B[0, 0], B[3, 1] = 0.03, 0.02
POLE = 0.98
ROWS = 601


def rod(
    u: np.ndarray, start: np.ndarray, process: float = 0.0, noise: float = 0.02, seed: int = 0
) -> np.ndarray:
    """Kelvin above ambient, with the valves at u per cent."""
    rng, x = np.random.default_rng(seed), np.zeros((len(u), 4))
    x[0] = start
    for k, own in enumerate(u[:-1]):
        x[k + 1] = A @ x[k] + B @ own + process * rng.standard_normal(4)
    return x + noise * rng.standard_normal(x.shape)


def steps(seed: int = 0) -> np.ndarray:
    return np.repeat(np.random.default_rng(seed).uniform(0.0, 100.0, (ROWS // 5 + 1, 2)), 5, 0)[
        :ROWS
    ]


REST = np.linalg.solve(np.eye(4) - A, B @ [50.0, 50.0])


def regulated(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Held 12 K above ambient, with 5 % of dither."""
    rng = np.random.default_rng(seed)
    K = np.array([[-3.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, -4.0]])
    x, z, u = np.array([10.0, 5.0, -5.0, -10.0]), np.zeros((ROWS, 4)), np.zeros((ROWS, 2))
    for k in range(ROWS):
        z[k] = x + 0.02 * rng.standard_normal(4)
        u[k] = 50.0 + K @ (z[k] - 12.0) + 5.0 * rng.standard_normal(2)
        x = A @ x + B @ u[k] + 0.05 * rng.standard_normal(4)
    return z, u


def identified(
    tmp_path: Path, z: np.ndarray, u: np.ndarray, cut: bool = False, **given: Any
) -> Identified:
    path = tmp_path / "own.csv"
    names = ",".join(["t", *(f"z{i}" for i in range(1, 5)), "a1", "a2"])
    table = np.column_stack([10.0 * np.arange(len(z)), z, u])
    np.savetxt(path, table, delimiter=",", header=names, comments="", fmt="%.4f")
    return identify_data(read_measurements(path, cut=cut), given)


@pytest.mark.parametrize("method", ["regression", "subspace"])
@pytest.mark.parametrize("seed", range(3))
def test_a_regulated_plant_has_its_poles_in_kelvin_degrees_and_deviations(
    tmp_path: Path, method: str, seed: int
) -> None:
    z, u = regulated(seed)
    found = [
        identified(tmp_path, z + ambient, u, identification=method).pole
        for ambient in (293.15, 20.0, 0.0)
    ]
    np.testing.assert_allclose(found, found[:1] * 3, atol=1e-4)
    size, low, high = found[0]
    assert low < POLE < high and size == pytest.approx(POLE, abs=0.005)


def test_data_without_noise_about_their_rest_need_no_constant_term(tmp_path: Path) -> None:
    path, u = tmp_path / "own.npz", steps() - 50.0
    z = rod(u, np.zeros(4), noise=0.0)
    np.savez(path, states=z, actions=u[:-1], sample_time=10.0)
    assert not any(identify_data(read_measurements(path), {}).summary()["constant"])
    np.savez(path, states=z + 20.0, actions=u[:-1], sample_time=10.0)
    model = identify_data(read_measurements(path), {}).model
    rest = np.linalg.solve(np.eye(4) - model.A, model.d)
    np.testing.assert_allclose(model.U @ rest, 20.0, rtol=1e-6)
