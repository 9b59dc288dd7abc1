# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The data of a report, gathered from the folder of a run or of a reproduction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from controller_node.identification import DesignSettings
from controller_node.law_batch import LawBatch
from pde_sim_node.build import build_plant
from pde_sim_node.plant import DIVERGED_COST, MEAN_FIELD, Plant
from pdeloop.episode import rollout
from pdeloop.evaluation import another_loop
from pdeloop.finished_run import FinishedRun, field_means, load_run
from pdeloop.in_process import LocalPair
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.array_files import checked_array, unpack_arrays
from pdeloop.messages.arrays import Array
from pdeloop.messages.controllers import CONTROLLERS
from pdeloop.messages.cost import measured_cost
from pdeloop.messages.model_rows import ModelRows
from pdeloop.method.laws.registry import law_kind, laws_of
from pdeloop.method.reduce.regression import OrderStudy, study_orders
from pdeloop.reproduction import reproduction_in, runs_of
from pdeloop.study.description import Study
from pdeloop.study.results import MOST, STUDY_FILE, reading
from pdeloop.study.training import CURVE
from tuner_node.batch import stacked
from tuner_node.build import build_training
from tuner_node.run_folder import RunFolderError


@dataclass(frozen=True)
class Behaviour:
    """One controller from the mean initial field.

    states (T + 1, n_z), actions (T, n_a) as they were applied, cost: mean stage cost; diverged at this
    step, -1 if it did not. What follows a divergence is NaN.
    """

    controller: str
    states: Array
    actions: Array
    cost: float
    diverged: int

    @property
    def title(self) -> str:
        """The controller's name, and its cost or where it diverged."""
        lost = self.diverged >= 0
        told = f"diverged at step {self.diverged}" if lost else f"mean stage cost {self.cost:.3g}"
        return f"{CONTROLLERS[self.controller].name}\n{told}"


@dataclass(frozen=True)
class Curve:
    """A controller's cost while it learns; each value holds from that many rollouts on.

    rollouts (N,): how many a seed's adaptation has used; costs (N, S): by then, NaN where a rollout
    diverged. over_lqt: each is that of a policy on the fields of the closing evaluation, divided by
    the cost of the seed's LQT law on the same; else they were measured on the training's own fields,
    which change during the training, so nothing measured on other fields compares with them.
    """

    controller: str
    rollouts: Array
    costs: Array
    over_lqt: bool


@dataclass(frozen=True)
class ProblemData:
    """A problem's part of a report.

    runs: by adapted controller; curves: their costs while they learn; shown: index of the seed whose
    behaviour, gains and steps are shown; plant: the built-in one; behaviours: empty where they cannot
    be computed; orders: what the shown seed's exploratory episode says about the order, None where
    that is not known; explored: rollouts used, up to 0, and mean costs of explorations; missing: a
    sentence for each thing that cannot be shown.
    """

    runs: Mapping[str, FinishedRun]
    curves: Sequence[Curve]
    shown: int
    plant: Plant
    missing: list[str] = field(default_factory=list)
    behaviours: list[Behaviour] = field(default_factory=list)
    orders: OrderStudy | None = None
    explored: tuple[Array, Array] = (np.zeros(0), np.zeros(0))

    @property
    def first(self) -> FinishedRun:
        """The run whose identification, LQT law and parameters of the problem are shown."""
        return next(iter(self.runs.values()))

    @property
    def name(self) -> str:
        return str(self.first.values["problem"])

    @property
    def costs(self) -> dict[str, Array]:
        """By controller, (S, fields)."""
        own = {name: run.costs["adapted"] for name, run in self.runs.items()}
        return {"none": self.first.costs["none"], "lqt": self.first.costs["lqt"], **own}

    @property
    def policies(self) -> dict[str, Array]:
        """The law's parameters of the shown seed, by controller."""
        warm = self.first.warm[self.shown]
        own = {name: run.policies[self.shown] for name, run in self.runs.items()}
        return {"none": np.zeros_like(warm), "lqt": warm, **own}

    @property
    def affine(self) -> bool:
        """True if the parameters are gains [K_a K_b]."""
        return all(run.affine for run in self.runs.values())

    @property
    def models(self) -> list[ModelRows]:
        return self.first.models

    def history(self, controller: str) -> list[dict[str, Any]]:
        """The rows of the shown seed's optimiser; `rollouts` are those of the adaptation."""
        run = self.runs[controller]
        return [
            {**row, "rollouts": row["rollouts"] - run.before[self.shown]}
            for row in run.result["history"]
            if row["seed"] == run.seeds[self.shown] and row.get("event") != "diverged"
        ]


