# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A real file system that loses what was not synced: ext4 in a file, shut down as xfstests does it."""

from __future__ import annotations

import fcntl
import os
import struct
from pathlib import Path

from tests.support.mounts import own_mounts, run

_SHUTDOWN = 0x8004587D
"""EXT4_IOC_SHUTDOWN."""
_NO_LOG_FLUSH = struct.pack("I", 2)
"""Nothing that is only in memory reaches the disk any more, not even the journal's last entries."""


class LossyDisk:
    """An ext4 file system of 16 MB at `folder`, which only this process and its children see.

    OSError where that cannot be had. What is mounted is gone with the process.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self._image = folder, folder.with_name(folder.name + ".img")
        own_mounts()
        folder.mkdir()
        with self._image.open("wb") as file:
            file.truncate(16 * 2**20)
        run("mkfs.ext4", "-q", "-F", str(self._image))
        self._mount()

    def cut_power(self) -> None:
        """From now on nothing is written, and every call on it fails. `restart` brings it back."""
        descriptor = os.open(self.folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.ioctl(descriptor, _SHUTDOWN, _NO_LOG_FLUSH)
        finally:
            os.close(descriptor)

    def restart(self) -> None:
        """Mount it again, which replays its journal."""
        run("umount", str(self.folder))
        self._mount()

    def close(self) -> None:
        """Unmount it."""
        run("umount", str(self.folder))

    def _mount(self) -> None:
        run("mount", "-o", "loop", str(self._image), str(self.folder))
