# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Verdicts on data: stable or not, residuals, FIT, and the orders of the method that was used."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pdeloop.cli import main
from pdeloop.method.reduce.reduced_model import ReducedModel, Trajectory, steps_of
from pdeloop.method.reduce.regression import fit
from pdeloop.model_checks import fit_percent, largest_pole, residuals, stability
from pdeloop.process.one_thread import one_thread
from tests.method.test_input_delay import logged
from tests.tools.test_cli import error_of

EYE = np.eye(2)


def plant(
    pole: float, *, seed: int = 0, steps: int = 300, noise: float = 0.0, bend: float = 0.0
) -> Trajectory:
    rng, z = np.random.default_rng(seed), np.zeros((steps + 1, 2))
    a = rng.normal(size=(steps, 1))
    for k in range(steps):
        forced = np.array([a[k, 0] + bend * (a[k - 1, 0] if k else 0.0), 0.0])
        z[k + 1] = np.array([[0.5, 0.1], [0.0, pole]]) @ z[k] + forced + 0.3 * rng.normal(size=2)
    return z + noise * rng.normal(size=z.shape), a


def regressed(trajectories: list[Trajectory]) -> ReducedModel:
    with one_thread():
        return fit(steps_of(trajectories), EYE)


def test_the_interval_of_the_largest_pole_covers_it_in_19_of_20_cases() -> None:
    covered = 0
    for seed in range(40):
        data = [plant(0.8, seed=seed)]
        size, low, high = largest_pole(regressed(data).A, data, lambda parts: regressed(parts).A)
        assert low < size < high
        covered += low < 0.8 < high
    assert covered >= 33  # the probability of fewer, of 95 %, is 1e-3


def test_stability_is_yes_no_or_undecided() -> None:
    for pole, told in ((0.5, "yes"), (1.05, "no"), (1.0, "undecided")):
        data = [plant(pole, steps=200)]
        ends = largest_pole(regressed(data).A, data, lambda parts: regressed(parts).A)[1:]
        assert stability(*ends) == told
    # Without an interval nothing is said.
    assert stability(*largest_pole(np.eye(1), [plant(0.5, steps=3)], lambda _: np.ones(2))[1:])


def test_residuals_of_the_plant_are_white_and_others_are_not() -> None:
    rejected = [
        residuals(regressed([own]), [own]) for own in (plant(0.8, seed=s) for s in range(50))
    ]
    assert sum(bool(one.in_time) for one in rejected) <= 5  # 1 % of them
    assert sum(bool(one.with_inputs) for one in rejected) <= 5
    noisy = plant(0.8, steps=1000, noise=1.0)
    assert residuals(regressed([noisy]), [noisy]).in_time
    # An input that acts again a step later, with half of its effect, on the first state alone.
    bent = plant(0.8, steps=1000, bend=0.5)
    found = residuals(regressed([bent]), [bent])
    assert [i for i, _ in found.with_inputs] == [0]
    # R^2: of the effect 0.5 a_{k-1}, less what z_k knows of it, and of the noise 0.3.
    assert 0.3 < found.with_inputs[0][1] < 0.25 / (0.25 + 0.09) + 0.05
    z, a = plant(0.8)
    exact = ReducedModel([[0.5, 0.1], [0.0, 0.8]], [[1.0], [0.0]])
    simulated, _ = exact.simulate(z[0], a)
    assert residuals(exact, [(simulated, a)]).rounding


def test_fit_is_that_of_the_simulation() -> None:
    z, a = plant(0.8)
    model = ReducedModel([[0.5, 0.1], [0.0, 0.8]], [[1.0], [0.0]])
    simulated, _ = model.simulate(np.ones(2), a)
    np.testing.assert_allclose(fit_percent(model, [(simulated, a)]), 100.0)
    simulated, _ = model.simulate(z[0], a)
    missed = np.linalg.norm(z - simulated, axis=0) / np.linalg.norm(z - z.mean(axis=0), axis=0)
    np.testing.assert_allclose(fit_percent(model, [(z, a)]), 100.0 * (1.0 - missed))


def written(path: Path, z: np.ndarray, a: np.ndarray) -> str:
    np.savez(path, states=z, actions=a, target=np.ones(z.shape[1]), sample_time=0.5)
    return str(path)


def test_identify_gives_its_verdict_and_the_orders_of_its_method(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = written(tmp_path / "a.npz", *logged((0, 0)))
    other = written(tmp_path / "b.npz", *logged((0, 0), seed=1))
    words = ["identify", "--data", data, "--validate", other, "--identification"]
    tables = {}
    for method in ("regression", "dmdc", "subspace"):
        rank = ["--rank", "2"] if method == "dmdc" else []
        assert main([*words, method, *rank, "--order", "2", "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        low, high = found["spectral_radius_interval"]
        assert found["stable"] == "yes" and low < found["spectral_radius"] < high
        assert len(found["fit"][other]) == 4
        tables[method] = found["orders"]
    assert [row["order"] for row in tables["subspace"]] == [2]
    assert tables["dmdc"][0]["one_step_error"] != tables["regression"][0]["one_step_error"]
    assert main([*words, "regression", "--order", "4"]) == 0
    text = capsys.readouterr().out
    assert "stable: yes; largest pole 0.9" in text and "FIT of the simulation of" in text
    assert "residuals: " in text


def test_a_law_that_begins_at_the_target_ends_near_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not an infinite share of no distance away."""
    z, a = logged((0, 0), noise=0.0, process=0.3)
    np.savez(tmp_path / "own.npz", states=z, actions=a, target=z[0], sample_time=0.5)
    assert main(["identify", "--data", str(tmp_path / "own.npz"), "--order", "4"]) == 0
    said = capsys.readouterr()
    assert "% of the variation of the log away from it" in said.out
    assert "law ends" not in said.err and "inf" not in said.out + said.err


def test_units_in_which_a_state_has_no_say_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    z, a = logged((0, 0))
    for factor, told in ((100.0, False), (1e5, True)):
        lines = ["t,level,b,c,pressure,a1,a2", "target,1,1,1,1,,"]
        for k, (state, action) in enumerate(zip(z * [1, 1, 1, factor], a, strict=False)):
            lines.append(",".join(map(str, [k, *state, *action])))
        (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
        words = [
            "--states",
            "level,b,c,pressure",
            "--inputs",
            "a*",
            "--identification",
            "regression",
        ]
        assert main(["identify", "--data", str(tmp_path / "log.csv"), *words]) == 0
        assert ("has no say in a cost" in capsys.readouterr().err) == told


def test_logs_to_validate_with_are_of_the_same_plant(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, other = (
        written(tmp_path / "a.npz", *logged((0, 0))),
        written(tmp_path / "b.npz", *plant(0.5)),
    )
    told = error_of(capsys, "identify", "--data", data, "--validate", other)
    assert "expected the same channels" in told and "b.npz" in told
