# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Shared by the tests of the command line tools."""

from __future__ import annotations

from pathlib import Path

import pytest

from pdeloop.study import Study, run
from tests.support.made_once import made_once
from tests.support.small_study import CONTENT, here


@pytest.fixture(scope="session")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a small study, finished."""

    def make(folder: Path) -> Path:
        assert run(Study.of(CONTENT), folder, here) == []
        return folder

    return made_once(tmp_path_factory, "study", make)
