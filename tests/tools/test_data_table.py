# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Tables as loggers and spreadsheets write them: the same numbers, or refused by row and column."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pdeloop.cli import FAILED, main
from pdeloop.data_file import Measurements, read_measurements
from pdeloop.identification import identify_data
from pdeloop.identification_plot import plot
from pdeloop.messages.files import FileError
from tests.support.linear_system import linear_system, trajectory

STATES, ACTIONS = (np.round(part, 3) for part in trajectory(*linear_system(4), steps=60))
NAMES = ["t", *(f"z{i}" for i in range(1, 5)), "a1", "a2"]
TARGET = ["target", "1", "1", "0.5", "0.25", "", ""]


def rows(start: float = 0.0, step: float = 0.1) -> list[list[str]]:
    """The log as texts, a row each; the last actions are missing."""
    table = []
    for k, z in enumerate(STATES):
        a = [f"{value:.3f}" for value in ACTIONS[k]] if k < len(ACTIONS) else ["", ""]
        table.append([f"{start + step * k:.6g}", *(f"{value:.3f}" for value in z), *a])
    return table


def text(
    lines: Sequence[Sequence[str]], *, separator: str = ",", mark: str = ".", end: str = "\n"
) -> str:
    return (
        end.join(separator.join(cell.replace(".", mark) for cell in line) for line in lines) + end
    )


PLAIN = [NAMES, TARGET, *rows()]


def read(
    tmp_path: Path, content: str | bytes, name: str = "own.csv", **options: Any
) -> Measurements:
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_measurements(path, **options)


def assert_the_log(found: Measurements) -> None:
    ((states, actions),) = found.trajectories
    assert np.array_equal(states, STATES) and np.array_equal(actions, ACTIONS)
    assert found.sample_time == pytest.approx(0.1, rel=1e-9)


def refused(tmp_path: Path, content: str | bytes, words: str, **options: Any) -> None:
    with pytest.raises(FileError, match=words) as failed:
        read(tmp_path, content, **options)
    assert "\n" not in str(failed.value) and "own.csv: " in str(failed.value)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
@pytest.mark.parametrize(("separator", "mark"), [(",", "."), (";", ","), (";", "."), ("\t", ",")])
def test_separators_decimal_marks_ends_of_lines_and_encodings_are_those_of_the_file(
    tmp_path: Path, separator: str, mark: str, encoding: str, end: str
) -> None:
    content = text(PLAIN, separator=separator, mark=mark, end=end)
    found = read(tmp_path, content.encode(encoding))
    assert_the_log(found)
    assert found.target is not None and found.target.tolist() == [1.0, 1.0, 0.5, 0.25]
    assert list(found.channels.states) == NAMES[1:5] and list(found.channels.inputs) == NAMES[5:]


@pytest.mark.parametrize(
    "content",
    [
        text(PLAIN, separator="|"),
        text([[f'"{cell}"' for cell in line] for line in PLAIN], separator=";", mark=","),
        text([[f" {cell} " for cell in line] for line in PLAIN]),
        text([[*line, ""] for line in PLAIN], separator=";"),  # a separator at the end
        "sep=;\n" + text(PLAIN, separator=";"),
        "\n\n" + text(PLAIN).replace("\n", "\n\n"),
        "# logged by hand\n\n" + text(PLAIN),
        "# of 2026\n# " + text(PLAIN),  # as numpy.savetxt writes names
        text(PLAIN).replace("target", "Target"),
        text([*PLAIN[:-1], [*PLAIN[-1][:5], "NaN", "-"]]),
        "Machine 7 of hall 2\nwritten on 2026-01-31, by its logger\n\n" + text(PLAIN),
        text([["", "Tanks", "", "", "", "Pumps", ""], *PLAIN]),  # groups above the names
        text(
            [["Machine 7", *[""] * 6], NAMES, ["s", *["degC"] * 4, "%", "%"], *rows()],
            separator=";",
        ),
    ],
)
def test_what_else_programs_write_is_read(tmp_path: Path, content: str) -> None:
    assert_the_log(read(tmp_path, content))


def test_columns_separated_by_spaces_are_read(tmp_path: Path) -> None:
    whole = [NAMES, *(line[:5] + [cell or "0" for cell in line[5:]] for line in rows())]
    for content in (text(whole, separator="  "), "# " + text(whole, separator=" ")):
        assert_the_log(read(tmp_path, content, name="own.dat"))


