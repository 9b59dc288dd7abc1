# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What a plant must still know of a run when its process is started again. Pure: a file, no ROS.

A plant that is killed while it is paused must not run on, and one whose controller signs must not take
actions that are not signed. The file names the runs; in any other run it means nothing.
"""

import os
import tempfile
from pathlib import Path

from loop_interfaces.files import open_ordinary, private_folder, write_atomically

FOLDER = Path(tempfile.gettempdir()) / f"pdeloop-plants-{os.getuid()}"


class RunRecord:
    """The runs in which a plant is paused, and has a controller that signs; 0 for none.

    name: full name of the plant's node; folder: made when it is needed, for this user alone.
    """

    def __init__(self, name: str, domain: int, folder: Path = FOLDER) -> None:
        self._path = folder / f"{domain}{name.replace('/', '+')}"
        self.paused, self.signed = self._read()

    def keep(self, paused: int, signed: int) -> None:
        """Remember both, or raise OSError, or FileError where the folder is not this user's."""
        if (paused, signed) == (self.paused, self.signed):
            return
        private_folder(self._path.parent)
        write_atomically(self._path, f"{paused} {signed}".encode())
        self.paused, self.signed = paused, signed

    def _read(self) -> tuple[int, int]:
        try:
            private_folder(self._path.parent)
            with open_ordinary(self._path) as file:
                paused, signed = file.read(40).split()
                return int(paused), int(signed)
        except (OSError, ValueError):  # a FileError is one
            return 0, 0
