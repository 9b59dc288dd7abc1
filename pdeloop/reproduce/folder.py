"""One training of the paper's experiment with the cost of every iteration's policy. Pure but for files.

The folder of a job is an ordinary run folder with two files more:

curve.npz     costs (iterations + 1, S, fields) of the policy before the first iteration and after
              each, on the evaluation fields; policies (iterations + 1, S, n_a, 2 n_s);
              mean_field (3, S): no control, first and last policy on the mean field; seconds
progress      what a continued job needs (tuner_node.checkpoint), until it is done
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.topics import CostColumn
from pde_sim_node.plant import DIVERGED_COST
from pdeloop.in_process import LocalPair
from pdeloop.training_run import resolve
from tuner_node import checkpoint
from tuner_node.batch import Batch
from tuner_node.build import build_training
from tuner_node.results import RunFolder, RunFolderError
from tuner_node.seeds import Purpose, derive
from tuner_node.training import Training

Array = NDArray[np.float64]
SAVE_PERIOD = 2.0
"""Seconds between two savings: what an interruption may lose."""
STARTS = ("lqt", "zero")
"""LQT-PO and pure PO."""
TITLES = {"lqt": "LQT-PO", "zero": "pure PO"}


@dataclass(frozen=True)
class Job:
    """A training: problem (name or file), start ('lqt' or 'zero'), and the folder of its results."""

    problem: str
    start: str
    folder: Path
    options: Mapping[str, Any]

    def values(self) -> dict[str, Any]:
        """Its resolved parameters."""
        return resolve(
            self.problem, {**self.options, "start": self.start, "optimizer": "two_point"}
        )

    @property
    def done(self) -> bool:
        return (self.folder / "curve.npz").exists()


def work(values: Mapping[str, Any]) -> float:
    """How much there is to compute, in rollouts times what one costs."""
    rollouts = values["seeds"] * (2 * values["iterations"] + 14)
    rollouts += values["seeds"] * values["evaluation_fields"] * (values["iterations"] + 4)
    inner = round(values["sample_time"] / values["integration_time"])
    return float(rollouts * values["horizon"] * inner * values["n_z"])


def run(job: Job, tell: Callable[[float, str], None]) -> None:
    """Carry the job out, or on.

    tell(share, status) is called now and then with the share that is done and the cost so far.
    """
    values = job.values()
    folder = RunFolder(job.folder)
    if (job.folder / "parameters.yaml").exists():
        folder.reopen(values)
    else:
        folder.create(values)
    state = _Curve(values, job.folder / "progress")
    while state.advance():
        tell(state.share, f"{values['problem']} {TITLES[job.start]} {state.cost}".strip())
    folder.finish(state.training, {"seconds": state.seconds, "transport": "in-process"})
    state.save_result(job.folder / "curve.npz")
    for path in job.folder.glob("progress*"):
        path.unlink()
    tell(1.0, "")


class _Curve:
    """The training under way, and the costs of its policies so far."""

    def __init__(self, values: Mapping[str, Any], path: Path) -> None:
        self.training: Training = build_training(values)
        self.seconds = 0.0
        self._values, self._path = values, path
        self._costs: list[Array] = []
        self._policies: list[Array] = []
        self._restore()
        self._pair = _single_threaded_pair(values)
        self._pair.follow(self.training)
        self._saved_at = self._at = time.monotonic()

    @property
    def share(self) -> float:
        return len(self._costs) / float(self._values["iterations"] + 1)

    @property
    def cost(self) -> str:
        """The mean cost of the newest policy on the evaluation fields, in words."""
        if not self._costs:
            return ""
        newest = self._costs[-1]
        if (newest >= DIVERGED_COST).any():
            return "diverged"
        return f"cost {newest.mean():.4g}"

    def advance(self) -> bool:
        """One batch of the training; False when it is over."""
        training = self.training
        batch = training.next_batch()
        if batch is None:
            return False
        phase = training.phase
        first = not training.optimizers
        result = self._pair.run(batch, self._values["max_batch"])
        training.finish(result)
        self._pair.follow(training)
        if training.optimizers and (first or phase == "adapt"):
            policies = training.policies()
            self._policies.append(policies)
            self._costs.append(self._evaluate(policies))
        self._save()
        return True

    def save_result(self, path: Path) -> None:
        """Write curve.npz."""
        policies = np.stack(self._policies)
        zero = np.zeros_like(policies[0])
        mean_field = np.stack(
            [self._cost(p, [-1])[:, 0] for p in (zero, policies[0], policies[-1])]
        )
        arrays = {
            "costs": np.stack(self._costs),
            "policies": policies,
            "mean_field": mean_field,
            "seconds": np.array(self.seconds),
        }
        part = path.with_name("curve.part.npz")
        np.savez(part, **arrays)  # type: ignore[arg-type]
        part.replace(path)

    def _evaluate(self, policies: Array) -> Array:
        seed = self._values["evaluation_seed"]
        fields = range(self._values["evaluation_fields"])
        return self._cost(policies, [derive(seed, Purpose.EVALUATION_FIELD, i) for i in fields])

    def _cost(self, policies: Array, fields: list[int]) -> Array:
        """Mean stage costs (S, fields) of a policy a seed."""
        rows = [(field, -1, 0, m) for m in range(len(policies)) for field in fields]
        gains = np.repeat(policies, len(fields), axis=0)
        result = self._pair.run(Batch(np.array(rows, dtype=np.float64), gains))
        cost: Array = result.costs[:, CostColumn.MEAN].reshape(len(policies), len(fields))
        return cost

    def _save(self) -> None:
        now = time.monotonic()
        self.seconds += now - self._at
        self._at = now
        if now - self._saved_at < SAVE_PERIOD or not self._costs:
            return
        self._saved_at = now
        arrays = {f"training.{name}": value for name, value in self.training.state().items()}
        arrays |= {"costs": np.stack(self._costs), "policies": np.stack(self._policies)}
        try:
            checkpoint.save(self._path, arrays | {"seconds": np.array(self.seconds)})
        except OSError as error:
            raise RunFolderError(f"cannot write {self._path}: {error.strerror}") from error

    def _restore(self) -> None:
        checkpoint.restore(self._path, self._take)

    def _take(self, arrays: dict[str, NDArray[Any]]) -> None:
        prefix = "training."
        n_a, seeds = int(self._values["n_a"]), int(self._values["seeds"])
        costs = checkpoint.taken(arrays, "costs", "f", (None, seeds, None))
        policies = checkpoint.taken(arrays, "policies", "f", (len(costs), seeds, n_a, None))
        seconds = float(checkpoint.taken(arrays, "seconds", "f", ()))
        self.training.restore(
            {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}
        )
        self._costs, self._policies, self.seconds = list(costs), list(policies), seconds


def _single_threaded_pair(values: Mapping[str, Any]) -> LocalPair:
    """A plant takes as many threads as it finds cores; here the other cores have other jobs."""
    if not hasattr(os, "sched_setaffinity"):
        return LocalPair(values)
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        return LocalPair(values)
    finally:
        os.sched_setaffinity(0, cores)
