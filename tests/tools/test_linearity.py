# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What one linear model does not describe is told of logs, and nothing else is.

Also rows that are means, inputs that stood still in the log alone, and how well effects are known.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pdeloop.data_file import Measurements, read_measurements
from pdeloop.identification import identify_data
from pdeloop.identified import Identified
from pdeloop.linearity import Misfit, disproportionate, products, rate_limited, structural_break
from pdeloop.method.reduce.input_delay import study_delays
from pdeloop.method.reduce.reduced_model import Trajectory, steps_of
from pdeloop.method.reduce.regression import fit
from pdeloop.method.reduce.subspace import InnovationModel
from pdeloop.model_checks import LAGS, uncertain_effects
from tests.method.test_input_delay import A, B, logged

POLE = np.linalg.eigvals(A).real.max()
LOOKED_FOR = products, rate_limited, disproportionate


def held(rows: int, every: int, seed: int, low: float = -10.0, high: float = 10.0) -> np.ndarray:
    """Two inputs, each of which moves at random after about so many rows."""
    rng, u = np.random.default_rng(seed), np.zeros((rows, 2))
    for k in range(rows):
        new = rng.random(2) < 1.0 / every if k else np.ones(2, bool)
        u[k] = np.where(new, rng.uniform(low, high, 2), u[k - 1])
    return u


def rod(u: np.ndarray, noise: float = 0.03, seed: int = 0) -> np.ndarray:
    z = np.zeros((len(u) + 1, 4))
    for k, own in enumerate(u):
        z[k + 1] = A @ z[k] + B @ own
    return z + noise * np.random.default_rng(seed).standard_normal(z.shape)


def tanks(noise: float, seed: int, rows: int = 900) -> Trajectory:
    """Two tanks, of which each flows out as the root of its level."""
    u, z = held(rows, 25, seed, 0.5, 6.0), np.full((rows + 1, 2), 4.0)
    for k in range(rows):
        x = z[k]
        for _ in range(10):
            out = 0.1 * np.sqrt(np.maximum(x, 0.0))
            x = x + 0.1 * np.array([0.1 * u[k, 0] - out[0], 0.05 * u[k, 1] + out[0] - out[1]])
        z[k + 1] = x
    return z + noise * np.random.default_rng(seed).standard_normal(z.shape), u


def exchanger_in_loops(seed: int = 0, rows: int = 800) -> Trajectory:
    """Three cells of hot and three of cold water, both outlets by PI, with set points that move."""
    rng, total, sp = (
        np.random.default_rng(seed),
        np.array([0.4, 0.9]),
        held(rows, 50, seed, -4.0, 4.0),
    )
    x, z, u = (
        np.r_[60.0, 50.0, 45.0, 40.0, 35.0, 30.0],
        np.zeros((rows + 1, 6)),
        np.zeros((rows, 2)),
    )
    for k in range(rows + 1):
        z[k] = x + 0.05 * rng.standard_normal(6)
        if k < rows:
            error = (np.array([48.0, 38.0]) + sp[k] - z[k, [2, 3]]) * [1.0, -1.0]
            total = np.clip(total + 0.004 * error, 0.05, 1.5)
            u[k] = np.clip(total + 0.03 * error, 0.05, 1.5)
            for _ in range(10):
                hot, cold = x[:3], x[3:]
                into = np.r_[80.0, hot[:-1]] - hot, np.r_[cold[1:], 20.0] - cold
                way = 0.3 * (hot - cold)
                x = x + 0.05 * np.r_[u[k, 0] * into[0] / 2 - way, u[k, 1] * into[1] / 2 + way]
    return z, u


def limited(rate: float, noise: float, seed: int) -> Trajectory:
    """A rod between valves that move by `rate` in a row, of which the log has the commands."""
    u = held(700, 15, seed)
    applied = u.copy()
    for k in range(1, len(u)):
        applied[k] = applied[k - 1] + np.clip(u[k] - applied[k - 1], -rate, rate)
    return rod(applied, noise, seed), u


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_an_outflow_that_goes_with_the_root_of_a_level_is_told(noise: float, seed: int) -> None:
    found = products([tanks(noise, seed)])
    assert isinstance(found, Misfit)
    assert "poles and gains change with the point" in found.text


@pytest.mark.parametrize("seed", range(3))
def test_products_are_told_behind_controllers_as_well(seed: int) -> None:
    found = products([exchanger_in_loops(seed)])
    assert found is not None and "products" in found.text


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_a_pendulum_that_swings_widely_is_told(noise: float) -> None:
    """An odd function of the state, of which no square tells."""
    u, z = held(800, 10, 0, -2.0, 2.0)[:, :1], np.zeros((801, 2))
    for k, own in enumerate(u):
        x = z[k]
        for _ in range(20):
            x = x + 0.005 * np.array([x[1], -9.8 * np.sin(x[0]) - 0.5 * x[1] + 2.0 * own[0]])
        z[k + 1] = x
    z += noise * np.random.default_rng(0).standard_normal(z.shape)
    found = products([(z, u)])
    assert found is not None and found.inputs == ()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("rate", "noise"), [(0.7, 0.01), (0.7, 0.03), (2.0, 0.01)])