def test_instants_are_seconds_since_the_first_one(tmp_path: Path) -> None:
    for form in ("2026-01-31 23:59:58.{}", "2026-01-31T23:59:58.{}+01:00"):
        lines = [NAMES, *rows()[:5]]
        for k, line in enumerate(lines[1:]):
            line[0] = form.format(k)
        found = read(tmp_path, text(lines))
        assert found.sample_time == pytest.approx(0.1)
    lines[3][0] = "2026-01-31 23:59:58.2"
    refused(tmp_path, text(lines), "a time zone in all rows or in none")
    lines[3][0] = "0.2"
    refused(tmp_path, text(lines), "expected a time t in row 4, got '0.2'")


def test_a_clock_that_counts_since_1970_has_equal_steps(tmp_path: Path) -> None:
    lines = [NAMES, *rows()]
    for k, line in enumerate(lines[1:]):
        line[0] = repr(1.7e9 + 1e-4 * k)
    assert read(tmp_path, text(lines)).sample_time == pytest.approx(1e-4, rel=1e-2)


@pytest.mark.parametrize("unit", [1e-9, 1e-3, 1.0, 1e9])
def test_a_gap_in_time_is_told_by_its_row_in_any_unit(tmp_path: Path, unit: float) -> None:
    lines = [NAMES, *rows(step=0.1 * unit)]
    assert read(tmp_path, text(lines)).sample_time == pytest.approx(0.1 * unit, rel=1e-6)
    del lines[20]
    refused(
        tmp_path, text(lines), r"got \S+ s before row 21 where the others are \S+ s: fill the gap"
    )


@pytest.mark.parametrize("missing", ["", "NaN", "n/a", "null"])
def test_a_gap_is_told_by_its_row_and_column(tmp_path: Path, missing: str) -> None:
    for column, name in ((2, "z2"), (6, "a2")):
        lines = [NAMES, TARGET, *rows()]
        lines[17][column] = missing
        words = f"{name} is missing in row 18: fill the gap, or cut the file in two there"
        refused(tmp_path, text(lines), words)
        lines[23][column] = missing
        refused(tmp_path, text(lines), r"row 18 \(and 1 more with gaps\)")
    refused(tmp_path, text([NAMES, ["target", "1", "", "0", "0", "", ""], *rows()]), "target of z2")


@pytest.mark.parametrize(
    ("cell", "separator", "words"),
    [
        ("1.234,5", ";", "no mark of thousands, got '1.234,5' in row 4, column z1"),
        ("1,234,567", ";", "no mark of thousands, got '1,234,567' in row 4, column z1"),
        ("0,5", ";", r"got '0,5' in row 4, column z1, after '\.' in an earlier number"),
        ('"0,5"', ",", "expected a decimal point .* got '0,5' in row 4, column z1"),
        ("1 234.5", ",", "expected a number, got '1 234.5' in row 4, column z1"),
        ("12:00", ",", "expected a number, got '12:00' in row 4, column z1"),
        ("5 V", ",", "expected a number, got '5 V' in row 4, column z1"),
        ("1e999", ",", "z1 is missing in row 4|finite"),
    ],
)
def test_what_may_mean_two_things_is_refused(
    tmp_path: Path, cell: str, separator: str, words: str
) -> None:
    lines = [NAMES, *rows()]
    lines[3][1] = cell
    refused(tmp_path, text(lines, separator=separator), words)


def test_columns_are_chosen_by_name_or_pattern(tmp_path: Path) -> None:
    names = ["note", "clock", "T [K]", "T2", "T3", "level", "pump", "valve"]
    lines = [names, *([f"x{k}", *line] for k, line in enumerate(rows()))]
    content = text(lines, separator=";", mark=",")
    found = read(tmp_path, content, time="clock", states="T [K],T*,level", inputs="pump, valve")
    assert_the_log(found)
    assert list(found.channels.states) == names[2:6] and list(found.channels.inputs) == names[6:]
    turned = read(tmp_path, content, time="clock", states="level,T*", inputs="valve,pump")
    assert np.array_equal(turned.trajectories[0][0], STATES[:, [3, 0, 1, 2]])
    assert np.array_equal(turned.trajectories[0][1], ACTIONS[:, ::-1])
    given = {"time": "clock", "states": "T*", "inputs": "pump"}
    for changes, words in (
        ({"states": "T9"}, "--states: no column is named 'T9'; there are note, clock, .*mean"),
        ({"time": "c*,note"}, "expected one column for --time, got clock and note"),
        ({"time": "time"}, "--time: no column is named 'time'"),
        ({"inputs": "T2"}, "T2 cannot be of both --states and --inputs"),
        ({"states": "clock"}, "clock cannot be of both --time and --states"),
        ({"states": "note"}, "expected a number, got 'x0' in row 2, column note"),
    ):
        refused(tmp_path, content, words, **{**given, **changes})
    refused(tmp_path, content, r"or choose columns with --time, --states and --inputs")
    refused(tmp_path, "t,z1,z1,a1\n0,1,1,1\n1,1,1,1\n", "several named z1")
    refused(tmp_path, "t,z1,a1,note\n0,1,1,1\n1,1,1,1\n", "got 't, z1, a1, note'")


