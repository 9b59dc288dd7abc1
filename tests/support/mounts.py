# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Mounts that only this process and its children see, and that end with them, however they end."""

from __future__ import annotations

import ctypes
import os
import subprocess

_CLONE_NEWNS = 0x00020000


def own_mounts() -> None:
    """Let this process mount for itself alone. OSError where it may not."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(_CLONE_NEWNS):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    run("mount", "--make-rprivate", "/")


def run(*command: str) -> None:
    """OSError if the command fails, or is not there."""
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    if ended.returncode:
        raise OSError(ended.stderr.strip() or f"{command[0]} failed")


def mountable(*commands: str) -> bool:
    """True if a process can have mounts of its own here, and these commands are there."""
    try:
        run("unshare", "--mount", "mount", "--make-rprivate", "/")
        for command in commands:
            run("sh", "-c", f"command -v {command}")
    except OSError:
        return False
    return True
