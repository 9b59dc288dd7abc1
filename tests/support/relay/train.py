# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop train ARGUMENTS` with a relay with faults between plant and controller.

`python -m tests.support.relay.train ARGUMENTS`
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from pdeloop import pairs
from pdeloop.cli import main
from pdeloop.pairs import LoopNode

FAULTS = {"loss": 0.01, "duplicate": 0.02, "delay": 0.002}
REMAPS = {"pde_sim_node": "state:=state_sent", "controller_node": "action:=action_sent"}


@dataclass(frozen=True)
class RemappedNode(LoopNode):
    """A plant or controller that is connected to the relay."""

    def ros_arguments(self, parameter_file: Path) -> list[str]:
        return [*super().ros_arguments(parameter_file), "-r", REMAPS[self.package]]


@dataclass(frozen=True)
class RelayNode(LoopNode):
    """The relay, which has nothing of the problem."""

    def ros_arguments(self, parameter_file: Path) -> list[str]:
        return [word for assignment in self.assignments for word in ("-p", assignment)]


class TransportWithRelay(pairs.Transport):
    """One pair, with a relay."""

    def nodes(self, folder: Path) -> list[LoopNode]:
        nodes = [
            RemappedNode(**vars(node)) if node.package in REMAPS else node
            for node in super().nodes(folder)
        ]
        return [*nodes, RelayNode("relay", "tests.support.relay", FAULTS)]


if __name__ == "__main__":
    pairs.Transport = TransportWithRelay  # type: ignore[misc]
    sys.exit(main(["train", *sys.argv[1:]]))
