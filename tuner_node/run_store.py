# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Keeps a training's folder up to date: progress lines, checkpoints, results."""

import secrets
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.array_files import checked_array
from pdeloop.messages.files import FileError
from pdeloop.messages.frames import MAX_ID
from tuner_node import checkpoint, training_state
from tuner_node.results import acting
from tuner_node.run_folder import RunFolder, RunIdentity
from tuner_node.training import Training

CHECKPOINT_PERIOD = 1.0
"""Minimum seconds between checkpoints. Work that a crash loses is computed again, identically."""
CHECKPOINT_SHARE = 0.2
"""Share of the time that writing them may take: with many trajectories one has 100 MB and more."""


class RunWriter:
    """Writes the progress of `training` into the folder `path`, continuing what is there.

    A file that cannot be written (full disk) is reported through `warn` and tried again; the
    training continues and the previous checkpoint stays.
    """

    def __init__(
        self,
        path: Path,
        parameters: Mapping[str, Any],
        training: Training,
        *,
        warn: Callable[[str], None],
    ) -> None:
        self._folder = RunFolder(path)
        self._training = training
        self._warn = warn
        self._save_at = float("-inf")
        self._began = time.monotonic()
        self._changed = False
        self.identity = self._folder.reopen(parameters)
        self._restore()

    def note(self, row: Mapping[str, Any]) -> None:
        """One line of progress, stamped with the time."""
        self._changed = True
        try:
            self._folder.note({"time": time.time(), **row})
        except OSError as error:
            self._warn(f"cannot write progress to {self._folder.path}: {error.strerror}")

    def keep(self, *, now: float, force: bool = False) -> None:
        """Write a checkpoint if something changed and the last one is old enough."""
        if not self._changed or (not force and now < self._save_at):
            return
        began = time.monotonic()
        try:
            arrays = training_state.arrays_of(self._training) | {"run": np.array(self.identity.run)}
            checkpoint.save(self._folder.checkpoint, arrays)
            self._changed = False
        except OSError as error:
            self._warn(
                f"cannot write the checkpoint to {self._folder.path}: {error.strerror}; the "
                "training continues and the previous checkpoint is kept"
            )
        took = time.monotonic() - began
        self._save_at = now + max(CHECKPOINT_PERIOD, took / CHECKPOINT_SHARE)

    def give_up(self, reason: str) -> None:
        """Prevent the training, which used contradicted results, from being continued."""
        if error := self._recorded(contradiction=reason):
            self._warn(
                f"do not continue the run in {self._folder.path}: it used contradicted results, "
                f"which could not be recorded ({error})"
            )

    def fail(self, reason: str) -> None:
        """Remember why the training failed, and would fail again."""
        if error := self._recorded(failure=reason):
            self._warn(f"cannot record that the training failed: {error}")

    def hold(self, paused: bool) -> None:
        """Remember whether an operator has paused the training, for its tuner's next process."""
        if error := self._recorded(paused=paused):
            self._warn(f"cannot record the pause, which is lost when this process ends: {error}")

    def _recorded(self, **entries: Any) -> Exception | None:
        """Keep entries of run.json; the error where that fails."""
        try:
            self._folder.change(**entries)
        except (OSError, FileError) as error:
            return error
        return None

    def finish(self, extra: Mapping[str, Any]) -> dict[str, Any]:
        """Write the results of the finished training. Raises OSError if they cannot be written."""
        self.keep(now=time.monotonic(), force=True)
        seconds = time.monotonic() - self._began
        laws = acting(self._training)
        extra = {"seconds": seconds, **({"acting": laws} if laws else {}), **extra}
        return self._folder.finish(self._training, extra)

    def _restore(self) -> None:
        """Go on from the newest usable checkpoint, or begin again: both lead to the same result."""

        def take(arrays: dict[str, NDArray[Any]]) -> None:
            if int(checked_array(arrays, "run", "i", ())) != self.identity.run:
                raise ValueError("belongs to another run")
            training_state.restore(self._training, arrays)

        found, passed_over = checkpoint.restore(self._folder.checkpoint, take)
        instead = "using an older checkpoint" if found else "beginning again from the start"
        for sentence in passed_over:
            self._warn(f"{sentence}; {instead}")


def open_run(
    values: Mapping[str, Any], training: Training, locks: ExitStack, warn: Callable[[str], None]
) -> tuple[RunWriter | None, RunIdentity]:
    """Begin the run in the folder `out` of the tuner's parameters, or continue it (`resume`).

    locks: the folder is locked until it is closed, before anything in it is looked at or written, as
    another process may also begin a run in it. Without a folder nothing is written.
    """
    if not values["out"]:
        return None, RunIdentity(1 + secrets.randbelow(MAX_ID - 1), 0)
    folder = RunFolder(Path(values["out"]))
    if values["resume"]:
        folder.parameters()  # no lock is left where no run is
        locks.enter_context(folder.locked())
    else:
        locks.enter_context(folder.made_and_locked())
        folder.begin(values)
    writer = RunWriter(folder.path, values, training, warn=warn)
    return writer, writer.identity
