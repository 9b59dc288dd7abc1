# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Nodes that find each other through Fast DDS's discovery server."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from benchmarks.participants import server_command
from benchmarks.processes import BenchError
from pdeloop.pairs import PAIR, namespaces
from tests.support.loop_harness import Processes, udp_sockets, until
from tests.support.small_loop import (
    LIMIT,
    PARAMETERS,
    adapted,
    assert_same_training,
    in_process,
    start_tuner,
)

pytestmark = pytest.mark.topics
ITERATIONS, PACE = 40, "real_time_factor:=40.0"
"""So many, of 37 ms an episode, that the server is gone for most of them."""


def test_two_pairs_train_through_a_server_and_wait_until_it_is_there(
    loop: Processes, tmp_path: Path
) -> None:
    try:
        command, address = server_command()
    except BenchError as error:
        pytest.skip(str(error))
    loop.environment["ROS_DISCOVERY_SERVER"] = address
    pairs = namespaces(2)
    for name in pairs:
        own = ("-p", f"publish_clock:={str(name == pairs[0]).lower()}", "-p", PACE)
        for package, given in zip(PAIR, (own, ()), strict=True):
            loop.node(package, *PARAMETERS, *given, "-r", f"__ns:=/{name}")
    out = tmp_path / "run"
    tuner = start_tuner(loop, out, pairs=f"[{', '.join(pairs)}]", seeds=2, iterations=ITERATIONS)

    # Without a server nobody is found: not by multicast either.
    def missing() -> list[str]:
        return [line for line in loop.output(tuner).splitlines() if "waiting for" in line]

    until(lambda: len(missing()) >= 2, LIMIT, "second line on who is missing")
    for line in missing():
        found = re.findall(r"(plant|controller) of pair (\d)", line)
        assert sorted(found) == [(node, pair) for node in ("controller", "plant") for pair in "01"]

    server = loop.program(*command, name="server")
    until(lambda: adapted(out) >= 2, LIMIT, "second iteration")
    port = int(address.partition(":")[2])
    assert ("0100007F", port) in udp_sockets(server.pid), "it listens beyond 127.0.0.1"
    server.kill()  # those who have found each other need it no more
    assert adapted(out) < ITERATIONS
    loop.wait(tuner, LIMIT)
    assert_same_training(out, in_process(iterations=ITERATIONS, seeds=2))
