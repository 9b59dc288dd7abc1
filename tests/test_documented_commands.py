"""Tables of measured costs name the command that gives them, and the command exists."""

from __future__ import annotations

import importlib
import re
import shlex
from pathlib import Path

import pytest

from benchmarks.__main__ import parser

DOCS = Path(__file__).resolve().parent.parent / "docs"
COMMAND = re.compile(r"python -m benchmarks ([^`\n#]+)")
BLANKS = {"PROBLEM": "burgers", "NAME": "two_point", "N": "4", "DIR": "limits"}


@pytest.mark.parametrize("page", sorted(DOCS.glob("*.md")), ids=lambda page: page.name)
def test_every_benchmark_that_a_page_names_can_be_called(page):
    for command in COMMAND.findall(page.read_text()):
        words = [BLANKS.get(word, word) for word in shlex.split(command.split(" (")[0])]
        options = parser().parse_args(words)
        module = importlib.import_module(f"benchmarks.{options.program}")
        assert callable(module.run), command


@pytest.mark.parametrize("name", ["optimizers.md", "robustness.md", "problems.md"])
def test_a_table_of_costs_names_its_command(name):
    sections = re.split(r"^## ", (DOCS / name).read_text(), flags=re.MULTILINE)
    measured = [text for text in sections if re.search(r"^\|.*\bLQT\b", text, re.MULTILINE)]
    assert measured
    for text in measured:
        assert COMMAND.search(text) or "pdeloop train" in text, text.partition("\n")[0]