def test_a_valve_with_a_rate_limit_is_told_with_its_rate(
    rate: float, noise: float, seed: int
) -> None:
    found = rate_limited([limited(rate, noise, seed)])
    assert found is not None
    told = float(found.text.split("about ")[1].split()[0])
    assert told == pytest.approx(rate, rel=0.25)


def test_commands_that_an_actuator_follows_late_tell_no_rate() -> None:
    u = held(800, 15, 3)
    late = u.copy()
    for k in range(1, len(u)):
        late[k] = late[k - 1] + 0.3 * (u[k] - late[k - 1])
    assert rate_limited([(rod(late), u)]) is None


ORDINARY = [
    {},
    {"noise": 0.5},
    {"held": 10},
    {"noise": 0.0},
    {"process": 0.05},
    {"process": 0.05, "held": 10},
    {"feedback": 0.3},
    {"feedback": 0.3, "process": 0.05, "held": 10},
]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("case", ORDINARY, ids=str)
def test_nothing_is_told_of_linear_plants(case: dict[str, float], seed: int) -> None:
    own = [logged((0, 0), steps=500, seed=seed, **case)]  # type: ignore[arg-type]
    assert [look(own) for look in LOOKED_FOR] == [None] * 3
    assert structural_break(own) is None
    assert not study_delays(own).beside


def test_one_row_in_which_an_input_moved_tells_nothing() -> None:
    u = held(800, 15, 1)
    u[:, 1] = 0.0
    u[400, 1] = 1.0
    assert [look([(rod(u), u)]) for look in LOOKED_FOR] == [None] * 3


def means(every: int, seed: int, noise: float = 0.01) -> Trajectory:
    """Means of five rows each, as a historian writes them."""
    u = np.repeat(held(3000 // every, 1, seed), every, axis=0)
    z = rod(u, 0.0)[:-1].reshape(-1, 5, 4).mean(axis=1)
    z += noise * np.random.default_rng(seed).standard_normal(z.shape)
    return z, u.reshape(-1, 5, 2).mean(axis=1)[:-1]


def identified(own: Trajectory, delay: tuple[int, ...] = ()) -> Identified:
    given = Measurements([own], None, 1.0, sources=[{"trajectory": 0}])
    return identify_data(given, {}, delay)


@pytest.mark.parametrize("every", [20, 60])
def test_rows_that_are_means_over_their_time_are_told_and_identified(every: int) -> None:
    pole = POLE**5
    plain = identified(means(every, 1))
    (told,) = [text for text in plain.warnings if "rows are means over time" in text]
    assert "give --input-delay=-1, with which" in told
    assert not plain.pole[1] < pole < plain.pole[2]  # the figures of what is not asked for
    found = identified(means(every, 1), (-1,))
    assert found.pole[0] == pytest.approx(pole, abs=0.01) and found.kind == "subspace"
    assert not any("rows are means" in text for text in found.warnings)


def test_an_input_that_stood_still_in_most_of_the_log_alone_is_told(tmp_path: Path) -> None:
    u = held(800, 15, 1)
    z = rod(u)[:-1]
    for begin, end in ((100, 800), (300, 380)):
        known = u.copy()
        known[begin:end, 1] = u[begin, 1]
        table = np.column_stack([np.arange(800), z, known])
        names = "t,z1,z2,z3,z4,a1,a2"
        np.savetxt(tmp_path / "own.csv", table, delimiter=",", header=names, comments="")
        remarks = read_measurements(tmp_path / "own.csv").remarks
        assert any(text.startswith("a2 stands at") for text in remarks)


def moved_once(seed: int) -> Trajectory:
    """The second input, for 20 rows by 0.3 of its unit, beside disturbances of each row."""
    rng, u, z = np.random.default_rng(seed), held(600, 15, seed), np.zeros((601, 4))
    u[:, 1] = 0.0
    u[300:320, 1] = 0.3
    for k, own in enumerate(u):
        z[k + 1] = A @ z[k] + B @ own + 0.03 * rng.standard_normal(4)
    return z, u


def effect(by: np.ndarray, to: np.ndarray) -> np.ndarray:
    x = np.zeros_like(to)
    for _ in range(LAGS):
        x = by @ x + to
    return x


def test_the_interval_of_an_effect_covers_it_also_of_an_input_that_moved_once() -> None:
    covered = np.zeros(2)
    for seed in range(30):
        z, u = moved_once(seed)
        fitted, unit = fit(steps_of([(z, u)]), np.eye(4), True), np.eye(4)
        model = InnovationModel(fitted.A, fitted.B, unit, fitted.A, unit, unit, 1, d=fitted.d)
        half, found = uncertain_effects(model, [(z, u)]), effect(fitted.A, fitted.B)
        wrong, size = (
            np.linalg.norm(x / z.std(axis=0)[:, None], axis=0)
            for x in (found - effect(A, B), found)
        )
        covered += wrong < half * size
        assert half[0] < 0.1 < 0.25 < half[1] < 0.75
    assert covered.min() >= 24  # the probability of fewer, of 95 %, is 1e-3


def test_an_effect_that_is_hardly_known_is_told_by_name() -> None:
    known = identified(moved_once(0))
    assert "in 10 rows, 95 % intervals: ± " in known.text()
    (told,) = [text for text in known.warnings if "effect of" in text]
    assert told.startswith("the data determine the effect of a2 to ")
    assert known.summary()["effects_uncertain"] == list(known.uncertain)
