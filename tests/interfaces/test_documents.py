# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Hostile YAML and JSON: refused in one short sentence, before anything is built from them."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pdeloop.cli import FAILED, main
from pdeloop.messages import actuators, documents
from pdeloop.messages.cost import Cost
from pdeloop.messages.documents import MAX_DEPTH, MAX_YAML_NODES, parse_json, parse_yaml
from pdeloop.messages.grid import Grid
from pdeloop.messages.problem import read_problem
from pdeloop.messages.protocol import ModelFailure
from pdeloop.messages.spec import ParameterError, Spec
from pdeloop.messages.text import MAX_SHOWN, shown
from tests.support.small import SMALL, parameters
from tests.support.small_limits import limited
from tuner_node.run_folder import RunFolder, RunFolderError

HEAD = "/**:\n  ros__parameters:\n"


def doubled(first: str, levels: int, last: str = "") -> str:
    """A parameter file in which each entry has the one before twice."""
    lines = [f"    l0: &l0 {first}\n"]
    for i in range(1, levels):
        lines.append(f"    l{i}: &l{i} {{a: *l{i - 1}, b: *l{i - 1}}}\n")
    return HEAD + "".join(lines) + last


HOSTILE = {
    "empty maps, doubled": (doubled("{a: {}, b: {}}", 30), "repeats 'l0' by an alias"),
    "leaves, doubled": (doubled("{a: 1, b: 2}", 30), "repeats 'l0' by an alias"),
    "a list, doubled": (doubled("[a, b]", 30, "    horizon: *l29\n"), "by an alias"),
    "a map in itself": (HEAD.replace("rs:\n", "rs: &a\n") + "    horizon: *a\n", "by an alias"),
    "a list in itself": (HEAD + "    horizon: &a [*a]\n", "by an alias"),
    "a merged alias": (f"a: &a {{b: 1}}\n{HEAD}    <<: *a\n", "by an alias"),
    "many maps in each other": (f"{HEAD}    {'{a: ' * 9000}1{'}' * 9000}\n", "nested more than"),
    "many lists in each other": (f"{HEAD}    seed: {'[' * 9000}{']' * 9000}\n", "nested more than"),
    "many entries": (HEAD + "".join(f"    k{i}: 1\n" for i in range(30_000)), "50000 entries"),
    "a long value": (f"{HEAD}    problem: {'p' * 20_000}\n", "more than 10000 characters"),
    "digits in base 60": (f"{HEAD}    seed: {':'.join(['1'] * 90_000)}\n", "10000 characters"),
    "a long name": (
        HEAD + "".join(f"{'  ' * (i + 2)}{'k' * 100}:\n" for i in range(9)) + "  " * 12 + "a: 1\n",
        "name of a parameter has more than 500 characters",
    ),
    "no YAML": ("/**: {", "did not find expected|expected the node"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_parameter_file_is_refused_in_one_short_sentence(tmp_path, name):
    text, words = HOSTILE[name]
    path = tmp_path / "p.yaml"
    path.write_text(text)
    with limited(seconds=20, megabytes=500), pytest.raises(ParameterError, match=words) as refused:
        read_problem(path)
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 400


@pytest.mark.parametrize(
    "value",
    [
        f"{':'.join(['1'] * 900)}.5",  # in base 60
        "!!timestamp soon",
        "!!int ''",
        "!!bool perhaps",
        "!!python/object:os.system x",
    ],
)
def test_what_ros_takes_for_a_text_is_one(tmp_path, value):
    path = tmp_path / "p.yaml"
    path.write_text(f"{HEAD}    equation: {value}\n")
    text = value.removeprefix("!!").partition(" ")[2] if value.startswith("!!") else value
    assert read_problem(path) == {"equation": text.strip("'")}


COMMANDS: dict[str, Callable[[Path], list[str]]] = {
    "check": lambda path: ["check", str(path)],
    "train": lambda path: ["train", str(path), "--in-process"],
    "reproduce": lambda path: ["reproduce", str(path)],
    "study": lambda path: ["study", str(path)],
    "evaluate": lambda path: ["evaluate", str(path.parent)],
    "report": lambda path: ["report", str(path.parent)],
    "resume": lambda path: ["train", "--resume", str(path.parent)],
}


@pytest.mark.parametrize("command", COMMANDS)
def test_no_command_hangs_on_a_kilobyte_of_yaml(tmp_path, monkeypatch, capsys, command):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "run" / "parameters.yaml"
    path.parent.mkdir()
    path.write_text(HOSTILE["empty maps, doubled"][0])
    assert path.stat().st_size < 1500
    with limited(seconds=20, megabytes=500):
        assert main(COMMANDS[command](path)) == FAILED
    (line,) = capsys.readouterr().err.splitlines()
    assert "repeats 'l0' by an alias" in line


def test_no_shipped_yaml_has_an_alias_and_all_of_it_is_read_as_a_library_reads_it():
    import yaml

    root = Path(documents.__file__).parents[2]
    found = [p for d in ("config", "examples", "benchmarks") for p in (root / d).rglob("*.yaml")]
    assert len(found) > 10
    for path in found:
        assert parse_yaml(path.read_bytes()) == yaml.safe_load(path.read_text()), path


def test_what_is_within_the_bounds_is_read():
    depth = MAX_DEPTH - 1
    assert parse_yaml("[" * depth + "]" * depth) is not None
    assert len(parse_yaml("[" + "1," * (MAX_YAML_NODES - 1) + "]")) == MAX_YAML_NODES - 1
    with pytest.raises(ValueError, match=f"more than {MAX_YAML_NODES} entries"):
        parse_yaml("[" + "1," * MAX_YAML_NODES + "]")
    assert parse_json("[" * depth + "]" * depth) is not None
    assert parse_json(json.dumps({"a": [1, 2.5, {"b": None}]})) == {"a": [1, 2.5, {"b": None}]}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 900 + "]" * 900, "nested too deeply"),
        ('{"a":' * 900 + "1" + "}" * 900, "nested too deeply"),
        ("[" * 50_000, "nested too deeply"),
        ("[" + "[]," * documents.MAX_JSON_CONTAINERS + "[]]", "objects and lists"),
        ("1" * 5000, "64 bits"),
    ],
)
def test_hostile_json_is_refused(text, words):
    with limited(seconds=30, megabytes=500), pytest.raises(ValueError, match=words):
        parse_json(text)


