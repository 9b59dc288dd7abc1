# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Every test can fail, and one that is skipped needs what a test run cannot install everywhere."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
from threadpoolctl import threadpool_info

from tests.conftest import LONG
from tests.support.interpreter import ROOT

Function = ast.FunctionDef | ast.AsyncFunctionDef
CHECKS = re.compile(r"pytest\.(raises|warns|fail)|np\.testing\.|check_env$|assert_")
SKIPS = {
    "tests/neighbours/test_models.py": ["{package} is not installed: extra neighbours"],
    "tests/plant/test_cell.py": ["PyBaMM is not installed: extra battery"],
    "tests/plant/test_tokamak.py": ["Gym-TORAX is not installed: extra tokamak"],
    "tests/tools/test_data_sets.py": [
        "Minari is not installed: extra minari",
        "pyarrow is not installed: extra logs",
    ],
    "tests/plant/test_fmu.py": [
        "FMPy is not installed: extra fmi",
        "needs a C compiler, the command cc (make packages)",
        "pythonfmu is not installed: extra fmi",
    ],
    "tests/plant/test_process.py": ["needs a C compiler, the command cc (make packages)"],
    "tests/tools/test_model_files.py": [
        "FMPy is not installed: extra fmi",
        "needs a C compiler, the command cc (make packages)",
        "onnx and onnxruntime are not installed: extra onnx",
        "python-control is not installed: extra extras",
    ],
    "tests/topics/test_isolation.py": ["needs root, and the right to make namespaces"],
    "tests/topics/test_pairs.py": [
        "needs root, iproute2, and a kernel with veth",
        "needs two cores",
    ],
    "tests/topics/test_clock.py": ["needs Debian's faketime (make packages)"],
    "tests/topics/test_discovery_server.py": ["str(error)"],
    "tests/solver/test_workers.py": ["needs two cores"],
    "tests/support/browser.py": ["needs a real browser, the command `chromium` (make packages)"],
    "tests/support/small_disk.py": ["mounting a small disk needs root, and the right to mount"],
    "tests/tools/test_terminal.py": ["needs {command[0]} (make packages)"],
    "tests/tools/test_exported_bounds.py": ["needs a C compiler, the command cc (make packages)"],
    "tests/tools/test_compare_and_export.py": [
        "needs a C compiler, the command cc (make packages)"
    ],
    "tests/tools/test_layout.py": ["needs two cores"],
    "tests/tuner/test_crash_points.py": [
        "mounting an ext4 file system needs root, e2fsprogs and loop devices"
    ],
    "tests/topics/test_own_plants.py": ["{module} is not installed: extra solvers"],
    "tests/tools/test_other_solvers.py": ["{package} is not installed: extra solvers"],
    "tests/tools/test_logs.py": ["{name} is not installed: extra logs"],
    "tests/tools/test_warm_start.py": ["stable-baselines3 is not installed: extra rl"],
    "tests/tools/test_stable_baselines.py": ["stable-baselines3 is not installed: extra rl"],
    "tests/benchmarks/test_baselines.py": [
        "stable-baselines3 is not installed: extra rl",
        "{library} is not installed: extra {extra}",
        "sbx is not installed: extra rivals",
    ],
    "tests/tools/test_environment_pictures.py": ["MoviePy is not installed: extra rl"],
    "tests/tools/test_tensorboard.py": ["tensorboardX is not installed: extra tensorboard"],
    "tests/tools/test_study_on_dask.py": ["another {name} cannot be had: {done.stderr"],
}
"""Where tests are skipped, and why: rights and programs of the machine, packages that bring PyTorch or
JAX, a registry that cannot be reached."""


@cache
def trees() -> dict[Path, ast.Module]:
    """The tests and their support, parsed."""
    return {file: ast.parse(file.read_text()) for file in sorted((ROOT / "tests").rglob("*.py"))}


@cache
def functions(tree: ast.AST) -> list[Function]:
    return [node for node in ast.walk(tree) if isinstance(node, Function)]


def test_no_rule_is_about_no_file() -> None:
    """A pattern that finds nothing would hold for ever: here is every one that a rule looks for."""
    packages = ["pdeloop", *(f"{name}_node" for name in ("pde_sim", "controller", "tuner"))]
    packages += ["recorder_node", "viewer_node", "benchmarks", "tests"]
    patterns = [*(f"{name}/**/*.py" for name in packages), "docs/**/*.md", "*.md", "findings/*.sh"]
    patterns += ["config/problems/*.yaml", "benchmarks/studies/*.yaml", "docs/reference/*.md"]
    assert [pattern for pattern in patterns if not any(ROOT.glob(pattern))] == []
    pages = [page.read_text() for page in (ROOT / "docs").rglob("*.md")]
    for what in (
        r"python -m benchmarks \w",
        r"^ *pdeloop \w+",
        r"^#+ \S",
        r"\]\([^)]+\)",
        "```python",
    ):
        assert any(re.search(what, page, re.MULTILINE) for page in pages), what