def test_without_times_the_sampling_time_is_given(tmp_path: Path) -> None:
    content = text([line[1:] for line in [NAMES, *rows()]])
    refused(tmp_path, content, "expected the names t, z")
    assert_the_log(read(tmp_path, content, sample_time=0.1))
    refused(tmp_path, text(PLAIN), "leave out --sample-time: it has a column", sample_time=0.1)


def test_a_row_alone_is_left_out_and_told(tmp_path: Path) -> None:
    lines = [NAMES, ["9", *rows()[0][1:]], *rows()]
    found = read(tmp_path, text(lines))
    assert_the_log(found)
    assert found.remarks == ("left out row 2: t increases neither before nor after it",)


def test_several_files_are_pooled_if_they_are_of_one_plant(tmp_path: Path) -> None:
    paths = [tmp_path / f"{i}.csv" for i in range(3)]
    for path, lines in zip(paths, (PLAIN, [NAMES, *rows(start=7.0)], PLAIN), strict=True):
        path.write_text(text(lines))
    found = read_measurements(*paths)
    assert len(found.trajectories) == 3 and found.target is not None
    assert found.sources[1] == {"file": str(paths[1]), "trajectory": 0}
    for changed, words in (
        ([NAMES, *rows(step=0.2)], "expected the sampling time of .*0.csv, 0.1 s, got 0.2 s"),
        ([[*NAMES[:4], "zz", "a1", "a2"], *rows()], "same channels as in .*0.csv, got the states"),
        ([NAMES, [*TARGET[:4], "7", "", ""], *rows()], "expected the target of .*0.csv, or none"),
    ):
        paths[1].write_text(text(changed))
        with pytest.raises(FileError, match=f"1.csv: .*{words}"):
            read_measurements(*paths)


def test_an_npz_has_arrays_of_other_names_and_no_target_if_that_is_said(tmp_path: Path) -> None:
    path = tmp_path / "own.npz"
    np.savez(path, T=STATES, u=ACTIONS, dt=0.1)
    found = read_measurements(path, states="T", inputs="u", time="dt")
    assert found.target is None
    assert_the_log(found)
    with pytest.raises(FileError, match=r"states, actions, .* is missing; there are T, u, dt"):
        read_measurements(path)
    assert_the_log(read_measurements(path, states="T", inputs="u", sample_time=0.1))
    with pytest.raises(FileError, match=r"expected a target of 4 finite numbers, .* got 2"):
        read_measurements(path, states="T", inputs="u", time="dt", target=[1.0, 2.0])


