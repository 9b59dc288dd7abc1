# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The command line as a tool: help, JSON, exit codes, what is not installed."""

from __future__ import annotations

import argparse
import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from pdeloop import cli
from pdeloop.cli import main
from pdeloop.commands import problems
from pdeloop.messages.problem import read_problem
from pdeloop.output import print_json
from tests.support.interpreter import python
from tests.support.small import SMALL
from tests.support.terminal import run


def commands(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """Every command and subcommand below `parser`."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for below in action.choices.values():
                yield below
                yield from commands(below)


ALL = {command.prog: command for command in commands(cli.parser())}


@pytest.mark.parametrize("name", ALL)
def test_every_command_shows_an_example_that_its_parser_takes(name: str, capsys) -> None:
    command = ALL[name]
    with pytest.raises(SystemExit) as left:
        main([*name.split()[1:], "--help"])
    assert left.value.code == 0
    said = " ".join(capsys.readouterr().out.split())
    assert (command.epilog or "").startswith("example: ")
    example = (command.epilog or "").removeprefix("example: ")
    assert " ".join(example.split()) in said
    inside = re.search(r"\$\((.*?)\)", example)
    words = shlex.split(inside.group(1) if inside else example.partition(" > ")[0])
    assert " ".join(words).startswith(name)
    cli.parser().parse_args(words[1:])


@pytest.mark.parametrize("name", ALL)
def test_every_argument_says_what_it_is(name: str) -> None:
    for action in ALL[name]._actions:
        if not isinstance(action, argparse._SubParsersAction):
            assert action.help, f"{name} {action.dest}"


def test_a_version_is_told(capsys) -> None:
    with pytest.raises(SystemExit) as left:
        main(["--version"])
    assert left.value.code == 0
    assert re.fullmatch(r"pdeloop \d+\.\d+\.\d+\n", capsys.readouterr().out)


def test_data_is_one_line_of_strict_json(capsys) -> None:
    print_json({"a": [1.5, float("nan"), (float("inf"), None)], 3: "ü"})
    out = capsys.readouterr().out
    assert out.count("\n") == 1
    assert json.loads(out) == {"a": [1.5, None, [None, None]], "3": "ü"}


def test_problems_are_data_too(capsys) -> None:
    assert main(["problems", "--json"]) == 0
    found = {one["name"]: one for one in json.loads(capsys.readouterr().out)}
    assert Path(found["burgers"]["file"]).is_file()
    values = read_problem(Path(found["kdv"]["file"]))
    assert all(found["kdv"][name] == values[name] for name in ("n_z", "n_a", "horizon"))


def test_a_trainings_result_is_all_of_its_output(tmp_path: Path, capsys) -> None:
    out = tmp_path / "run"
    words = ["train", str(SMALL), "--in-process", "--iterations", "2", "--json", "--out", str(out)]
    assert main(words) == 0
    captured = capsys.readouterr()
    result = json.loads(captured.out)
    assert result["folder"] == str(out)
    assert result["mean_cost"] == json.loads((out / "result.json").read_text())["mean_cost"]
    assert "evaluate" in captured.err


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["problems"], 0, ""),
        (["bag", "info", "nowhere"], 1, "nowhere"),
        (["train", "burgers", "--iterations", "many"], 2, "invalid int value: 'many'"),
        (["tarin"], 2, "invalid choice: 'tarin'"),
        ([], 2, "required: COMMAND"),
    ],
)
def test_exit_codes(words: list[str], code: int, said: str, capsys) -> None:
    try:
        assert main(words) == code
    except SystemExit as left:
        assert left.code == code
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error


def test_the_exit_code_is_that_of_the_process() -> None:
    done = run("train", "stokes")
    assert done.returncode == 1
    assert done.stderr.startswith("pdeloop: unknown problem 'stokes'")


def test_ctrl_c_finds_little_to_interrupt_before_it_is_caught() -> None:
    code = "import sys, pdeloop.cli; print([m for m in ('numpy', 'yaml', 'email') if m in sys.modules])"
    assert python("-c", code).stdout.strip() == "[]"


def test_the_help_of_all_commands_and_their_completion_wait_for_no_numerics() -> None:
    slow = ("numpy", "scipy", "numba", "rclpy", "matplotlib", "importlib.metadata")
    code = "import sys; from pdeloop.cli import parser; parser(); "
    done = python("-c", f"{code} print([name for name in {slow} if name in sys.modules])")
    assert done.stdout.strip() == "[]"


def test_ctrl_c_during_imports_is_one_line(monkeypatch, capsys) -> None:
    def interrupted() -> argparse.ArgumentParser:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "parser", interrupted)
    assert main(["problems"]) == cli.INTERRUPTED
    assert capsys.readouterr().err == "pdeloop: stopped by SIGINT\n"


def test_a_bug_is_a_traceback_and_a_code_of_its_own(monkeypatch, capsys) -> None:
    def broken() -> dict[str, Path]:
        raise KeyError("a bug")

    monkeypatch.setattr(problems, "shipped_problems", broken)
    assert main(["problems"]) == 70
    assert "Traceback" in capsys.readouterr().err


def test_the_help_of_train_is_in_groups(capsys) -> None:
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    text = capsys.readouterr().out
    groups = ("problem:", "budget and method:", "run:", "recording:", "machine:")
    assert [line for line in text.splitlines() if line in groups] == list(groups)
    (options,) = re.findall(r"^options:\n(.*?)\n\n", text, flags=re.MULTILINE | re.DOTALL)
    assert options.count("--") == 1  # --help


def test_every_optional_part_that_is_not_installed_is_named_in_one_line(tmp_path: Path) -> None:
    """All optional modules are missing; each command names the extra that it needs."""
    code = f"""
import contextlib, io, sys
for name in ("rclpy", "rosbags", "mcap", "aiohttp", "matplotlib", "std_msgs"):
    sys.modules[name] = None
from pdeloop.cli import main
run = {str(tmp_path / "run")!r}
assert main(["train", {str(SMALL)!r}, "--in-process", "--rollouts", "11", "--out", run]) == 0
for words in (["monitor"], ["report", run], ["bag", "info", run],
              ["identify", "--bag", run],
              ["train", {str(SMALL)!r}, "--record", "--out", run + "2"],
              ["train", {str(SMALL)!r}, "--out", run + "3"]):
    said = io.StringIO()
    with contextlib.redirect_stderr(said):
        code = main(words)
    print("@", code, " ".join(words[:2]), "|", said.getvalue().replace(chr(10), "|"))
assert main(["identify", "--data", "examples/measurements.csv"]) == 0
"""
    done = python("-c", code)
    lines = [line for line in done.stdout.splitlines() if line.startswith("@")]
    assert len(lines) == 6, done.stdout
    said = r"@ 1 .*\| pdeloop: needs \w+: .*pip install 'pdeloop\[\w+\]'[^|]*\|"
    for line in lines:
        assert re.fullmatch(said, line), line
