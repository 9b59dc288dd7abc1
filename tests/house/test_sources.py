# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Every source file says whose it is, as REP-2004 asks of each level."""

from __future__ import annotations

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
