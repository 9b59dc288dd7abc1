"""What a report shows, gathered from the folder of a run or of a reproduction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller_node.policy import ProjectedLaw
from loop_interfaces import model_rows
from loop_interfaces.model_rows import ModelRows
from pde_sim_node.build import build_plant
from pde_sim_node.plant import DIVERGED_COST, MEAN_FIELD, Plant
from pdeloop.reference import Reference, find
from pdeloop.reproduce import experiment as reproduce
from pdeloop.rollout import rollout
from tuner_node.results import RunFolder, RunFolderError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Behaviour:
    """One controller from the mean initial field.

    t (T + 1,), states (T + 1, n_z), actions (T, n_a), cost: mean stage cost; diverged at this step,
    -1 if it did not.
    """

    controller: str
    t: Array
    states: Array
    actions: Array
    cost: float
    diverged: int


@dataclass(frozen=True)
class Curve:
    """A controller's cost while it learns, relative to the seed's LQT cost.

    rollouts (N,): how many a seed has used; relative (N, S); held: the cost stays until the next.
    """

    controller: str
    rollouts: Array
    relative: Array
    held: bool = False


@dataclass(frozen=True)
class Steps:
    """What became of the steps that one seed's optimiser tried, and of the models behind them.

    decided (N,): rollouts used when each was decided; accepted (N,) bool; relative (N,): cost of the
    candidate over the incumbent's, on the fields it ran on, NaN where one diverged; predicted (N,):
    the same as the quadratic model predicts it; damping (N,): lambda afterwards; proposed (P,),
    mismatch (P,): rollouts used when a step was proposed, and the error E of the best model then.
    """

    decided: Array
    accepted: NDArray[np.bool_]
    relative: Array
    predicted: Array
    damping: Array
    proposed: Array
    mismatch: Array


@dataclass(frozen=True)
class ProblemData:
    """A problem's part of a report.

    costs: (S, fields) by controller; curves; policies: by controller, of the shown seed; models: of
    all seeds, with the adapted policies; shown: the seed whose behaviour is shown; components: the
    names of the fields that a state consists of; steps: of the shown seed, where the optimiser
    judges its steps; reference: the limits, where they are known.
    """

    name: str
    values: Mapping[str, Any]
    costs: Mapping[str, Array]
    curves: list[Curve]
    curve_label: str
    policies: Mapping[str, Array]
    models: list[ModelRows]
    adapted: Mapping[str, Array]
    shown: int
    behaviours: list[Behaviour]
    x: Array
    target: Array
    components: tuple[str, ...]
    steps: Steps | None
    reference: Reference | None

    @property
    def seeds(self) -> int:
        return len(self.models)

    def share(self, controller: str) -> float | None:
        """(J_LQT - J)/(J_LQT - J_opt) of the means over the seeds, None where it is not known."""
        if self.reference is None:
            return None
        first = int(self.values["seed"])
        return self.reference.share(
            range(first, first + self.seeds), self.costs["lqt"], self.costs[controller]
        )


@dataclass(frozen=True)
class ReportData:
    """Everything a report shows."""

    title: str
    problems: list[ProblemData]
    versions: Mapping[str, str]
    rows: list[dict[str, Any]]


def gather(folder: Path, limits: Path | None = None) -> ReportData:
    """The content of a report of `folder`. RunFolderError when it holds nothing to report.

    limits: folder of what `python -m benchmarks optimum` saved; the shipped one if not given.
    """
    if (folder / reproduce.ASKED).exists():
        return _reproduction(folder, limits)
    if (folder / "parameters.yaml").exists():
        return _run(folder, limits)
    raise RunFolderError(f"{folder} holds neither a run nor a reproduction")


def _reproduction(folder: Path, limits: Path | None) -> ReportData:
    problems, rows = [], []
    for results in reproduce.load(folder):
        place = folder / results.problem
        lqt, zero = (_Trained(place / start) for start in ("lqt", "zero"))
        curves = [
            # Two rollouts an iteration: it is the paper's optimiser that is reproduced.
            Curve(name, 2 * np.arange(len(relative), dtype=np.float64), relative)
            for name, relative in results.curves.items()
        ]
        final = {"lqt_po": lqt.policies, "pure_po": zero.policies}
        ratio = results.curves["lqt_po"][-1]
        known = max(1, int(np.isfinite(ratio).sum()))
        shown = int(np.argsort(ratio, kind="stable")[(known - 1) // 2])  # the median seed
        label = "cost relative to LQT"
        problems.append(_problem(lqt, results.costs, curves, label, final, shown, limits))
        rows.append(results.row())
    return ReportData(
        title="Policy optimisation for PDE control with a warm start",
        problems=problems,
        versions=reproduce.asked(folder).get("versions", {}),
        rows=rows,
    )


def _run(folder: Path, limits: Path | None) -> ReportData:
    trained = _Trained(folder)
    result = trained.result
    name = "pure_po" if trained.values["start"] == "zero" else "lqt_po"
    costs = {
        own: np.array(result["costs_by_field"][theirs])
        for own, theirs in (("none", "none"), ("lqt", "lqt"), (name, "adapted"))
    }
    curve = _history(result, name, costs["lqt"].mean(axis=1))
    final = {name: trained.policies}
    label = "cost of the rollouts\nrelative to LQT"
    problem = _problem(
        trained, costs, [curve] if len(curve.rollouts) else [], label, final, 0, limits
    )
    return ReportData(
        title=f"Training of {problem.name}",
        problems=[problem],
        versions=result.get("versions", {}),
        rows=[],
    )


class _Trained:
    """A finished run folder."""

    def __init__(self, folder: Path) -> None:
        run = RunFolder(folder)
        self.values = run.values()
        arrays = run.policies()
        self.policies, self.warm = arrays["policy"], arrays["lqt"]
        self.models = [model_rows.unpack(rows, self.values["n_a"]) for rows in arrays["model"]]
        self.result = run.result()


def _problem(
    trained: _Trained,
    costs: Mapping[str, Array],
    curves: list[Curve],
    label: str,
    final: Mapping[str, Array],
    shown: int,
    limits: Path | None,
) -> ProblemData:
    plant = build_plant(trained.values)
    warm = trained.warm[shown]
    policies = {"none": np.zeros_like(warm), "lqt": warm}
    policies |= {name: own[shown] for name, own in final.items()}
    behaviours = _behaviours(plant, trained.models[shown], policies, trained.values["action_limit"])
    return ProblemData(
        name=str(trained.values["problem"]),
        values=trained.values,
        costs=costs,
        curves=curves,
        curve_label=label,
        policies=policies,
        models=trained.models,
        adapted=final,
        shown=shown,
        behaviours=behaviours,
        x=plant.x,
        target=plant.field_target,
        components=plant.equation.components,
        steps=_steps(trained.result["history"], int(trained.values["seed"]) + shown),
        reference=find(trained.values, behaviours[0].cost, limits),
    )


def _behaviours(
    plant: Plant, model: ModelRows, policies: Mapping[str, Array], action_limit: float
) -> list[Behaviour]:
    law = ProjectedLaw([model.U], plant.target, action_limit)
    law.set(np.stack(list(policies.values())))
    fields = np.full(len(policies), MEAN_FIELD)
    episode = rollout(plant, lambda k, states: law.actions(states), fields)
    t = plant.sample_time * np.arange(plant.horizon + 1, dtype=np.float64)
    return [
        Behaviour(
            name,
            t,
            episode.fields[:, i],
            episode.actions[:, i],
            float(episode.costs.mean[i]),
            int(episode.costs.diverged_step[i]),
        )
        for i, name in enumerate(policies)
    ]


def _history(result: Mapping[str, Any], controller: str, lqt: Array) -> Curve:
    """Costs of the optimiser's rows against the rollouts used; NaN where a rollout diverged."""
    first, seeds = int(result["seed"]), int(result["seeds"])
    rows = result["history"]
    used = np.array(sorted({int(row["rollouts"]) for row in rows}), dtype=np.float64)
    relative = np.full((len(used), seeds), np.nan)
    for s in range(seeds):
        own = [row for row in rows if int(row["seed"]) - first == s]
        if not own:
            continue
        costs = np.array([row.get("cost", np.nan) for row in own], dtype=np.float64)
        costs[~(costs < DIVERGED_COST)] = np.nan
        # Seeds may use their rollouts in unequal portions: a cost holds until the next row.
        last = np.searchsorted([row["rollouts"] for row in own], used, side="right") - 1
        relative[:, s] = np.where(last >= 0, costs[last], np.nan) / lqt[s]
    held = any("role" in row for row in rows)
    return Curve(controller, used, relative, held)


def _steps(history: Sequence[Mapping[str, Any]], seed: int) -> Steps | None:
    """The judged steps of one seed; None for an optimiser that does not judge them."""
    own = [row for row in history if int(row["seed"]) == seed]
    decided = [row for row in own if "accepted" in row and "damping" in row]
    proposed = [row for row in own if "mismatch" in row]
    if not decided or not proposed:
        return None

    def numbers(rows: Sequence[Mapping[str, Any]], name: str) -> Array:
        return np.array([row.get(name, np.nan) for row in rows], dtype=np.float64)

    used, made = numbers(decided, "rollouts"), numbers(proposed, "rollouts")
    # The step that was decided is the last one proposed before.
    last = np.searchsorted(made, used, side="left") - 1
    predicted = 1 - numbers(proposed, "predicted_fall") / numbers(proposed, "cost")
    return Steps(
        decided=used,
        accepted=np.array([bool(row["accepted"]) for row in decided]),
        relative=numbers(decided, "relative_cost"),
        predicted=np.where(last >= 0, predicted[last], np.nan),
        damping=numbers(decided, "damping"),
        proposed=made,
        mismatch=numbers(proposed, "mismatch"),
    )