@pytest.mark.parametrize("text", ["[" * 9999, '{"run":' * 900 + "1" + "}" * 900])
def test_deep_json_from_the_network_is_a_value_error(text):
    with pytest.raises(ValueError, match="expected the JSON of a model failure"):
        ModelFailure.from_json(text)


def test_a_text_with_a_null_character_is_refused(tmp_path, capsys):
    path = tmp_path / "p.yaml"
    path.write_text(f'{HEAD}    equation: "a\\0b.py:A"\n')
    assert main(["train", str(path), "--in-process"]) == FAILED
    (line,) = capsys.readouterr().err.splitlines()
    assert "parameter 'equation' is '" in line and "a\\x00b.py:A'; expected a text" in line


def nested(depth: int) -> list[Any]:
    found: list[Any] = []
    for _ in range(depth):
        found = [found]
    return found


def doubled_list(levels: int) -> list[Any]:
    """A list of a few kilobytes that Python writes as 2**levels entries."""
    found: list[Any] = ["x"]
    for _ in range(levels):
        found = [found, found]
    return found


@pytest.mark.parametrize(
    "value",
    [
        "x" * 10**7,
        b"x" * 10**7,
        10**6000,
        [10**6000] * 100,
        nested(5000),
        doubled_list(60),
        {"a": doubled_list(60)},
        dict.fromkeys(range(100), "y" * 10**6),
        (doubled_list(40),) * 3,
        {frozenset(range(10**5))},
        np.zeros((300, 300)),
    ],
    ids=lambda value: type(value).__name__,
)
def test_the_text_of_any_value_is_short_and_soon_there(value):
    with limited(seconds=10, megabytes=200):
        assert len(shown(value)) <= MAX_SHOWN + 3
        with pytest.raises(ParameterError) as refused:
            Spec("horizon", 300, 1, 10**6).check(value)
    assert len(str(refused.value)) < 400


@pytest.mark.parametrize("value", [1, -2.5, "two\nlines", [1, "a"], {"b": 1, "a": None}, (), True])
def test_a_short_value_is_shown_as_python_writes_it(value):
    assert shown(value) == repr(value)


