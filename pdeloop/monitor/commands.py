"""What the page asks of the loop, handed from the web server's thread to the node's. Pure."""

from __future__ import annotations

import queue
from concurrent.futures import Future
from dataclasses import dataclass, field

VERBS = ("pause", "resume", "step", "stop")
"""std_srvs/Trigger services that nodes of a loop may offer under their private names."""


@dataclass
class Call:
    """Call the service NODE/VERB; the answer is (success, message)."""

    node: str
    verb: str
    answer: Future[tuple[bool, str]] = field(default_factory=Future)

    def fail(self, reason: str) -> None:
        """Answer that it did not work."""
        self.tell(False, reason)

    def tell(self, success: bool, message: str) -> None:
        """Answer, unless who asked has gone."""
        if self.answer.set_running_or_notify_cancel():
            self.answer.set_result((success, message))


@dataclass
class Watch:
    """Watch the loop in this namespace of the domain."""

    namespace: str


Command = Call | Watch
Commands = queue.SimpleQueue[Command]
