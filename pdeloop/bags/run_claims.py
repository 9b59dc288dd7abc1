# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What a run's folder claims about its training, for comparison with its bags."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pdeloop.bags.report import Report
from pdeloop.display import ProgressFile
from pdeloop.messages.documents import parse_json
from pdeloop.messages.files import FileError, read_json
from pdeloop.messages.text import shown
from tuner_node.results import check_result, summarise
from tuner_node.rollouts import EVALUATED
from tuner_node.run_folder import RunFolder, RunFolderError
from tuner_node.training import Training

RESULT, RUN, PROGRESS = "result.json", "run.json", "progress.jsonl"
FILES = (RUN, PROGRESS, "parameters.yaml", "policy.npz")
"""The files of a finished run beside its results."""


@dataclass
class RunClaims:
    """The claims of a run's folder.

    run: the id on the network, None where run.json does not say; result: the content of result.json,
    None for a training that is not finished; paid: minimum number of rollouts, by seed, that the
    training had used; parameters: those in run.json that define the run; unreadable: files that are
    there and cannot be read, in words.
    """

    folder: Path
    run: int | None = None
    result: dict[str, Any] | None = None
    paid: dict[int, int] = field(default_factory=dict)
    parameters: dict[str, Any] = field(default_factory=dict)
    unreadable: list[str] = field(default_factory=list)

    @property
    def finished(self) -> bool:
        """True if the folder has the policies of a finished run."""
        return (self.folder / "policy.npz").exists()

    def reached(self, training: Training) -> bool:
        """True if the training has been followed as far as the folder says that it went."""
        if self.result is not None:
            return False  # to its very end
        paid = dict(zip(training.settings.all_seeds, training.budget.paid.tolist(), strict=True))
        return all(paid.get(seed, count) >= count for seed, count in self.paid.items())


def claims_of(folder: Path) -> RunClaims | None:
    """The claims of the run in `folder`; None if no run is there."""
    if not any((folder / name).exists() for name in (RUN, RESULT, "parameters.yaml")):
        return None
    claims = RunClaims(folder)
    try:
        if (folder / RUN).exists():
            known = read_json(folder / RUN)
            claims.run, claims.parameters = int(known["run"]), dict(known["parameters"])
    except (FileError, LookupError, TypeError, ValueError) as error:
        claims.unreadable.append(f"{folder / RUN} cannot be read: {_words(error)}")
    try:
        if (folder / RESULT).exists():
            result = read_json(folder / RESULT)
            check_result(result, result["seed"], result["seeds"])
            claims.result = result
    except (FileError, LookupError, TypeError, ValueError) as error:
        claims.unreadable.append(f"{folder / RESULT} cannot be read: {_words(error)}")
    for row in ProgressFile(folder / PROGRESS, past=True).rows():
        match row:
            case {"event": "adapted", "seed": int(seed), "rollouts": int(paid)}:
                claims.paid[seed] = max(paid, claims.paid.get(seed, 0))
    return claims


def _words(error: Exception) -> str:
    return f"it lacks {error}" if isinstance(error, LookupError) else str(error)


def compare_parameters(claims: RunClaims, values: Mapping[str, Any], report: Report) -> None:
    """Hold the parameters that the bag knows against those that define the run."""
    for name, value in claims.parameters.items():
        if name in values and values[name] != value:
            report.differs(
                f"parameter '{shown(name)[1:-1]}' is {shown(values[name])} in the bag and "
                f"{shown(value)} in {claims.folder / RUN}"
            )


def compare_results(claims: RunClaims, training: Training, report: Report) -> None:
    """Hold the results of a training that was followed to its end against those in the folder."""
    if claims.result is None or training.evaluation is None:
        return
    costs, where = claims.result["costs_by_field"], claims.folder / RESULT
    for i, name in enumerate(EVALUATED):
        told = np.array(costs[name], dtype=np.float64)
        report.compare("results", f"'{name}' of {where}", told, training.evaluation[:, i])
    _compare_history(claims.result.get("history", []), training.history, report, where)
    _compare_summary(claims.result, training, report, where)
    for name in FILES:
        if not (claims.folder / name).exists():
            report.missing.append(f"{name} of the run in {claims.folder}")
    try:
        told = RunFolder(claims.folder).policies()["policy"]
    except RunFolderError as error:
        report.differs(str(error))
        return
    report.compare("results", f"the policy in {claims.folder}", told, training.policies())


def _compare_summary(
    told: Mapping[str, Any], training: Training, report: Report, where: Path
) -> None:
    """Compare every other figure of the results, those that this version writes as well."""
    for name, value in parse_json(json.dumps(summarise(training)).encode()).items():
        if name in told and name not in ("costs_by_field", "history"):
            report.count_compared("figures of results", 1)
            if told[name] != value:
                report.differs(
                    f"'{name}' of {where} is {shown(told[name])}, the training has {shown(value)}"
                )


def _compare_history(
    told: Sequence[Mapping[str, Any]],
    again: Sequence[Mapping[str, Any]],
    report: Report,
    where: Path,
) -> None:
    """Compare the rows of the optimisers by what every version and optimiser writes."""
    if len(told) != len(again):
        report.differs(f"history of {where}: {len(told)} rows, the training has {len(again)}")
        return
    for number, (row, own) in enumerate(zip(told, again, strict=True)):
        for name in ("seed", "rollouts", "cost"):
            if row.get(name) != own.get(name):
                report.differs(
                    f"history of {where}, row {number}: {name} is {shown(row.get(name))}, "
                    f"the training has {shown(own.get(name))}"
                )
                return