def test_a_run_with_other_parameters_is_refused_in_a_short_sentence(tmp_path):
    values = parameters()
    folder = RunFolder(tmp_path / "run")
    folder.create(values)
    path = folder.path / "run.json"
    known = json.loads(path.read_text())
    known["parameters"] |= {f"physical.{i}": [["x" * 1000] * 10] * 10 for i in range(500)}
    path.write_text(json.dumps(known))
    with pytest.raises(RunFolderError, match="and 480 more") as refused:
        folder.reopen(values)
    assert len(str(refused.value)) < 10_000


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"problems": [{}]}, "'problems' holds {}; expected names"),
        ({"problems": ["p" * 5000]}, "'problems' holds 'ppp"),
        ({"problems": ["kdv"], **{f"k{i}": 1 for i in range(10_000)}}, "unknown entries: k0"),
        ({"problems": ["kdv"], "seeds": ["s" * 5000] * 1000}, "'seeds' is"),
    ],
)
def test_a_study_of_foreign_values_is_refused_in_a_short_sentence(content, words):
    from pdeloop.study.description import Study, StudyError

    with pytest.raises(StudyError) as refused:
        Study.of(content)
    assert words in str(refused.value)
    assert len(str(refused.value)) < 600


@pytest.mark.parametrize("value", ["1.0e+98", "1e98", "1.0e+308", "1.0e-300"])
@pytest.mark.parametrize("name", ["sample_time", "integration_time", "length", "actuator_width"])
def test_a_number_out_of_all_proportion_gets_its_own_sentence(tmp_path, capsys, name, value):
    lines = [line for line in SMALL.read_text().splitlines() if not line.startswith(f"    {name}:")]
    path = tmp_path / "p.yaml"
    path.write_text("\n".join([*lines, f"    {name}: {value}", ""]))
    with limited(seconds=60):
        assert main(["train", str(path), "--in-process", "--out", str(tmp_path / "out")]) == FAILED
    (line,) = [x for x in capsys.readouterr().err.splitlines() if "compiling" not in x]
    assert line.startswith("pdeloop: ")
    assert name in line or "width" in line


def test_data_that_make_a_matrix_singular_get_their_own_sentence(tmp_path, capsys):
    data = tmp_path / "data.csv"
    rows = [f"{i},{10.0**i},{10.0**i},{(-1) ** i},{i % 3}" for i in range(60)]
    data.write_text("\n".join(["t,z1,z2,a1,a2", *rows, "target,0,0,,", ""]))
    assert main(["identify", "--data", str(data)]) == FAILED
    (line,) = capsys.readouterr().err.splitlines()
    assert "slice" not in line and len(line) < 500


def zeros() -> str:
    """Text that stands for a thousand times its length; no worker makes it that does not need it."""
    return base64.b85encode(zlib.compress(bytes(2**27), 9)).decode()


@pytest.mark.parametrize(
    ("parse", "text"),
    [
        (Cost.parse, "[" * 20_000),
        (Cost.parse, "[1e999, 1, 9, {}]"),
        (Cost.parse, '[2, 1, 9, {"target": {"shape": [1e999], "number": 1}}]'),
        (Cost.parse, '[2, 1, 9, {"target": {"shape": [30000, 30000], "number": 1}}]'),
        (Cost.parse, f'[2, 1, 9, {{"target": {{"shape": [{2**30}], "data": "ZEROS"}}}}]'),
        (Cost.parse, '[2, 1, 9, {"target": {"shape": [3], "data": "ZEROS"}}]'),
        (Cost.parse, "{}"),
        (Grid.parse, "[" * 20_000),
        (Grid.parse, '[[["x", 1.0, 1e999, true, true, "m"]], ["u"], "", 0]'),
        (Grid.parse, '[[["x", 1.0, 1e300, true, true, "m"]], ["u"], "", 0]'),
        (Grid.parse, '[[["y", 1, 9999, 0, 0, "m"], ["x", 1, 9999, 0, 0, "m"]], "u", "", 0]'),
        (Grid.parse, '[[], ["u"], "", -3]'),
        (Grid.parse, '[[], ["u"], "", 1e999]'),
        (actuators.parse, "[" * 20_000),
        (actuators.parse, "[[1e999, [0, 1]]]"),
        (actuators.parse, '{"a": 1}'),
    ],
)
def test_a_hostile_text_of_a_parameter_is_refused_in_one_short_sentence(
    parse: Callable[[Any], object], text: str
) -> None:
    if "ZEROS" in text:
        text = text.replace("ZEROS", zeros())
    with limited(seconds=20, megabytes=300), pytest.raises(ValueError) as error:
        parse([text] if parse == Cost.parse else text)
    assert len(str(error.value)) < 400
