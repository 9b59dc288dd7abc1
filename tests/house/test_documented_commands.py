# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Tables of measured costs name the command that gives them, and the command exists."""

from __future__ import annotations

import importlib
import re
import shlex
from pathlib import Path

import pytest

from benchmarks.__main__ import parser
from pdeloop.cli import COMMANDS
from pdeloop.cli import parser as pdeloop_parser

TESTS = Path(__file__).resolve().parents[1]
DOCS = TESTS.parent / "docs"
COMMAND = re.compile(r"python -m benchmarks ([^`\n#]+)")
BLANKS = {"PROBLEM": "burgers", "NAME": "two_point", "N": "4", "DIR": "limits"}


@pytest.mark.parametrize("page", sorted(DOCS.rglob("*.md")), ids=lambda page: page.name)
def test_every_benchmark_that_a_page_names_can_be_called(page):
    for command in COMMAND.findall(page.read_text()):
        words = [BLANKS.get(word, word) for word in shlex.split(command.split(" (")[0])]
        options = parser().parse_args(words)
        module = importlib.import_module(f"benchmarks.{options.program}")
        assert callable(module.run), command


PRINTED = re.compile(rf"^(?: {{4}})?(pdeloop (?:{'|'.join(COMMANDS)})\b[^#|>&\n]*)", re.MULTILINE)
OPTIONAL = re.compile(r"\[[^]]*\]")


def printed(page: Path) -> list[str]:
    """The `pdeloop` commands in a page's blocks of code."""
    text = page.read_text().replace("\\\n", "").replace("$seed", "0").replace(" 2>", " >")
    return [OPTIONAL.sub("", command.strip()) for command in PRINTED.findall(text)]


PAGES = [*sorted(DOCS.rglob("*.md")), DOCS.parent / "README.md"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_that_a_page_prints_is_understood(page):
    for command in printed(page):
        assert pdeloop_parser().parse_args(shlex.split(command)[1:]), command


PAGES_OF_COSTS = ("comparison.md", "reference/tables.md", "robustness.md", "problems.md")


@pytest.mark.parametrize("name", PAGES_OF_COSTS)
def test_a_table_of_costs_names_its_command(name):
    sections = re.split(r"^## ", (DOCS / name).read_text(), flags=re.MULTILINE)
    measured = [
        text for text in sections if re.search(r"^\|.*\b(LQT|first law)\b", text, re.MULTILINE)
    ]
    assert measured
    for text in measured:
        heading = text.partition("\n")[0]
        assert COMMAND.search(text) or re.search("pdeloop (train|study)", text), heading


NAMED = re.compile(r"`(?:tests/)?((?:\w+/)?test_\w+\.py)`|`([a-z_0-9]{12,})`")
"""A file of tests, or the distinctive part of a test's name."""


def has_test(name: str, part: str) -> bool:
    """True if a file of tests, wherever it is, has a test with this in its name."""
    return any(re.search(rf"def test_\w*{part}", file.read_text()) for file in TESTS.rglob(name))


def test_every_fault_that_is_survived_names_a_test_of_it():
    text = (DOCS / "reference" / "faults.md").read_text()
    rows = re.findall(r"^\|.*\|(.*)\|$", text, re.MULTILINE)[2:]
    for row in rows:
        file, parts = "topics/test_faults.py", 0
        for name, part in NAMED.findall(row):
            file, parts = name or file, parts + bool(part)
            assert has_test(file, part), (file, part)
        assert parts, row


def test_every_test_that_the_page_on_security_names_exists():
    text = (DOCS / "security.md").read_text()
    files = re.findall(r"`tests/([\w/]+\.py)`", text)
    named = re.findall(r"`(\w{12,})`\s+in\s+`tests/([\w/]+\.py)`", text)
    assert len(files) > 10 and len(named) >= 5
    assert all(has_test(file, part) for part, file in [*named, *(("", file) for file in files)])


@pytest.mark.parametrize("flag", ["--optimizer", "--optimiser"])
def test_a_flag_is_understood_in_both_spellings(flag: str) -> None:
    options = pdeloop_parser().parse_args(["train", "burgers", flag, "two-point"])
    assert options.optimizer == "two-point"
