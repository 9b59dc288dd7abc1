# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""No file of the working directory runs because it has the name of a module that is imported."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from pdeloop.cli import COMMANDS
from pdeloop.process.module_path import safe_environment
from tests.support.interpreter import python
from tests.support.loop_harness import Processes, until
from tests.support.small import SMALL

pytestmark = pytest.mark.topics
LIMIT = 240.0
"""Seconds for one command on a busy machine."""
BIN = Path(sys.executable).parent
OPTIONAL = {"IPython", "brotli", "colorama", "coverage", "tbb", "uvloop", "usercustomize"}
"""Modules that libraries look for, installed or not."""
TRAP = """
with open({taken!r}, "a") as file:
    print({name!r}, file=file)
raise SystemExit("{name} of the working directory was imported")
"""
STUDY = f"""
problems: [{SMALL}]
seeds: 1
settings: {{evaluation_fields: 1}}
variants: {{one: {{iterations: 1}}}}
"""
TRAIN = ("train", str(SMALL), "--iterations", "1", "--evaluation-fields", "1")
NAMED = ("--equation", "numpy.py:Own")
OWN = """
from pde_sim_node.equations import Burgers

class Own(Burgers):
    name = "own"
"""
"""Code that the user names, in a file with the name of a module."""
WORDS: dict[str, tuple[str, ...]] = {
    "train": (*TRAIN, *NAMED, "--out", "run", "--record", "--view"),
    "evaluate": ("evaluate", "run", *NAMED, "--fields", "1"),
    "identify": ("identify", "--bag", "run"),
    "bag": ("bag", "verify", "run", *NAMED),
    "monitor": ("monitor", "--port", "0"),
    "reproduce": (
        "reproduce",
        str(SMALL),
        "--seeds",
        "1",
        "--iterations",
        "5",
        "--out",
        "paper",
        "--processes",
        "1",
    ),
    "report": ("report", "run", *NAMED),
    "animate": ("animate", "run", *NAMED, "--out", "run.gif", "--seconds", "0.1"),
    "compare": ("compare", "run", "run"),
    "export": ("export", "run", "--out", "law.npz"),
    "study": ("study", "study.yaml", "--out", "study"),
    "problems": ("problems",),
    "new": ("new", "my-pde"),
    "check": ("check", str(SMALL), "--picture", "check.png"),
}
"""What each command is called with, in an order in which it finds what it needs."""
ONE_AFTER_THE_OTHER = """
import json, sys
from pdeloop.cli import main

if __name__ == "__main__":  # processes that it starts load this file, too
    for words in json.loads(sys.argv[1]):
        if words[0] == "report":  # most of its time: it draws each figure, as `check` does one
            from pdeloop.report import page
            page._draw = lambda figure, png: png.write(b"a picture")
            page.FigureCanvasSVG.print_svg = lambda self, svg, **_: svg.write(b"a picture")
        sys.argv[1:] = words
        code = main()
        if code:
            sys.exit(f"{words} ended with {code}")
"""
"""The script `pdeloop` for several commands, whose imports are as lazy and take longer than they do."""
BENCHMARK = ("linearised", str(SMALL))
SCRIPT = "tuner_node"
"""The script of one node: others differ in its name. What nodes load, a recorded training does."""


def third_party() -> set[str]:
    """The top-level modules of everything that is installed here."""
    files = [file for of in metadata.distributions() for file in of.files or []]
    modules = [file for file in files if file.suffix in (".py", ".so")]
    return {file.parts[0].split(".")[0] for file in modules} | OPTIONAL


def set_traps(folder: Path, names: set[str]) -> Path:
    """A file for each of these modules; the file that says which were imported."""
    taken = folder / "imported.txt"
    for name in filter(str.isidentifier, names):
        (folder / f"{name}.py").write_text(TRAP.format(taken=str(taken), name=name))
    return taken


