"""`pdeloop secure`."""

from __future__ import annotations

import argparse

from pdeloop.commands.common import Commands, command


def add(commands: Commands) -> None:
    """The command `secure`."""
    secure = command(
        commands,
        "secure",
        _secure,
        help="print an access policy for SROS2",
        description="Print a policy for `ros2 security generate_artifacts -p` in which each node "
        "has its own topics and nothing else (docs/security.md).",
        example="pdeloop secure --namespace /lab > policy.xml",
    )
    secure.add_argument("--namespace", default="/", metavar="NS", help="namespace of the loop [/]")
    secure.add_argument(
        "--pairs", nargs="+", default=[""], metavar="NS", help="namespaces of its pairs below it"
    )


def _secure(options: argparse.Namespace) -> int:
    from pdeloop.secure import policy

    print(policy(options.namespace, tuple(options.pairs)), end="")
    return 0
