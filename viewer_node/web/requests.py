"""What a page asks for, handed from the server's thread to the node's. Pure."""

from __future__ import annotations

import queue
from dataclasses import dataclass

from viewer_node.operation import Call


@dataclass(frozen=True)
class Watch:
    """Watch the loop in this namespace of the domain."""

    namespace: str


@dataclass(frozen=True)
class ShowEpisode:
    """Show the recorded episode of this index."""

    index: int


Request = Call | Watch | ShowEpisode
Requests = queue.SimpleQueue[Request]
