# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Parameters: every refusal names the parameter, the value and the range."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.serialization import deserialize_message, serialize_message

from pde_sim_node.build import build_plant, fingerprint
from pde_sim_node.equations import EQUATIONS, OWN_EQUATIONS
from pde_sim_node.node import physical_specs
from pdeloop.messages.parameters import NODES, table, taken_by, with_names
from pdeloop.messages.problem import completed, find_problem, load_parameters, shipped_problems
from pdeloop.messages.spec import ParameterError as Refused
from pdeloop.messages.spec import Spec, check_names
from pdeloop.method.adapt.registry import OWN_OPTIMIZERS
from pdeloop.ros.parameters import descriptor
from tests.support.small import parameters
from tuner_node.optimizer_parameters import setting_specs

SPECS = {spec.name: spec for spec in table()}


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("n_z", 0, "'n_z' is 0; expected a whole number from 1 to 1048576"),
        ("n_z", 64.0, "'n_z' is 64.0; expected a whole number"),
        ("n_a", True, "'n_a' is True; expected a whole number from 1 to 1024"),
        ("length", 0.0, "'length' is 0.0; expected a number above 0"),
        ("length", float("nan"), "'length' is nan; expected a number above 0"),
        ("sample_time", "fast", "'sample_time' is 'fast'; expected a number above 0"),
        ("length", "1.0e12", "(m); in YAML a number with an exponent needs"),
        ("actuator_width", 1.5, "'actuator_width' is 1.5; expected a number above 0, at most 1"),
        ("start", "lqg", "'start' is 'lqg'; expected one of lqt, zero"),
        ("seed", -1, "'seed' is -1; expected a whole number from 0"),
        ("pairs", "a", "'pairs' is 'a'; expected a list of texts"),
        ("actuator_positions", [0.1, 1.2], "is [0.1, 1.2]; expected a list of numbers from 0 to 1"),
        ("actuator_positions", [0.1, "a"], "is [0.1, 'a']; expected a list of numbers from 0 to 1"),
        ("actuator_positions", 0.1, "is 0.1; expected a list of numbers from 0 to 1"),
    ],
)
def test_a_bad_value_is_refused_with_name_value_and_range(name, value, words):
    with pytest.raises(Refused) as refusal:
        SPECS[name].check(value)
    assert words in str(refusal.value)


def test_a_value_of_any_length_is_refused_in_a_short_sentence():
    for name, value in (("seed", 10**5000), ("length", 10**5000), ("start", "x" * 10**6)):
        with pytest.raises(Refused, match=f"^parameter '{name}' is .*; expected") as refusal:
            SPECS[name].check(value)
        assert len(str(refusal.value)) < 400


def test_defaults_are_within_their_own_ranges():
    for spec in table():
        assert spec.check(spec.default) == spec.default
        assert spec.description
        assert spec.range


def test_a_whole_number_serves_where_a_number_is_expected():
    value = Spec("x", 1.0).check(2)
    assert value == 2.0
    assert isinstance(value, float)


@pytest.mark.parametrize("positions", [[0, 0.5], (0.0, 0.5), np.array([0.0, 0.5])])
def test_numbers_in_a_list_a_tuple_or_an_array_become_a_list_that_a_file_can_hold(positions):
    value = SPECS["actuator_positions"].check(positions)
    assert value == [0.0, 0.5]
    assert [type(number) for number in value] == [float, float]


def test_an_unknown_name_is_refused_with_the_nearest_known_one():
    with pytest.raises(Refused, match="'learning_rat'; did you mean 'learning_rate'"):
        check_names(["learning_rat"], SPECS)


def test_a_plant_with_other_actuators_has_another_fingerprint():
    options = [{}, {"actuator_positions": [0.1, 0.2, 0.5, 0.8]}, {"actuator_shape": "gaussian"}]
    assert len({fingerprint(parameters(**given)) for given in options}) == len(options)


