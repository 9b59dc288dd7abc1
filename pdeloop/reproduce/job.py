"""One training of the experiment, and the cost of every policy that it had. Pure but for files.

The folder of a job is an ordinary run folder with one file more, curve.npz:

policies (N, S, n_a, 2 n_s)    at the start, and after every batch of the adaptation
costs (N, S, fields)           theirs, on the evaluation fields
rollouts (N, S)                paid until then
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.files import write_atomically
from loop_interfaces.parameters import noisy
from loop_interfaces.topics import CostColumn
from pdeloop.in_process import LocalPair
from pdeloop.training_run import resolve
from tuner_node.batch import Batch
from tuner_node.build import build_training
from tuner_node.results import RunFolder
from tuner_node.seeds import Purpose, derive, evaluation_noise
from tuner_node.training import Training

Array = NDArray[np.float64]
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
        return (self.folder / "result.json").exists()


def run(job: Job, tell: Callable[[float], None]) -> None:
    """Carry the job out; one that was interrupted begins again, with the same numbers.

    tell(share) is called now and then with the share that is done.
    """
    values, folder, began = job.values(), RunFolder(job.folder), time.monotonic()
    if (job.folder / "parameters.yaml").exists():
        folder.reopen(values)
    else:
        folder.create(values)
    training, pair, curve = build_training(values), LocalPair(values), _Curve()
    pair.follow(training)
    while (batch := training.next_batch()) is not None:
        training.finish(pair.run(batch, values["max_batch"]))
        pair.follow(training)
        if training.optimizers and training.phase != "done":
            curve.add(training, pair, values)
        tell(float(training.budget.paid.sum() / training.budget.total.sum()))
    archive = BytesIO()
    np.savez(archive, **{key: np.stack(rows) for key, rows in vars(curve).items()})  # type: ignore[arg-type]
    write_atomically(job.folder / "curve.npz", archive.getvalue())
    seconds = time.monotonic() - began
    folder.finish(training, {"seconds": seconds, "transport": "in-process"})


@dataclass
class _Curve:
    """The rows of curve.npz."""

    policies: list[Array] = field(default_factory=list)
    costs: list[Array] = field(default_factory=list)
    rollouts: list[Array] = field(default_factory=list)

    def add(self, training: Training, pair: LocalPair, values: Mapping[str, Any]) -> None:
        """Add the present policies; a seed's cost is measured anew where its policy changed."""
        policies = training.policies()
        costs = np.empty((len(policies), values["evaluation_fields"]))
        changed = np.full(len(policies), True)
        if self.costs:
            costs = self.costs[-1].copy()
            changed = (policies != self.policies[-1]).any(axis=(1, 2))
        if changed.any():
            costs[changed] = _costs_of(policies, np.flatnonzero(changed), pair, values)
        self.policies.append(policies)
        self.costs.append(costs)
        self.rollouts.append(training.budget.paid.astype(np.float64))


def _costs_of(
    policies: Array, seeds: NDArray[np.intp], pair: LocalPair, values: Mapping[str, Any]
) -> Array:
    """Mean stage costs (seeds, fields) of those seeds' policies, as in the closing evaluation."""
    seed, count = values["evaluation_seed"], values["evaluation_fields"]
    noise = evaluation_noise(seed, count) if noisy(values) else []
    rows = [
        (derive(seed, Purpose.EVALUATION_FIELD, i), -1, 0, m, *noise[i : i + 1])
        for m in seeds
        for i in range(count)
    ]
    gains = np.repeat(policies[seeds], count, axis=0)
    result = pair.run(Batch(np.array(rows, dtype=np.float64), gains), values["max_batch"])
    costs: Array = result.costs[:, CostColumn.MEAN].reshape(len(seeds), count)
    return costs
