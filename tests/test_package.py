"""The ROS 2 package: manifest, what colcon installs, and what the launch files would start."""

from __future__ import annotations

import argparse
import ast
import importlib.util
import re
import tomllib
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from loop_interfaces.parameters import table
from loop_interfaces.spec import ParameterError, read_yaml
from pde_sim_node.equations import ALLOWED
from pdeloop import cli, launch_plan
from pdeloop.launch_plan import LOOP_ARGUMENTS, TRAIN_ARGUMENTS, loop_plan, train_plan
from pdeloop.pairs import LoopNode
from tests.colcon_workspace import ROOT, Workspace, build
from tests.small import SMALL
from tuner_node.results import RunFolderError

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
NODES = ("pde_sim_node", "controller_node", "tuner_node", "recorder_node")


def test_the_manifest_says_what_the_project_says() -> None:
    manifest = ElementTree.parse(ROOT / "package.xml").getroot()
    assert manifest.get("format") == "3"
    for field in ("name", "version", "description"):
        assert manifest.findtext(field) == PROJECT["project"][field]
    assert manifest.findtext("export/build_type") == "ament_python"
    assert "Apache Software License" in " ".join(PROJECT["project"]["classifiers"])
    assert manifest.findtext("license") == "Apache-2.0"


def test_the_manifest_names_every_ros_package_that_is_imported() -> None:
    declared = {e.text for e in ElementTree.parse(ROOT / "package.xml").iter("exec_depend")}
    ros = re.compile(r"rclpy|launch|launch_ros|[a-z_]+_(msgs|srvs|interfaces)")
    used = set()
    for package in {name.split(".")[0] for name in PROJECT["tool"]["setuptools"]["packages"]}:
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
                if isinstance(node, ast.ImportFrom) and node.module:
                    names = [node.module]
                used |= {name.split(".")[0] for name in names}
    needed = {name for name in used if ros.fullmatch(name)} - {"loop_interfaces"}
    assert {"rclpy", "std_msgs", "launch_ros"} <= needed
    assert needed <= declared


def test_every_package_is_in_the_list_that_is_installed() -> None:
    packages = {
        ".".join(path.parent.relative_to(ROOT).parts)
        for top in {name.split(".")[0] for name in PROJECT["tool"]["setuptools"]["packages"]}
        for path in (ROOT / top).rglob("__init__.py")
    }
    assert packages == set(PROJECT["tool"]["setuptools"]["packages"])


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


