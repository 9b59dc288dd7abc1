# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What holds for every source file: whose it is, as REP-2004 asks, and how calls are written."""

from __future__ import annotations

import ast
import re
import subprocess

from tests.support.interpreter import ROOT

SOURCES = ("*.py", "*.js", "*.css", "*.html", ".ci/run", ":!viewer_node/web/static/vendor")
STATEMENT = "Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0"


def test_every_source_file_of_our_own_has_the_copyright_statement() -> None:
    listed = subprocess.check_output(["git", "ls-files", *SOURCES], cwd=ROOT, text=True)
    files = [ROOT / name for name in listed.splitlines()]
    assert len(files) > 300
    texts = {file: file.read_text() for file in files if file.exists()}
    missing = [file for file, text in texts.items() if text and STATEMENT not in text[:120]]
    assert missing == [], f"expected '# {STATEMENT}' as the first line"


def test_calls_name_their_arguments_one_by_one() -> None:
    """f(*(a, b)) is f(a, b). Only a file with such characters is parsed."""
    listed = subprocess.check_output(["git", "ls-files", "*.py"], cwd=ROOT, text=True)
    files = [ROOT / name for name in listed.splitlines()]
    texts = {file: file.read_text() for file in files if file.exists()}
    found = [
        f"{file.relative_to(ROOT)}:{node.lineno}"
        for file, text in texts.items()
        if re.search(r"(?<!\*)\*[(\[]", text)
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Call)
        for given in node.args
        if isinstance(given, ast.Starred) and isinstance(given.value, ast.Tuple | ast.List)
    ]
    assert found == []
