# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Containers, workflow and citation call the two commands, and agree with the project's metadata."""

from __future__ import annotations

import importlib.metadata
import json
import re
import shlex
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.support.interpreter import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
TARGETS = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
CITATION = yaml.safe_load((ROOT / "CITATION.cff").read_text())


def made(command: str) -> set[str]:
    """The targets of the Makefile that a shell command asks for."""
    words = shlex.split(command, comments=True)
    return set(words[words.index("make") + 1 :]) if "make" in words else set()


def instructions(path: Path) -> list[tuple[str, str]]:
    lines = [line for line in path.read_text().splitlines() if line and not line.startswith("#")]
    return [(line.partition(" ")[0], line.partition(" ")[2]) for line in lines]


def supported(image: str) -> bool:
    """True if an image is named without a host, and has a Python that the project runs with."""
    name = re.fullmatch(r"python:(\d+)\.(\d+)-[a-z]+", image)
    least = re.fullmatch(r">=(\d+)\.(\d+)", PROJECT["requires-python"])
    assert least
    return bool(name) and tuple(map(int, name.groups())) >= tuple(map(int, least.groups()))


def test_the_image_is_set_up_and_runs_the_first_command() -> None:
    steps = instructions(ROOT / "Dockerfile")
    (image,) = [value for name, value in steps if name == "FROM"]
    assert supported(image)
    assert [made(value) for name, value in steps if name == "RUN"] == [{"setup"}]
    (command,) = [json.loads(value) for name, value in steps if name == "CMD"]
    assert command == ["make", "run"]
    assert [name for name, _ in steps].index("COPY") < [name for name, _ in steps].index("RUN")


def test_nothing_that_a_clone_has_is_left_out_of_the_image() -> None:
    ignored = [
        line.rstrip("/")
        for line in (ROOT / ".dockerignore").read_text().splitlines()
        if not line.startswith("#")
    ]
    never_committed = {
        line.rstrip("/")
        for line in (ROOT / ".gitignore").read_text().splitlines()
        if not line.startswith("#")
    }
    assert {line.removeprefix("**/") for line in ignored} <= never_committed


def test_the_development_container_is_set_up_by_the_makefile() -> None:
    described = json.loads((ROOT / ".devcontainer" / "devcontainer.json").read_text())
    assert supported(described["image"])
    steps = described["postCreateCommand"].split(" && ")
    assert [made(step) for step in steps] == [set(), {"setup"}]
    assert (
        "safe.directory" in steps[0]
    )  # git lists the sources for tests; the host's user owns them
    settings = described["customizations"]["vscode"]["settings"]
    assert settings["python.defaultInterpreterPath"].endswith("/.venv/bin/python")


def test_the_workflow_calls_the_two_commands_and_builds_the_wheel() -> None:
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())
    (job,) = workflow["jobs"].values()
    commands = [step["run"] for step in job["steps"] if "run" in step]
    called = [made(command) for command in commands]
    assert {"run"} in called and {"test"} in called
    assert set().union(*called) <= TARGETS
    assert any("pip wheel --no-deps" in command for command in commands)
    # In YAML 1.1 the word on is true.
    assert {"push", "pull_request"} <= set(workflow[True])


def test_a_package_that_a_distribution_lacks_does_not_stop_the_tests(tmp_path: Path) -> None:
    """On Ubuntu apt-get does not know chromium: the others are installed, the missing one named."""
    asked = tmp_path / "asked"
    for name, script in {
        "id": "echo 0",
        "ls": "exit 1",
        "apt-get": f'echo "$*" >> {asked}; case "$*" in *chromium*) exit 100;; esac',
    }.items():
        (tmp_path / name).write_text(f"#!/bin/bash\n{script}\n")
        (tmp_path / name).chmod(0o755)
    make = shutil.which("make")
    assert make
    done = subprocess.run(
        [make, "packages"], cwd=ROOT, env={"PATH": str(tmp_path)}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.startswith("not installed: chromium (Debian's names)")
    assert asked.read_text().splitlines()[0] == "update -qq"
    assert {line.split()[-1] for line in asked.read_text().splitlines()[1:]} == {
        "chromium",
        "gcc",
        "libc6-dev",
        "iproute2",
        "zsh",
        "fish",
        "faketime",
    }


def test_the_citation_says_what_the_project_says() -> None:
    assert CITATION["version"] == PROJECT["version"]
    assert [author["name"] for author in CITATION["authors"]] == [
        author["name"] for author in PROJECT["authors"]
    ]
    heading = rf"^## \[{re.escape(CITATION['version'])}\] - {CITATION['date-released']}$"
    assert re.search(heading, (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    (paper,) = CITATION["references"]
    assert (
        paper["identifiers"][0]["value"].removeprefix("arXiv:") in (ROOT / "README.md").read_text()
    )


@pytest.mark.parametrize("name", ["cff-version", "message", "title", "authors", "type", "license"])
def test_the_citation_has_what_its_format_asks_for(name: str) -> None:
    """The Citation File Format 1.2.0; a date is one."""
    assert CITATION[name]
    assert CITATION["cff-version"] == "1.2.0" and CITATION["type"] == "software"
    assert CITATION["date-released"].isoformat() == str(CITATION["date-released"])


def pins(text: str) -> dict[str, str]:
    """Version by normalised name of each line NAME==VERSION."""
    found = re.findall(r"^([\w.-]+)(?:\[[\w,-]+\])?==([^\s;]+)", text, re.MULTILINE)
    return {canonicalize_name(name): version for name, version in found}


@pytest.mark.parametrize(("part", "extras"), [("run", ["ros", "report"]), ("test", ["ros", "dev"])])
def test_what_is_installed_is_pinned_and_has_digests(part: str, extras: list[str]) -> None:
    text = (ROOT / "requirements" / f"{part}.txt").read_text()
    constrained = pins((ROOT / "constraints.txt").read_text())
    for requirement in re.split(r"\n(?=\S)", text.strip()):
        assert re.search(r"--hash=sha256:[0-9a-f]{64}", requirement), requirement
    found = pins(text)
    assert {n: v for n, v in found.items() if constrained.get(n, v) != v} == {}, "make lock"
    needed = [*PROJECT["dependencies"]]
    while extras:
        for words in PROJECT["optional-dependencies"][extras.pop()]:
            nested = re.fullmatch(r"pdeloop\[(.*)\]", words)
            if nested:
                extras += nested[1].split(",")
            else:
                needed.append(words)
    assert {canonicalize_name(Requirement(n).name) for n in needed} <= set(found), "make lock"


def test_each_extra_that_a_package_asks_for_is_pinned_with_its_extra() -> None:
    """pip looks for the newest version of ``name[extra]`` unless that, not only ``name``, is pinned."""
    pinned = re.findall(r"^(\S+)==", (ROOT / "requirements" / "test.txt").read_text(), re.MULTILINE)
    requirements = [Requirement(words) for words in pinned]
    extras = {canonicalize_name(r.name): r.extras for r in requirements}
    asked = [
        Requirement(words)
        for installed in importlib.metadata.distributions()
        if canonicalize_name(installed.name) in extras
        for words in installed.requires or []
    ]
    asked = [
        r for r in asked if r.extras and (r.marker is None or r.marker.evaluate({"extra": ""}))
    ]
    assert asked
    assert {str(r) for r in asked if not r.extras <= extras[canonicalize_name(r.name)]} == set()
