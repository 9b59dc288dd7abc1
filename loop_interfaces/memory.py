"""Memory that a node has needed only to start. No ROS import."""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path

_MADV_DONTNEED = 4


def release_compiler() -> None:
    """Give back the resident code of LLVM, which loads compiled functions and then does nothing.

    53 MB of a node. They are pages of a file that is mapped and never written, so whatever is used
    again comes back by itself, from the file.
    """
    if "llvmlite" not in sys.modules or sys.platform != "linux":
        return
    libc = ctypes.CDLL(None)
    libc.madvise.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)
    for line in Path("/proc/self/maps").read_text().splitlines():
        addresses, access, *_, path = line.split()
        # Data that were relocated are not in the file: code only.
        if access == "r-xp" and Path(path).name.startswith("libllvmlite"):
            begin, end = (int(address, 16) for address in addresses.split("-"))
            libc.madvise(begin, end - begin, _MADV_DONTNEED)