@pytest.mark.parametrize("name", shipped_problems())
def test_shipped_problems_load_and_build(name):
    values = load_parameters(name, {})
    plant = build_plant(values)
    assert plant.n_z == values["n_z"]
    assert plant.supports.shape == (len(plant.x), values["n_a"])
    assert set(EQUATIONS) <= set(shipped_problems())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("n_z: 3", "not a ROS parameter file"),
        ("/**: {ros__parameters: [1]}", "not a ROS parameter file"),
        ("a: [", "not valid YAML"),
        ("a: 1\nb: 2: 3\n", "not valid YAML: mapping values are not allowed"),
        ("", "has no parameters; expected '/**:' with 'ros__parameters:' in it"),
        ("/**: {ros__parameters: {use_sim_time: true}}", "no parameters for the nodes of a loop"),
        ("/camera: {ros__parameters: {gain: 3}}", "only for /camera"),
        ("/**: {ros__parameters: {problem: stokes, n_z: 64}}", "unknown problem 'stokes'"),
        ("/**: {ros__parameters: {n_zz: 3}}", "unknown parameter 'n_zz'; did you mean 'n_z'"),
        ("/**: {ros__parameters: {n_z: odd}}", "'n_z' is 'odd'"),
        ("/**: {ros__parameters: {physical: {viscosity: thick}}}", "'physical.viscosity'"),
        ("x: !!python/object/apply:os.system ['true']", "not a ROS parameter file"),
    ],
)
def test_a_bad_problem_file_is_one_clear_sentence(tmp_path, text, words):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(Refused) as refusal:
        load_parameters(str(path), {})
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_an_unknown_problem_lists_the_known_ones():
    with pytest.raises(
        Refused, match="'rocket'; expected one of allen-cahn, allen-cahn-modes, burgers, burgers-m"
    ):
        load_parameters("rocket", {})


@pytest.mark.parametrize("n_z", [7, 6, 65538])
def test_the_points_of_an_equation_are_even_and_not_too_few_or_many(n_z):
    with pytest.raises(
        Refused, match=f"'n_z' is {n_z}; expected an even whole number from 8 to 65536"
    ):
        load_parameters("burgers", {"n_z": n_z})


def test_a_number_as_plant_is_the_fingerprint_that_older_versions_called_so():
    old = {"plant": 77, "n_z": 32}
    assert with_names(old) == {"plant": "", "plant_fingerprint": 77, "n_z": 32}
    values = load_parameters("burgers", old)
    assert (values["plant"], values["plant_fingerprint"]) == ("", 77)


def test_an_equation_file_is_found_beside_its_yaml(tmp_path):
    (tmp_path / "mine.yaml").write_text("/**: {ros__parameters: {equation: 'heat.py:Heat'}}")
    assert (
        load_parameters(str(tmp_path / "mine.yaml"), {})["equation"] == f"{tmp_path}/heat.py:Heat"
    )


def test_the_documents_table_is_that_of_the_specs():
    """docs/parameters.md: name, default, unit, nodes and meaning of every parameter, in any order."""
    text = (Path(__file__).parents[2] / "docs" / "parameters.md").read_text()
    rows = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in text.splitlines()]
    rows = [row for row in rows if len(row) == 5 and row[0][:1] == "`"]
    documented = {row[0].strip("`"): row for row in rows}
    units = {spec.unit for spec in table()} - {""}
    for spec in table():
        default = str(spec.default).lower() if spec.type is bool else str(spec.default)
        _, shown, limits, nodes, meaning = documented.pop(spec.name, [""] * 5)
        if spec.name != "pairs":
            assert shown == (f"`{default}`" if default else "empty"), spec.name
        assert nodes == spec.nodes, spec.name
        assert [unit for unit in units if limits.endswith(f" {unit}")] == [spec.unit] * bool(
            spec.unit
        )
        assert re.sub(r"\[(.*?)\]\(.*?\)", r"\1", meaning) == spec.description, spec.name
    assert documented == {}


def test_the_documents_table_of_equations_is_that_of_the_classes():
    text = (Path(__file__).parents[2] / "docs" / "reference" / "settings.md").read_text()
    section = text.partition("| equation | constants and defaults |")[2].partition("\n\n")[0]
    rows = dict(re.findall(r"^\| `([\w-]+)` \| (.*) \|$", section, re.MULTILINE))
    assert list(rows) == list(EQUATIONS)
    for name, row in rows.items():
        own = {field.name: field.default for field in fields(OWN_EQUATIONS.load(name))}
        del own["length"]  # a parameter of every problem
        assert {word: float(x) for word, x in re.findall(r"`(\w+)` ([-\d.]+)", row)} == own


def test_a_text_is_parsed_as_its_parameter_asks():
    assert SPECS["horizon"].parse("20") == 20
    assert SPECS["sample_time"].parse("1e-3") == 1e-3
    assert SPECS["publish_clock"].parse("false") is False
    assert SPECS["problem"].parse("5") == "5"
    assert SPECS["actuator_positions"].parse("[0, 0.25]") == [0.0, 0.25]
    refused = {"horizon": "2.5", "sample_time": "fast", "publish_clock": "no"}
    for name, text in {**refused, "actuator_positions": "0.1 0.2"}.items():
        with pytest.raises(Refused, match=f"'{name}' is '{text}'; expected"):
            SPECS[name].parse(text)


