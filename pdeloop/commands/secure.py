"""`pdeloop secure`."""

from __future__ import annotations

import argparse

from pdeloop.commands.common import Commands, command


def add(commands: Commands) -> None:
    """The command `secure`."""
    command(
        commands,
        "secure",
        _secure,
        help="print an access policy for SROS2",
        description="Print a policy for `ros2 security generate_artifacts -p` in which each node "
        "has its own topics and nothing else (docs/security.md).",
        example="pdeloop secure > policy.xml",
    )


def _secure(options: argparse.Namespace) -> int:
    from pdeloop.secure import policy

    print(policy(), end="")
    return 0
