"""What the page asks of the loop, handed from the web server's thread to the node's. Pure."""

from __future__ import annotations

import queue
from dataclasses import dataclass

VERBS = ("pause", "resume", "step", "stop")
"""std_srvs/Trigger services that nodes of a loop may offer under their private names."""


@dataclass(frozen=True)
class Call:
    """Call the service NODE/VERB."""

    node: str
    verb: str


@dataclass(frozen=True)
class Watch:
    """Watch the loop in this namespace of the domain."""

    namespace: str


Command = Call | Watch
Commands = queue.SimpleQueue[Command]
