# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The command line as a tool: help, JSON, colours, exit codes, completion in real shells."""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import io
import json
import os
import pty
import re
import resource
import select
import shlex
import shutil
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path

import pytest
from rich.console import Console

from loop_interfaces.loop_parameters import read_problem
from loop_interfaces.start import PARENT, die_with
from pdeloop import cli, training_run
from pdeloop.cli import main
from pdeloop.commands import problems
from pdeloop.interruption import Interruption, interruptible
from pdeloop.output import print_json
from pdeloop.pairs import Transport
from pdeloop.progress import Progress
from pdeloop.supervisor import START
from tests.support.interpreter import ROOT, python
from tests.support.small import SMALL
from tuner_node.run_folder import RunFolder

PDELOOP = [sys.executable, "-m", "pdeloop.cli"]
CONTROL = re.compile(r"\x1b\[[0-9;?]*[a-zA-Z]")
COLOUR = re.compile(r"\x1b\[(?:\d+;)*(?:3[0-8]|4[0-8]|9[0-7]|10[0-7])(?:;\d+)*m")
LIMIT = 240.0
"""Seconds for a command, on a busy machine that has to compile the kernels first."""


def commands(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """Every command and subcommand below `parser`."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for below in action.choices.values():
                yield below
                yield from commands(below)


ALL = {command.prog: command for command in commands(cli.parser())}


def run(*words: str, environment: Mapping[str, str] | None = None, cwd: Path | None = None):
    """The command in a process of its own, with its output in pipes."""
    return subprocess.run(
        [*PDELOOP, *words],
        env={**os.environ, "PYTHONPATH": str(ROOT), **(environment or {})},
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=LIMIT,
    )


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
        ("slow", ["-m", "loop_interfaces.start", "slow"]),
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
        [sys.executable, "-m", "loop_interfaces.start", "short"],
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
    code = f"import sys; sys.modules[{module!r}] = None; from loop_interfaces.start import run; "
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


class Terminal:
    """A process on a pseudo-terminal: what is typed and what is shown."""

    def __init__(self, *command: str, cwd: Path, environment: Mapping[str, str]) -> None:
        self.master, slave = pty.openpty()
        self.process = subprocess.Popen(
            command,
            stdin=slave,
            stdout=slave,
            stderr=slave,
            cwd=cwd,
            env={**os.environ, "TERM": "xterm-256color", "COLUMNS": "100", **environment},
            start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),  # of which it is in charge
        )
        os.close(slave)
        self.shown = ""

    def read(self, seconds: float) -> bool:
        """Take what comes within `seconds`; False at the end."""
        if not select.select([self.master], [], [], seconds)[0]:
            return True
        try:
            new = os.read(self.master, 65536)
        except OSError:
            return False
        self.shown += new.decode(errors="replace")
        return bool(new)

    def until(self, text: str) -> str:
        """What is shown when `text` is (escape sequences left out)."""
        deadline = time.monotonic() + LIMIT
        while text not in self.plain:
            assert time.monotonic() < deadline, f"no {text!r} in {self.plain!r}"
            if not self.read(0.1):
                assert text in self.plain, f"no {text!r} in {self.plain!r}"
        return self.plain

    @property
    def plain(self) -> str:
        return CONTROL.sub("", self.shown)

    def type(self, text: str) -> None:
        """Type `text`, forgetting what was shown before."""
        self.shown = ""
        os.write(self.master, text.encode())

    def wait(self) -> int:
        """Read to the end; the exit code."""
        deadline = time.monotonic() + LIMIT
        while self.read(0.1) and time.monotonic() < deadline:
            pass
        return self.process.wait(LIMIT)


@contextlib.contextmanager
def terminal(*command: str, cwd: Path, **environment: str) -> Iterator[Terminal]:
    started = Terminal(*command, cwd=cwd, environment=environment)
    try:
        yield started
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(started.process.pid, signal.SIGKILL)
        started.process.wait(LIMIT)
        os.close(started.master)


@pytest.mark.parametrize("colour", [True, False])
def test_a_terminal_shows_a_bar_with_cost_and_time_left(tmp_path: Path, colour: bool) -> None:
    words = ("train", str(SMALL), "--in-process", "--iterations", "400", "--out", "run")
    environment = {"PYTHONPATH": str(ROOT)} | ({} if colour else {"NO_COLOR": "1"})
    with terminal(*PDELOOP, *words, cwd=tmp_path, **environment) as shown:
        assert shown.wait() == 0, shown.plain
    assert re.search(
        r"adapting [━╺╸]+ +\d+ of 803 rollouts cost [\d.]+ +\d:\d\d:\d\d", shown.plain
    ), shown.plain
    assert bool(COLOUR.search(shown.shown)) == colour
    assert "results in run" in shown.plain


def test_a_pipe_gets_plain_lines(tmp_path: Path) -> None:
    done = run(
        "train",
        str(SMALL),
        "--in-process",
        "--iterations",
        "16",
        "--out",
        "run",
        environment={"TERM": "xterm-256color"},
        cwd=tmp_path,
    )
    assert done.stdout.count(" of 35 rollouts, cost ") >= 6
    assert re.search(r"^  35 rollouts: cost [\d.]+$", done.stdout, flags=re.MULTILINE)
    assert "\x1b" not in done.stdout
    assert "\r" not in done.stdout


def test_an_interrupted_training_says_how_to_go_on(tmp_path: Path) -> None:
    words = ("train", str(SMALL), "--in-process", "--iterations", "100000", "--out", "run")
    with terminal(*PDELOOP, *words, cwd=tmp_path, PYTHONPATH=str(ROOT)) as shown:
        shown.until("cost ")
        os.killpg(shown.process.pid, signal.SIGINT)
        assert shown.wait() == 130
    assert "continue with: pdeloop train --resume run --in-process" in shown.plain


@pytest.mark.parametrize("nohup", [False, True])
def test_a_terminal_that_closes_ends_a_training_unless_nohup_was_asked_for(
    tmp_path: Path, nohup: bool
) -> None:
    words = ("train", str(SMALL), "--in-process", "--iterations", "100000", "--out", "run")
    ignore = "import signal, os, sys; signal.signal(signal.SIGHUP, signal.SIG_IGN); "
    ignore += "os.execv(sys.argv[1], sys.argv[1:])"
    prefix = (sys.executable, "-c", ignore) if nohup else ()
    with terminal(*prefix, *PDELOOP, *words, cwd=tmp_path, PYTHONPATH=str(ROOT)) as shown:
        shown.until("cost ")
        os.killpg(shown.process.pid, signal.SIGHUP)
        if nohup:
            so_far = len(shown.shown)
            deadline = time.monotonic() + LIMIT
            while len(shown.shown) < so_far + 500 and time.monotonic() < deadline:
                shown.read(0.1)
            assert shown.process.poll() is None
            return
        assert shown.wait() == 130
    assert "stopped by SIGHUP; continue with: pdeloop train --resume run" in shown.plain


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


def test_progress_becomes_lines() -> None:
    file = io.StringIO()
    progress = Progress(Console(file=file, width=80), "soak", "episodes")
    for done in range(0, 101, 2):
        progress.tell(done, 100, f"{done} faults")
    progress.close()
    lines = file.getvalue().splitlines()
    assert len(lines) == 9
    assert lines[4] == "soak: 50 of 100 episodes, 50 faults"


def test_news_after_long_silence_is_a_line(monkeypatch) -> None:
    file = io.StringIO()
    progress = Progress(Console(file=file, width=80), "adapting", "rollouts")
    monkeypatch.setattr("pdeloop.progress.PERIOD", -1.0)
    for done in (9, 10, 10, 11, 11, 11):
        progress.tell(done, 80, "cost 1.5")
    progress.close()
    said = [f"adapting: {done} of 80 rollouts, cost 1.5" for done in (10, 11)]
    assert file.getvalue().splitlines() == said


def test_progress_on_a_terminal_is_a_bar_that_leaves_nothing() -> None:
    file = io.StringIO()
    progress = Progress(Console(file=file, width=80, force_terminal=True), "soak", "episodes")
    progress.tell(0, 8)
    progress.tell(4, 8, "3 faults")
    progress.close()
    text = CONTROL.sub("", file.getvalue())
    assert re.search(r"soak [━╺]+ +4 of 8 episodes 3 faults", text)
    assert file.getvalue().rstrip().endswith("\x1b[2K")


SHELLS = {
    "bash": (
        ["bash", "--norc", "--noprofile", "-i"],
        'eval "$(register-python-argcomplete pdeloop)"',
    ),
    "zsh": (
        ["zsh", "-f", "-i"],
        'autoload -Uz compinit; compinit -u -D; eval "$(register-python-argcomplete pdeloop)"',
    ),
    "fish": (
        ["fish", "--no-config", "-i"],
        "register-python-argcomplete --shell fish pdeloop | source",
    ),
}


@pytest.mark.parametrize("shell", SHELLS)
def test_a_real_shell_completes(shell: str, tmp_path: Path) -> None:
    command, load = SHELLS[shell]
    if not shutil.which(command[0]):
        pytest.skip(f"needs {command[0]} (make packages)")
    (tmp_path / "zzz-own.yaml").write_text("")
    (tmp_path / "zzz-other.txt").write_text("")
    (tmp_path / "runs").mkdir()
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    home = {"HOME": str(tmp_path), "TMPDIR": str(tmp_path)}  # fish leaves a folder there
    home |= {"PYTHONPATH": str(ROOT), "PS1": "$ ", "PATH": path}
    with terminal(*command, cwd=tmp_path, **home) as shown:
        shown.type(load + "; echo load''ed\n")
        shown.until("loaded")
        for typed, completed in (
            ("pdeloop tra", "pdeloop train "),
            ("pdeloop train sch", "pdeloop train schrodinger "),
            # fish only sorts YAML files before others; bash and zsh leave the others out.
            ("pdeloop train zzz" + "-ow" * (shell == "fish"), "pdeloop train zzz-own.yaml "),
            ("pdeloop bag ver", "pdeloop bag verify "),
            ("pdeloop bag ver", "pdeloop bag verify "),
            ("pdeloop train --optimizer gauss", "--optimizer gauss_newton "),
            ("pdeloop evaluate ru", "pdeloop evaluate runs/"),
        ):
            shown.type(typed + "\t")
            shown.until(completed)
            shown.type("\x15")  # an empty line again
