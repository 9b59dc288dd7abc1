# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Logs of a plant with products of state and input: told, and figures of the model that is used."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pdeloop.cli import main
from pdeloop.data_file import Measurements
from pdeloop.identification import identify_data
from pdeloop.identified import Identified
from pdeloop.linearity import products
from tests.method.test_input_delay import logged

TARGET = np.array([60.0, 48.0])
STEPS = 400


def exchanger(z: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Two tanks that share a wall, with flows of 80 and 20 degrees C."""
    exchanged = 0.1 * (z[0] - z[1])
    return z + np.array(
        [0.2 * a[0] * (80.0 - z[0]) - exchanged, 0.2 * a[1] * (20.0 - z[1]) + exchanged]
    )


def log(noise: float = 0.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng, z, a = np.random.default_rng(seed), np.full((STEPS + 1, 2), 50.0), np.zeros((STEPS, 2))
    for k in range(STEPS):
        a[k] = rng.uniform(0.1, 1.5, 2) if k % 5 == 0 else a[k - 1]
        z[k + 1] = exchanger(z[k], a[k])
    return z + noise * rng.standard_normal(z.shape), a


def identified(z: np.ndarray, a: np.ndarray, **given: object) -> Identified:
    own = Measurements([(z, a)], TARGET, 1.0, sources=[{"trajectory": 0}])
    return identify_data(own, {"action_weight": 1.0, **given}, (), {"again": own})


def poles_at(a: np.ndarray) -> np.ndarray:
    return np.linalg.eigvalsh(np.array([[0.9 - 0.2 * a[0], 0.1], [0.1, 0.9 - 0.2 * a[1]]]))


def test_the_figures_are_those_of_the_model_whose_law_is_used() -> None:
    z, a = log()
    found = identified(z, a)
    known, held = found.summary(), a.mean(axis=0)
    assert known["model"] == "polynomial" and found.of_field is not None
    np.testing.assert_allclose(np.sort(found.poles.real), poles_at(held), atol=1e-4)
    size, low, high = found.pole
    assert size == pytest.approx(poles_at(held)[1], abs=1e-4) and low < size < high < low + 1e-3
    assert known["residuals"]["relative_size"] < 1e-4
    assert min(known["fit"]["again"]) > 99.9
    # The closed loop of the plant itself, not of a linear model.
    assert isinstance(found.model.K_a, np.ndarray) and found.closed_loop is not None
    state = z[0]
    for told, acted in zip(found.closed_loop.states, found.closed_loop.actions, strict=False):
        np.testing.assert_allclose(told, state, atol=0.02)
        state = exchanger(state, acted)
    text = found.text()
    assert "those of the polynomial model of the whole field, whose law is used" in text
    assert "closed loop on the polynomial model" in text and "of the regression:" in text


def test_directions_in_which_nothing_moves_have_no_poles() -> None:
    """A third sensor between the two tanks: a polynomial model leaves what is not moved where it is."""
    z, a = log()
    own = Measurements(
        [(np.column_stack([z, z.mean(axis=1)]), a)],
        np.r_[TARGET, TARGET.mean()],
        1.0,
        sources=[{"trajectory": 0}],
    )
    found = identify_data(own, {"action_weight": 1.0, "reduced_order": 2})
    assert found.kind == "polynomial" and found.closed_loop is not None
    np.testing.assert_allclose(np.sort(found.poles.real), poles_at(a.mean(axis=0)), atol=1e-4)
    assert found.pole[2] < 0.95 and found.closed_loop.radius < 0.95


def test_the_figures_of_the_regression_are_had_by_its_name() -> None:
    found = identified(*log(), identification="regression", reduced_order=2)
    known = found.summary()
    assert known["model"] == "regression" and known["residuals"]["relative_size"] > 0.01
    np.testing.assert_allclose(found.poles, np.linalg.eigvals(found.model.A))
    assert "whose law is used" not in found.text()


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_products_of_state_and_input_are_told(noise: float) -> None:
    told = [text for text in identified(*log(noise)).warnings if "products of a state" in text]
    assert len(told) == 1 and told[0].startswith(("z1 follows", "z2 follows"))


def test_the_inputs_in_products_are_named() -> None:
    """The second flow alone: the first input is a heater."""
    rng, z, a = np.random.default_rng(1), np.full((STEPS + 1, 2), 50.0), np.zeros((STEPS, 2))
    for k in range(STEPS):
        a[k] = rng.uniform(0.1, 1.5, 2) if k % 5 == 0 else a[k - 1]
        flow = exchanger(z[k], np.array([0.0, a[k, 1]]))
        z[k + 1] = flow + np.array([2.0 * a[k, 0] - 0.1 * (z[k, 0] - 20.0), 0.0])
    found = products([(z, a)])
    assert found is not None and (found.state, found.inputs) == (1, (1,))


@pytest.mark.parametrize("case", [{}, {"noise": 0.0}, {"held": 10, "steps": 400}])
def test_a_linear_plant_has_no_products(case: dict[str, float]) -> None:
    assert products([logged((0, 0), **case)]) is None  # type: ignore[arg-type]


def test_the_command_says_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    z, a = log()
    np.savez(tmp_path / "log.npz", states=z, actions=a, target=TARGET, sample_time=1.0)
    words = ["identify", "--data", str(tmp_path / "log.npz"), "--plot", str(tmp_path / "log.png")]
    assert main([*words, "--json"]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["model"] == "polynomial"
    assert "WARNING: z" in said.err and "products of a state" in said.err
