"""Plant and controller in compiled functions on a line: the same bytes, and their business only."""

from __future__ import annotations

import pytest

from tests.topics.test_loop import LIMIT

pytestmark = pytest.mark.topics


def test_plant_and_controller_flow_with_the_bytes_of_the_long_way(loop):
    text = loop.wait(loop.start("-m", "tests.flow_program", name="flow"), LIMIT)
    assert text.strip() == "done"
