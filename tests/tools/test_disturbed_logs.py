# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Logs of a plant with a disturbance that is not in them have its gains."""

from __future__ import annotations

import numpy as np
import pytest

from controller_node.identification import DesignSettings, designed
from pdeloop import field_report
from pdeloop.data_file import Measurements
from pdeloop.identification import identify_data
from pdeloop.linearity import structural_break
from pdeloop.method.reduce.subspace import InnovationModel, subspace_model
from pdeloop.model_checks import without_insignificant_effects

A = np.array([[0.92, 0.019], [0.014, 0.946]])
B = np.array([[0.096, 0.02], [0.015, 0.073]])
REST, HELD = np.array([70.0, 45.0]), np.array([50.0, 60.0])
GAIN = np.linalg.solve(np.eye(2) - A, B)


def log(seed: int, disturbance: np.ndarray, N: int = 900) -> tuple[np.ndarray, np.ndarray]:
    """States (N + 1, 2) and inputs (N, 2), held for ten rows on average."""
    rng, x = np.random.default_rng(seed), REST.copy()
    u, z = np.zeros((N, 2)), np.zeros((N + 1, 2))
    for k in range(N):
        new = rng.random(2) < 0.1 if k else np.ones(2, bool)
        u[k] = np.where(new, HELD + rng.uniform(-12.0, 12.0, 2), u[k - 1])
        z[k] = x + 0.03 * rng.standard_normal(2)
        own = np.array([0.15, 0.1]) * disturbance[k] + 0.01 * rng.standard_normal(2)
        x = REST + A @ (x - REST) + B @ (u[k] - HELD) + own
    z[N] = x
    return z, u


def walk(seed: int, N: int = 900) -> np.ndarray:
    v = np.cumsum(0.3 * np.random.default_rng(seed).standard_normal(N))
    return v - v.mean()


def gain(model: InnovationModel) -> np.ndarray:
    found: np.ndarray = model.U @ model.C @ np.linalg.solve(np.eye(len(model.A)) - model.A, model.B)
    return found


@pytest.mark.parametrize("kind", ["walk", "walk again", "ramp"])
def test_chance_does_not_move_a_disturbance(kind: str) -> None:
    v = np.linspace(0.0, 4.0, 900) if kind == "ramp" else walk(len(kind))
    z, u = log(1, v)
    found = subspace_model([(z, u)], order=3, past=4, constant=True)
    wrong, right = (
        np.abs(gain(model) - GAIN).max()
        for model in (found, without_insignificant_effects(found, [(z, u)]))
    )
    assert right < 0.3 and right < 0.2 * wrong


def test_a_slow_mode_that_inputs_move_keeps_their_effect() -> None:
    """A level of which one row is a thousandth, and a temperature."""
    rng, x, u = np.random.default_rng(0), np.zeros(2), np.zeros((600, 2))
    z = np.zeros((601, 2))
    for k in range(600):
        u[k] = rng.uniform(-1.0, 1.0, 2) if k % 10 == 0 else u[k - 1]
        x = np.array([[0.999, 0.0], [0.0, 0.8]]) @ x + np.array([[0.01, -0.01], [0.1, 0.0]]) @ u[k]
        z[k + 1] = x + 0.005 * rng.standard_normal(2)
    found = subspace_model([(z, u)], order=2, past=8, constant=True)
    assert without_insignificant_effects(found, [(z, u)]) is found


def test_a_part_of_a_log_in_which_inputs_stood_still_gives_no_law() -> None:
    """The first rows near the target, seven in this log: what is fitted to them has another B."""
    z, u = log(0, walk(19))
    settings = DesignSettings(2, 2, 1.0, 1e-3, identification="field")
    found = designed([(z, u)], REST + 2.0, settings, constant=True)
    assert found.field is not None and found.field.part > 50
    assert f"of {found.field.part} steps near the target" in field_report.text(found.field)[0]
    np.testing.assert_allclose(found.rows.U @ found.rows.B, B, atol=0.02)


def test_two_machines_in_one_log_are_told() -> None:
    """The second input of the other machine is stuck; one machine is one, also at other points."""
    z, u = log(1, np.zeros(900))
    x, stuck = z[-1], np.zeros((401, 2))
    new = HELD + np.repeat(np.random.default_rng(5).uniform(-12.0, 12.0, (40, 2)), 10, axis=0)
    for k in range(401):
        stuck[k] = x
        x = REST + A @ (x - REST) + B @ np.array([new[min(k, 399), 0] - HELD[0], 0.0])
    other = stuck + 0.03 * np.random.default_rng(6).standard_normal(stuck.shape)
    one = np.concatenate([z[:-1], other]), np.concatenate([u, new])
    place = structural_break([one])
    assert place is not None and place[0] == 0 and abs(place[1] - 900) < 50 and place[2] > 3.0
    found = structural_break([(z, u), (other, new)])
    assert found is not None and found[:2] == (1, 1)
    short = [(z[:91], u[:90]), (other[:91], new[:90])]
    names = [{"trajectory": 0}, {"trajectory": 1}]
    given = {"identification": "regression", "reduced_order": 2}
    told = identify_data(Measurements(short, None, 1.0, sources=names), given).warnings
    assert any("from about trajectory 1 on the states follow" in text for text in told)
    assert structural_break([(z, u)]) is None
    assert structural_break([(z[:401] + 30.0, u[:400]), (z, u)]) is not None
    assert structural_break([(z[:301], u[:300]), log(2, np.zeros(600), 600)]) is None
