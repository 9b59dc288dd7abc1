# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The environment variables that ROS 2, its middleware and Fast DDS read, before a node starts.

They are often set once for all in a shell's start-up file, for other work. Where the messages stay on
this machine, which is the default (pdeloop.process.isolation), the profile of the project says how
nodes find each other, and what contradicts it is left out; what cannot work is refused by its name.
No ROS import.
"""

from __future__ import annotations

import ipaddress
import os
import re
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from pdeloop.messages.files import FileError, private_folder
from pdeloop.process.isolation import NETWORK, PROFILE, loopback_profile

MIDDLEWARE = "rmw_fastrtps_cpp"
"""The middleware that the project's profile is for, and the only one of the wheels."""
RANGES = ("OFF", "LOCALHOST", "SUBNET", "SYSTEM_DEFAULT")
LAST_DOMAIN = 232
_SWITCHES = (
    "RCUTILS_COLORIZED_OUTPUT",
    "RCUTILS_LOGGING_USE_STDOUT",
    "RCUTILS_LOGGING_BUFFERED_STREAM",
)
_NEUTRAL = {
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
    "ROS_LOCALHOST_ONLY": "0",
    "ROS_STATIC_PEERS": "",
    "RMW_FASTRTPS_USE_QOS_FROM_XML": "0",
    "FASTDDS_ENVIRONMENT_FILE": "",
    "FASTDDS_BUILTIN_TRANSPORTS": "",
}
"""Variables that steer discovery and transport, with their neutral values."""
STEERING = (*_NEUTRAL, "ROS_DISCOVERY_SERVER", PROFILE, "RMW_IMPLEMENTATION")
"""Variables on which it depends which nodes find each other."""
_SERVER = re.compile(r"(?:UDPv[46]:)?\[?(?P<host>[^\[\]]*?)\]?(?::(?P<port>\d+))?")
_SERVER_PORT = 11811
"""Of a discovery server whose address names none."""
_QUIET = {"SKIP_DEFAULT_XML_FILE": "1"}
"""Fast DDS would read a profile that lies in the working directory."""
_BOOTSTRAPPED = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"


class RosEnvironmentError(ValueError):
    """A variable with which no node can work; the text names it, its value and what to do."""


def prepared(environment: Mapping[str, str]) -> tuple[dict[str, str], list[str]]:
    """The environment of a node to be started in this one, and what was removed, in words.

    RosEnvironmentError where it cannot work. What has the project's profile already is complete.
    """
    found = dict(environment)
    _check_values(found)
    confined = (
        found.get(PROFILE) in (None, "", str(loopback_profile())) and found.get(NETWORK) != "1"
    )
    changed: dict[str, str] = {}
    if confined:
        found[PROFILE] = str(loopback_profile())
        changed = {
            name: value for name, value in _NEUTRAL.items() if found.get(name, value) != value
        }
        if not _all_loopback(found.get("ROS_DISCOVERY_SERVER", "")):
            changed["ROS_DISCOVERY_SERVER"] = ""
        found |= _QUIET
    remarks = [
        f"{name}={environment[name]} is ignored: the messages stay on this machine"
        for name in changed
    ]
    found |= changed
    for name, value in changed.items():
        if not value:
            del found[name]
    middleware = found.get("RMW_IMPLEMENTATION", "")
    if middleware not in ("", MIDDLEWARE):
        if not _installed(middleware, found):
            found["RMW_IMPLEMENTATION"] = MIDDLEWARE
            remarks.append(
                f"RMW_IMPLEMENTATION={middleware} is not installed: {MIDDLEWARE} is used"
            )
        elif confined:
            raise RosEnvironmentError(
                f"RMW_IMPLEMENTATION={middleware}: only {MIDDLEWARE} keeps the messages on this "
                f"machine; unset it, or let messages leave the machine (--network, {NETWORK}=1)"
            )
    if not confined and found.get("ROS_AUTOMATIC_DISCOVERY_RANGE") == "OFF":
        raise RosEnvironmentError(
            "ROS_AUTOMATIC_DISCOVERY_RANGE=OFF: no node finds another; unset it, or set SUBNET"
        )
    if found.get(NETWORK) == "1" and found.get("ROS_LOCALHOST_ONLY") == "1":
        raise RosEnvironmentError(
            f"ROS_LOCALHOST_ONLY=1 and {NETWORK}=1 (--network) contradict each other; unset one"
        )
    if found.get("FASTDDS_DEFAULT_PROFILES_FILE") and not environment.get(PROFILE):
        remarks.append(
            f"FASTDDS_DEFAULT_PROFILES_FILE is not read by ROS 2 Jazzy; set {PROFILE} instead"
        )
    libraries = found.get("LD_LIBRARY_PATH", "").split(os.pathsep)
    if found.get(_BOOTSTRAPPED) and str(Path(sys.prefix) / "lib") not in libraries:
        del found[_BOOTSTRAPPED]  # of another shell: the wheels have to find their libraries again
    return found, remarks