@pytest.mark.parametrize("option", ["--merge-install", "--symlink-install"])
def test_merged_and_linked_installations_work_too(option: str, tmp_path: Path) -> None:
    workspace = build(tmp_path, option)
    merged = option == "--merge-install"
    assert workspace.prefix == tmp_path / "install" / ("" if merged else "pdeloop")
    done = workspace.run("pdeloop", "problems", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    # A linked installation runs the workspace's sources, so that an edit needs no build.
    used = workspace.prefix / "share/pdeloop" if merged else tmp_path / "src/pdeloop"
    assert str(used / "config/problems/burgers.yaml") in done.stdout


def names_of(node: LoopNode) -> list[str]:
    return [word.partition(":=")[0] for word in node.parameters]


def train(**texts: object) -> launch_plan.Plan:
    return train_plan({"problem": str(SMALL), **{k: str(v) for k, v in texts.items()}})


def test_a_launched_training_has_the_nodes_and_parameters_that_exist(tmp_path: Path) -> None:
    plan = train(out=tmp_path / "run", pairs=2, record="true", iterations=3, real_time_factor=50)
    assert [node.name for node in plan.nodes] == [
        "recorder_node",
        *("pde_sim_node-pair0", "controller_node-pair0"),
        *("pde_sim_node-pair1", "controller_node-pair1"),
        "tuner_node",
    ]
    known = {spec.name for spec in table()}
    for node in plan.nodes:
        assert node.package in PROJECT["project"]["scripts"]
        assert importlib.util.find_spec(f"{node.package}.node") is not None
        assert set(names_of(node)) <= known
    values = read_yaml(plan.parameter_file)
    assert (values["iterations"], values["real_time_factor"], values["n_z"]) == (3, 50.0, 32)
    assert "recorder:=start" in plan.nodes[-1].parameters


def test_an_interrupted_launched_training_is_continued_with_its_own_parameters(tmp_path) -> None:
    first = train(out=tmp_path / "run", iterations=3)
    again = train_plan({"resume": str(tmp_path / "run"), "record_or_stop": "true"})
    assert again.parameter_file == first.parameter_file
    assert "recorder:=required" in again.nodes[-1].parameters
    with pytest.raises(ParameterError, match="leave out seed"):
        train_plan({"resume": str(tmp_path / "run"), "seed": "1"})
    with pytest.raises(RunFolderError, match="no run in"):
        train_plan({"resume": str(tmp_path)})
    with pytest.raises(RunFolderError, match="already holds a run"):
        train(out=tmp_path / "run")


@pytest.mark.parametrize(
    ("texts", "said"),
    [
        ({"problem": "stokes"}, "unknown problem 'stokes'"),
        ({"iterations": "many"}, "parameter 'iterations' is 'many'; expected a whole number"),
        ({"pairs": "0"}, "parameter 'pairs' is 0; expected"),
        ({"record": "yes"}, "parameter 'record' is 'yes'; expected true or false"),
        ({"optimizer": "adam"}, "parameter 'optimizer' is 'adam'"),
        ({"real_time_factor": "-1"}, "parameter 'real_time_factor' is -1.0"),
        ({"pairs": "64", "pin": "true"}, "a core of its own"),
    ],
)
def test_a_bad_argument_is_refused_before_anything_is_made(
    texts: dict[str, str], said: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=said):
        train(out=tmp_path / "run", **texts)
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


def test_code_that_only_a_problems_file_names_is_not_run(own_equation: Path) -> None:
    out = str(own_equation.parent / "run")
    with pytest.raises(ValueError, match="is code, which is not run because a file names it"):
        train_plan({"problem": str(own_equation), "out": out})
    plan = train_plan(
        {"problem": str(own_equation), "out": out, "equation": f"{own_equation.parent}/own.py:Own"}
    )
    assert plan.environment == {ALLOWED: f",{own_equation.parent}/own.py:Own".lstrip(",")}


def test_a_loop_without_a_tuner_finds_an_equation_beside_its_file(own_equation: Path) -> None:
    plan = loop_plan({"problem": str(own_equation), "namespace": "lab", "process_noise": "0.1"})
    assert plan.namespace == "lab"
    assert plan.environment == {}
    for node in plan.nodes:
        assert f"equation:='{own_equation.parent / 'own.py'}:Own'" in node.parameters
        assert "process_noise:=0.1" in node.parameters


def test_what_train_takes_is_a_launch_argument_too() -> None:
    subcommands = next(
        a for a in cli.parser()._actions if isinstance(a, argparse._SubParsersAction)
    )
    actions = subcommands.choices["train"]._actions
    known = {argument.spec.name for argument in TRAIN_ARGUMENTS}
    # `ros2 launch` does not place processes, whence no spread.
    not_for_launch = {"help", "in_process", "faulty_line", "json", "spread"}
    assert {action.dest for action in actions} - not_for_launch <= known


def test_every_launch_argument_is_described() -> None:
    for argument in (*LOOP_ARGUMENTS, *TRAIN_ARGUMENTS):
        assert len(argument.description) > 10
        assert argument.value(argument.default) in (None, argument.spec.default)


def test_the_package_says_who_makes_it_and_where_it_lives() -> None:
    """REP-149: a maintainer with an address; no placeholder in what a package index shows."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    package = ElementTree.fromstring((ROOT / "package.xml").read_text())
    assert project["authors"] and {"Repository", "Issues"} <= set(project["urls"])
    address = package.find("maintainer").get("email", "")
    assert re.fullmatch(r"[\w.+-]+@([\w-]+\.)+[a-z]{2,}", address)
    assert not address.endswith((".invalid", ".example", "example.com"))
    repository = {url.get("type"): url.text for url in package.findall("url")}
    assert repository["repository"] == project["urls"]["Repository"]
    assert repository["bugtracker"] == project["urls"]["Issues"]
    assert package.find("author").text == project["authors"][0]["name"]