@dataclass(frozen=True)
class ReportData:
    """Everything a report shows; study: the reproduction that it is about."""

    folder: Path
    problems: list[ProblemData]
    study: Study | None = None

    @property
    def missing(self) -> list[str]:
        """Data that cannot be shown, with the problem where there are several."""
        several = len(self.problems) > 1
        return [
            f"{problem.name}: {sentence}" if several else sentence
            for problem in self.problems
            for sentence in problem.missing
        ]


def gather(folder: Path) -> ReportData:
    """The content of a report of `folder`. RunFolderError when it holds nothing to report."""
    if (study := reproduction_in(folder)) is not None:
        problems = [_reproduced(study, folder, name) for name in study.problems]
        return ReportData(folder, problems, study)
    if (folder / "parameters.yaml").exists():
        return ReportData(folder, [of_run(load_run(folder))])
    if (folder / STUDY_FILE).exists():
        raise RunFolderError(
            f"{folder} holds a study, whose table and figure are its table.json and costs.png; have "
            f"its runs written with `pdeloop study --out {folder} --run-folders`, and report one of "
            f"them, {folder}/PROBLEM/VARIANT/SEED"
        )
    raise RunFolderError(f"{folder} holds neither a run nor a reproduction")


def of_run(run: FinishedRun) -> ProblemData:
    """A single run's part of a report."""
    return replace(_problem({"adapted": run}, _history(run), 0), explored=_explored(run))


