"""What the commands share."""

from __future__ import annotations

import argparse
from typing import TypeAlias

from loop_interfaces.parameters import TUNER

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
"""Where a command adds its parser."""
DEFAULTS = {spec.name: spec for spec in TUNER}
"""The tuner's parameters by name: their defaults, ranges and meanings."""