def test_every_parameter_says_which_nodes_take_it():
    for node in ("pde_sim_node", "controller_node", "tuner_node", "recorder_node", "viewer_node"):
        assert taken_by(node)
    assert {spec.name for spec in table()} == {
        spec.name for node in NODES.values() for spec in taken_by(node)
    }


SYSTEM = """
/camera_node:
  ros__parameters: {gain: 3, tiles: [[1, 2]]}
/**:
  ros__parameters: {use_sim_time: true}
"""
PLANT = "{problem: own, equation: burgers, n_z: 64, physical: {viscosity: 1e-2}}"


@pytest.mark.parametrize(
    "text",
    [
        f"/**: {{ros__parameters: {PLANT}}}",
        f"/*: {{ros__parameters: {PLANT}}}",
        f"/pde_sim_node: {{ros__parameters: {PLANT}}}",
        f"pde_sim_node: {{ros__parameters: {PLANT}}}",
        f"/lab: {{pde_sim_node: {{ros__parameters: {PLANT}}}}}",
        f"/lab/pde_sim_node: {{ros__parameters: {PLANT}}}",
        f"/lab/**: {{ros__parameters: {PLANT}}}",
        f"/*/pde_sim_node: {{ros__parameters: {PLANT}}}",
        f"/a/lab: {{'*': {{ros__parameters: {PLANT}}}}}",
        f"/left: {{'**': {{ros__parameters: {PLANT}}}}}\n/right/**: {{ros__parameters: {PLANT}}}",
        # What a node does not take is not for it; a later block is taken over an earlier one.
        f"/tuner_node: {{ros__parameters: {{pin: 3}}}}\n/**: {{ros__parameters: {PLANT}}}",
        f"/**: {{ros__parameters: {{n_z: 32}}}}\n/*: {{ros__parameters: {PLANT}}}",
    ],
)
def test_a_file_for_a_whole_system_is_read_as_the_nodes_read_it(tmp_path, text):
    path = tmp_path / "system.yaml"
    path.write_text(SYSTEM + text)
    values = load_parameters(str(path), {})
    assert (values["problem"], values["n_z"], values["pin"]) == ("own", 64, -1)
    assert values["physical.viscosity"] == 0.01


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "/pde_sim_node: {ros__parameters: {n_z: 64}}\n/tuner_node: {ros__parameters: {n_z: 32}}",
            "'n_z' as 64 for pde_sim_node and as 32 for tuner_node; expected one value",
        ),
        (
            "/left/**: {ros__parameters: {n_z: 64}}\n/right/**: {ros__parameters: {n_z: 32}}",
            "different parameters for the nodes in /left and in /right",
        ),
        ("/**: {ros__parameters: {a: 1}, camera: {ros__parameters: {b: 2}}}", "put them before it"),
        ("/**: {ros__parameters: {horizon: 3, horizon: 3.5}}", "'horizon' as 3 and as 3.5"),
        (
            "/**: {ros__parameters: {horizon: 20, horizon: 30}}",
            "'horizon' as 20 and as 30 in line 1",
        ),
        ("/**: {ros__parameters: {a: {b: 1}, a.b: 2}}", "'a.b' as 1 and as 2 in line 1"),
        ("/**: {ros__parameters: {pairs: [[a]]}}", "has lists within the list 'pairs'"),
        ("/**: {ros__parameters: {pairs: [a, 1]}}", "several types"),
        ("/**: {ros__parameters: {physical: {}}}", "empty group 'physical'"),
        ("/**: {ros__parameters: {a: {b.c: {d: 1}}}}", "dots in the name of a group"),
        ("/**: {ros__parameters: {n_z: }}", "'n_z' has no value in line 1"),
        ("/my-plant: {ros__parameters: {n_z: 64}}", "'/my-plant' is not the name of a node"),
    ],
)
def test_a_file_that_ros_misreads_or_that_contradicts_itself_is_refused(tmp_path, text, words):
    path = tmp_path / "system.yaml"
    path.write_text(text)
    with pytest.raises(Refused) as refused:
        load_parameters(str(path), {})
    assert words in str(refused.value) and str(path) in str(refused.value)


