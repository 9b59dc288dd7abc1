# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A training's folder and what is in it.

parameters.yaml    the resolved parameters, in ROS form: what defines the training
run.json           the run's id on the network, how often its tuner was started, whether an
                   operator has paused it, the plant's fingerprint if it was given (0: not),
                   what defines the training, and why it cannot be continued, or would fail again
                   if it were, if so
progress.jsonl     events, one JSON object per line, in order
checkpoint         the training's state (tuner_node.checkpoint), and the one before
policy.npz         policy (S, n_a, 2 n_s), lqt (the same), model rows (S, rows, n_s), seeds (S,);
                   of another law than the affine one `law`, its name, and policies (S, size)
result.json        costs, reductions, history, seeds, versions, timing, the plant's fingerprint
logs/              one file per node, if the command line started them
"""

import contextlib
import errno
import json
import os
import secrets
import shlex
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages import model_rows
from pdeloop.messages.array_files import checked_array, packed_arrays, read_arrays
from pdeloop.messages.files import (
    FileError,
    make_folder,
    open_own,
    read_json,
    try_lock,
    write_atomically,
    writing_to,
)
from pdeloop.messages.frames import MAX_ID
from pdeloop.messages.parameter_file import yaml_text
from pdeloop.messages.parameters import (
    EXECUTION,
    PLANT,
    RECORDER,
    VIEWER,
    as_recorded,
    measured_size,
    recorded_values,
    table,
)
from pdeloop.messages.problem import read_problem
from pdeloop.messages.spec import ParameterError
from pdeloop.messages.text import shown
from pdeloop.method.laws.registry import OWN_LAWS
from tuner_node.results import check_result, policy_arrays, summarise, versions
from tuner_node.training import Training

TRANSIENT = (
    "out",
    "resume",
    "pairs",
    "max_batch",
    "episode_timeout",
    "max_attempts",
    "recorder",
    "plant_fingerprint",
    *(spec.name for spec in (*PLANT, *EXECUTION, *RECORDER, *VIEWER)),
)
"""Parameters that change how a training is carried out, not what comes out of it."""

SHOWN = 20
"""Parameters that differ and are named; the others are only counted."""


class RunFolderError(ValueError):
    """The folder cannot be used as asked; the text says why and what to do."""


def resuming(folder: Path) -> str:
    """The command that continues the training in `folder`, to be typed."""
    return f"pdeloop train --resume {shlex.quote(str(folder))}"


@dataclass(frozen=True)
class RunIdentity:
    """run: the id in every frame of this training; incarnation: starts of its tuner so far.

    paused: whether an operator had paused it when its tuner ended.
    """

    run: int
    incarnation: int
    paused: bool = False


class RunFolder:
    """The files of one training. Writing errors are OSErrors; nothing is left half-written."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.checkpoint = path / "checkpoint"

    def refuse_another(self, *, briefly: bool = False) -> None:
        """RunFolderError where no new training can begin: the folder holds one, or is none.

        briefly: without reading what became of the one that is there.
        """
        if (self.path / "parameters.yaml").exists():
            begun = f"{self.path} already holds a run; choose another folder, delete this one, or "
            if (self.path / "result.json").exists():  # there is nothing to continue
                report = f"pdeloop report {shlex.quote(str(self.path))}"
                raise RunFolderError(f"{begun}see its results: {report}")
            if ended := "" if briefly else self._ended_early():
                raise RunFolderError(
                    f"{self.path} holds a run without results: {ended}; choose another folder, or "
                    "delete this one"
                )
            raise RunFolderError(
                f"{begun}continue it with: {resuming(self.path)} "
                "(a tuner_node with -p resume:=true)"
            )
        there = next(path for path in (self.path, *self.path.absolute().parents) if path.exists())
        if not there.is_dir():
            raise RunFolderError(f"cannot write to {self.path}: {there} is not a folder")
        if not os.access(there, os.W_OK | os.X_OK):
            read_only = os.statvfs(there).f_flag & os.ST_RDONLY
            why = os.strerror(errno.EROFS if read_only else errno.EACCES)
            raise RunFolderError(f"cannot write to {self.path}: {why}")

    def create(self, parameters: Mapping[str, Any]) -> None:
        """Begin a new training here. RunFolderError if the folder holds one or cannot be written."""
        with self.made_and_locked():
            self.begin(parameters)

    @contextlib.contextmanager
    def made_and_locked(self) -> Iterator[None]:
        """Make the folder, if it can hold a new training, and keep other processes from it."""
        self.refuse_another()
        with writing_to(f"to {self.path}", RunFolderError):
            make_folder(self.path)
        with self.locked():
            yield

    def begin(self, parameters: Mapping[str, Any]) -> None:
        """Begin a new training in the folder that the caller has locked: `create`.

        RunFolderError if the folder holds one by now, or cannot be written.
        """
        self.refuse_another(briefly=True)  # who has just begun one here waits for the lock
        with writing_to(f"to {self.path}", RunFolderError):
            kept = {k: v for k, v in parameters.items() if k not in ("out", "resume")}
            # parameters.yaml comes last and whole: where it is, there is a run.
            self._identify(RunIdentity(1 + secrets.randbelow(MAX_ID - 1), 0), parameters)
            text = yaml_text(kept, "resolved parameters of this run")
            write_atomically(self.path / "parameters.yaml", text.encode())

    def reopen(self, parameters: Mapping[str, Any]) -> RunIdentity:
        """Continue the training here. RunFolderError if there is none, or with other parameters."""
        self.unfinished()
        try:
            known = read_json(self.path / "run.json")
            if "contradiction" in known:
                raise RunFolderError(f"the run in {self.path}: {_contradicted(known)}")
            self._check_same(known["parameters"], parameters)
            paused = bool(known.get("paused", False))
            identity = RunIdentity(int(known["run"]), int(known["incarnation"]) + 1, paused)
            if not (0 < identity.run < MAX_ID and 0 < identity.incarnation < 2**21):
                raise ValueError("ids out of range")
            plant = {"plant_fingerprint": parameters.get("plant_fingerprint", 0)}
            return self._identify(identity, known["parameters"] | plant)
        except RunFolderError:
            raise
        except OSError as error:
            raise RunFolderError(f"cannot write to {self.path}: {error.strerror}") from error
        except (LookupError, TypeError, ValueError, ArithmeticError, AttributeError) as error:
            raise RunFolderError(f"{self.path}/run.json cannot be used: {error}") from error

    def without_results(self) -> str:
        """Why the training here has no results, and what to do, in words."""
        if ended := self._ended_early():
            known = shlex.quote(str(self.path / "parameters.yaml"))
            return (
                f"{ended}; a new run with other parameters: pdeloop train {known} --set NAME=VALUE"
            )
        return f"the run is not finished; continue it with: {resuming(self.path)}"

    def _ended_early(self) -> str:
        """Why it is no use to continue the training here, in words; empty: it may be."""
        try:
            known = read_json(self.path / "run.json")
        except FileError:  # `reopen` says so
            return ""
        if "contradiction" in known:
            return _contradicted(known)
        if "failure" in known:
            return f"the training failed, and would fail again ({known['failure']})"
        return ""

    def change(self, **entries: Any) -> None:
        """Change entries of run.json: `contradiction`, `failure`, `paused`. OSError or FileError."""
        path = self.path / "run.json"
        write_atomically(path, json.dumps(read_json(path) | entries).encode())

    def parameters(self) -> dict[str, Any]:
        """The resolved parameters of the training here."""
        path = self.path / "parameters.yaml"
        if not path.is_file():
            raise RunFolderError(f"no run in {self.path}: there is no parameters.yaml")
        try:
            return read_problem(path)
        except ParameterError as error:
            raise RunFolderError(str(error)) from error

    def unfinished(self) -> dict[str, Any]:
        """The parameters of a training to continue. RunFolderError if this version cannot."""
        known = self.parameters()
        if "rollouts" not in known:
            raise RunFolderError(
                f"the run in {self.path} is from an older version, which did not count its "
                "rollouts, so it cannot be continued; start a new run"
            )
        return known

    def values(self) -> dict[str, Any]:
        """The parameters of the training here, with current defaults where its file has none."""
        try:
            return recorded_values(self.parameters())
        except ParameterError as error:
            raise RunFolderError(f"{self.path}/parameters.yaml cannot be used: {error}") from error

    def _check_same(self, known: Mapping[str, Any], now: Mapping[str, Any]) -> None:
        """RunFolderError showing every difference that would change the results."""
        if changes := parameter_changes(known, now):
            raise RunFolderError(
                f"the run in {self.path} has other parameters ({changes}); "
                "continue it with its own, or start a new run in another folder"
            )

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from working on the run. RunFolderError if one does."""
        with writing_to(f"to {self.path}", RunFolderError):
            file = open_own(self.path / "lock", 0)
        with file:
            try:
                free = try_lock(file)
            except FileError as error:
                raise RunFolderError(
                    f"{self.path / 'lock'} {error}: choose another folder for the run"
                ) from error
            if not free:
                raise RunFolderError(
                    f"another process is working on the run in {self.path}; wait for it to end, or "
                    "stop it"
                )
            yield

    def note(self, row: Mapping[str, Any]) -> None:
        """Append one line to progress.jsonl."""
        with open_own(self.path / "progress.jsonl", os.O_APPEND) as file:
            end = file.seek(0, os.SEEK_END)
            file.seek(max(0, end - 1))
            torn = end > 0 and file.read(1) != b"\n"  # by a disk that was full
            file.write(b"\n" * torn + json.dumps(row).encode() + b"\n")

    def finish(self, training: Training, extra: Mapping[str, Any]) -> dict[str, Any]:
        """Write policy.npz and result.json; returns the latter's content."""
        known = {"plant": training.plant, "versions": versions()}
        summary = summarise(training) | dict(extra) | known
        write_atomically(self.path / "policy.npz", packed_arrays(policy_arrays(training)))
        text = json.dumps(summary, indent=1)
        write_atomically(self.path / "result.json", text.encode())
        return summary

    def policies(self) -> dict[str, NDArray[Any]]:
        """The arrays of policy.npz: `policy`, `lqt`, `model`.

        RunFolderError where they cannot be read, or are not those of a run with these parameters.
        """
        path = self.path / "policy.npz"
        if not path.exists():
            raise RunFolderError(f"no results in {self.path}: {self.without_results()}")
        values = self.values()
        n_a, seeds = values["n_a"], values["seeds"]
        try:
            arrays = read_arrays(path)
            model = checked_array(arrays, "model", "f", (seeds, None, None))
            law: tuple[int | None, ...] = (seeds, n_a, 2 * model.shape[2])
            if values["law"] != "affine":  # whose parameters only the law itself can read
                law = (seeds, *[None] * (arrays["policy"].ndim - 1)) if "policy" in arrays else law
            for rows in model:
                model_of(rows, values)
            return {
                "policy": checked_array(arrays, "policy", "f", law),
                "lqt": checked_array(arrays, "lqt", "f", law),
                "model": model,
            }
        except ValueError as error:
            raise RunFolderError(
                f"{path} cannot be read ({error}); to write it anew, delete it and result.json, "
                f"and then: {resuming(self.path)}"
            ) from error

    def result(self) -> dict[str, Any]:
        """The content of result.json. RunFolderError unless it is that of this run."""
        path = self.path / "result.json"
        values = self.values()
        try:
            content = read_json(path)
            check_result(content, values["seed"], values["seeds"])
            return content
        except (ValueError, TypeError) as error:
            raise RunFolderError(
                f"{path} cannot be used ({error}); if the run is not finished, delete this file "
                f"and continue with: {resuming(self.path)}"
            ) from error

    def _identify(self, identity: RunIdentity, parameters: Mapping[str, Any]) -> RunIdentity:
        content = {
            "run": identity.run,
            "incarnation": identity.incarnation,
            "paused": identity.paused,
            "plant": parameters.get("plant_fingerprint", 0),
            "parameters": {k: v for k, v in parameters.items() if k not in TRANSIENT},
        }
        write_atomically(self.path / "run.json", json.dumps(content).encode())
        return identity


