# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Files that are complete or absent, whenever a crash happens.

No symbolic link is followed.
"""

import errno
import fcntl
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import Any, BinaryIO

from pdeloop.messages.documents import parse_json

MAX_JSON_BYTES = 2**27
"""Most bytes of a JSON file; a training's history takes about 200 bytes per rollout."""


class FileError(ValueError):
    """A file that is not what it should be; the text says which, what was expected and what it is."""


def write_atomically(path: Path, *content: bytes | memoryview) -> None:
    """Replace `path` by `content`, so that a crash at any moment leaves the old or the new file.

    The content is on the disk before the name points to it, and the name before this returns. After
    an OSError, of a full disk or no permission, the old or the new file is there.
    """
    part = write_part(path, *content)
    try:
        part.replace(path)
    except OSError:  # a folder is there
        part.unlink()
        raise
    sync_folder(path.parent)


@contextmanager
def writing_to(place: object, refusal: type[Exception]) -> Iterator[None]:
    """An OSError in the block, of a full disk or no permission, becomes a refusal in one sentence."""
    try:
        yield
    except OSError as error:
        raise refusal(f"cannot write {place}: {error.strerror}") from error


def write_part(path: Path, *content: bytes | memoryview) -> Path:
    """Write `content` to the disk as `path`.part, and return that, to be renamed to `path`.

    What an earlier crash has left there is removed, and a link there is not followed.
    """
    part = path.with_name(path.name + ".part")
    part.unlink(missing_ok=True)
    try:
        with open_new(part) as file:
            for piece in content:
                file.write(piece)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        part.unlink(missing_ok=True)
        error.filename = error.filename or str(path)  # a write that fails does not know it
        raise
    return part


def open_new(path: Path) -> BinaryIO:
    """Make the file `path` and open it for writing. FileExistsError if anything is there, or a link."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
    return os.fdopen(os.open(path, flags, 0o666), "wb")


def sync_folder(folder: Path) -> None:
    """Have the names in `folder` written to the disk."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def make_folder(path: Path) -> None:
    """Make the folder `path`, and those above it that are missing, and have them on the disk."""
    missing = [folder for folder in (path, *path.parents) if not folder.exists()]
    path.mkdir(parents=True, exist_ok=True)
    for folder in missing:
        sync_folder(folder.parent)


def make_own_folder(path: Path) -> None:
    """Make the folder `path` if it is not there. OSError if it is a link, which may lead anywhere."""
    path.mkdir(exist_ok=True)
    if path.is_symlink():
        raise OSError(errno.ELOOP, "it is a symbolic link", str(path))


def private_folder(path: Path) -> None:
    """Make `path` a folder that only this user can look into and write to.

    FileError where something else is there: a link, a file, or a folder of another user.
    """
    try:
        path.mkdir(mode=0o700)
    except FileExistsError:
        if not is_private(path):
            raise FileError(
                f"{path} is not a folder of this user; expected one, because its files are trusted: "
                "remove it, or set TMPDIR to a folder of your own"
            ) from None
        path.chmod(0o700)


def is_private(path: Path) -> bool:
    """True if `path` is a folder of this user, and not a link. OSError if nothing is there."""
    found = path.lstat()
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid()


def open_own(path: Path, flags: int) -> BinaryIO:
    """Open or make a file for reading and writing. OSError if it is a link, or no ordinary file.

    flags: further ones of os.open, for instance os.O_APPEND.
    """
    flags |= os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        descriptor = os.open(path, flags, 0o666)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise OSError(errno.ELOOP, "it is a symbolic link", str(path)) from error
        raise
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "it is not a regular file", str(path))
    return os.fdopen(descriptor, "ab+" if flags & os.O_APPEND else "rb+")


def try_lock(file: BinaryIO | BufferedReader, *, shared: bool = False) -> bool:
    """Take the lock of an open file, for as long as it is open; False if another process has it.

    FileError if its file system has no locks: the file must then not count as free.
    """
    try:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        raise FileError(
            f"cannot be locked ({error.strerror}), so nothing would keep two processes "
            "from writing at the same time; expected a file system with locks, such as a local disk"
        ) from error
    return True


def open_ordinary(path: Path) -> BufferedReader:
    """Open a file for reading. OSError if it is not an ordinary one: a pipe would wait for ever."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "it is not a regular file", str(path))
    return os.fdopen(descriptor, "rb")


def read_bounded(path: Path, most: int, instead: str = "") -> bytes:
    """The content of a file. FileError if it cannot be read, or has more than `most` bytes.

    instead: what to do then, for the error.
    """
    try:
        with open_ordinary(path) as file:
            content = bytearray()
            # In pieces: Python makes room for all that it is asked to read, however little there is.
            while (piece := file.read(2**20)) and len(content) <= most:
                content += piece
    except OSError as error:
        raise FileError(f"{path} cannot be read: {error.strerror or error}") from error
    if len(content) > most:
        raise FileError(f"{path} is larger than {most} bytes" + (instead and f"; {instead}"))
    return bytes(content)


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file. FileError if there is none."""
    try:
        content = parse_json(read_bounded(path, MAX_JSON_BYTES))
    except FileError:
        raise
    except ValueError as error:
        raise FileError(f"{path} is not JSON: {error}") from error
    if not isinstance(content, dict):
        raise FileError(f"{path} does not hold a JSON object")
    return content
