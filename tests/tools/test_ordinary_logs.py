# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Logs of a rod between two valves as people have them give its poles, whatever their zero."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pdeloop.data_file import Measurements, read_measurements
from pdeloop.identification import identify_data
from pdeloop.identified import Identified
from pdeloop.log_effects import fed_back, require_effects
from pdeloop.method.reduce.identifiability import NotIdentifiableError

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


def regulated() -> tuple[np.ndarray, np.ndarray]:
    """Held 12 K above ambient, with 5 % of dither."""
    rng = np.random.default_rng(0)
    K = np.array([[-3.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, -4.0]])
    x, z, u = np.array([10.0, 5.0, -5.0, -10.0]), np.zeros((ROWS, 4)), np.zeros((ROWS, 2))
    for k in range(ROWS):
        z[k] = x + 0.02 * rng.standard_normal(4)
        u[k] = 50.0 + K @ (z[k] - 12.0) + 5.0 * rng.standard_normal(2)
        x = A @ x + B @ u[k] + 0.05 * rng.standard_normal(4)
    return z, u


def identified(tmp_path: Path, z: np.ndarray, u: np.ndarray, **given: Any) -> Identified:
    path = tmp_path / "own.csv"
    names = ",".join(["t", *(f"z{i}" for i in range(1, 5)), "a1", "a2"])
    table = np.column_stack([10.0 * np.arange(len(z)), z, u])
    np.savetxt(path, table, delimiter=",", header=names, comments="", fmt="%.4f")
    return identify_data(read_measurements(path), given)


@pytest.mark.parametrize("method", ["regression", "subspace"])
def test_a_regulated_plant_has_its_poles_in_kelvin_and_deviations(
    tmp_path: Path, method: str
) -> None:
    z, u = regulated()
    found = [
        identified(tmp_path, z + ambient, u, identification=method).pole
        for ambient in (293.15, 0.0)
    ]
    np.testing.assert_allclose(found, found[:1] * 2, atol=1e-4)
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


def test_an_input_that_hardly_moved_is_refused_by_name_and_the_rest_is_known(
    tmp_path: Path,
) -> None:
    """A valve at 50 % but for its position's noise of 0.01 %: 0.0002 K a row, beside 0.02 K."""
    u = steps()
    u[:, 1] = 50.0 + 0.01 * np.random.default_rng(5).standard_normal(ROWS)
    z = rod(u, REST) + 293.15
    told = r"no effect of a2, which moved by 0\.0\d* about 50: move it more, .* out of --inputs$"
    with pytest.raises(NotIdentifiableError, match=told):
        identified(tmp_path, z, u)
    found = identify_data(read_measurements(tmp_path / "own.csv", inputs="a1"), {})
    assert found.pole[0] == pytest.approx(POLE, abs=0.002)
    own = found.innovations
    assert own is not None
    np.testing.assert_allclose(own.U @ own.C @ own.B, B[:, :1], atol=1e-4)


@pytest.mark.parametrize("seed", range(5))
def test_a_slow_effect_in_noise_is_one_and_an_idle_input_has_none(seed: int) -> None:
    """A row of the slow log changes the states by a hundredth of their noise at most."""
    slow, rng = np.eye(4) + (A - np.eye(4)) / 30.0, np.random.default_rng(seed)
    u = np.full((1500, 3), 50.0)
    u[300:700, 0] = u[800:1200, 1] = 70.0
    u[:, 2] = np.repeat(rng.uniform(0.0, 100.0, 300), 5)
    z = np.tile(REST, (1501, 1))
    for k in range(1500):
        z[k + 1] = slow @ z[k] + B @ u[k, :2] / 30.0
    z += 293.15 + rng.standard_normal(z.shape)
    require_effects([(z, u[:, :2])])
    with pytest.raises(NotIdentifiableError, match=r"no effect of a3, which moved by \d\d about"):
        require_effects([(z, u)])


def test_local_effects_in_a_short_log_of_a_long_field_are_seen() -> None:
    """Three heaters of six of 128 cells in 60 rows, whose effects are identified to 10 %."""
    rng, heat = np.random.default_rng(0), np.zeros((128, 3))
    for j in range(3):
        heat[10 + 50 * j : 16 + 50 * j, j] = 0.05
    step = 0.49 * np.eye(128) + 0.25 * (np.eye(128, k=1) + np.eye(128, k=-1))
    u = np.repeat(rng.uniform(0.0, 4.0, (12, 3)), 5, 0)
    z = np.tile(np.linalg.solve(np.eye(128) - step, heat @ np.full(3, 2.0)), (61, 1))
    for k in range(60):
        z[k + 1] = step @ z[k] + heat @ u[k]
    require_effects([(z + 0.05 * rng.standard_normal(z.shape), u)])


