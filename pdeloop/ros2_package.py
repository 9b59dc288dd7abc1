# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law as a ROS 2 package of its own, of rclpy, std_msgs and NumPy."""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from collections.abc import Mapping
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from pdeloop.finished_run import FinishedRun
from pdeloop.law_form import law_form
from pdeloop.messages import action_set
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.array_files import packed_arrays
from pdeloop.messages.arrays import Array
from pdeloop.messages.files import write_atomically
from pdeloop.messages.spec import ParameterError
from pdeloop.messages.text import shown

_NAME = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")
_TEMPLATES = Path(__file__).parent / "commands" / "template"
_FORMULAS = {
    "affine": "    a = K U^T y + constant",
    "observer": "    a = K p + D s + b,    p <- F p + G s + B a + c,    s = U^T y,    p = s at first",
}
_MANIFEST = """<?xml version="1.0"?>
<package format="3">
  <name>$package</name>
  <version>0.1.0</version>
  <description>$name</description>
  <maintainer email="user@localhost">user</maintainer>
  <license>TODO: License declaration</license>
  <exec_depend>rclpy</exec_depend>
  <exec_depend>std_msgs</exec_depend>
  <exec_depend>python3-numpy</exec_depend>
  <export><build_type>ament_python</build_type></export>
</package>
"""
_SETUP = """from setuptools import setup

setup(
    name="$package",
    version="0.1.0",
    packages=["$package"],
    package_data={"$package": ["law.npz"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/$package"]),
        ("share/$package", ["package.xml", "README.md"]),
        ("share/$package/config", ["config/parameters.yaml"]),
        ("share/$package/launch", ["launch/law.launch.py"]),
    ],
    entry_points={"console_scripts": ["law = $package.node:main"]},
)
"""
_CONFIGURED = """[develop]
script_dir=$$base/lib/$package
[install]
install_scripts=$$base/lib/$package
"""
_RESOURCES = "resource"


def write_package(
    run: FinishedRun, folder: Path, which: str = "adapted", seed: int | None = None
) -> None:
    """Write the package of a law of a run, which has the name of its folder.

    folder: a new or empty folder; which, seed: as for `FinishedRun.law`. ValueError if the
    law has no such form, the folder has contents, or its name is none of a package.
    """
    package = folder.absolute().name
    if not _NAME.fullmatch(package):
        raise ParameterError(
            f"{shown(package)} cannot be the name of a ROS 2 package; expected small letters, digits "
            "and _, beginning with a letter"
        )
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ParameterError(f"{folder} exists; give a new folder for the package")
    law = law_form(run, which, seed)
    law.require_matrices()
    limits = {"rate": np.full(law.n_a, np.inf), "start": np.zeros(law.n_a)}
    limits |= law.action_set.limits(law.n_a)
    words = {
        "package": package,
        "name": law.name,
        "kind": law.kind,
        "formula": _FORMULAS[law.kind],
        "action_set": _projection(),
        "n_y": law.n_y,
        "n_a": law.n_a,
        "sample_time": f"{law.sample_time:g}",
        "safe": [0.0] * law.n_a,
        **{name: _yaml(numbers) for name, numbers in limits.items()},
    }
    numbers = {
        **limits,
        "zero_mean": np.array(law.action_set.zero_mean),
        "sample_time": np.array(law.sample_time),
        "n_y": np.array(law.n_y),
    }
    files = {
        "package.xml": _filled(_MANIFEST, words),
        "setup.py": _filled(_SETUP, words),
        "setup.cfg": _filled(_CONFIGURED, words),
        f"{_RESOURCES}/{package}": b"",
        "README.md": _template("ros2_readme.md", words),
        "config/parameters.yaml": _template("ros2_parameters.yaml", words),
        "launch/law.launch.py": _template("ros2_launch.py", words),
        f"{package}/__init__.py": b"",
        f"{package}/law.py": _template("ros2_law.py", words),
        f"{package}/node.py": _template("ros2_node.py", words),
        f"{package}/law.npz": packed_arrays({**law.arrays, **numbers}),
    }
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, text)


def _projection() -> str:
    """The source of the methods by which actions are made admissible."""
    methods = ActionSet.project, ActionSet.within, ActionSet._shifts, ActionSet._balance
    sources = [_bare(textwrap.dedent(inspect.getsource(method))) for method in methods]
    text = "\n".join(sources).replace("_BALANCED", repr(action_set._BALANCED))
    return textwrap.indent(text, "    ")


def _bare(source: str) -> str:
    """A method without annotations, whose names its new module does not have."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            node.returns = None
            for argument in (*node.args.args, *node.args.kwonlyargs):
                argument.annotation = None
            node.body = [part for part in node.body if not _is_docstring(part)]
    return ast.unparse(_Plain().visit(tree)) + "\n"


class _Plain(ast.NodeTransformer):
    """Annotated assignments as plain ones."""

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        assert node.value is not None
        return ast.copy_location(ast.Assign([node.target], node.value), node)


def _is_docstring(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _yaml(numbers: Array) -> str:
    return f"[{', '.join(_number(float(number)) for number in numbers)}]"


def _number(number: float) -> str:
    return ("" if number > 0 else "-") + ".inf" if np.isinf(number) else repr(number)


def _template(name: str, words: Mapping[str, Any]) -> bytes:
    return _filled((_TEMPLATES / f"{name}.txt").read_text(), words)


def _filled(text: str, words: Mapping[str, Any]) -> bytes:
    return Template(text).substitute(words).encode()
