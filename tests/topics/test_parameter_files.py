# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Parameter files are read as rclpy reads them, and end a node that they have nothing for."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from pdeloop.messages.parameter_file import read_parameter_file
from pdeloop.messages.spec import ParameterError
from tests.support.loop_harness import Processes
from tests.support.small import SMALL

pytestmark = pytest.mark.topics
LIMIT = 120.0
NODES = ("/pde_sim_node", "/lab/pde_sim_node", "/lab/left/pde_sim_node", "/lab")
RCLPY = """
import json, sys
import rclpy
from rclpy.node import Node
from pdeloop.process.isolation import keep_on_this_machine

keep_on_this_machine()
folder, *nodes = sys.argv[1:]
found = {}
for number, text in enumerate(json.loads(open(f"{folder}/texts.json").read())):
    path = f"{folder}/{number}.yaml"
    open(path, "w").write(text)
    for node in nodes:
        namespace, _, name = node.rpartition("/")
        context = rclpy.context.Context()
        arguments = ["--ros-args", "--params-file", path, "-r", f"__ns:={namespace or '/'}"]
        try:
            rclpy.init(args=arguments, context=context)
        except Exception:
            found[f"{number} {node}"] = None
            continue
        own = {"start_parameter_services": False, "enable_rosout": False}
        made = Node(name, context=context, **own)
        given = made._parameter_overrides.items()
        found[f"{number} {node}"] = {name: [] if p.value is None else p.value for name, p in given}
        made.destroy_node()
        rclpy.shutdown(context=context)
open(f"{folder}/found.json", "w").write(json.dumps(found))
"""
"""What rclpy gives nodes of these names from each of the texts; None where it refuses the file."""
BLOCKS = [
    "/**",
    "/*",
    "'**'",
    "'*'",
    "/pde_sim_node",
    "pde_sim_node",
    "/lab",
    "/camera_node",
    "/lab/pde_sim_node",
    "lab/pde_sim_node",
    "/lab/**",
    "/lab/*",
    "/*/pde_sim_node",
    "/*/**",
    "/**/pde_sim_node",
    "/**/left/*",
    "/lab//pde_sim_node",
    "/lab/",
    "/***",
    "/pde-sim",
    "/**/**",
]
VALUES = [
    "1",
    "-1",
    "+5",
    "0x10",
    "010",
    "08",
    "1_000",
    "9223372036854775808",
    "1,5",
    "1.5",
    ".5",
    "5.",
    "1e3",
    "1.0e+3",
    "-2E-3",
    "1e400",
    "1e-320",
    "0x1p3",
    ".inf",
    "-.INF",
    "inf",
    "nan",
    ".NaN",
    "yes",
    "'yes'",
    "on",
    "True",
    "y",
    "N",
    "'1'",
    '"x"',
    "''",
    "text",
    "~",
    "null",
    "12:30",
    "2001-01-01",
    "|\n      5",
    "!!str 5",
    "!!float 5",
    "!!int '5'",
    "!!str",
    "",
    "2:",
    "&x 1",
    "[]",
    "[1, 2]",
    "[1, 2.0]",
    "[yes, no]",
    "[a, '1']",
    "[a, 1]",
    "{b: {c: 2}, d.e: 3}",
]
FILES = [
    "",
    "# nothing\n",
    "- 1\n",
    "/**:\n  a: 1\n",
    "/**:\n  ros__parameters:\n",
    "/**:\n  ros__parameters: {}\n",
    "/**:\n  ros__parameters: &x {a: 1}\n/lab: *x\n",
    "/**: {ros__parameters: {a: 1, b: 1}}\n/pde_sim_node: {ros__parameters: {a: 2}}\n",
    "/pde_sim_node: {ros__parameters: {a: 2}}\n/**: {ros__parameters: {a: 1, b: 1}}\n",
    "/*: {ros__parameters: {a: 1}}\n/**: {ros__parameters: {b: 2}}\n/*: {ros__parameters: {b: 3}}\n",
    "/lab: {pde_sim_node: {ros__parameters: {a: 1}}, left/pde_sim_node: {ros__parameters: {b: 1}}}",
    "/lab: {left: {ros__parameters: {b: 1}}, ros__parameters: {a: 1}}\n",
    "/lab: {ros__parameters: {a: 1}, pde_sim_node: {ros__parameters: {b: 1}}}\n",
    "/camera_node: {ros__parameters: {t: [[1, 2]], g: {}}}\n/**: {ros__parameters: {a: 1}}\n",
    "---\n/**: {ros__parameters: {a: 1}}\n---\n/*: {ros__parameters: {b: 1}}\n",
]
TEXTS = [
    *FILES,
    *(f"{name}:\n  ros__parameters:\n    a: 1\n" for name in BLOCKS),
    *(f"/**:\n  ros__parameters:\n    a: {value}\n" for value in VALUES),
]