def finish(loop: Processes, process: Any) -> None:
    """Wait for the end of a command; that of the page, once it serves it."""
    if "monitor" in process.args:
        until(lambda: "http://" in loop.output(process), LIMIT, "page")
        os.kill(process.pid, signal.SIGINT)
    loop.wait(process, LIMIT)


def test_no_command_and_no_node_runs_a_file_of_the_working_directory_but_what_is_named(
    loop: Processes, tmp_path: Path
) -> None:
    assert set(WORDS) == set(COMMANDS)
    (tmp_path / "study.yaml").write_text(STUDY)
    taken = set_traps(tmp_path, third_party() | set(sys.stdlib_module_names))
    (tmp_path / "numpy.py").write_text(OWN)  # an import of NumPy that finds it fails, too
    folder = tmp_path / "bin"
    folder.mkdir()
    (folder / "commands.py").write_text(ONE_AFTER_THE_OTHER)
    in_script = [words for name, words in WORDS.items() if name not in ("train", "monitor")]
    said = loop.wait(loop.program(str(BIN / "pdeloop"), *WORDS["train"]), LIMIT)
    assert "mean stage cost after adaptation" in said
    started = [loop.program(str(BIN / SCRIPT), "--help")]
    started.append(loop.program(str(BIN / "pdeloop"), *WORDS["monitor"]))
    started.append(loop.program(sys.executable, str(folder / "commands.py"), json.dumps(in_script)))
    for process in started:
        finish(loop, process)
    assert not taken.exists(), taken.read_text()


def test_completion_runs_no_file_of_the_working_directory(tmp_path: Path) -> None:
    taken = set_traps(tmp_path, third_party() | set(sys.stdlib_module_names))
    line = "pdeloop train --optimizer two"
    done = subprocess.run(
        ["sh", "-c", '"$0" 8>&1 9>/dev/null', str(BIN / "pdeloop")],
        cwd=tmp_path,
        env={**os.environ, "_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line))},
        capture_output=True,
        text=True,
        timeout=LIMIT,
    )
    assert done.stdout.strip() == "two_point", done.stderr
    assert not taken.exists(), taken.read_text()


@pytest.mark.parametrize("words", [("pdeloop", *TRAIN, "--in-process"), ("benchmarks", *BENCHMARK)])
def test_modules_that_python_starts_run_no_file_of_the_working_directory(
    words: tuple[str, ...], loop: Processes, tmp_path: Path
) -> None:
    # What Python imports to find the module, before it can say anything, and the module itself.
    loaded = python("-c", "import runpy, sys; print(*sys.modules)").stdout.split()
    names = third_party() | set(sys.stdlib_module_names)
    taken = set_traps(tmp_path, names - {name.split(".")[0] for name in loaded} - {words[0]})
    loop.wait(loop.start("-m", *words), LIMIT)
    assert not taken.exists(), taken.read_text()


def test_code_that_the_user_names_runs_from_the_working_directory_and_no_other(
    loop: Processes, tmp_path: Path
) -> None:
    # As of `export PYTHONPATH=$PYTHONPATH:/some/folder` where it was not set.
    loop.environment["PYTHONPATH"] = f":{loop.environment['PYTHONPATH']}"
    taken = set_traps(tmp_path, {"scipy", "numba", "yaml", "rich", "rclpy", "std_msgs"})
    (tmp_path / "numpy.py").write_text(OWN)
    words = (*TRAIN, *NAMED, "--in-process")
    said = loop.wait(loop.program(str(BIN / "pdeloop"), *words), LIMIT)
    assert "mean stage cost after adaptation" in said
    assert not taken.exists(), taken.read_text()


def test_what_a_process_starts_leaves_the_working_directory_out_as_well() -> None:
    path = os.pathsep.join(["", "/a", "", "/b", ""])
    found = safe_environment({"HOME": "/home", "PYTHONPATH": path})
    assert found == {"HOME": "/home", "PYTHONPATH": "/a:/b", "PYTHONSAFEPATH": "1"}
