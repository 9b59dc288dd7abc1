# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The memory of a plant across restarts of its process. Pure: a file, no ROS.

A plant that was paused must not run on, whatever run it is to serve, and one whose controller signs
must not take actions of that run that are not signed.
"""

import contextlib
import os
import tempfile
from pathlib import Path

from pdeloop.messages.files import is_private, open_ordinary, private_folder, write_atomically

FOLDER = Path(tempfile.gettempdir()) / f"pdeloop-plants-{os.getuid()}"


class RunRecord:
    """The state of a plant: paused or not, and the last run whose controller signs; 0 for none.

    name: full name of the plant's node; folder: made when it is needed, for this user alone.
    """

    def __init__(self, name: str, domain: int, folder: Path = FOLDER) -> None:
        self._path = folder / f"{domain}{name.replace('/', '+')}"
        self.paused, self.signed = self._read()

    def keep(self, paused: bool, signed: int) -> None:
        """Remember both, or raise OSError, or FileError where the folder is not this user's."""
        if (paused, signed) == (self.paused, self.signed):
            return
        private_folder(self._path.parent)
        write_atomically(self._path, f"{paused:d} {signed}".encode())
        self.paused, self.signed = paused, signed

    def _read(self) -> tuple[bool, int]:
        try:
            private_folder(self._path.parent)
            with open_ordinary(self._path) as file:
                paused, signed = file.read(40).split()
                return bool(int(paused)), int(signed)
        except (OSError, ValueError):  # a FileError is one
            return False, 0


def forget(domain: int, folder: Path = FOLDER) -> None:
    """Remove the records of a domain in which no plant is.

    Nothing where the folder is not this user's own: a link may lead to other files of these names.
    """
    with contextlib.suppress(OSError):
        records = list(folder.glob(f"{domain}+*")) if is_private(folder) else []
        for path in records:
            with contextlib.suppress(IsADirectoryError, PermissionError):  # no record of ours
                path.unlink(missing_ok=True)