def _reproduced(study: Study, folder: Path, name: str) -> ProblemData:
    runs = runs_of(study, folder, name)
    lqt = field_means(runs["lqt_po"].costs["lqt"])
    curves = []
    for controller, run in runs.items():
        seeds = []
        for seed, before, base in zip(study.seeds, run.before, lqt, strict=True):
            path = f"{name}/{controller}/{seed}"
            try:
                with reading(folder) as results:
                    content = results.files(path)[CURVE]
                arrays = unpack_arrays(BytesIO(content), MOST)
                used = checked_array(arrays, "rollouts", "f", (None,)) - before
                costs = field_means(checked_array(arrays, "costs", "f", (len(used), None)))
            except (ValueError, KeyError) as error:
                raise RunFolderError(f"{CURVE} of {path} cannot be read: {error}") from error
            seeds.append((used, costs / base))
        curves += _curve(controller, seeds, over_lqt=True)
    ratio = field_means(runs["lqt_po"].costs["adapted"]) / lqt
    known = max(1, int(np.isfinite(ratio).sum()))
    median = int(np.argsort(ratio, kind="stable")[(known - 1) // 2])
    return _problem(runs, curves, median)


def _history(run: FinishedRun) -> list[Curve]:
    """The measured costs in the rows of the optimiser, whichever it is."""
    seeds = []
    for seed, before in zip(run.seeds, run.before, strict=True):
        own = [row for row in run.result["history"] if row["seed"] == seed]
        rows = [row for row in own if row.get("event") != "diverged"]
        rows.sort(key=lambda row: int(row["rollouts"]))
        costs = np.array([row.get("cost", np.nan) for row in rows], dtype=np.float64)
        costs[~(np.abs(costs) < DIVERGED_COST)] = np.nan
        used = np.array([row["rollouts"] - before for row in rows], dtype=np.float64)
        seeds.append((used, costs))
    return _curve("adapted", seeds, over_lqt=False)


def _explored(run: FinishedRun) -> tuple[Array, Array]:
    """Rollouts that explorations had used, 0 where the adaptation begins, and their mean costs."""
    before = dict(zip(run.seeds, run.before, strict=True))
    rows = [row for row in run.measured if row["phase"] == "identify" and "cost" in row]
    points = [(row["rollouts"] - before.get(row["seed"], 0), row["cost"]) for row in rows]
    used, costs = np.array(sorted(set(points)), dtype=np.float64).reshape(-1, 2).T
    return used, costs


def _curve(controller: str, seeds: Sequence[tuple[Array, Array]], *, over_lqt: bool) -> list[Curve]:
    """One curve from each seed's rollouts and costs; none where nothing was learned.

    Seeds may use their rollouts in unequal portions: a cost holds until the next one.
    """
    used = np.unique(np.concatenate([rollouts for rollouts, _ in seeds]))
    known = np.full((len(used), len(seeds)), np.nan)
    for s, (rollouts, costs) in enumerate(seeds):
        last = np.searchsorted(rollouts, used, side="right") - 1
        known[last >= 0, s] = costs[last[last >= 0]]
    return [Curve(controller, used, known, over_lqt)] if np.isfinite(known).any() else []


def _problem(runs: Mapping[str, FinishedRun], curves: Sequence[Curve], shown: int) -> ProblemData:
    values = next(iter(runs.values())).values
    data = ProblemData(runs, curves, shown, build_plant(values))
    if not curves:
        data.missing.append(
            "Training curves: the adaptation completed no rollout, or there was none to compare with."
        )
    if reason := another_loop(data.first):
        data.missing.append(
            f"Behaviour, gains, spectrum: {reason}. All costs are those that the run measured."
        )
        return data
    orders = _orders(data.first, shown, data.plant)
    return replace(data, behaviours=behaviours(data), orders=orders)


def _orders(run: FinishedRun, shown: int, plant: Plant) -> OrderStudy | None:
    """The orders that the exploration supports from which a seed's model was identified."""
    if run.values["model"] or not run.rollouts:
        return None
    training = build_training({**run.values, "seed": run.seeds[shown], "seeds": 1})
    explored = run.rollouts[shown]["exploration"] // training.settings.explorations
    seed, rows = run.seeds[shown], run.result["history"]
    void = sum(row["seed"] == seed and row.get("event") == "diverged" for row in rows)
    training.attempts, training.void = [explored - 1 - void], [void]
    batch = training.next_batch()
    assert batch is not None
    episode = LocalPair(run.values, plant).roll_out(batch)
    pairs = list(zip(episode.states.swapaxes(0, 1), episode.actions.swapaxes(0, 1), strict=True))
    design = DesignSettings.of(run.values)
    if design.identification != "subspace":
        pairs = pairs[:1]  # the others are for models of the whole field
    try:
        return study_orders(pairs, settings=design.method)
    except ValueError:  # too few steps to hold some out
        return None


def behaviours(data: ProblemData, field: int = MEAN_FIELD, noise_seed: int = 0) -> list[Behaviour]:
    """The shown seed's controllers, all from the initial field of this seed and with this noise."""
    policies, values, plant = data.policies, data.first.values, data.plant
    models = {name: run.models[data.shown] for name, run in data.runs.items()}
    used = [models.get(name, data.models[data.shown]) for name in policies]
    laws = laws_of(law_kind(values["law"], values), used, values["horizon"], measured_cost(values))
    law = LawBatch(laws, plant.target, ActionSet.of(values))
    count = len(policies)
    law.set(stacked([*policies.values()]), np.arange(count))
    starts, noise = np.full(count, field), np.full(count, noise_seed, dtype=np.int64)
    episode = rollout(plant, law.actions, starts, noise)
    costs, found = episode.costs, []
    for i, name in enumerate(policies):
        diverged = int(costs.diverged_step[i])
        states, actions = episode.fields[:, i], episode.applied[:, i]
        if diverged >= 0:
            states[diverged + 1 :], actions[diverged:] = np.nan, np.nan
        found.append(Behaviour(name, states, actions, float(costs.mean[i]), diverged))
    return found
