# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""How commands and nodes end: signals, readers that leave, closed streams, too little memory."""

from __future__ import annotations

import os
import re
import resource
import shlex
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from pdeloop import cli, training_run
from pdeloop.cli import main, parser
from pdeloop.commands import problems
from pdeloop.interruption import Interruption, interruptible
from pdeloop.pairs import Transport
from pdeloop.process.start import PARENT, die_with
from pdeloop.supervisor import START
from pdeloop.training_run import continuing
from tests.support.interpreter import ROOT, python
from tests.support.small import SMALL
from tests.support.terminal import LIMIT, PDELOOP
from tuner_node.run_folder import RunFolder


def test_a_reader_that_leaves_is_no_error_to_talk_about() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(
        [*PDELOOP, "problems"], stdout=writing, stderr=subprocess.PIPE, text=True, timeout=LIMIT
    )
    os.close(writing)
    assert done.returncode == 141
    assert done.stderr == ""


def test_a_reader_that_leaves_a_training_is_told_how_to_go_on(tmp_path: Path) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    words = ["train", str(SMALL), "--in-process", "--iterations", "100000", "--out", "a run"]
    done = subprocess.run(
        [*PDELOOP, *words],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=writing,
        stderr=subprocess.PIPE,
        text=True,
        timeout=LIMIT,
    )
    os.close(writing)
    assert done.returncode == 141
    assert done.stderr.splitlines()[-1:] == [
        "pdeloop: the output has no reader; continue with: pdeloop train --resume 'a run' "
        "--in-process"
    ]


def test_a_training_goes_on_where_its_output_cannot_be_written(tmp_path: Path) -> None:
    out = tmp_path / "run"
    words = ["train", str(SMALL), "--in-process", "--iterations", "4", "--out", str(out)]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [*PDELOOP, *words], stdout=full, stderr=subprocess.PIPE, text=True, timeout=LIMIT
        )
    assert done.returncode == 0
    (told,) = [line for line in done.stderr.splitlines() if line.startswith("pdeloop:")]
    assert told.endswith("(No space left on device); the work continues")
    assert (out / "result.json").exists()


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_streams_are_like_dev_null(closed: str) -> None:
    done = subprocess.run(
        ["sh", "-c", f'"$@" {closed}', "sh", *PDELOOP, "problems"],
        capture_output=True,
        text=True,
        timeout=LIMIT,
    )
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_ends_any_command_and_the_start_of_a_node_with_one_line(
    name: str, tmp_path: Path
) -> None:
    (tmp_path / "slow").mkdir()
    (tmp_path / "slow" / "node.py").write_text(
        f"import os, signal\nos.kill(os.getpid(), signal.{name})\n"
    )
    command = (
        "import sys; from pdeloop import cli; sys.argv = ['pdeloop']; "
        "cli.parser = lambda: __import__('slow.node'); sys.exit(cli.main())"
    )
    for program, words in (
        ("pdeloop", ["-c", command]),
        ("slow", ["-m", "pdeloop.process.start", "slow"]),
    ):
        done = subprocess.run(
            [sys.executable, *words],
            env={**os.environ, "PYTHONPATH": f"{ROOT}:{tmp_path}"},
            capture_output=True,
            text=True,
            timeout=LIMIT,
        )
        assert (done.returncode, done.stderr) == (130, f"{program}: stopped by {name}\n")


def test_a_node_ends_with_its_code_and_nothing_after_it(tmp_path: Path) -> None:
    (tmp_path / "short").mkdir()
    (tmp_path / "short" / "node.py").write_text(
        "import atexit\n\natexit.register(print, 'late')\n\n"
        "def main():\n    print('done')\n    return 75\n"
    )
    done = subprocess.run(
        [sys.executable, "-m", "pdeloop.process.start", "short"],
        env={**os.environ, "PYTHONPATH": f"{ROOT}:{tmp_path}"},
        capture_output=True,
        text=True,
        timeout=LIMIT,
    )
    assert (done.returncode, done.stdout) == (75, "done\n")


def test_a_signal_may_wait_until_it_is_asked_for() -> None:
    known = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    done = False
    try:
        with (
            pytest.raises(Interruption, match="SIGTERM; continue with: more"),
            interruptible("more", at_once=False) as check,
        ):
            os.kill(os.getpid(), signal.SIGTERM)
            done = True
            check()
    finally:
        for number, handler in known.items():
            signal.signal(number, handler)
    assert done


