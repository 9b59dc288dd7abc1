# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Mutants are what they are called, always the same, and one that is wrong is found."""

from __future__ import annotations

import ast

import pytest

from tests.simulation.equivalent import ARGUED
from tests.simulation.mutants import TESTS, drawn, mutants_of, tried
from tests.simulation.operators import mutations
from tests.support.interpreter import ROOT

SOURCE = """
def f(self, a, b):
    if a < 3 and not b:
        self.c = min(a, 2)
        return a is b
    assert a != 7, f"{a == b}"
    self.counters["x"] += 1
    return a + 1
"""


@pytest.mark.parametrize(
    ("line", "changed"),
    [
        (3, ["if not (a < 3 and (not b)):", "if a < 3 or not b:", "if a <= 3 and (not b):"]),
        (3, ["if a < 4 and (not b):", "if a < 3 and (not not b):"]),
        (4, ["pass", "self.c = max(a, 2)", "self.c = min(a, 3)"]),
        (5, ["pass", "return a is not b"]),
        (6, []),
        (7, []),
        (8, ["pass", "return a - 1", "return a + 2"]),
    ],
)
def test_a_change_is_one_wrong_thing(line: int, changed: list[str]) -> None:
    count, found = len(list(mutations(ast.parse(SOURCE)))), []
    for number in range(count):
        tree = ast.parse(SOURCE)
        change = list(mutations(tree))[number]
        change.apply()
        text = ast.unparse(ast.fix_missing_locations(tree)).splitlines()[line - 2 :]
        found += [text[0].strip()] if change.line == line else []
    assert set(changed) <= set(found)
    assert bool(found) == bool(changed)


@pytest.mark.parametrize("module", TESTS)
def test_the_mutants_of_a_module_are_the_same_each_time_and_have_tests(module: str) -> None:
    assert drawn(module, 5, 1) == drawn(module, 5, 1) != drawn(module, 5, 2)
    assert all((ROOT / "tests" / file.partition("::")[0]).is_file() for file in TESTS[module])
    known = {(mutant.there, mutant.how) for mutant in mutants_of(module)}
    argued = {key[1:] for key in ARGUED if key[0] == module}
    assert argued <= known, "argued, and not there any more"


def test_a_check_that_is_turned_round_is_found() -> None:
    (mutant,) = (
        mutant
        for mutant in mutants_of("tuner_node.dispatch")
        if (mutant.there, mutant.how) == ("if frame.run != self.run:", "NotEq -> Eq")
    )
    ((_, end),) = tried([mutant])
    assert end == "simulation"