def ours(path: Path, node: str) -> dict[str, Any] | None:
    try:
        return read_parameter_file(path).of(node)
    except ParameterError:
        return None


def test_files_are_read_as_rclpy_reads_them(loop: Processes, tmp_path: Path) -> None:
    (tmp_path / "texts.json").write_text(json.dumps(TEXTS))
    loop.wait(loop.start("-c", RCLPY, str(tmp_path), *NODES), LIMIT)
    found = json.loads((tmp_path / "found.json").read_text())
    assert len(found) == len(TEXTS) * len(NODES)
    assert sum(values is None for values in found.values()) < len(found) / 3
    for key, values in found.items():
        number, node = key.split(" ")
        own = ours(tmp_path / f"{number}.yaml", node)
        assert repr(own) == repr(values), (TEXTS[int(number)], node)


@pytest.mark.parametrize(
    ("node", "text", "arguments", "said"),
    [
        (
            "pde_sim_node",
            "/camera_node: {ros__parameters: {gain: 3}}",
            (),
            "has no parameters for /pde_sim_node, only for /camera_node; expected '/**:' or",
        ),
        (
            "controller_node",
            "/controller_node: {ros__parameters: {n_a: 3}}",
            ("-r", "__ns:=/lab"),
            "has no parameters for /lab/controller_node, only for /controller_node",
        ),
        (
            "tuner_node",
            "/**: {ros__parameters: {use_sim_time: true}}",
            (),
            "no parameters for /tuner",
        ),
        ("recorder_node", "", (), "has no parameters; expected '/**:'"),
        (
            "viewer_node",
            "/**: {ros__parameters: {problem: stokes}}",
            (),
            "unknown problem 'stokes'",
        ),
        ("pde_sim_node", "/**: {ros__parameters: {pairs: [1, a]}}", (), "several types"),
        (
            "pde_sim_node",
            "/**: {ros__parameters: {n_z: 64}}",
            ("-p", "problem:=stokes"),
            "unknown pro",
        ),
        ("controller_node", None, ("-p", "problem:=stokes"), "unknown problem 'stokes'"),
        ("tuner_node", None, ("-p", "problem:=stokes"), "unknown problem 'stokes'"),
    ],
)
def test_a_node_that_a_file_has_nothing_for_ends_in_one_sentence(
    loop: Processes,
    tmp_path: Path,
    node: str,
    text: str | None,
    arguments: tuple[str, ...],
    said: str,
) -> None:
    if text is not None:
        (tmp_path / "p.yaml").write_text(text)
        arguments = ("--params-file", "p.yaml", *arguments)
    (line,) = loop.wait(loop.node(node, *arguments), LIMIT, code=1).strip().splitlines()
    assert line.startswith(f"{node}: ") and said in line


def test_one_file_of_a_whole_system_serves_all_nodes_of_a_loop(
    loop: Processes, tmp_path: Path
) -> None:
    small = SMALL.read_text().replace("/**:", "/lab/**:")
    own = "/camera: {ros__parameters: {gain: 3}}\n/lab: {tuner_node: {ros__parameters: {out: run}}}"
    (tmp_path / "p.yaml").write_text(
        f"{small}\n/**: {{ros__parameters: {{use_sim_time: false}}}}\n{own}"
    )
    given = ("--params-file", "p.yaml", "-r", "__ns:=/lab")
    for node in ("pde_sim_node", "controller_node"):
        loop.node(node, *given)
    loop.wait(loop.node("tuner_node", *given, "-p", "iterations:=1"), LIMIT)
    assert (tmp_path / "run" / "result.json").exists()
