# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What CONTRIBUTING.md says has to be touched to add something is all that names what is shipped."""

from __future__ import annotations

import inspect
import re
from functools import cache
from pathlib import Path

import pytest

from pde_sim_node.equations.loading import EQUATIONS
from pde_sim_node.plants.loading import PLANTS
from pdeloop.cli import COMMANDS
from pdeloop.method.adapt.registry import OWN_OPTIMIZERS
from tests.house.test_house import KNOWS, imports, sources
from tests.support.interpreter import ROOT

TABLE = {
    row[0]: re.findall(r"`([^`]+)`", row[2])
    for line in (ROOT / "CONTRIBUTING.md").read_text().splitlines()
    if len(row := [cell.strip() for cell in line.strip("|").split("|")]) == 3
}


@cache
def importers() -> dict[str, set[str]]:
    """The files that import each module, apart from those that offer it again (`__init__.py`)."""
    found: dict[str, set[str]] = {}
    for path in sources("pdeloop", *KNOWS):
        if path.name != "__init__.py":
            for module in imports(path):
                found.setdefault(module, set()).add(str(path.relative_to(ROOT)))
    return found


def who_names(kind: type) -> set[str]:
    own = inspect.getsourcefile(kind)
    assert own is not None
    return importers().get(kind.__module__, set()) - {str(Path(own).relative_to(ROOT))}


@pytest.mark.parametrize("what", sorted(TABLE.keys() - {"to add", "---"}))
def test_the_files_of_the_table_are_there(what: str) -> None:
    assert TABLE[what]
    assert all((ROOT / file).exists() for file in TABLE[what])


@pytest.mark.parametrize("name", EQUATIONS)
def test_nothing_but_the_registry_names_an_equation(name: str) -> None:
    assert who_names(EQUATIONS[name]) <= {*TABLE["an equation"]}
    (problems,) = (file for file in TABLE["an equation"] if file.endswith("/"))
    text = "".join(path.read_text() for path in (ROOT / problems).glob("*.yaml"))
    assert f"equation: {name}\n" in text


@pytest.mark.parametrize("name", PLANTS)
def test_nothing_but_the_registry_names_a_plant(name: str) -> None:
    # Plants of one family share a file with their common base.
    assert who_names(PLANTS[name]) <= {*TABLE["a plant"], "pde_sim_node/plants/reactions.py"}


def test_nothing_but_the_registry_names_a_law() -> None:
    named = {
        str(path.relative_to(ROOT))
        for path in sources("pdeloop", *KNOWS)
        if re.search(r"\bFeedForward\b", path.read_text())
    }
    own = {f"pdeloop/method/laws/{name}.py" for name in ("__init__", "linear")}
    own |= {"pdeloop/method/laws/linear.py"}  # laws that begin as it
    own |= {"pdeloop/export.py"}  # its form in C
    assert named - own <= {*TABLE["a law"]}


def test_the_package_offers_an_optimiser_as_any_other_package_would() -> None:
    assert who_names(OWN_OPTIMIZERS.shipped["two_point"]) == set()
    assert TABLE["an optimiser"] == ["pyproject.toml"]


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_is_a_file_that_the_command_line_lists(name: str) -> None:
    assert importers().get(f"pdeloop.commands.{name}", set()) <= {"pdeloop/commands/reproduce.py"}
    assert (ROOT / "pdeloop" / "commands" / f"{name}.py").is_file()
    assert TABLE["a command"][0] == "pdeloop/cli.py"
