# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Times as Excel and SCADA systems write them, and a row of units below the names."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from pdeloop.data_file import read_measurements
from pdeloop.instants import seconds_of

STEPS = 10.0 * np.arange(8)


def written(form: str, begin: str = "2024-10-27 00:30:00") -> list[str]:
    first = datetime.fromisoformat(begin)
    return [(first + timedelta(seconds=t)).strftime(form) for t in STEPS]


def read(texts: list[str]) -> np.ndarray:
    return seconds_of(texts, range(2, 2 + len(texts)))


@pytest.mark.parametrize(
    "form",
    [
        "%d.%m.%Y %H:%M:%S",
        "%d.%m.%y %H:%M:%S",
        "%m/%d/%Y %I:%M:%S %p",
        "%d/%m/%Y %H:%M:%S,0",
        "%d-%m-%Y %H:%M:%S",
        "%Y/%m/%d %H:%M:%S.000",
        "%Y-%m-%d %H:%M:%S",
        "%d-%b-%Y %H:%M:%S",
    ],
)
def test_dates_and_times_are_seconds_since_the_first(form: str) -> None:
    assert read(written(form)).tolist() == STEPS.tolist()
    assert read(written(form, "2024-10-31 23:59:35")).tolist() == STEPS.tolist()


def test_times_of_day_go_on_after_midnight() -> None:
    for form in ("%H:%M:%S", "%I:%M:%S %p"):
        times = read(written(form, "2024-10-27 23:59:35"))
        assert np.diff(times).tolist() == np.diff(STEPS).tolist()
    assert read(["09:00:00", "09:00:10", "08:00:00"])[2] == 8 * 3600  # another experiment


def test_of_day_and_month_the_order_decides_or_nothing() -> None:
    for form in ("%d/%m/%Y %H:%M:%S", "%m/%d/%Y %H:%M:%S"):
        assert read(written(form, "2024-05-06 23:59:35")).tolist() == STEPS.tolist()
        assert read(written(form, "2024-05-06 12:00:00")).tolist() == STEPS.tolist()
    with pytest.raises(ValueError, match=r"'05/06/2024' in row 2, may begin with the day or with"):
        read(["05/06/2024", "06/06/2024", "06/07/2024"])


@pytest.mark.parametrize(
    ("texts", "words"),
    [
        (["31.02.2024 00:00:00"], "row 2, got '31.02.2024 00:00:00' .day is out of range"),
        (["13/13/2024 00:00:00"], "row 2, got '13/13/2024"),
        (["1.2.2024 13:00:00 PM"], "an hour of 13"),
        (["1.2.2024 12:70:00"], "no time of day"),
        (["1.2.2024 12:00", "2/1/2024 12:01"], "in row 3 in the form of '1.2.2024 12:00'"),
        (["2024-02-01 12:00", "1.2.2024 12:01"], "expected a time t in row 3"),
    ],
)
def test_other_times_are_refused_by_row(texts: list[str], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        read(texts)


def table(tmp_path: Path, times: list[str], *below: str) -> Path:
    path = tmp_path / "log.csv"
    rows = [f"{t};{0.5 * k % 1.3};{k * k % 7}" for k, t in enumerate(times)]
    path.write_text("\n".join(["t;z1;a1", *below, *rows]))
    return path


def test_a_log_of_a_spreadsheet_is_read(tmp_path: Path) -> None:
    found = read_measurements(table(tmp_path, written("%d.%m.%Y %H:%M:%S")))
    assert found.sample_time == 10.0
    for text in ("27. Okt 2024 00:30", "27-Okt-2024 00:30", "00:30", "yesterday"):
        with pytest.raises(
            ValueError, match=r"row 2, got '.*'; times are numbers, h:m:s, or dates"
        ):
            read_measurements(table(tmp_path, [text, text]))


@pytest.mark.parametrize(
    ("units", "step"),
    [
        ("s;K;%", 10.0),
        ("[ms];[K];[%]", 0.01),
        ("min;K;", 600.0),
        (";degC;-", 10.0),
        ("s;1;1", 10.0),
    ],
)
def test_a_row_of_units_below_the_names_is_read(tmp_path: Path, units: str, step: float) -> None:
    found = read_measurements(table(tmp_path, [f"{t:g}" for t in STEPS], units))
    assert found.sample_time == pytest.approx(step)
    assert len(found.trajectories[0][0]) == len(STEPS)


def test_a_row_of_units_stands_above_dates_too(tmp_path: Path) -> None:
    path = table(tmp_path, written("%d.%m.%Y %H:%M:%S"), "dd.mm.yyyy hh:mm:ss;K;%")
    assert read_measurements(path).sample_time == 10.0


def test_words_in_the_first_row_of_numbers_are_no_units(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected a number, got 'Off' in row 2"):
        read_measurements(table(tmp_path, ["0", "1"], "0;Off;Off"))


def test_a_clock_that_shows_no_seconds_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="rows 2 and 3, and 5 times more: its clock is too coarse"):
        read_measurements(table(tmp_path, written("%m/%d/%Y %H:%M")))


def test_dates_as_numbers_are_days(tmp_path: Path) -> None:
    for begin in (45592.020833333336, 739552.020833333336):  # of Excel, and of MATLAB
        found = read_measurements(table(tmp_path, [f"{begin + t / 86400.0:.9f}" for t in STEPS]))
        assert found.sample_time == pytest.approx(10.0, rel=1e-4)
        assert "dates as numbers of days, by their size" in " ".join(found.remarks)
    for step in (0.1, 10.0, 0.25):  # seconds of a day, and since a start
        found = read_measurements(table(tmp_path, [f"{36000.0 + step * k:.9g}" for k in range(8)]))
        assert found.sample_time == pytest.approx(step) and not found.remarks
