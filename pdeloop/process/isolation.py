# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Confines a run's messages: by default to the loopback interface."""

import ipaddress
import os
import re
from pathlib import Path
from xml.etree import ElementTree

from pdeloop.messages.files import FileError, read_bounded
from pdeloop.messages.problem import config_folder

PROFILE = "FASTRTPS_DEFAULT_PROFILES_FILE"
NETWORK = "PDELOOP_NETWORK"
MAX_PROFILE_BYTES = 2**20


def loopback_environment() -> dict[str, str]:
    """Environment variables that keep a node's traffic on this machine.

    Empty when the user brings a Fast DDS profile of their own or sets PDELOOP_NETWORK=1.
    """
    if os.environ.get(PROFILE) or os.environ.get(NETWORK) == "1":
        return {}
    return {PROFILE: str(loopback_profile())}


def keep_on_this_machine() -> None:
    """Apply `loopback_environment` to this process; call before ROS is initialised."""
    os.environ.update(loopback_environment())


def check_profile() -> None:
    """ValueError if the user's Fast DDS profile is invalid: Fast DDS would use its defaults."""
    path = os.environ.get(PROFILE)
    if not path:
        return
    try:
        root = ElementTree.fromstring(read_bounded(Path(path), MAX_PROFILE_BYTES))
    except (FileError, ElementTree.ParseError) as error:
        reason = str(error)
    else:
        if any(element.tag.rpartition("}")[2] == "profiles" for element in root.iter()):
            return
        reason = "it has no element <profiles>"
    raise ValueError(
        f"{PROFILE}={path} is not a Fast DDS profile ({reason}); Fast DDS would use every "
        "interface: correct it, or unset the variable to stay on this machine"
    )


def is_confined() -> bool:
    """True if this process is configured to keep its traffic on this machine."""
    return os.environ.get(PROFILE) == str(loopback_profile())


def outside_sockets() -> list[str]:
    """Addresses of this process's UDP sockets that reach beyond the loopback interface.

    Fast DDS only logs a profile that it cannot read and uses its defaults, which send to
    every interface: so look at what it has opened. Multicast addresses are groups that were joined,
    on the interface of the profile, and count as inside.
    """
    own = set()
    for entry in Path("/proc/self/fd").iterdir():
        try:
            target = str(entry.readlink())
        except OSError:
            continue
        if match := re.fullmatch(r"socket:\[(\d+)\]", target):
            own.add(match.group(1))
    outside = []
    for table in ("udp", "udp6"):
        try:
            lines = Path(f"/proc/self/net/{table}").read_text().splitlines()[1:]
        except OSError:
            continue
        for line in lines:
            columns = line.split()
            address = _address(columns[1].split(":")[0])
            if columns[9] in own and not (address.is_loopback or address.is_multicast):
                outside.append(str(address))
    return outside


def loopback_profile() -> Path:
    """The Fast DDS profile that keeps messages on this machine."""
    return config_folder() / "fastdds_loopback.xml"


def _address(hexadecimal: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    """An address as /proc/net writes it: words of four bytes, each in the machine's order."""
    raw = bytes.fromhex(hexadecimal)
    words = b"".join(raw[i : i + 4][::-1] for i in range(0, len(raw), 4))
    return ipaddress.ip_address(words)
