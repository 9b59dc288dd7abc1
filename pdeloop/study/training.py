# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""One training of a study: a function of its parameters alone, wherever it runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Any

import llvmlite.binding
import numpy as np
from numpy.typing import NDArray

from pdeloop.evaluation import mean_costs
from pdeloop.in_process import LocalPair, train
from pdeloop.training_run import built_in
from tuner_node.build import build_training
from tuner_node.results import versions
from tuner_node.run_folder import RunFolder

FILES = ("parameters.yaml", "policy.npz", "result.json")
"""The files of a run folder that a training of a study leaves, in the order of writing."""
CURVE = "curve.npz"
"""The file of `curve`, of a study with curves."""
_ONE_AT_A_TIME = Lock()
"""A worker that runs tasks in threads: a training uses NumPy's and Numba's own threads."""
_folder: str | None = None


class EnvironmentMismatchError(ValueError):
    """A worker has other versions or another processor than the study."""


def work_in(folder: str) -> None:
    """Let the trainings of this process keep their files in `folder`, not in the temporary one."""
    global _folder
    _folder = folder


def environment() -> dict[str, str]:
    """The environment that the last bits of a result depend on: versions and the processor's type."""
    known = versions()
    known.pop("ros-jazzy-rclpy", None)
    return {**known, "processor": str(llvmlite.binding.get_host_cpu_name())}


def require_environment(expected: Mapping[str, str] | None) -> dict[str, str]:
    """The `environment` of this process; EnvironmentMismatchError if another one is expected."""
    here = environment()
    if expected is not None and (other := differences(here, expected)):
        raise EnvironmentMismatchError(f"a worker has {other}")
    return here


def differences(there: Mapping[str, str], expected: Mapping[str, str]) -> str:
    """Differences of another environment from the expected one, in words; empty if there are none."""
    return ", ".join(
        f"{name} {there.get(name, 'missing')} instead of {expected.get(name, 'none')}"
        for name in sorted({*there, *expected})
        if there.get(name) != expected.get(name)
    )


def train_one(
    parameters: Mapping[str, Any], expected: Mapping[str, str] | None = None, curves: bool = False
) -> dict[str, bytes]:
    """Train in this process: a function of the resolved parameters alone.

    expected: the `environment` in which alone the result may be computed, None: any; curves: with
    the cost of every policy that the training has. Returns the content of each of `FILES`, before
    them that of `CURVE`; `environment` is an entry of result.json. EnvironmentMismatchError in
    another environment; ValueError or RuntimeError for a training that cannot be carried out.
    """
    here = require_environment(expected)
    with _ONE_AT_A_TIME, TemporaryDirectory(prefix="pdeloop-", dir=_folder) as place:
        folder = RunFolder(Path(place) / "run")
        folder.create(parameters)
        training = build_training(parameters)
        pair = LocalPair(parameters)
        policies: list[NDArray[np.float64]] = []
        rollouts: list[float] = []

        def note() -> None:
            if training.optimizers and training.phase != "done":
                policies.append(training.policies()[0])
                rollouts.append(float(training.budget.paid[0]))

        train(training, pair, lambda row: None, max_batch=parameters["max_batch"], after_batch=note)
        extra = {"transport": "in-process", "controller": built_in(training), "environment": here}
        folder.finish(training, extra)
        kept = {name: (folder.path / name).read_bytes() for name in FILES}
        if curves:
            kept = {CURVE: curve(parameters, pair, policies, rollouts), **kept}
        return kept


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
    content = BytesIO()
    np.savez(content, policies=laws, costs=costs[which.ravel()], rollouts=np.array(rollouts))
    return content.getvalue()
