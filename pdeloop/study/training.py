# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""One training of a study: a function of its parameters alone, wherever it runs."""

from __future__ import annotations

import contextlib
import hashlib
import json
import resource
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Any

import llvmlite.binding
import numpy as np
from numpy.typing import NDArray

from pde_sim_node.definition import source_of
from pdeloop.evaluation import mean_costs
from pdeloop.in_process import LocalPair, train
from pdeloop.messages.array_files import packed_arrays
from pdeloop.messages.files import make_folder, write_atomically
from pdeloop.method.laws.registry import law_kind
from pdeloop.training_run import built_in
from tuner_node.build import build_training
from tuner_node.optimizer_parameters import kind_of
from tuner_node.results import versions
from tuner_node.run_folder import RunFolder, RunFolderError, parameter_changes
from tuner_node.run_store import RunWriter

FILES = ("parameters.yaml", "policy.npz", "result.json")
"""The files of a run folder that a training of a study leaves, in the order of writing."""
CURVE = "curve.npz"
"""The file of `curve`, of a study with curves."""
_ONE_AT_A_TIME = Lock()
"""A worker that runs tasks in threads: a training uses NumPy's and Numba's own threads."""
_folder: str | None = None
_listener: ContextVar[Callable[[Mapping[str, Any]], None]] = ContextVar(
    "listener", default=lambda row: None
)
"""What is told of each batch of a training: its phase, rollouts and memory."""
CHECKPOINT_PERIOD, CHECKPOINT_SHARE = 10.0, 0.05
"""Seconds between two checkpoints of a training, and the share of its time that they may take."""
PLANT_FILE = "plant"
"""The file of an unfinished training that has the fingerprint of its plant, with `code_of`."""


@dataclass(frozen=True)
class Place:
    """Where all processes that see it keep the run folder of a training.

    root: a folder of the study, whose file `study` has the study's id; study: that id, by which a
    worker on another machine knows that it sees the same folder; name: of the training: its folder in
    `root`.
    """

    root: str
    study: str
    name: str

    def run_folder(self) -> Path | None:
        """The run folder of the training; None where this process does not see it."""
        root = Path(self.root)
        try:
            return root / self.name if (root / "study").read_text() == self.study else None
        except (OSError, ValueError):
            return None


@contextlib.contextmanager
def listening(tell: Callable[[Mapping[str, Any]], None]) -> Iterator[None]:
    """Have `tell` called after each batch of the trainings of this thread."""
    before = _listener.set(tell)
    try:
        yield
    finally:
        _listener.reset(before)


def listener() -> Callable[[Mapping[str, Any]], None]:
    """What is told of each batch of the trainings of this thread."""
    return _listener.get()


def work_in(folder: str) -> None:
    """Let the trainings of this process keep their files in `folder`, not in the temporary one."""
    global _folder
    _folder = folder


def environment() -> dict[str, str]:
    """The environment that the last bits of a result depend on: versions and the processor's type."""
    known = versions()
    known.pop("ros-jazzy-rclpy", None)
    return {**known, "processor": str(llvmlite.binding.get_host_cpu_name())}


def differences(there: Mapping[str, str], expected: Mapping[str, str]) -> str:
    """Differences of another environment from the expected one, in words; empty if there are none."""
    return ", ".join(
        f"{name} {there.get(name, 'missing')} instead of {expected.get(name, 'none')}"
        for name in sorted({*there, *expected})
        if there.get(name) != expected.get(name)
    )


def train_one(
    parameters: Mapping[str, Any], place: Place | None = None, curves: bool = False
) -> dict[str, bytes]:
    """Train in this process: a function of the resolved parameters alone.

    place: where this process and later ones keep the run folder, so that one continues what another
    has begun; curves: with the cost of every policy that the training has, for which it begins again.
    Returns the content of each of `FILES`, before them that of `CURVE`; `environment` is an entry of
    result.json. ValueError or RuntimeError for a training that cannot be carried out.
    """
    with _ONE_AT_A_TIME, ExitStack() as stack:
        pair = LocalPair(parameters)
        plant = pair.fingerprint ^ code_of(parameters)
        folder = _opened(stack, place, parameters, plant, anew=curves)
        names = (CURVE, *FILES) if curves else FILES
        if not (folder.path / FILES[-1]).exists():
            _train(folder, parameters, pair, curves)
        return {name: (folder.path / name).read_bytes() for name in names}