def with_servers_there(environment: Mapping[str, str]) -> tuple[dict[str, str], list[str]]:
    """The environment without discovery servers of this machine where nothing listens, and a remark.

    Nodes wait for a server for ever, and those of one command find each other without one.
    """
    named = environment.get("ROS_DISCOVERY_SERVER", "")
    if not named or not _all_loopback(named):
        return dict(environment), []
    ports = {
        int(match["port"] or _SERVER_PORT)
        for server in filter(None, named.split(";"))
        if (match := _SERVER.fullmatch(server))
    }
    if ports & _open_ports():
        return dict(environment), []
    found = {name: value for name, value in environment.items() if name != "ROS_DISCOVERY_SERVER"}
    return found, [f"ROS_DISCOVERY_SERVER={named} is ignored: no server runs there"]


def _open_ports() -> set[int]:
    found = set()
    for table in ("udp", "udp6"):
        try:
            lines = Path(f"/proc/net/{table}").read_text().splitlines()[1:]
        except OSError:
            continue
        found |= {int(line.split()[1].rpartition(":")[2], 16) for line in lines}
    return found


def steering(environment: Mapping[str, str]) -> str:
    """The variables that are set and may keep nodes from finding each other, for a sentence."""
    usual = ("", MIDDLEWARE, str(loopback_profile()))
    names = [
        name
        for name in STEERING
        if environment.get(name, "") not in (*usual, _NEUTRAL.get(name, ""))
    ]
    return ", ".join(f"{name}={environment[name]}" for name in names)


def with_log_folder(environment: Mapping[str, str]) -> tuple[dict[str, str], list[str]]:
    """The environment with a folder where ROS can write its logs, and a remark about it.

    RosEnvironmentError where the folder that ROS_LOG_DIR names cannot be written.
    """
    named = environment.get("ROS_LOG_DIR")
    home = environment.get("ROS_HOME") or str(Path(environment.get("HOME", "/")) / ".ros")
    folder = Path(named or f"{home}/log").expanduser()
    if _writable(folder):
        return dict(environment), []
    if named:
        raise RosEnvironmentError(
            f"ROS_LOG_DIR={named} is not writable; name a writable folder, or unset it"
        )
    instead = Path(tempfile.gettempdir()) / f"pdeloop-logs-{os.getuid()}"
    try:
        private_folder(instead)
    except (OSError, FileError) as error:
        raise RosEnvironmentError(
            f"{folder} cannot be written; set ROS_LOG_DIR to a folder for the logs ({error})"
        ) from error
    said = f"{folder} cannot be written: logs go to {instead} (ROS_LOG_DIR)"
    return {**environment, "ROS_LOG_DIR": str(instead)}, [said]


def _check_values(environment: Mapping[str, str]) -> None:
    """Values that rcl would refuse in words of its own, or take for something else."""
    domain = environment.get("ROS_DOMAIN_ID", "")
    if domain and not (re.fullmatch("[0-9]+", domain) and int(domain) <= LAST_DOMAIN):
        raise RosEnvironmentError(
            f"ROS_DOMAIN_ID is {domain!r}; expected a whole number from 0 to {LAST_DOMAIN}"
        )
    found = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "")
    if found and found not in RANGES:
        raise RosEnvironmentError(
            f"ROS_AUTOMATIC_DISCOVERY_RANGE is {found!r}; expected one of {', '.join(RANGES)}"
        )
    for name in _SWITCHES:
        if environment.get(name, "") not in ("", "0", "1"):
            raise RosEnvironmentError(f"{name} is {environment[name]!r}; expected 0 or 1")
    if environment.get("ROS_SECURITY_ENABLE", "").lower() == "true":
        if (Path(sys.prefix) / "lib" / "libfastrtps.so").exists():
            raise RosEnvironmentError(
                "ROS_SECURITY_ENABLE=true: the Fast DDS of the wheels is built without security; unset "
                "it, or use an installed ROS 2 (docs/security.md)"
            )
        keystore = environment.get("ROS_SECURITY_KEYSTORE", "")
        if not Path(keystore).is_dir() or not keystore:
            raise RosEnvironmentError(
                f"ROS_SECURITY_KEYSTORE is {keystore!r}; expected the folder of a keystore, "
                "because ROS_SECURITY_ENABLE is true"
            )


def _all_loopback(servers: str) -> bool:
    """True if all addresses of discovery servers, as of ROS_DISCOVERY_SERVER, are on this machine."""
    for server in filter(None, servers.split(";")):
        host = server.rpartition(":")[0] or server
        try:
            if not ipaddress.ip_address(host.strip("[]")).is_loopback:
                return False
        except ValueError:
            if host != "localhost":
                return False
    return True


def _installed(middleware: str, environment: Mapping[str, str]) -> bool:
    """True if a middleware can be loaded. The wheels are linked to theirs, and load no other."""
    own = Path(sys.prefix) / "lib"
    if (own / f"lib{MIDDLEWARE}.so").exists() and not (own / "librmw_implementation.so").exists():
        return False
    prefixes = environment.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    folders = [*(f"{prefix}/lib" for prefix in prefixes if prefix)]
    folders += environment.get("LD_LIBRARY_PATH", "").split(os.pathsep)
    return any((Path(f) / f"lib{middleware}.so").exists() for f in folders if f)


def _writable(folder: Path) -> bool:
    """True if files can be made in a folder, which is created as ROS would."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK | os.X_OK)