def test_a_problem_that_names_a_shipped_one_is_that_one_with_changes(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("/**: {ros__parameters: {problem: kdv, horizon: 20}}")
    values, shipped = load_parameters(str(path), {}), load_parameters("kdv", {})
    assert values == {**shipped, "horizon": 20}


@pytest.mark.parametrize(
    ("package", "given", "known"),
    [
        ("pde_sim_node", {"problem": "stokes"}, False),
        ("pde_sim_node", {"problem": "stokes", "n_z": 64}, False),
        ("pde_sim_node", {"problem": "stokes", "equation": "burgers"}, True),
        ("controller_node", {"problem": "stokes"}, False),
        ("tuner_node", {"problem": "stokes", "out": "run"}, False),
        ("viewer_node", {"problem": "stokes"}, False),
        # Of a plant that is not this project's, which has no equation here.
        ("controller_node", {"problem": "rig", "n_a": 2}, True),
        ("tuner_node", {"problem": "rig", "n_z": 8}, True),
        ("recorder_node", {"problem": "rig"}, True),
        ("tuner_node", {"n_z": 8}, True),
    ],
)
def test_a_node_refuses_a_problem_that_nobody_knows(package, given, known):
    if known:
        assert completed(given, package) == given
    else:
        with pytest.raises(Refused, match=r"unknown problem 'stokes'.*burgers, .*kdv"):
            completed(given, package)


@pytest.mark.parametrize("name", ["plant.py", "plant.py:Plant"])
def test_a_plant_that_is_given_as_a_problem_is_told_how_to_be_given(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("plant.py").touch()
    with pytest.raises(Refused, match=rf"got '{name}'; .* as --plant FILE\.py:CLASS"):
        find_problem(name)


def test_what_a_plant_tells_of_itself_is_not_taken_from_a_file_of_all_its_parameters() -> None:
    from pdeloop.ros.parameters import given_parameters

    overrides = {"actuators": "[[0, [0.0, 0.5]]]", "n_a": 3}
    node: Any = SimpleNamespace(
        _parameter_overrides={n: SimpleNamespace(value=v) for n, v in overrides.items()}
    )
    given = given_parameters(node, "pde_sim_node")
    assert "actuators" not in given and given["n_a"] == 3


@pytest.mark.parametrize("code", ["equation", "plant"])
def test_code_of_a_relative_file_is_the_same_for_a_command_and_a_node(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str
) -> None:
    """It is next to the file that names it, wherever the command or the node is started."""
    from pdeloop.messages.parameter_file import read_parameter_file
    from pdeloop.ros.parameters import given_parameters, require_parameters

    folder, elsewhere = tmp_path / "lab", tmp_path / "elsewhere"
    folder.mkdir(), elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    file = folder / "mine.yaml"
    file.write_text(f"/**:\n  ros__parameters: {{problem: mine, {code}: o.py:Mine, law: l.py:L}}\n")
    known = read_parameter_file(file)

    def taken(**more: str) -> dict[str, Any]:
        values = {**known.of("/pde_sim_node"), **more}
        node: Any = SimpleNamespace(
            get_fully_qualified_name=lambda: "/pde_sim_node",
            _parameter_overrides={n: SimpleNamespace(value=v) for n, v in values.items()},
        )
        require_parameters(node, [known])
        return given_parameters(node, "pde_sim_node")

    command, node = load_parameters(str(file), {}), taken()
    for name, own in ((code, "o.py:Mine"), ("law", "l.py:L")):
        assert node[name] == command[name] == f"{folder}/{own}"
    # What the command line of a node says is relative to where that is.
    assert taken(law="k.py:L")["law"] == "k.py:L"


def every_spec() -> list[Spec]:
    """Parameters of all nodes, of all equations, and the settings of all methods."""
    of_methods = [
        spec
        for name in OWN_OPTIMIZERS.offered()
        for spec in setting_specs(parameters(optimizer=name))
    ]
    of_equations = [spec for name in EQUATIONS for spec in physical_specs(name)]
    return [*table(), *of_methods, *of_equations]


def test_other_nodes_read_the_ranges_of_all_parameters():
    """What the descriptor of a parameter holds once it has been a message."""
    for spec in every_spec():
        told = deserialize_message(serialize_message(descriptor(spec)), ParameterDescriptor)
        ranges = [*told.floating_point_range, *told.integer_range]
        assert len(ranges) == (spec.type in (int, float)), spec
        for found in ranges:
            assert found.from_value == (found.from_value if spec.minimum is None else spec.minimum)
            assert found.to_value == (found.to_value if spec.maximum is None else spec.maximum)
            assert found.from_value <= spec.default <= found.to_value, spec


def test_a_number_that_differs_from_itself_is_refused_as_what_it_is(tmp_path):
    path = tmp_path / "nan.yaml"
    path.write_text("/**: {ros__parameters: {equation: burgers, state_weight: .nan}}\n")
    with pytest.raises(Refused, match="'state_weight' is nan; expected a number above 0"):
        load_parameters(str(path), {})
