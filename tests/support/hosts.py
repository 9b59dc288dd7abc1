# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Hosts made of network namespaces on a bridge. Needs root.

Every host has one interface, `lan0`, with an address in 10.77.0.0/24, and nothing leads outside.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

from pdeloop.messages.problem import config_folder
from pdeloop.process.isolation import PROFILE

INTERFACE = "lan0"


class HostsError(RuntimeError):
    """Namespaces cannot be made here."""


def can_make_hosts() -> bool:
    """True if this process may make network namespaces."""
    return (
        os.geteuid() == 0 and shutil.which("ip") is not None and Path("/proc/self/ns/net").exists()
    )


def on(host: str) -> list[str]:
    """Words in front of a command that is to run on `host`."""
    return ["ip", "netns", "exec", host]


def environment() -> dict[str, str]:
    """Variables that let a node use the hosts' network, and it alone."""
    profile = str(config_folder() / "fastdds_interface.xml")
    return {PROFILE: profile, "PDELOOP_INTERFACE": INTERFACE}


@contextlib.contextmanager
def hosts(count: int) -> Iterator[list[str]]:
    """Names of `count` hosts that reach each other; they are gone after the block."""
    if not can_make_hosts():
        raise HostsError("hosts made of network namespaces need root and iproute2's ip")
    mark = f"pdl{os.getpid()}"
    switch, names = f"{mark}s", [f"{mark}h{i}" for i in range(count)]
    made: list[str] = []
    try:
        for name in (switch, *names):
            _ip("netns", "add", name)
            made.append(name)
            _ip("-n", name, "link", "set", "lo", "up")
        _ip("-n", switch, "link", "add", "bridge0", "type", "bridge", "mcast_snooping", "0")
        _ip("-n", switch, "link", "set", "bridge0", "up")
        for i, name in enumerate(names):
            port = f"port{i}"
            peer = ("peer", "name", INTERFACE, "netns", name)
            _ip("-n", switch, "link", "add", port, "type", "veth", *peer)
            _ip("-n", switch, "link", "set", port, "master", "bridge0", "up")
            _ip("-n", name, "addr", "add", f"10.77.0.{i + 1}/24", "dev", INTERFACE)
            _ip("-n", name, "link", "set", INTERFACE, "up")
            _ip("-n", name, "route", "add", "224.0.0.0/4", "dev", INTERFACE)
        yield names
    finally:
        for name in made:
            subprocess.run(["ip", "netns", "del", name], check=False, capture_output=True)


def _ip(*words: str) -> None:
    done = subprocess.run(["ip", *words], check=False, capture_output=True, text=True)
    if done.returncode:
        raise HostsError(f"ip {' '.join(words)}: {done.stderr.strip()}")