def test_a_signal_after_the_result_interrupts_nothing(tmp_path: Path, monkeypatch, capsys) -> None:
    out = tmp_path / "run"
    assert main(["train", str(SMALL), "--in-process", "--iterations", "2", "--out", str(out)]) == 0

    def interrupted(*_: object) -> None:
        raise Interruption("SIGINT")

    monkeypatch.setattr(training_run, "carry_out", interrupted)
    values = RunFolder(out).values()
    assert training_run.run(out, values, Transport(in_process=True)) == 0
    assert f"results in {out}" in capsys.readouterr().out


def test_who_starts_when_its_parent_has_ended_ends_too() -> None:
    for parent, code in ((os.getpid(), 0), (os.getppid(), 1)):
        child = subprocess.Popen(["true"], preexec_fn=partial(die_with, parent))
        assert child.wait(LIMIT) == code


def test_a_node_whose_supervisor_has_ended_before_it_began_ends_too() -> None:
    """It learns of it from its environment: nothing of ours runs between its fork and execution."""
    command = [sys.executable, "-m", START, "pde_sim_node"]
    done = subprocess.run(
        command, env={**os.environ, PARENT: str(os.getppid())}, capture_output=True, timeout=LIMIT
    )
    assert (done.returncode, done.stdout, done.stderr) == (1, b"", b"")


@pytest.mark.parametrize(
    ("node", "module", "extra"),
    [("pde_sim_node", "rclpy", "ros"), ("recorder_node", "mcap", "record")],
)
def test_a_node_names_what_is_not_installed(node: str, module: str, extra: str) -> None:
    code = f"import sys; sys.modules[{module!r}] = None; from pdeloop.process.start import run; "
    done = python("-c", f"{code} assert run({node!r}) == 1")
    assert re.fullmatch(rf"{node}: needs {module}: .*'pdeloop\[{extra}\]'\n", done.stderr)


@pytest.mark.parametrize("words", [PDELOOP, [sys.executable, "-m", START, "tuner_node"]])
def test_too_little_address_space_is_one_sentence_before_a_library_waits_for_more(words) -> None:
    ended = subprocess.run(
        words,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=LIMIT,
        preexec_fn=partial(resource.setrlimit, resource.RLIMIT_AS, (400 * 2**20, 400 * 2**20)),
    )
    assert ended.returncode == cli.FAILED and ended.stdout == ""
    assert re.fullmatch(r".*: the limit .*\(ulimit -v\) is 400 MiB; expected .*\n", ended.stderr)


def test_too_little_memory_is_one_sentence(monkeypatch, capsys) -> None:
    def large() -> dict[str, Path]:
        raise MemoryError("Unable to allocate 61.0 GiB")

    monkeypatch.setattr(problems, "shipped_problems", large)
    assert main(["problems"]) == 1
    assert capsys.readouterr().err.startswith("pdeloop: not enough memory (Unable to allocate 61.0")


@pytest.mark.parametrize(
    "words",
    [
        ["--in-process", "--plant", "a folder/own.py:Rod"],
        ["--record", "--record-every", "3", "--pairs", "2", "--network", "--view"],
        ["--record-or-stop", "--optimizer", "own.py:Search", "--law", "own.py:Law"],
        [],
    ],
)
def test_the_command_that_continues_a_training_is_whole(words: list[str]) -> None:
    """With all that says how it is carried out, and the code that its user has named."""
    given = parser().parse_args(["train", *words])
    recorder = "required" if given.record_or_stop else "start" if given.record else "none"
    transport = Transport(
        given.in_process, recorder, given.record_every, given.network, given.pairs, given.view
    )
    values = {"equation": "burgers", "plant": "", "optimizer": "two_point", "law": "affine"}
    values |= {name: vars(given)[name] for name in values if vars(given)[name]}
    _, *again = shlex.split(continuing(Path("a run"), values, transport))
    found = vars(parser().parse_args(again)) | {"refuse": given.refuse}  # of its own parser
    assert found == vars(given) | {"resume": Path("a run")}
