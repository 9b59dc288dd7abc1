"""The record of a pause, so that it outlives the plant's process. Pure: a file, no ROS.

A plant that is killed while it is paused must not run on when it is started again. The file names the
run that it was paused in; in any other run it means nothing.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from loop_interfaces.files import open_ordinary, private_folder, write_atomically

FOLDER = Path(tempfile.gettempdir()) / f"pdeloop-paused-{os.getuid()}"


class PauseRecord:
    """The run in which the plant `name` of the ROS domain `domain` is paused.

    Parameters
    ----------
    name : str
        Full name of its node.
    domain : int
    folder : Path
        Made when it is needed, for this user alone.
    """

    def __init__(self, name: str, domain: int, folder: Path = FOLDER) -> None:
        self._path = folder / f"{domain}{name.replace('/', '+')}"
        self.run = self._read()

    def keep(self, run: int) -> None:
        """Remember that it is paused in `run`; 0: in none.

        Raises
        ------
        FileError
            The folder belongs to another user.
        OSError
            The record cannot be written.
        """
        if run == self.run:
            return
        private_folder(self._path.parent)
        write_atomically(self._path, str(run).encode())
        self.run = run

    def _read(self) -> int:
        try:
            private_folder(self._path.parent)
            with open_ordinary(self._path) as file:
                return int(file.read(20))
        except (OSError, ValueError):  # a FileError is one
            return 0