def identified(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    capsys.readouterr()
    assert main(["identify", *words, "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_without_a_target_there_is_a_model_and_no_law(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own, out = tmp_path / "own.csv", tmp_path / "model.npz"
    own.write_text(text([NAMES, *rows()]))
    words = ["--data", str(own), "--order", "4"]
    assert main(["identify", *words, "--out", str(out)]) == 0
    assert "no target, so no gains: give --target" in capsys.readouterr().out
    with np.load(out) as saved:
        assert {"A", "B", "U", "d", "sample_time", "states", "inputs"} == set(saved)
    assert identified(capsys, *words)["closed_loop"] is None
    train = [
        "train",
        "burgers",
        "--in-process",
        "--model",
        str(out),
        "--out",
        str(tmp_path / "run"),
    ]
    for refusal, told in (
        (["identify", *words, "--state-weight", "2"], "--state-weight are weights of a law"),
        (["identify", *words, "--identification", "field"], "designs a law for a target"),
        (["identify", *words, "--target", "1,2"], "expected a target of 4 finite numbers"),
        (train, "the model is of a state of 4 numbers and 2 inputs, but the plant has 128 and 6"),
    ):
        assert main(refusal) == FAILED
        error = capsys.readouterr().err
        assert told in error and error.count("\n") == 1


@pytest.mark.parametrize("offset", [0.0, 20.0])
def test_a_picture_simulates_with_the_constant_term_and_says_so(
    tmp_path: Path, offset: float
) -> None:
    shifted = [[row[0], *(str(float(z) + offset) for z in row[1:5]), *row[5:]] for row in rows()]
    target = np.array([float(z) for z in TARGET[1:5]]) + offset
    log = read(tmp_path, text([NAMES, *shifted]), target=target)
    figure = plot(identify_data(log, {"reduced_order": 4, "identification": "regression"}))
    drawn = np.array([line.get_ydata() for line in figure.axes[1].lines])
    recorded, simulated = drawn[:4], drawn[4:]
    np.testing.assert_array_equal(recorded, STATES.T + offset)
    np.testing.assert_allclose(simulated, recorded, atol=0.02)
    assert "constant term" in (figure.get_suptitle() or "")
    low, high = ACTIONS.min(axis=0), ACTIONS.max(axis=0)
    ends = [line.get_ydata()[0] for line in figure.axes[3].lines if line.get_linestyle() == ":"]
    assert ends == [low[0], high[0], low[1], high[1]]


def test_the_law_on_the_model_is_the_law_that_is_saved(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As somebody who reads the last line of the text would apply it."""
    own, out, picture = tmp_path / "own.csv", tmp_path / "model.npz", tmp_path / "own.png"
    own.write_text(text([NAMES, *rows()]))
    words = ["--data", str(own), "--order", "4", "--target", "1,1,0.5,0.25", "--out", str(out)]
    assert main(["identify", *words, "--plot", str(picture)]) == 0
    told = capsys.readouterr().out
    assert "a = K_a U^T z + K_b s_r every 0.1 s, with z = (z1, z2, z3, z4) and a = (a1, a2)" in told
    assert f"picture in {picture}" in told
    assert picture.read_bytes().startswith(b"\x89PNG")
    loop = identified(capsys, *words)["closed_loop"]
    with np.load(out) as law:
        A, B = law["U"] @ law["A"] @ law["U"].T, law["U"] @ law["B"]
        d = law["U"] @ law["d"]
        z, distances, actions = STATES[0], [], []
        for _ in range(loop["steps"] + 1):
            distances.append(np.linalg.norm(z - [1, 1, 0.5, 0.25]))
            actions.append(law["K_a"] @ law["U"].T @ z + law["K_b"] @ law["s_r"])
            z = A @ z + B @ actions[-1] + d
        radius = np.abs(np.linalg.eigvals(A + B @ law["K_a"] @ law["U"].T)).max()
    assert loop["spectral_radius"] == pytest.approx(radius)
    assert loop["distance_left"] == pytest.approx(distances[-1] / distances[0], rel=1e-9)
    taken = [np.min(actions[:-1], axis=0), np.max(actions[:-1], axis=0)]
    np.testing.assert_allclose(loop["action_range"], taken, rtol=1e-9)


def test_the_commands_options_reach_the_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = tmp_path / "own.csv"
    own.write_text(
        text([["clock", "T1", "T2", "T3", "T4", "pump", "valve"], *rows()], separator=";")
    )
    words = ["--time", "clock", "--states", "T*", "--inputs", "pump,valve", "--order", "4"]
    found = identified(capsys, "--data", str(own), *words)
    assert found["states"] == ["T1", "T2", "T3", "T4"] and found["inputs"] == ["pump", "valve"]
    twice = identified(capsys, "--data", str(own), str(own), *words)
    assert "1 repeats 0" in twice["warnings"][0] and twice["steps"] == found["steps"] == 60
    lines = [["clock", "T1", "T2", "T3", "T4", "pump", "valve"], *rows()]
    for line in lines[1:]:
        line[6] = "0"
    own.write_text(text(lines, separator=";"))
    assert main(["identify", "--data", str(own), *words]) == FAILED
    assert "the input valve never moved" in capsys.readouterr().err


@pytest.mark.parametrize("flag", ["--time", "--states", "--inputs", "--sample-time"])
def test_what_is_of_a_file_is_refused_with_a_bag(
    tmp_path: Path, flag: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["identify", "--bag", str(tmp_path), flag, "1"]) == FAILED
    assert f"{flag} applies to --data only" in capsys.readouterr().err


@pytest.mark.parametrize("numbers", ["", "1,", "1,x", "nan,1", "1;2"])
def test_a_target_that_is_not_numbers_is_refused(
    numbers: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["identify", "--data", "own.csv", "--target", numbers])
    assert "expected finite numbers with commas between" in capsys.readouterr().err


def test_a_column_that_is_named_twice_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    refused(tmp_path, text(PLAIN), "--states names z1 more than once", states="z1, z2,z1")
    read(tmp_path, text(PLAIN), states="z2,z*")  # an order
    for step in ("0", "-1", "nan", "x"):
        with pytest.raises(SystemExit):
            main(["identify", "--data", str(tmp_path / "own.csv"), f"--resample={step}"])
        told = (
            f"--resample: expected seconds above 0, got '{step}'; without a number it is the log's"
        )
        assert told in capsys.readouterr().err