def _contradicted(known: Mapping[str, Any]) -> str:
    """What run.json says of a training that used results which were contradicted later."""
    return (
        "it cannot be continued, because it used results that were contradicted later "
        f"({known['contradiction']})"
    )


def parameter_changes(known: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """The parameters of two trainings that differ and change the results, in words; empty if none.

    A parameter that a run of an older version does not know has its default there: a new one's is
    always what was done before.
    """
    defaults = {spec.name: spec.default for spec in table()}
    known = as_recorded(known)
    there = {name: known.get(name, defaults.get(name)) for name in {*known, *now}}
    changes = [
        f"{shown(name)[1:-1]}: {shown(there[name])} there, {shown(now.get(name))} now"
        for name in sorted(set(there) - set(TRANSIENT))
        if there[name] != now.get(name)
    ]
    more = f"; and {len(changes) - SHOWN} more" if len(changes) > SHOWN else ""
    return "; ".join(changes[:SHOWN]) + more


def timestamp() -> str:
    """Local time for folder names."""
    return time.strftime("%Y%m%d-%H%M%S") + f"-{os.getpid()}"


def model_of(rows: NDArray[np.float64], values: Mapping[str, Any]) -> model_rows.ModelRows:
    """The model in rows of a run's policy.npz. ValueError where there is no room for it."""
    n_a, n_z = values["n_a"], measured_size(values)
    rows = model_rows.completed(rows, n_a, n_z)
    filtered = model_rows.has_filter(rows, n_a, n_z)
    # A tuner that was not told the components of the state counts one; then the law shows it.
    law = OWN_LAWS.shipped.get(values["law"])
    if law and not filtered and len(rows) != n_z + rows.shape[1] + 3 * n_a + 1:
        filtered = law.filtered
    return model_rows.unpack(rows, n_a, filtered)
