# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The command line on a terminal: progress, colours, interruptions, completion in real shells."""

from __future__ import annotations

import io
import os
import re
import shutil
import signal
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

from pdeloop.display import Progress
from tests.support.interpreter import ROOT
from tests.support.small import SMALL
from tests.support.terminal import COLOUR, CONTROL, LIMIT, PDELOOP, run, terminal


@pytest.mark.parametrize("colour", [True, False])
def test_a_terminal_shows_a_bar_with_cost_and_time_left(tmp_path: Path, colour: bool) -> None:
    words = ("train", str(SMALL), "--in-process", "--iterations", "200", "--out", "run")
    environment = {"PYTHONPATH": str(ROOT)} | ({} if colour else {"NO_COLOR": "1"})
    with terminal(*PDELOOP, *words, cwd=tmp_path, **environment) as shown:
        assert shown.wait() == 0, shown.plain
    assert re.search(
        r"adapting [━╺╸]+ +\d+ of 403 rollouts mean cost [\d.]+ of the laws tried last +"
        r"\d:\d\d:\d\d left",
        shown.plain,
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
    assert done.stdout.count(" of 35 rollouts, mean cost ") >= 6
    told = r"^  35 rollouts: mean cost [\d.]+ of the laws tried last, not of the returned one$"
    assert re.search(told, done.stdout, flags=re.MULTILINE)
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
    monkeypatch.setattr("pdeloop.display.PERIOD", -1.0)
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
    assert re.search(r"soak [━╺╸]+ +4 of 8 episodes 3 faults 0:00:00 left", text)
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
            ("pdeloop train --optimizer model", "--optimizer model_based "),
            ("pdeloop evaluate ru", "pdeloop evaluate runs/"),
        ):
            shown.type(typed + "\t")
            shown.until(completed)
            shown.type("\x15")  # an empty line again