def _train(folder: RunFolder, parameters: Mapping[str, Any], pair: LocalPair, curves: bool) -> None:
    training = build_training(parameters)
    writer = RunWriter(folder.path, parameters, training, warn=lambda text: None)
    policies: list[NDArray[np.float64]] = []
    rollouts: list[float] = []
    tell, keep_at = listener(), time.monotonic() + CHECKPOINT_PERIOD

    def note() -> None:
        nonlocal keep_at
        if training.optimizers and training.phase != "done":
            policies.append(training.policies()[0])
            rollouts.append(float(training.budget.paid[0]))
        row = {
            "phase": training.phase,
            "rollouts": float(training.budget.paid[0]),
            "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        }
        writer.note(row)
        tell(row)
        if (now := time.monotonic()) > keep_at:
            writer.keep(now=now, force=True)
            took = time.monotonic() - now
            keep_at = now + max(CHECKPOINT_PERIOD, took / CHECKPOINT_SHARE)

    train(training, pair, lambda row: None, max_batch=parameters["max_batch"], after_batch=note)
    if curves:
        write_atomically(folder.path / CURVE, curve(parameters, pair, policies, rollouts))
    extra = {"transport": "in-process", "controller": built_in(training)}
    code = {"code": own} if (own := code_of(parameters)) else {}
    folder.finish(training, {**extra, **code, "environment": environment()})


def code_of(parameters: Mapping[str, Any]) -> int:
    """A digest of the source of the user's own law and optimiser; 0 without any."""
    kinds: list[type] = []
    if ":" in parameters["law"]:
        kinds.append(law_kind(parameters["law"], parameters))
    if ":" in parameters["optimizer"]:
        kinds.append(kind_of(parameters))
    shipped = ("pdeloop", *sys.stdlib_module_names)
    bases = (base for kind in kinds for base in kind.__mro__)
    own = [base for base in bases if base.__module__.partition(".")[0] not in shipped]
    sources = json.dumps([source_of(base) for base in own])
    return int(hashlib.sha256(sources.encode()).hexdigest()[:12], 16) if own else 0


def _opened(
    stack: ExitStack, place: Place | None, parameters: Mapping[str, Any], plant: int, *, anew: bool
) -> RunFolder:
    """The run folder of a training, with what an earlier process has left of it; else a temporary one.

    plant: its fingerprint, with `code_of`; anew: begin again, unless there is the result.
    """
    path = place and place.run_folder()
    if path:
        folder = RunFolder(path)
        with contextlib.suppress(OSError, RunFolderError):  # another process trains it, or no room
            make_folder(path)
            stack.enter_context(folder.locked())
            if not _continues(folder, parameters, plant, anew=anew):
                for old in path.iterdir():
                    if old.name != "lock":
                        shutil.rmtree(old) if old.is_dir() else old.unlink()
                write_atomically(path / PLANT_FILE, str(plant).encode())
                folder.begin(parameters)
            return folder
    within = stack.enter_context(TemporaryDirectory(prefix="pdeloop-", dir=_folder))
    folder = RunFolder(Path(within) / "run")
    folder.create(parameters)
    return folder


def _continues(folder: RunFolder, parameters: Mapping[str, Any], plant: int, *, anew: bool) -> bool:
    """Whether what is in the folder can be continued as a training with these parameters."""
    if anew and not (folder.path / FILES[-1]).exists():
        return False
    try:
        known = folder.parameters()
        there = int((folder.path / PLANT_FILE).read_text())
    except (OSError, ValueError):
        return False
    return there == plant and not parameter_changes(known, parameters)


def curve(
    parameters: Mapping[str, Any],
    pair: LocalPair,
    policies: Sequence[NDArray[np.float64]],
    rollouts: Sequence[float],
) -> bytes:
    """The costs of every policy that a training of one seed had, as in its closing evaluation.

    These rollouts belong to no budget. An .npz file: `policies` (N, *shape), at the start and
    after every batch of the adaptation, their `costs` (N, fields), and the `rollouts` (N,) that
    were paid until then.
    """
    laws = np.stack(policies)
    distinct, which = np.unique(laws, axis=0, return_inverse=True)
    count, seed = parameters["evaluation_fields"], parameters["evaluation_seed"]
    costs = mean_costs(pair, parameters, distinct, [0] * len(distinct), fields=count, seed=seed)
    known = {"policies": laws, "costs": costs[which.ravel()], "rollouts": np.array(rollouts)}
    return packed_arrays(known)
