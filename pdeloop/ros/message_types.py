# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Message classes by the names of their types."""

import importlib
from typing import Any


def message_class(name: str) -> Any:
    """The class of a message type like 'std_msgs/msg/String'; None if it is not installed."""
    package, _, kind = name.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), kind, None)
    except ImportError:
        return None
