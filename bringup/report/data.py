"""What a report shows, gathered from the folder of a run or of a reproduction."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bringup.reproduce import experiment as reproduce
from controller_node.policy import ProjectedLaw
from loop_interfaces import model_rows
from loop_interfaces.model_rows import ModelRows
from loop_interfaces.parameters import check, table
from pde_sim_node.build import build_plant
from pde_sim_node.plant import DIVERGED_COST, MEAN_FIELD, Plant
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
    """A controller's cost while it learns: (iterations, S), relative to the seed's LQT cost."""

    controller: str
    iterations: Array
    relative: Array


@dataclass(frozen=True)
class ProblemData:
    """A problem's part of a report.

    costs: (S, fields) by controller; curves; policies: by controller, of the shown seed; models: of
    all seeds, with the adapted policies; shown: the seed whose behaviour is shown; components: the
    names of the fields that a state consists of.
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

    @property
    def seeds(self) -> int:
        return len(self.models)


@dataclass(frozen=True)
class ReportData:
    """Everything a report shows."""

    title: str
    problems: list[ProblemData]
    versions: Mapping[str, str]
    rows: list[dict[str, Any]]


def gather(folder: Path) -> ReportData:
    """The content of a report of `folder`. RunFolderError when it holds nothing to report."""
    if (folder / reproduce.ASKED).exists():
        return _reproduction(folder)
    if (folder / "parameters.yaml").exists():
        return _run(folder)
    raise RunFolderError(f"{folder} holds neither a run nor a reproduction")


def _reproduction(folder: Path) -> ReportData:
    problems, rows = [], []
    for results in reproduce.load(folder):
        place = folder / results.problem
        lqt, zero = (_Trained(place / start) for start in ("lqt", "zero"))
        curves = [
            Curve(name, np.arange(len(relative), dtype=np.float64), relative)
            for name, relative in results.curves.items()
        ]
        final = {"lqt_po": lqt.policies, "pure_po": zero.policies}
        ratio = results.curves["lqt_po"][-1]
        known = max(1, int(np.isfinite(ratio).sum()))
        shown = int(np.argsort(ratio, kind="stable")[(known - 1) // 2])  # the median seed
        label = "cost relative to LQT"
        problems.append(_problem(lqt, results.costs, curves, label, final, shown))
        rows.append(results.row())
    return ReportData(
        title="Policy optimisation for PDE control with a warm start",
        problems=problems,
        versions=reproduce.asked(folder).get("versions", {}),
        rows=rows,
    )


def _run(folder: Path) -> ReportData:
    trained = _Trained(folder)
    result = trained.result
    name = "pure_po" if trained.values["start"] == "zero" else "lqt_po"
    costs = {
        own: np.array(result["costs_by_field"][theirs])
        for own, theirs in (("none", "none"), ("lqt", "lqt"), (name, "adapted"))
    }
    relative = _history(result, costs["lqt"].mean(axis=1))
    curve = Curve(name, np.arange(1, len(relative) + 1, dtype=np.float64), relative)
    final = {name: trained.policies}
    label = "cost of the rollouts\nrelative to LQT"
    problem = _problem(trained, costs, [curve] if len(relative) else [], label, final, 0)
    return ReportData(
        title=f"Training of {problem.name}",
        problems=[problem],
        versions=result.get("versions", {}),
        rows=[],
    )


class _Trained:
    """A finished run folder."""

    def __init__(self, folder: Path) -> None:
        self.values = {**check(table(), {}), **RunFolder(folder).parameters()}
        try:
            with np.load(folder / "policy.npz", allow_pickle=False) as arrays:
                self.policies, self.warm = arrays["policy"], arrays["lqt"]
                self.models = [model_rows.unpack(m, self.values["n_a"]) for m in arrays["model"]]
            self.result: dict[str, Any] = json.loads((folder / "result.json").read_text())
        except (OSError, ValueError, KeyError) as error:
            raise RunFolderError(
                f"{folder} cannot be reported; is the run finished? ({error})"
            ) from error


def _problem(
    trained: _Trained,
    costs: Mapping[str, Array],
    curves: list[Curve],
    label: str,
    final: Mapping[str, Array],
    shown: int,
) -> ProblemData:
    plant = build_plant(trained.values)
    warm = trained.warm[shown]
    policies = {"none": np.zeros_like(warm), "lqt": warm}
    policies |= {name: own[shown] for name, own in final.items()}
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
        behaviours=_behaviours(
            plant, trained.models[shown], policies, trained.values["action_limit"]
        ),
        x=plant.x,
        target=plant.field_target,
        components=plant.equation.components,
    )


def _behaviours(
    plant: Plant, model: ModelRows, policies: Mapping[str, Array], action_limit: float
) -> list[Behaviour]:
    law = ProjectedLaw([model.U], plant.target, action_limit)
    law.set(np.stack(list(policies.values())))
    published = plant.reset(np.full(len(policies), MEAN_FIELD))
    states, actions = [plant.states.copy()], []  # the fields, whatever is measured of them
    for _ in range(plant.horizon):
        actions.append(law.actions(published).copy())
        published = plant.step(actions[-1])
        states.append(plant.states.copy())
    costs = plant.episode_costs()
    t = plant.sample_time * np.arange(plant.horizon + 1, dtype=np.float64)
    field, action = np.stack(states), np.stack(actions)
    return [
        Behaviour(
            name,
            t,
            field[:, i],
            action[:, i],
            float(costs.mean[i]),
            int(costs.diverged_step[i]),
        )
        for i, name in enumerate(policies)
    ]


def _history(result: Mapping[str, Any], lqt: Array) -> Array:
    """Costs of the iterations' rollouts (iterations, S) relative to LQT; NaN where one diverged."""
    first, seeds = int(result["seed"]), int(result["seeds"])
    count = max((int(row["iteration"]) for row in result["history"]), default=0)
    relative = np.full((count, seeds), np.nan)
    for row in result["history"]:
        cost = row.get("cost")
        if cost is not None and cost < DIVERGED_COST:
            s = int(row["seed"]) - first
            relative[int(row["iteration"]) - 1, s] = float(cost) / lqt[s]
    return relative