def dotted(function: ast.expr) -> str:
    """a.b.c of a function, as in the source; (...).c of what begins with no name."""
    if isinstance(function, ast.Attribute):
        return f"{dotted(function.value)}.{function.attr}"
    return function.id if isinstance(function, ast.Name) else "(...)"


@cache
def looked_through(node: ast.AST) -> tuple[bool, set[str]]:
    """Whether something in it compares or fails by itself, and what it calls, enters or asks for."""
    checked, names = False, set()
    for part in ast.walk(node):
        if isinstance(part, ast.Call):
            function = dotted(part.func)
            names.add(function.split(".")[-1])
            checked = checked or CHECKS.match(function) is not None
        elif isinstance(part, ast.Assert | ast.Raise):
            checked = True
    arguments = node.args.args if isinstance(node, Function) else []
    return checked, names | {argument.arg for argument in arguments}


def checks(node: ast.AST) -> bool:
    return looked_through(node)[0]


def called(node: ast.AST) -> set[str]:
    return looked_through(node)[1]


def helpers() -> dict[str, bool]:
    """The functions of the tests and their support, and whether all of that name check something."""
    every: dict[str, list[Function]] = {}
    for tree in trees().values():
        for function in functions(tree):
            every.setdefault(function.name, []).append(function)
    known = {name: all(checks(f) for f in found) for name, found in every.items()}
    while True:
        further = [
            name
            for name, found in every.items()
            if not known[name] and all(checks(f) or any_of(known, called(f)) for f in found)
        ]
        if not further:
            return known
        known |= dict.fromkeys(further, True)


def any_of(known: dict[str, bool], names: set[str]) -> bool:
    return any(known.get(name, False) for name in names)


def test_every_test_can_fail() -> None:
    known = helpers()
    silent = []
    for file, tree in trees().items():
        own = {function.name: checks(function) for function in functions(tree)}
        all_known = {**known, **own}
        for function in functions(tree) if file.name.startswith("test_") else ():
            silence = not own[function.name] and not any_of(all_known, called(function))
            if function.name.startswith("test_") and silence:
                silent.append(f"{file.relative_to(ROOT)}:{function.lineno}: {function.name}")
    assert silent == []


def reasons(tree: ast.Module) -> list[str]:
    """Why its tests may be skipped, as far as the source says it."""
    found = []
    for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
        name = dotted(call.func)
        if name == "pytest.skip":
            found.append(ast.unparse(call.args[0]))
        elif name == "pytest.mark.skipif":
            found += [ast.unparse(word.value) for word in call.keywords if word.arg == "reason"]
        elif name in ("pytest.importorskip", "pytest.mark.skip", "pytest.mark.xfail"):
            found.append(ast.unparse(call))
    return found


def test_only_what_cannot_be_had_everywhere_is_a_reason_to_skip() -> None:
    found = {str(file.relative_to(ROOT)): reasons(tree) for file, tree in trees().items()}
    other = [
        (name, reason)
        for name, given in found.items()
        for reason in given
        if not any(words in reason for words in SKIPS.get(name, []))
    ]
    assert other == [], "a reason to skip that is not in the table above"
    gone = {name: w for name, w in SKIPS.items() if len(found[name]) < len(w)}
    assert gone == {}


@pytest.mark.parametrize("name", ["osqp", "cmaes", "matplotlib", "gymnasium", "scikit-fem"])
def test_what_tests_need_of_these_is_installed_with_them(name: str) -> None:
    locked = Path(ROOT / "requirements" / "test.txt").read_text()
    assert re.search(rf"^{re.escape(name)}==", locked, re.MULTILINE)


def test_files_that_come_first_are_there() -> None:
    missing = [name for name in LONG if not (ROOT / "tests" / "topics" / f"{name}.py").is_file()]
    assert missing == []


def test_linear_algebra_of_the_tests_has_one_thread() -> None:
    """Radau's method on 128 points took twenty times as long with two of them."""
    assert scipy.linalg.inv(np.eye(2))[0, 0] == 1.0  # whose library was loaded before any test ran
    assert {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"} == {1}
