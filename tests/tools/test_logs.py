# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Logs as machines write them: what is found before any fit, and what each option does about it."""

from __future__ import annotations

import importlib.util
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy import io

import pdeloop
from pdeloop.cli import FAILED, main
from pdeloop.data_file import Measurements, read_measurements
from pdeloop.identification import identify_data
from pdeloop.log import in_seconds

A = np.array([[0.95, 0.05, 0.0], [0.02, 0.9, 0.05], [0.0, 0.1, 0.8]])
B = np.array([[0.5, 0.0], [0.1, 0.2], [0.0, 0.4]])
ROWS = 300
NAMES = ["t", "z1", "z2", "z3", "a1", "a2"]


def log(seed: int = 0, noise: float = 0.01, held: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """States (ROWS, 3) and inputs (ROWS, 2) of x+ = A x + B u with process noise, inputs held."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(0, 5, (ROWS // held + 1, 2)), held, 0)[:ROWS]
    z = np.zeros((ROWS, 3))
    z[0] = rng.standard_normal(3)
    for k in range(ROWS - 1):
        z[k + 1] = A @ z[k] + B @ u[k] + noise * rng.standard_normal(3)
    return z, u


Z, U = log()
T = np.arange(ROWS, dtype=float)


def write(
    path: Path,
    z: np.ndarray = Z,
    u: np.ndarray = U,
    t: np.ndarray = T,
    names: list[str] = NAMES,
    digits: int = 9,
) -> Path:
    lines = [",".join(names)]
    for k in range(len(t)):
        lines.append(",".join(f"{v:.{digits}g}" for v in (t[k], *z[k], *u[k])))
    path.write_text("\n".join(lines) + "\n")
    return path


def poles(found: Measurements) -> np.ndarray:
    model = pdeloop.identify(*found.trajectories, n_s=3)
    return np.sort(np.abs(model.poles))


TRUE = np.sort(np.abs(np.linalg.eigvals(A)))


def spoilt(where: Callable[[np.ndarray, np.ndarray], None]) -> tuple[np.ndarray, np.ndarray]:
    z, u = Z.copy(), U.copy()
    where(z, u)
    return z, u


@pytest.mark.parametrize("value", [-9999.0, 999.9, 9999.0, 32767.0, -999.0])
@pytest.mark.parametrize("column", [1, 4])
def test_a_sentinel_is_refused_by_column_and_row_and_left_out_where_that_is_asked(
    tmp_path: Path, value: float, column: int
) -> None:
    z, u = Z.copy(), U.copy()
    both = np.hstack([z, u])
    both[[40, 41, 200], column - 1] = value
    path = write(tmp_path / "own.csv", both[:, :3], both[:, 3:])
    with pytest.raises(
        ValueError, match=rf"{NAMES[column]} is {value:.10g} in row 42 .and in 2 more"
    ):
        read_measurements(path)
    with pytest.raises(ValueError, match=rf"give --missing={value:.10g} --cut"):
        read_measurements(path)
    with pytest.raises(ValueError, match=r"is missing in row 42 .and 2 more with gaps"):
        read_measurements(path, missing=[value])
    found = read_measurements(path, missing=[value], cut=True)
    assert [len(a) for _, a in found.trajectories] == [39, 157, 98]
    assert np.array_equal(found.trajectories[1][0][0], np.round(Z[42], 9)) or np.allclose(
        found.trajectories[1][0][0], Z[42], rtol=1e-8
    )
    assert found.remarks == ("left out 3 rows, the first of them row 42",)
    np.testing.assert_allclose(poles(found), TRUE, atol=0.01)
    kept = read_measurements(path, missing=[np.nan])
    assert len(kept.trajectories) == 1 and "far from all else" in kept.remarks[0]


def test_two_sentinels_are_named_together(tmp_path: Path) -> None:
    z, u = Z.copy(), U.copy()
    z[10, 0], z[90, 2] = 999.9, -9999.0
    with pytest.raises(ValueError, match=r"--missing=999\.9,-9999 --cut"):
        read_measurements(write(tmp_path / "own.csv", z, u))


def stuck(z: np.ndarray, u: np.ndarray) -> None:
    z[100:115, 1] = z[100, 1]


def hung(z: np.ndarray, u: np.ndarray) -> None:
    z[100:115], u[100:115] = z[100], u[100]


def spike(z: np.ndarray, u: np.ndarray) -> None:
    z[77, 2] += 60.0


def saturated(z: np.ndarray, u: np.ndarray) -> None:
    np.minimum(z[:, 0], np.quantile(z[:, 0], 0.8), out=z[:, 0])


def stuck_at_a_round_number(z: np.ndarray, u: np.ndarray) -> None:
    z /= 100.0
    z[100:115, 1] = np.round(z[100, 1], 1)


def saturated_at_a_round_number(z: np.ndarray, u: np.ndarray) -> None:
    z /= 100.0
    np.minimum(z[:, 0], np.round(np.quantile(z[:, 0], 0.7), 1), out=z[:, 0])


@pytest.mark.parametrize(
    ("what", "words", "left_out"),
    [
        (stuck, r"z2 is frozen \(\S+\) in 15 rows, from row 102 on", 15),
        (hung, r"z1, z2 and z3 are frozen \(\S+\) in 15 rows, from row 102 on", 15),
        (spike, r"z3 jumps to \S+ for one row, row 79", 1),
        (
            saturated,
            r"z1 is at \S+, an end of the range, in 60 rows, the first of them row \d+",
            60,
        ),
        (stuck_at_a_round_number, r"z2 is frozen \(\d+\.\d\) in 15 rows, from row 102 on", 15),
        (saturated_at_a_round_number, r"z1 is at 0\.6, an end of the range, in 50 rows", 50),
    ],
)
def test_rows_that_are_not_the_plants_are_told_and_left_out(
    tmp_path: Path, what: Callable[[np.ndarray, np.ndarray], None], words: str, left_out: int
) -> None:
    path = write(tmp_path / "own.csv", *spoilt(what))
    (text,) = read_measurements(path).remarks
    assert re.match(words, text) and text.endswith("with --cut")
    found = read_measurements(path, cut=True)
    (text,) = found.remarks
    assert text.startswith(f"left out {left_out} row")
    np.testing.assert_allclose(poles(found), TRUE, atol=0.02)


def test_an_input_that_stands_in_the_log_alone_is_told_and_left_out(tmp_path: Path) -> None:
    """A model of all rows would have gains of its input that are three times too small."""
    u = U.copy()
    u[80:230, 1] = u[80, 1]
    path = write(tmp_path / "own.csv", Z, u)
    words = r"a2 stands at \S+ in 15\d rows, from row (8\d) on, while z2 and z3 move as by an input"
    assert [re.match(words, text) is not None for text in read_measurements(path).remarks] == [True]
    found = read_measurements(path, cut=True)
    model = pdeloop.identify(*found.trajectories, n_s=3)
    gains = model.U @ np.linalg.solve(np.eye(3) - model.A, model.B)
    np.testing.assert_allclose(gains, np.linalg.solve(np.eye(3) - A, B), rtol=0.1)
    z = np.zeros_like(Z)  # an input that did stand is none
    for k in range(ROWS - 1):
        z[k + 1] = A @ z[k] + B @ u[k] + (Z[k + 1] - A @ Z[k] - B @ U[k])
    assert read_measurements(write(path, z, u)).remarks == ()


@pytest.mark.parametrize(("turn", "swing"), [(360.0, 9.0), (65536.0, 3000.0), (2 * np.pi, 0.02)])
def test_an_angle_that_wraps_is_told_and_cut_at_that(
    tmp_path: Path, turn: float, swing: float
) -> None:
    """An angle and its speed; the last one stays about 0, where every turn is a jump."""
    rng, x, z = np.random.default_rng(0), np.zeros(2), np.zeros((ROWS, 3))
    u = np.repeat(rng.uniform(-1.0, 1.0, (ROWS // 5, 2)), 5, 0) * swing
    for k in range(ROWS):
        z[k, :2] = x[0] % turn, x[1]
        u[k, 0] -= 0.2 * x[0] * (swing < 1.0)
        x = np.array([x[0] + x[1], 0.5 * x[1] + u[k, 0] + swing * (swing > 1.0)])
    z[:, 2] = np.cos(T)
    path = write(tmp_path / "own.csv", z, u)
    told = [text for text in read_measurements(path).remarks if "as an angle or a counter" in text]
    assert len(told) == 1 and told[0].startswith("z1 jumps from one end of the range to the other")
    found = read_measurements(path, states="z1,z2", inputs="a1", time="t", cut=True)
    model = pdeloop.identify(*found.trajectories, n_s=2)
    A = model.U @ model.A @ model.U.T
    np.testing.assert_allclose(A, [[1.0, 1.0], [0.0, 0.5]], atol=1e-5)


def test_a_sensor_slower_than_the_log_is_told_with_its_period(tmp_path: Path) -> None:
    z = np.repeat(Z[::5], 5, 0)
    path = write(tmp_path / "own.csv", z, t=0.1 * T)
    (text,) = read_measurements(path).remarks
    assert text == (
        "z1, z2 and z3 change in every 5th row only, so the log is faster than the sensor (first in "
        "row 7): give --resample 0.5"
    )
    found = read_measurements(path, resample=0.5)
    assert found.remarks == () and found.sample_time == 0.5
    ((states, actions),) = found.trajectories
    np.testing.assert_allclose(states, Z[: 5 * len(states) : 5], rtol=1e-8)
    means = U[: 5 * len(actions)].reshape(-1, 5, 2).mean(axis=1)
    np.testing.assert_allclose(actions, means, rtol=1e-7)


@pytest.mark.parametrize(
    ("read", "told"), [("held", "change in every 5th"), ("lines", "lie on str")]
)
def test_slow_sensors_among_others_are_told_though_inputs_move_as_seldom(
    tmp_path: Path, read: str, told: str
) -> None:
    """Of interpolated readings a regression has a law that diverges on the plant."""
    rng = np.random.default_rng(2)
    u = np.repeat(rng.uniform(0, 5, (ROWS, 2)), rng.integers(3, 8, ROWS), axis=0)[:ROWS]
    z = np.zeros((ROWS, 3))
    for k in range(ROWS - 1):
        z[k + 1] = A @ z[k] + B @ u[k] + (Z[k + 1] - A @ Z[k] - B @ U[k])
    whole, knots = z.copy(), np.arange(0, ROWS, 5)
    for i in (1, 2):
        z[:, i] = np.repeat(z[knots, i], 5) if read == "held" else np.interp(T, knots, z[knots, i])
    (text,) = read_measurements(write(tmp_path / "own.csv", z, u)).remarks
    assert text.startswith(f"z2 and z3 {told}") and text.endswith("give --resample 5")
    assert read_measurements(write(tmp_path / "own.csv", z, u), resample=5.0).remarks == ()
    assert read_measurements(write(tmp_path / "own.csv", whole, u)).remarks == ()
    smooth = np.cumsum(np.cumsum(u[:, :1] - u[:, :1].mean(), axis=0), axis=0) @ np.ones((1, 3))
    smooth[:, 1:] = np.cumsum(u - u.mean(axis=0), axis=0)  # straight until an input moves
    remarks = read_measurements(write(tmp_path / "own.csv", smooth, u)).remarks
    assert not any("straight" in text or "faster" in text for text in remarks)


def test_a_state_that_follows_a_held_input_is_no_slow_sensor_in_any_trajectory(
    tmp_path: Path,
) -> None:
    """The second one begins in the middle of what would be a hold of the first."""
    z, u = Z.copy(), np.repeat(U[::4], 4, axis=0)
    u[103:] = np.repeat(U[::4], 4, axis=0)[: ROWS - 103]
    z[:, 2] = np.r_[0.0, u[:-1, 1]]  # beside others that are as fast as the log
    t = np.r_[T[:103], T[: ROWS - 103]]
    assert not any(
        "faster" in text for text in read_measurements(write(tmp_path / "own.csv", z, u, t)).remarks
    )


def test_jitter_is_told_and_resampled(tmp_path: Path) -> None:
    """Of a slow motion, linear interpolation loses what the jitter times the curvature is."""
    rng = np.random.default_rng(1)
    path = write(tmp_path / "own.csv", t=T + rng.uniform(-0.02, 0.02, ROWS))
    with pytest.raises(ValueError, match=r"between 0\.96\d+ and 1\.03\d+ s\): .* --resample 1$"):
        read_measurements(path)
    for resample in (0.0, 1.0):
        found = read_measurements(path, resample=resample)
        assert found.sample_time == 1.0 and found.remarks == ()
        np.testing.assert_allclose(poles(found), TRUE, atol=0.02)
    with pytest.raises(ValueError, match=r"at least that of the log, .* got 0.1 s"):
        read_measurements(path, resample=0.1)


@pytest.mark.parametrize("drift", [0.0, 1.0])
def test_a_disturbance_that_grows_is_told(tmp_path: Path, drift: float) -> None:
    z, u = log(seed=3)
    ramp = np.zeros_like(z)
    for k in range(ROWS - 1):
        ramp[k + 1] = A @ ramp[k] + drift * np.array([0.4, 0.0, 0.0]) * k / ROWS
    found = read_measurements(write(tmp_path / "log.csv", z + ramp, u)).remarks
    told = [text for text in found if "through the log, and not by an input" in text]
    assert len(told) == (drift > 0.0) and all(text.startswith("z1 ") for text in told)


@pytest.mark.parametrize("seed", [24, 51])
def test_a_nonlinear_plant_does_not_drift(tmp_path: Path, seed: int) -> None:
    """Two tanks whose outflow is the root of the level."""
    rng, z = np.random.default_rng(seed), np.full((900, 2), 4.0)
    held = [np.repeat(rng.uniform(0.0, 6.0, 80), rng.integers(12, 50, 80)) for _ in range(2)]
    u = np.stack([own[:900] for own in held], axis=1)
    for k in range(899):
        out = 0.1 * np.sqrt(np.maximum(z[k], 0.0))
        z[k + 1] = z[k] + [0.1 * u[k, 0] - out[0], 0.05 * u[k, 1] + out[0] - out[1]]
    z += 0.02 * rng.standard_normal(z.shape)
    np.savez(tmp_path / "log.npz", states=z, actions=u[:-1], sample_time=1.0)
    remarks = read_measurements(tmp_path / "log.npz").remarks
    assert not any("drift" in text for text in remarks)


def test_rows_of_another_step_that_cut_leaves_out_are_told(tmp_path: Path) -> None:
    """The second half was logged at every third step: none of its rows has a neighbour."""
    kept = np.r_[:150, 150:ROWS:3]
    path = write(tmp_path / "log.csv", Z[kept], U[kept], T[kept])
    found = read_measurements(path, cut=True)
    assert [len(a) for _, a in found.trajectories] == [150]
    told = "left out 49 rows alone between gaps, the first of them row 153"
    assert found.remarks == (told,)


def test_a_log_whose_step_changes_is_told_of_resampling_which_keeps_both_parts(
    tmp_path: Path,
) -> None:
    kept = np.r_[:200, 200:ROWS:2]
    path = write(tmp_path / "log.csv", Z[kept], U[kept // 4 * 4], T[kept])
    with pytest.raises(ValueError, match=r"got 2 s before row 203 .* give --resample 2, as --cut"):
        read_measurements(path)
    for cut in (False, True):
        found = read_measurements(path, resample=2.0, cut=cut)
        assert [len(a) for _, a in found.trajectories] == [149]


def test_rows_that_are_there_twice_are_told(tmp_path: Path) -> None:
    rows = np.sort(np.r_[:ROWS, 20:ROWS:20])
    found = read_measurements(write(tmp_path / "log.csv", Z[rows], U[rows], T[rows]))
    assert len(found.trajectories) == 15
    told = "t is the same in rows 22 and 23, and 13 times more: each begins another trajectory"
    assert found.remarks[0].startswith(told)


def test_a_log_of_changes_alone_is_refused_with_what_to_do(tmp_path: Path) -> None:
    path = write(tmp_path / "own.csv")
    lines = path.read_text().splitlines()
    lines[5:] = [f"{line.rpartition(',')[0]}," for line in lines[5:]]
    path.write_text("\n".join(lines))
    with pytest.raises(ValueError, match=r"a2 is missing in row 6 \(.* the last value before it"):
        read_measurements(path)


def test_missing_rows_are_cut_at_and_never_interpolated_over(tmp_path: Path) -> None:
    there = np.delete(np.arange(ROWS), [100, 101, 250])
    path = write(tmp_path / "own.csv", Z[there], U[there], T[there])
    with pytest.raises(ValueError, match=r"got 3 s before row 102 .* --cut does so"):
        read_measurements(path)
    with pytest.raises(ValueError, match=r"t grows by 3 s before row 102 .* add --cut"):
        read_measurements(path, resample=1.0)
    for resample in (None, 1.0):
        found = read_measurements(path, cut=True, resample=resample)
        assert [len(a) for _, a in found.trajectories] == [99, 147, 48]
        np.testing.assert_allclose(poles(found), TRUE, atol=0.01)


@pytest.mark.parametrize("name", ["t_ms", "time_ms", "Time [ms]", "time (ms)"])
def test_the_column_of_times_is_found_by_its_name(tmp_path: Path, name: str) -> None:
    """Also beside a temperature T, which is none."""
    names = [name, *NAMES[1:]]
    path = write(tmp_path / "own.csv", Z, U, t=100.0 * T, names=names)
    found = read_measurements(path, states=",".join(NAMES[1:4]), inputs=",".join(NAMES[4:]))
    assert found.sample_time == pytest.approx(0.1)
    assert list(found.channels.states) == NAMES[1:4]


@pytest.mark.parametrize(
    ("name", "step", "seconds"),
    [
        ("t_ms", 100.0, 0.1),
        ("Time [ms]", 100.0, 0.1),
        ("time_us", 1e5, 0.1),
        ("t (min)", 1.0, 60.0),
        ("Zeit in h", 0.5, 1800.0),
        ("t/ns", 1e8, 0.1),
        ("timestampMs", 100.0, 0.1),
        ("elapsed [Seconds]", 0.25, 0.25),
        ("time.d", 1.0, 86400.0),
        ("time [s]", 100.0, 100.0),
        ("t", 0.1, 0.1),
        ("timer", 2.0, 2.0),
    ],
)
def test_the_unit_of_time_is_that_of_the_name(
    tmp_path: Path, name: str, step: float, seconds: float
) -> None:
    names = [name, *NAMES[1:]]
    path = write(tmp_path / "own.csv", t=step * T, names=names)
    found = read_measurements(path, time=name)
    assert found.sample_time == pytest.approx(seconds, rel=1e-9) and found.remarks == ()
    if name.startswith("t") and name[1:2] in ("", "_", " "):
        assert read_measurements(path).sample_time == found.sample_time
    assert read_measurements(path, time=name, time_unit="ms").sample_time == pytest.approx(
        1e-3 * step
    )


@pytest.mark.parametrize(
    ("name", "times", "words", "step"),
    [
        ("t", 100.0 * T, "the steps of t are 100, taken as s: give --time-unit ms", 100.0),
        ("t", 1e5 * T, "the steps of t are 100000, taken as s", 1e5),
        ("t [ticks]", T, r"the unit 'ticks' of t \[ticks\] is not known, so it is taken as s", 1.0),
        ("t", 1.7e12 + 250.0 * T, "t counts since 1970 in ms, by its size", 0.25),
        ("t", 1.7e15 + 250e3 * T, "t counts since 1970 in us, by its size", 0.25),
    ],
)
def test_times_of_another_size_are_told(
    tmp_path: Path, name: str, times: np.ndarray, words: str, step: float
) -> None:
    names = [name, *NAMES[1:]]
    found = read_measurements(
        write(tmp_path / "own.csv", t=times, names=names, digits=17), time=name
    )
    assert re.match(words, found.remarks[0]) and found.sample_time == pytest.approx(step)
    assert in_seconds(name, times, "s") == (pytest.approx(times), [])
    with pytest.raises(ValueError, match="the unit of time is 'fortnight'; expected one of ns, us"):
        read_measurements(tmp_path / "own.csv", time_unit="fortnight")


def test_two_channels_that_are_one_are_told_with_factor_and_offset(tmp_path: Path) -> None:
    z = np.column_stack([Z, 1.8 * Z[:, 1] + 32.0])
    names = [*NAMES[:4], "z4", *NAMES[4:]]
    (text,) = read_measurements(write(tmp_path / "own.csv", z, names=names)).remarks
    assert text.startswith(
        "z4 is 1.8 z2 + 32 in every row from row 2 on, so the two are one channel"
    )
    (text,) = read_measurements(write(tmp_path / "own.csv", np.round(z, 1), names=names)).remarks
    assert re.match(r"z4 is 1\.(80|79)\d* z2 \+ 32\.\d+ in every row", text)
    z[:, 3] = U[:, 0]
    (text,) = read_measurements(write(tmp_path / "own.csv", z, names=names)).remarks
    assert text.startswith("a1 is z4 in every row") and text.endswith("leave one out of --inputs")


def test_a_large_offset_is_told_only_where_the_model_has_no_constant_term(tmp_path: Path) -> None:
    path = write(tmp_path / "own.csv", Z / 50.0 + [300.0, 20.0, 0.0])
    found = identify_data(read_measurements(path), {})
    assert found.model.d is not None and not any("below 5% of" in text for text in found.warnings)
    given = {"identification": "dmdc", "dmdc_rank": 5, "reduced_order": 3}
    told = identify_data(read_measurements(path), given).warnings
    assert any(text.startswith("z1 and z2: the variation is below 5% of") for text in told)


def test_an_actuator_that_saturates_beyond_the_log_is_told(tmp_path: Path) -> None:
    told = "does not follow"
    plain = identify_data(read_measurements(write(tmp_path / "own.csv")), {})
    assert not any(told in text for text in plain.warnings)
    band = 2.5 + np.sign(U - 2.5) * np.maximum(np.abs(U - 2.5) - [0.0, 1.0], 0.0)
    for applied in (np.minimum(U, [5.0, 2.5]), band):
        z, noise = Z.copy(), np.random.default_rng(3).standard_normal(Z.shape)
        for k in range(ROWS - 1):
            z[k + 1] = A @ z[k] + B @ applied[k] + 0.01 * noise[k]
        found = identify_data(read_measurements(write(tmp_path / "own.csv", z)), {})
        (text,) = [one for one in found.warnings if told in one]
        assert text.startswith("z3 does not follow a2 in proportion")


def step_test() -> tuple[np.ndarray, np.ndarray]:
    """From rest, without noise, and at rest again in the end."""
    u = np.zeros((ROWS, 2))
    u[60:], u[200:] = (2.0, 1.0), 0.0
    z = np.zeros((ROWS, 3))
    for k in range(ROWS - 1):
        z[k + 1] = A**2 @ z[k] + B @ u[k]
    return z, u


def pulses() -> tuple[np.ndarray, np.ndarray]:
    """One row of input now and then, and a state that answers at once."""
    rng, u, z = np.random.default_rng(2), np.zeros((ROWS, 2)), np.zeros((ROWS, 3))
    u[rng.choice(ROWS - 20, 12, replace=False)] = rng.uniform(20, 50, (12, 2))
    for k in range(ROWS - 1):
        z[k + 1] = 0.1 * A @ z[k] + B @ u[k]
    return z, u


def wave() -> tuple[np.ndarray, np.ndarray]:
    """What arrives late: the second and third state stand still at first."""
    u, z = U.copy(), np.zeros((ROWS, 3))
    for k in range(ROWS - 1):
        z[k + 1] = [0.5 * z[k, 0] + u[k, 0], z[max(k - 30, 0), 0], u[max(k - 60, 0), 1]]
    return z, u


@pytest.mark.parametrize(
    ("z", "u"),
    [
        (Z, U),
        log(3, noise=0.0),
        log(4, held=1),
        log(5, held=40),
        (np.round(Z, 1), U),
        step_test(),
        pulses(),
        wave(),
        (Z, np.where(U > 2.5, 5.0, 0.0)),
        (np.where(Z.mean(axis=0) < Z, 99.0, -99.0), U),
    ],
    ids=[
        "noise",
        "exact",
        "white",
        "steps",
        "coarse",
        "rest",
        "pulses",
        "late",
        "switched",
        "binary",
    ],
)
@pytest.mark.parametrize("digits", [4, 17])
def test_nothing_is_found_in_what_plants_do(
    tmp_path: Path, z: np.ndarray, u: np.ndarray, digits: int
) -> None:
    assert read_measurements(write(tmp_path / "own.csv", z, u, digits=digits)).remarks == ()


def test_arrays_have_the_same_pass(tmp_path: Path) -> None:
    z, u = spoilt(spike)
    path = tmp_path / "own.npz"
    np.savez(path, states=np.stack([Z, z]), actions=np.stack([U, u])[:, :-1], dt_ms=100.0)
    found = read_measurements(path, time="dt_ms")
    assert found.sample_time == 0.1 and len(found.trajectories) == 2
    (text,) = found.remarks
    assert text.startswith("z3 jumps to") and "row 77:" in text
    assert [len(a) for _, a in read_measurements(path, time="dt_ms", cut=True).trajectories] == [
        ROWS - 1,
        76,
        ROWS - 79,
    ]
    z[5, 0] = -9999.0
    np.savez(path, states=z, actions=u[:-1], sample_time=0.1)
    with pytest.raises(ValueError, match="z1 is -9999 in row 5, far"):
        read_measurements(path)


def assert_same(found: Measurements) -> None:
    ((states, actions),) = found.trajectories
    np.testing.assert_array_equal(states, Z)
    np.testing.assert_array_equal(actions, U[:-1])


@pytest.mark.parametrize("version", ["4", "5"])
def test_matlab_files_are_read(tmp_path: Path, version: str) -> None:
    path = tmp_path / "own.mat"
    io.savemat(path, {"t_ms": 100 * T, "T": Z, "u": U.T, "K": np.eye(2)}, format=version)
    found = read_measurements(path, time="t_ms", states="T*", inputs="u*")
    assert_same(found)
    assert found.sample_time == pytest.approx(0.1) and list(found.channels.inputs) == ["u1", "u2"]
    io.savemat(path, {"states": Z, "actions": U[:-1], "sample_time": 0.1}, format=version)
    assert_same(read_measurements(path))
    if version == "5":
        io.savemat(path, {"log": {"t": T, "z": Z, "a": U}, "note": "of today", "target": [1, 2, 3]})
        found = read_measurements(path, time="log.t", states="log.z*", inputs="log.a*")
        assert_same(found)
        assert found.target is not None and found.target.tolist() == [1.0, 2.0, 3.0]
    path.write_bytes(b"no matlab file" * 99)
    with pytest.raises(ValueError, match="it is no MATLAB file"):
        read_measurements(path)


def needs(name: str) -> None:
    if importlib.util.find_spec(name) is None:
        pytest.skip(f"{name} is not installed: extra logs")


def test_matlab_files_of_version_7_3_are_read(tmp_path: Path) -> None:
    """As MATLAB writes them: HDF5 with a block in front, matrices transposed."""
    needs("h5py")
    import h5py

    path = tmp_path / "own.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, array in (("t", T[:, None]), ("log/z", Z), ("u", U)):
            file.create_dataset(name, data=array.T).attrs["MATLAB_class"] = b"double"
        file.create_dataset("note", data=[[104, 105]]).attrs["MATLAB_class"] = b"char"
        file.create_group("#refs#")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file")
    assert_same(read_measurements(path, time="t", states="log.z*", inputs="u*"))


def test_parquet_files_are_read(tmp_path: Path) -> None:
    needs("pyarrow")
    import pyarrow
    from pyarrow import parquet

    path = tmp_path / "own.parquet"
    columns = dict(zip(NAMES, [T, *Z.T, *U.T], strict=True))
    parquet.write_table(pyarrow.table(columns), path)
    assert_same(read_measurements(path))
    instants = (1_760_000_000_000 + 500 * np.arange(ROWS)).astype("datetime64[ms]")
    parquet.write_table(pyarrow.table({**columns, "t": instants, "note": ["x"] * ROWS}), path)
    found = read_measurements(path, time="t", states="z*", inputs="a*")
    assert_same(found)
    assert found.sample_time == 0.5 and found.remarks == ()
    holes = pyarrow.array([None if k == 7 else v for k, v in enumerate(Z[:, 0])])
    parquet.write_table(pyarrow.table({**columns, "z1": holes}), path)
    with pytest.raises(ValueError, match="z1 is missing in row 8"):
        read_measurements(path)
    with pytest.raises(ValueError, match="expected numbers in column note, got 'x'"):
        parquet.write_table(pyarrow.table({**columns, "note": ["x"] * ROWS}), path)
        read_measurements(path, states="z*,note")
    path.write_bytes(b"PAR1" * 9)
    with pytest.raises(ValueError, match="cannot be read as Parquet"):
        read_measurements(path)


@pytest.mark.parametrize(
    ("name", "module", "words"),
    [
        ("own.parquet", "pyarrow", "needs pyarrow: pip install 'pdeloop.logs.'"),
        ("own.mat", "h5py", "version 7.3, which needs h5py: pip install 'pdeloop.logs.'"),
    ],
)
def test_a_library_that_is_missing_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, module: str, words: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / name).write_bytes(b"\x89HDF\r\n\x1a\n")
    with pytest.raises(ValueError, match=words):
        read_measurements(tmp_path / name)


def test_the_commands_options_reach_the_log(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    z, u = spoilt(stuck)
    z[200, 0] = -9999.0
    path = write(tmp_path / "own.csv", z, u, t=100 * T)
    words = ["identify", "--data", str(path), "--order", "3", "--json"]
    assert main(words) == FAILED
    error = capsys.readouterr().err
    assert "z1 is -9999 in row 202" in error and error.count("\n") == 1
    assert main([*words, "--missing=-9999,nan", "--cut", "--time-unit", "ms", "--resample"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["sample_time"] == 0.1
    assert printed.err == "WARNING: left out 16 rows, the first of them row 102\n"
    assert main(["identify", "--bag", str(tmp_path), "--cut"]) == FAILED
    assert "--cut applies to --data only" in capsys.readouterr().err
