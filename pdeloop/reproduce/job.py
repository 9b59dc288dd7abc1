"""One training of the experiment, and the cost of every policy that it had. Pure but for files.

The folder of a job is an ordinary run folder with two files more:

curve.npz     policies (N, S, n_a, 2 n_s): at the start, and after every batch of the adaptation;
              costs (N, S, fields): theirs, on the evaluation fields; rollouts (N, S): paid until then;
              seconds
progress      what a continued job needs (tuner_node.checkpoint), until it is done
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.controllers import CONTROLLERS
from loop_interfaces.files import write_atomically
from loop_interfaces.parameters import noisy
from loop_interfaces.topics import CostColumn
from pde_sim_node.plant import DIVERGED_COST
from pdeloop.in_process import LocalPair
from pdeloop.training_run import resolve
from tuner_node import checkpoint
from tuner_node.batch import Batch
from tuner_node.build import build_training
from tuner_node.noise import evaluation_noise
from tuner_node.results import RunFolder, RunFolderError
from tuner_node.seeds import Purpose, derive

Array = NDArray[np.float64]
SAVE_PERIOD = 2.0
"""Seconds between two savings: what an interruption may lose."""
LEARNED = {
    "lqt_po": {"start": "lqt", "optimizer": "two_point", "identification": "dmdc"},
    "pure_po": {"start": "zero", "optimizer": "two_point", "identification": "dmdc"},
    "gauss_newton": {"start": "lqt", "optimizer": "gauss_newton", "identification": "dmdc"},
}
"""The adapted controllers of the experiment, and how each is trained: all on the paper's models."""


@dataclass(frozen=True)
class Job:
    """A training: problem (name or file), one of LEARNED, the folder of its results, options."""

    problem: str
    controller: str
    folder: Path
    options: Mapping[str, Any]

    def values(self) -> dict[str, Any]:
        """Its resolved parameters.

        The paper counts iterations of two rollouts each, after exploration and check; Gauss-Newton
        has that many rollouts with exploration and check.
        """
        options = {**self.options, **LEARNED[self.controller]}
        if options["optimizer"] == "gauss_newton":
            options["rollouts"] = 2 * options.pop("iterations")
        return resolve(self.problem, options)

    @property
    def done(self) -> bool:
        return (self.folder / "curve.npz").exists()


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
    state = _TrainingWithCosts(values, job.folder / "progress")
    while state.advance():
        status = f"{values['problem']} {CONTROLLERS[job.controller].name} {state.cost}"
        tell(state.share, status.strip())
    folder.finish(state.training, {"seconds": state.seconds, "transport": "in-process"})
    archive = BytesIO()
    np.savez(archive, **state.curve())  # type: ignore[arg-type]
    write_atomically(job.folder / "curve.npz", archive.getvalue())
    for path in job.folder.glob("progress*"):
        path.unlink()


class _TrainingWithCosts:
    """The training under way, and the costs of its policies so far."""

    def __init__(self, values: Mapping[str, Any], path: Path) -> None:
        self.training = build_training(values)
        self.seconds = 0.0
        self._values, self._path = values, path
        self._costs: list[Array] = []
        self._policies: list[Array] = []
        self._rollouts: list[Array] = []
        checkpoint.restore(path, self._go_on)  # without a usable one it begins again, identically
        self._pair = LocalPair(values)
        self._pair.follow(self.training)
        self._saved_at = self._at = time.monotonic()

    @property
    def share(self) -> float:
        budget = self.training.budget
        return float(budget.paid.sum() / budget.total.sum())

    @property
    def cost(self) -> str:
        """The mean cost of the newest policies on the evaluation fields, in words."""
        if not self._costs:
            return ""
        newest = self._costs[-1]
        return "diverged" if (newest >= DIVERGED_COST).any() else f"cost {newest.mean():.4g}"

    def advance(self) -> bool:
        """One batch of the training; False when it is over."""
        batch = self.training.next_batch()
        if batch is None:
            return False
        self.training.finish(self._pair.run(batch, self._values["max_batch"]))
        self._pair.follow(self.training)
        if self.training.optimizers and self.training.phase != "done":
            self._measure()
        now = time.monotonic()
        self.seconds, self._at = self.seconds + now - self._at, now
        if self._costs and now - self._saved_at >= SAVE_PERIOD:
            self._save()
            self._saved_at = now
        return True

    def curve(self) -> dict[str, Array]:
        """The arrays of curve.npz."""
        return {
            "costs": np.stack(self._costs),
            "policies": np.stack(self._policies),
            "rollouts": np.stack(self._rollouts),
            "seconds": np.array(self.seconds),
        }

    def _measure(self) -> None:
        """Note the present policies; a seed's cost is measured anew where its policy changed."""
        policies = self.training.policies()
        seeds, fields = len(policies), self._values["evaluation_fields"]
        costs, changed = np.empty((seeds, fields)), np.full(seeds, True)
        if self._costs:
            costs = self._costs[-1].copy()
            changed = (policies != self._policies[-1]).any(axis=(1, 2))
        if changed.any():
            costs[changed] = self._costs_of(policies, np.flatnonzero(changed))
        self._policies.append(policies)
        self._costs.append(costs)
        self._rollouts.append(self.training.budget.paid.astype(np.float64))

    def _costs_of(self, policies: Array, seeds: NDArray[np.intp]) -> Array:
        """Mean stage costs (seeds, fields) of those seeds' policies, as in the closing evaluation."""
        seed, count = self._values["evaluation_seed"], self._values["evaluation_fields"]
        noise = evaluation_noise(seed, count) if noisy(self._values) else []
        rows = [
            (derive(seed, Purpose.EVALUATION_FIELD, i), -1, 0, m, *noise[i : i + 1])
            for m in seeds
            for i in range(count)
        ]
        gains = np.repeat(policies[seeds], count, axis=0)
        result = self._pair.run(
            Batch(np.array(rows, dtype=np.float64), gains), self._values["max_batch"]
        )
        costs: Array = result.costs[:, CostColumn.MEAN].reshape(len(seeds), count)
        return costs

    def _save(self) -> None:
        arrays = {f"training.{name}": value for name, value in self.training.state().items()}
        try:
            checkpoint.save(self._path, {**arrays, **self.curve()})
        except OSError as error:
            raise RunFolderError(f"cannot write {self._path}: {error.strerror}") from error

    def _go_on(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Go on from a checkpoint of `_save`; ValueError, and nothing is changed, if it is none."""
        n_a, seeds = int(self._values["n_a"]), int(self._values["seeds"])
        costs = checkpoint.taken(arrays, "costs", "f", (None, seeds, None))
        policies = checkpoint.taken(arrays, "policies", "f", (len(costs), seeds, n_a, None))
        rollouts = checkpoint.taken(arrays, "rollouts", "f", (len(costs), seeds))
        seconds = checkpoint.taken(arrays, "seconds", "f", ())
        prefix = "training."
        self.training.restore(
            {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}
        )
        self._costs, self._policies = list(costs), list(policies)
        self._rollouts, self.seconds = list(rollouts), float(seconds)
