# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The names in docs/architecture.md exist where it says they are."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "docs" / "architecture.md").read_text()
FILES = sorted(set(re.findall(r"`([\w/]+\.py)(?::\w+)?`", TEXT)) - {"file.py", "node.py"})
NAMES = sorted(set(re.findall(r"`([\w/]+\.py):(\w+)`", TEXT)) - {("file.py", "name")})


@pytest.mark.parametrize("file", FILES)
def test_the_file_exists(file: str) -> None:
    assert (ROOT / file).is_file()


@pytest.mark.parametrize("file, name", NAMES, ids=":".join)
def test_the_name_is_defined_in_the_file(file: str, name: str) -> None:
    defined = {
        node.name
        for node in ast.walk(ast.parse((ROOT / file).read_text()))
        if isinstance(node, (ast.FunctionDef, ast.ClassDef))
    }
    assert name in defined


def test_the_document_names_code() -> None:
    assert len(NAMES) > 30
