"""Where a run's messages may go: by default nowhere but the loopback interface."""

from __future__ import annotations

import os

from loop_interfaces.problem import config_folder

PROFILE = "FASTRTPS_DEFAULT_PROFILES_FILE"
NETWORK = "PDELOOP_NETWORK"


def loopback_environment() -> dict[str, str]:
    """Environment variables that keep a node's traffic on this machine.

    Empty when the user brings a Fast DDS profile of their own or sets PDELOOP_NETWORK=1.
    """
    if os.environ.get(PROFILE) or os.environ.get(NETWORK) == "1":
        return {}
    return {PROFILE: str(config_folder() / "fastdds_loopback.xml")}


def keep_on_this_machine() -> None:
    """Apply `loopback_environment` to this process; call before ROS is initialised."""
    os.environ.update(loopback_environment())
