# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Shared by the tests of the recorder: a run with its bag, and the messages in that."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from pdeloop.bags.mcap_messages import Message
from tests.support.made_once import made_once
from tests.support.recorded_here import messages_of, record_run
from tests.support.verified_bag import HORIZON


@pytest.fixture(scope="session")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run with its bag."""

    def make(folder: Path) -> Path:
        record_run(folder / "run", horizon=HORIZON)
        return folder / "run"

    return made_once(tmp_path_factory, "verified", make)


@pytest.fixture
def run(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "run"))


@pytest.fixture(scope="session")
def original_messages(original: Path) -> tuple[Message, ...]:
    return tuple(messages_of(original / "bag"))


@pytest.fixture
def messages(original_messages: tuple[Message, ...]) -> list[Message]:
    return list(original_messages)
