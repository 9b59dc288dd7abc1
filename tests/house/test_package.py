# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The ROS 2 package: manifest, what colcon installs, and what the launch files would start."""

from __future__ import annotations

import argparse
import importlib.util
import itertools
import json
import os
import re
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
import yaml

from pde_sim_node.build import fingerprint
from pde_sim_node.equations import ALLOWED
from pdeloop import cli
from pdeloop.messages.parameters import flags, table
from pdeloop.messages.problem import read_problem
from pdeloop.process.isolation import NETWORK
from tests.house.test_house import imports
from tests.support.colcon_workspace import ROOT, Workspace, build
from tests.support.small import SMALL

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
TRAIN = "train.launch.py"
NODES = ("pde_sim_node", "controller_node", "tuner_node", "recorder_node")


def test_the_manifest_says_what_the_project_says() -> None:
    manifest = ElementTree.parse(ROOT / "package.xml").getroot()
    assert manifest.get("format") == "3"
    for field in ("name", "version", "description"):
        assert manifest.findtext(field) == PROJECT["project"][field]
    newest = re.search(r"^## \[(\d.*)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert newest and newest[1] == PROJECT["project"]["version"]
    assert metadata.version("pdeloop") == newest[1], "make setup"  # what pdeloop --version tells
    assert manifest.findtext("export/build_type") == "ament_python"
    assert "Apache Software License" in " ".join(PROJECT["project"]["classifiers"])
    assert manifest.findtext("license") == "Apache-2.0"


def test_the_manifest_names_every_ros_package_that_is_imported() -> None:
    declared = {e.text for e in ElementTree.parse(ROOT / "package.xml").iter("exec_depend")}
    ros = re.compile(r"rclpy|launch|launch_ros|[a-z_]+_(msgs|srvs|interfaces)")
    used = set()
    packages = {name.split(".")[0] for name in PROJECT["tool"]["setuptools"]["packages"]}
    for package in (*packages, "launch"):
        for path in (ROOT / package).rglob("*.py"):
            used |= {name.split(".")[0] for name in imports(path)}
    needed = {name for name in used if ros.fullmatch(name)}
    assert {"rclpy", "std_msgs", "launch_ros"} <= needed
    assert needed <= declared


DATA = {"pdeloop.commands.template", "viewer_node.web.static", "viewer_node.web.static.vendor"}


def test_every_package_is_in_the_list_that_is_installed() -> None:
    packages = {
        ".".join(path.parent.relative_to(ROOT).parts)
        for top in {name.split(".")[0] for name in PROJECT["tool"]["setuptools"]["packages"]}
        for path in (ROOT / top).rglob("__init__.py")
    }
    assert packages | DATA == set(PROJECT["tool"]["setuptools"]["packages"])


def test_colcon_installs_every_file_of_the_packages(workspace: Workspace) -> None:
    (library,) = workspace.prefix.glob("lib/python*/site-packages")
    for top in {name.split(".")[0] for name in PROJECT["tool"]["setuptools"]["packages"]}:
        for path in (ROOT / top).rglob("*"):
            if path.is_file() and "__pycache__" not in path.parts:
                assert (library / path.relative_to(ROOT)).is_file(), path


def test_colcon_installs_what_ros2_looks_for(workspace: Workspace) -> None:
    share = workspace.prefix / "share"
    assert (share / "ament_index/resource_index/packages/pdeloop").is_file()
    assert (share / "pdeloop/package.xml").read_text() == (ROOT / "package.xml").read_text()
    for folder in ("config", "config/problems", "launch"):
        shipped = {path.name for path in (ROOT / folder).iterdir() if path.is_file()}
        installed = {path.name for path in (share / "pdeloop" / folder).iterdir()}
        assert shipped <= installed, folder
    for name in (*NODES, "pdeloop"):
        assert workspace.executable(name).stat().st_mode & 0o111
    # colcon does what is missing itself, with a warning that it will not for ever.
    assert "explicitly" not in workspace.said
    assert "WARN" not in workspace.said


def test_installed_executables_run_with_the_installed_code_and_configuration(
    workspace: Workspace, tmp_path: Path
) -> None:
    problems = workspace.run("pdeloop", "problems", cwd=tmp_path)
    assert problems.returncode == 0, problems.stderr
    assert str(workspace.prefix / "share/pdeloop/config/problems/burgers.yaml") in problems.stdout
    for name in NODES:
        file = str(tmp_path / "missing.yaml")
        refused = workspace.run(name, "--ros-args", "--params-file", file, cwd=tmp_path)
        assert refused.returncode == 1, refused.stderr
        assert file in refused.stderr
        assert "Traceback" not in refused.stderr


def test_a_merged_and_linked_installation_works_too(tmp_path: Path) -> None:
    workspace = build(tmp_path, "--merge-install", "--symlink-install")
    assert workspace.prefix == tmp_path / "install"
    done = workspace.run("pdeloop", "problems", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    # A linked installation runs the workspace's sources, so that an edit needs no build.
    assert str(tmp_path / "src/pdeloop/config/problems/burgers.yaml") in done.stdout


@pytest.fixture(scope="module")
def launched(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., list[Any]]]:
    """A function to the nodes that a launch file starts, as the stand-in for launch says.

    In a process of its own, which has no other `launch`, and is asked more than once.
    """
    path = os.pathsep.join([str(ROOT / "tests" / "support" / "launch_stand_in"), str(ROOT)])
    with (tmp_path_factory.mktemp("launched") / "errors").open("w+") as errors:
        asked = subprocess.Popen(
            [sys.executable, "-c", LAUNCHED],
            env={**os.environ, "PYTHONPATH": path, "LAUNCH_DRY_RUN": "1"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        )
        assert asked.stdin and asked.stdout

        def launch(file: str, **texts: object) -> list[dict[str, Any]]:
            words = {name: str(text) for name, text in texts.items()}
            print(json.dumps([str(ROOT / "launch" / file), words]), file=asked.stdin, flush=True)
            answer = asked.stdout.readline()
            assert answer, Path(errors.name).read_text()
            code, said = json.loads(answer)
            if code:
                raise ValueError(said[0])
            return [json.loads(line) for line in said if line.startswith("{")]

        with asked:
            yield launch
            asked.stdin.close()


LAUNCHED = """
import contextlib, io, json, os, sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
environment = dict(os.environ)
for line in sys.stdin:
    path, texts = json.loads(line)
    source, service = PythonLaunchDescriptionSource(path), LaunchService()
    included = IncludeLaunchDescription(source, launch_arguments=texts.items())
    service.include_launch_description(LaunchDescription([included]))
    with contextlib.redirect_stdout(io.StringIO()) as said:
        code = service.run()
    print(json.dumps([code, said.getvalue().splitlines()]), flush=True)
    os.environ.clear()
    os.environ.update(environment)
"""


def given_to(node: dict[str, Any]) -> dict[str, Any]:
    """What a node is told besides the parameter file."""
    words = node["arguments"]
    own = [word for before, word in itertools.pairwise(words) if before == "-p"]
    return {name: yaml.safe_load(value) for name, value in (word.split(":=", 1) for word in own)}


def file_of(node: dict[str, Any]) -> str:
    """The parameter file of a node, which comes before what it is told besides."""
    words: list[str] = node["arguments"]
    assert "-p" not in words[: words.index("--params-file")]
    return words[words.index("--params-file") + 1]


def test_a_launched_training_has_the_nodes_and_parameters_that_exist(launched, tmp_path) -> None:
    run = tmp_path / "run"
    nodes = launched(
        TRAIN,
        problem=SMALL,
        out=run,
        pairs=2,
        record="true",
        iterations=3,
        real_time_factor=50,
        view="true",
        set="physical.viscosity=2e-2,horizon=20",
    )
    assert [(node["executable"], node["namespace"]) for node in nodes] == [
        ("recorder_node", ""),
        ("viewer_node", "pair0"),
        ("tuner_node", ""),
        ("pde_sim_node", "pair0"),
        ("controller_node", "pair0"),
        ("pde_sim_node", "pair1"),
        ("controller_node", "pair1"),
    ]
    known = {spec.name for spec in table()}
    for node in nodes:
        assert node["executable"] in PROJECT["project"]["scripts"]
        assert importlib.util.find_spec(f"{node['executable']}.node") is not None
        assert set(given_to(node)) <= known
        assert file_of(node) == str(run / "parameters.yaml")
    values = read_problem(run / "parameters.yaml")
    assert (values["iterations"], values["real_time_factor"], values["n_z"]) == (3, 50.0, 32)
    assert (values["physical.viscosity"], values["horizon"]) == (2e-2, 20)
    by_name = {node["executable"]: given_to(node) for node in nodes}
    assert by_name["tuner_node"]["recorder"] == "start"
    assert by_name["tuner_node"]["plant_fingerprint"] == fingerprint(values)
    assert by_name["tuner_node"]["pairs"] == by_name["recorder_node"]["pairs"] == ["pair0", "pair1"]
    assert [given_to(node).get("publish_clock") for node in nodes[3::2]] == [None, False]
    # The run's file has the rest: a cost over time would not fit into an argument.
    assert all(set(given_to(node)) <= {"pin", "publish_clock"} for node in nodes[3:])


def test_an_interrupted_launched_training_is_continued_with_its_own_parameters(
    launched, tmp_path
) -> None:
    launched(TRAIN, problem=SMALL, out=tmp_path / "run", iterations=3)
    again = launched(TRAIN, resume=tmp_path / "run", record_or_stop="true")
    assert file_of(again[0]) == str(tmp_path / "run" / "parameters.yaml")
    by_name = {node["executable"]: given_to(node) for node in again}
    assert by_name["tuner_node"]["recorder"] == "required"
    with pytest.raises(ValueError, match="leave out seed"):
        launched(TRAIN, resume=tmp_path / "run", seed=1)
    with pytest.raises(ValueError, match="no run in"):
        launched(TRAIN, resume=tmp_path)
    with pytest.raises(ValueError, match="already holds a run"):
        launched(TRAIN, problem=SMALL, out=tmp_path / "run")


@pytest.mark.parametrize(
    ("texts", "said"),
    [
        ({"problem": "stokes"}, "unknown problem 'stokes'"),
        ({"iterations": "many"}, "parameter 'iterations' is 'many'; expected a whole number"),
        ({"pairs": "0"}, "parameter 'pairs' is 0; expected"),
        ({"record": "yes"}, "yes"),
        ({"optimizer": "adam"}, "adam"),
        ({"real_time_factor": "-1"}, "parameter 'real_time_factor' is -1.0"),
    ],
)
def test_a_bad_argument_is_refused_before_anything_is_made(
    launched, texts: dict[str, str], said: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=said):
        launched(TRAIN, **{"problem": SMALL, "out": tmp_path / "run", **texts})
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def own_equation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A problem whose equation is code beside it, which nobody has allowed yet."""
    monkeypatch.setenv(ALLOWED, "")
    code = "from pde_sim_node.equations import Burgers\n\n\nclass Own(Burgers):\n    name = 'own'\n"
    (tmp_path / "own.py").write_text(code)
    text = SMALL.read_text().replace("equation: burgers", "equation: own.py:Own")
    (tmp_path / "own.yaml").write_text(text)
    return tmp_path / "own.yaml"


def test_code_that_only_a_problems_file_names_is_not_run(launched, own_equation: Path) -> None:
    out, own = own_equation.parent / "run", f"{own_equation.parent}/own.py:Own"
    with pytest.raises(
        ValueError, match="is code, which is not run merely because a file names it"
    ):
        launched(TRAIN, problem=own_equation, out=out)
    nodes = launched(TRAIN, problem=own_equation, out=out, equation=own)
    assert all(own in node["environment"][ALLOWED].split(",") for node in nodes)


def test_a_loop_without_a_tuner_finds_an_equation_beside_its_file(
    launched, own_equation: Path
) -> None:
    nodes = launched("loop.launch.py", problem=own_equation, namespace="lab", process_noise=0.1)
    assert [node["executable"] for node in nodes] == ["pde_sim_node", "controller_node"]
    for node in nodes:
        assert node["namespace"] == "lab"
        assert given_to(node)["equation"] == f"{own_equation.parent / 'own.py'}:Own"
        assert given_to(node)["process_noise"] == 0.1
        assert NETWORK not in node["environment"]
    nodes = launched("loop.launch.py", problem=SMALL, network="true")
    assert all(node["environment"][NETWORK] == "1" for node in nodes)


def test_what_train_takes_is_a_launch_argument_too(tmp_path: Path) -> None:
    subcommands = next(
        a for a in cli.parser()._actions if isinstance(a, argparse._SubParsersAction)
    )
    actions = subcommands.choices["train"]._actions
    text = (ROOT / "launch/train.launch.py").read_text() + (
        ROOT / "launch/loop.launch.py"
    ).read_text()
    known = {spec.name for spec in flags()} | set(re.findall(r'"([a-z_]+)"', text))
    # About processes that `pdeloop train` starts itself.
    others = {"help", "in_process", "json"}
    words = [(*action.option_strings, action.dest)[0].lstrip("-") for action in actions]
    assert {word.replace("-", "_") for word in words} - others - {"h"} <= known


def test_the_package_says_who_makes_it_and_names_no_address_that_is_not_there() -> None:
    """REP-149: a maintainer with an address; no placeholder in what a package index shows."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    package = ElementTree.fromstring((ROOT / "package.xml").read_text())
    assert project["authors"] and "urls" not in project and package.find("url") is None
    address = package.find("maintainer").get("email", "")
    assert re.fullmatch(r"[\w.+-]+@([\w-]+\.)+[a-z]{2,}", address)
    assert not address.endswith((".invalid", ".example", "example.com"))
    assert package.find("author").text == project["authors"][0]["name"]