def test_an_input_that_acts_later_than_looked_for_is_no_effect(tmp_path: Path) -> None:
    u = np.random.default_rng(1).uniform(0.0, 100.0, (ROWS, 2))
    late = np.vstack([np.tile(u[:1], (15, 1)), u[:-15]])
    with pytest.raises(
        NotIdentifiableError, match=r"no effect of a1 and a2, .* an --input-delay of more than ten"
    ):
        identified(tmp_path, rod(late, REST), u)


@pytest.mark.parametrize("moved", [0.0, 2.0])
def test_a_controller_with_an_integral_part_needs_set_points_that_move(
    tmp_path: Path, moved: float
) -> None:
    """Noise alone moved the inputs, of which a model then shows no effect that is the plant's."""
    rng, x, total = np.random.default_rng(3), REST, np.zeros(2)
    z, u = np.zeros((ROWS, 4)), np.zeros((ROWS, 2))
    for k in range(ROWS):
        z[k] = x + 0.02 * rng.standard_normal(4)
        error = REST[[0, 3]] + moved * np.array([k // 50 % 2, k // 35 % 2]) - z[k, [0, 3]]
        total += 0.2 * error
        u[k] = 50.0 + 5.0 * error + total
        x = A @ x + B @ u[k] + 0.02 * rng.standard_normal(4)
    if moved:
        assert identified(tmp_path, z, u).pole[0] == pytest.approx(POLE, abs=0.02)
        return
    with pytest.raises(NotIdentifiableError, match="a test signal to them, or move the set points"):
        identified(tmp_path, z, u)


def test_an_experiment_that_is_appended_with_t_in_equal_steps_is_a_trajectory_and_told(
    tmp_path: Path,
) -> None:
    other = rod(steps(9), np.array([20.0, 5.0, 0.0, 0.0]), seed=9)
    z, u = np.vstack([rod(steps(), REST), other]) + 293.15, np.vstack([steps(), steps(9)])
    found = identified(tmp_path, z, u)
    pole, low, high = found.pole
    assert low < POLE < high and pole == pytest.approx(POLE, abs=1e-4)
    assert len(found.sources) == 2
    assert any(text.startswith("the states jump in row 603, and not") for text in found.remarks)


def test_steps_of_inputs_are_no_other_experiments(tmp_path: Path) -> None:
    """Of a plant that answers at once, and whose dead time is eight rows."""
    u = np.full((ROWS, 2), 50.0)
    u[100:300, 0] = u[350:500, 1] = 60.0
    late = np.vstack([u[:8], u[:-8]])
    z = late @ np.array([[0.1, 0.3, 0.2, 0.1], [0.3, 0.1, 0.2, 0.2]])
    z += 0.02 * np.random.default_rng(0).standard_normal(z.shape)
    names = "t,z1,z2,z3,z4,a1,a2"
    table = np.column_stack([np.arange(ROWS), z, u])
    np.savetxt(tmp_path / "own.csv", table, delimiter=",", header=names, comments="")
    remarks = read_measurements(tmp_path / "own.csv").remarks
    assert not any("jump" in text for text in remarks)


@pytest.mark.parametrize(
    ("moved", "digits", "told"),
    [
        (0.0, "%.17g", "nor an input"),
        (1e-12, "%.17g", "nor an input"),
        (1e-3, "%.4g", "nor an input"),
        (1e-3, "%.17g", ""),
        (1.0, "%.4g", ""),
    ],
)
def test_a_log_at_rest_is_told(tmp_path: Path, moved: float, digits: str, told: str) -> None:
    """A rod at 100 degrees C: of inputs that move enough its poles are found, of others nothing."""
    u = 50.0 + moved * (steps() - 50.0) / 50.0
    z = rod(u, REST, noise=0.0) + 100.0
    table = np.column_stack([10.0 * np.arange(len(z)), z, u])
    names = "t,z1,z2,z3,z4,a1,a2"
    path = tmp_path / "rest.csv"
    np.savetxt(path, table, fmt=digits, delimiter=",", header=names, comments="")
    if not told:
        identify_data(read_measurements(path), {"identification": "regression"})
        return
    with pytest.raises(NotIdentifiableError, match=f"the plant stands still: .*{told}"):
        identify_data(read_measurements(path), {})


def test_states_that_are_frozen_while_inputs_move_are_no_plant_at_rest() -> None:
    own = Measurements([(np.full((ROWS, 4), 20.0), steps()[:-1])], None, 1.0)
    with pytest.raises(NotIdentifiableError, match=r"stands still: .* although a1 and a2 moved"):
        identify_data(own, {})


def test_a_log_that_is_too_short_for_the_past_tells_no_feedback() -> None:
    z = np.arange(27.0).reshape(9, 3) % 7
    assert fed_back([(z, -z[:-1, :1])]) == []
    rng = np.random.default_rng(0)
    z = rng.normal(size=(200, 3))
    assert fed_back([(z, np.column_stack([-z[:-1, 0], rng.normal(size=199)]))]) == [0]
