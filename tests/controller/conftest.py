# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Shared by the tests of the controller."""

from __future__ import annotations

import pytest

from controller_node.responder import Responder
from tests.support.responding import SETTINGS, target


@pytest.fixture
def responder() -> Responder:
    """A controller that knows the target."""
    made = Responder(SETTINGS)
    made.target(target())
    return made
