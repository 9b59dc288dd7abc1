# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The tuner's disk: what is left of its checkpoints after a crash at any call, or a power cut.

Checkpoints are written and read by `tuner_node.checkpoint` itself, in a folder in memory. Only what
decides about the state after a crash is done, and only then: the last checkpoints are written again,
the calls that change the disk are watched, and one of them is the last.
"""

from __future__ import annotations

import os
import random
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from tuner_node import checkpoint

KEPT = 3
"""Checkpoints that can matter: there are two files, and one that is being written."""
Arrays = dict[str, np.ndarray]
Files = dict[str, bytes]


class _Killed(BaseException):
    """The process ends here."""


@cache
def _folder() -> tuple[Path, tempfile.TemporaryDirectory[str]]:
    memory = Path("/dev/shm")
    made = tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None)
    return Path(made.name), made


class Disk:
    """Takes checkpoints, and gives back what is found after the tuner has died."""

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self._saved: list[Arrays] = []
        self._number = self._found = 0

    def save(self, arrays: Arrays) -> None:
        """Take a checkpoint; its arrays may change later."""
        self._number += 1
        copied = {name: array.copy() for name, array in arrays.items()}
        self._saved = [*self._saved[1 - KEPT :], copied | {"number": np.array(self._number)}]

    def restart(self, take: Callable[[Arrays], None], *, power: bool, rot: bool) -> None:
        """Hand the newest usable checkpoint to `take`, if there is one.

        power: what was not synced is lost, or a part of it; rot: a bit has changed.

        Raises
        ------
        AssertionError
            A checkpoint is lost that had been written.
        """
        if not self._saved:
            return
        # Within the last save, unless it was found before: then it is on the disk.
        during = self._rng.random() < 0.5 and self._number > self._found
        left = self._left(during, power)
        if rot and left:
            name = self._rng.choice(sorted(left))
            raw = bytearray(left[name])
            if raw:
                raw[self._rng.randrange(len(raw))] ^= 1 << self._rng.randrange(8)
            left[name] = bytes(raw)
        folder, _ = _folder()
        _fill(folder, left)
        found: list[Arrays] = []
        checkpoint.restore(folder / "checkpoint", found.append)
        number = int(found[0].pop("number")) if found else 0
        written = self._number - during
        if (
            rot
        ):  # the one before is there, unless only one had its name, or was left by damage before
            written = 0 if during or len(self._saved) < 2 else written - 1
        assert number >= written, f"checkpoint {written} was written, {number} was found"
        self._saved = [state for state in self._saved if state["number"] <= number]
        self._number = self._found = number
        if found:
            take(found[0])

    def _left(self, during: bool, power: bool) -> Files:
        """The files after a crash, within the last save or after it."""
        folder, _ = _folder()
        _fill(folder, {})
        path = folder / "checkpoint"
        for arrays in self._saved[:-1]:
            checkpoint.save(path, arrays)
        watched = _Watched(folder, self._rng.randrange(1, 7) if during else 0)
        with watched:
            checkpoint.save(path, self._saved[-1])
        return watched.after_a_power_cut(self._rng) if power else _files(folder)


class _Watched:
    """Watches the calls that change a folder; the process is killed at the n-th of them."""

    def __init__(self, folder: Path, kill_at: int) -> None:
        self._folder, self._kill_at, self._calls = folder, kill_at, 0
        self._synced: dict[int, bytes] = {}
        """Content of files that is on the disk, by inode."""
        self._names = [_names(folder)]
        """What the folder was when it was synced last, and after each change since."""
        for name, inode in self._names[0].items():
            self._synced[inode] = (folder / name).read_bytes()
        self._contents = dict(self._synced)

    def __enter__(self) -> None:
        self._patches = [
            mock.patch.object(os, name, self._watching(getattr(os, name)))
            for name in ("fsync", "replace", "unlink", "open")
        ]
        for patch in self._patches:
            patch.start()

    def __exit__(self, kind: type[BaseException] | None, *_: Any) -> bool:
        for patch in self._patches:
            patch.stop()
        self._look()
        return kind is _Killed

    def after_a_power_cut(self, rng: random.Random) -> Files:
        """What is found: changes of names up to one of them, contents as far as they were synced."""
        names = rng.choice(self._names)
        return {name: self._content(inode, rng) for name, inode in names.items()}

    def _content(self, inode: int, rng: random.Random) -> bytes:
        if inode in self._synced:
            return self._synced[inode]
        whole = self._contents[inode]
        return whole[: rng.randrange(len(whole) + 1)]

    def _watching(self, call: Callable[..., Any]) -> Callable[..., Any]:
        def watched(subject: Any, *rest: Any, **more: Any) -> Any:
            self._calls += 1
            if self._calls == self._kill_at:
                raise _Killed
            result = call(subject, *rest, **more)
            self._look()
            if call.__name__ == "fsync":
                inode = os.fstat(subject).st_ino
                if inode in self._contents:
                    self._synced[inode] = self._contents[inode]
                else:  # the folder
                    self._names = self._names[-1:]
            return result

        return watched

    def _look(self) -> None:
        names = _names(self._folder)
        for name, inode in names.items():
            if inode not in self._synced:
                self._contents[inode] = (self._folder / name).read_bytes()
        if names != self._names[-1]:
            self._names.append(names)


def _names(folder: Path) -> dict[str, int]:
    return {entry.name: entry.inode() for entry in os.scandir(folder)}


def _files(folder: Path) -> Files:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def _fill(folder: Path, files: Files) -> None:
    for path in folder.iterdir():
        path.unlink()
    for name, content in files.items():
        (folder / name).write_bytes(content)
