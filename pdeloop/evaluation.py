# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop evaluate`: the cost of a run's policies on sampled fields or the mean field."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pde_sim_node.build import SUPPLIED, build_plant, complete
from pde_sim_node.plant import DIVERGED_COST
from pde_sim_node.plants.dynamics_plant import SETTABLE
from pdeloop.finished_run import FinishedRun
from pdeloop.in_process import LocalPair
from pdeloop.messages.arrays import Array
from pdeloop.messages.model_rows import pack
from pdeloop.messages.parameters import EVALUATION, noisy
from pdeloop.messages.spec import ParameterError
from pdeloop.messages.topics import CostColumn
from pdeloop.method.seeds import Purpose, derive, evaluation_noise
from pdeloop.output import aligned
from tuner_node.batch import Batch, stacked
from tuner_node.rollouts import EVALUATED
from tuner_node.run_folder import RunFolderError

_UNCHANGED: Mapping[str, Any] = {}
EVALUATES = EVALUATION - {"equation", "plant", "grid", "evaluation_fields", "evaluation_seed"}
"""The parameters of the plant and the cost, by name."""
ROUNDED = 0.1
"""Relative difference of a mean cost that other rounding may explain where the field is chaotic."""
SAME = 1e-6
"""The same for each single cost where the plant's fingerprint is another one than the run's."""


def evaluate(
    run: FinishedRun,
    *,
    fields: int,
    seed: int,
    mean_field: bool = False,
    changes: Mapping[str, Any] = _UNCHANGED,
) -> dict[str, Array]:
    """Costs of no control, LQT and the adapted policy of a run, with the built-in plant and law.

    The fields are drawn from the seed, or it is the mean one of their distribution. changes:
    parameters of the plant or the cost that differ from those of the run, whose policies stay.
    Returns mean stage costs (training seeds, fields) by controller. ValueError where the run had
    another plant or law, its equation is code that is not allowed, or its policies do not fit the
    changed plant.
    """
    build_plant(run.values)  # refuses code that the user has not named
    if reason := another_loop(run):
        raise RunFolderError(f"{reason}, so its policies cannot be evaluated here")
    seeds = len(run.policies)
    if changes:
        run = changed(run, changes)
    return _costs(run, _pair(run), seeds, fields=fields, seed=seed, mean_field=mean_field)


def changed(run: FinishedRun, changes: Mapping[str, Any]) -> FinishedRun:
    """A run's policies with another plant or cost. ParameterError for what would change neither."""
    for name in changes:
        if name not in EVALUATES and not name.startswith("physical."):
            raise ParameterError(
                f"parameter '{name}' has no effect on trained policies; expected a parameter of "
                "the plant or the cost, such as horizon, state_weight or physical.*"
            )
    values = {**run.values, **changes}
    if values["plant"]:  # which supplies the rest itself, from its changed arguments
        own = {n: v for n, v in run.values.items() if n not in (*SUPPLIED, *SETTABLE)}
        before, _ = complete(own, compiled=False)
        supplied = {n for n in SETTABLE if run.values[n] == getattr(before, n)}.union(SUPPLIED)
        values = {n: v for n, v in values.items() if n in changes or n not in supplied}
        plant, values = complete(values, compiled=False)
    else:
        plant = build_plant(values, compiled=False)
    size, n_a = len(run.models[0].U), run.models[0].B.shape[1]
    if (plant.state_size, plant.n_a) != (size, n_a):
        raise ParameterError(
            f"the policies are for a state of {size} numbers and {n_a} actuators, but the changed "
            f"plant has {plant.state_size} and {plant.n_a}"
        )
    there = replace(run, values=values)
    if (shape := there.laws[0].shape) != run.warm.shape[1:]:
        raise ParameterError(
            f"the law '{values['law']}' has parameters of shape {shape} for the changed plant, but "
            f"those of the run have shape {run.warm.shape[1:]}"
        )
    return there


def another_loop(run: FinishedRun) -> str:
    """Why a run's costs are not those of the built-in plant and law, in words; empty if they are.

    The closing evaluation is computed again for that, for its first seed. A plant of the run's
    fingerprint may round otherwise on another machine; any other plant must give the same costs.
    """
    try:
        pair = _pair(run)
    except ValueError as error:
        return f"the plant of the run was not the built-in one ({error})"
    count, seed = run.costs["none"].shape[1], int(run.values["evaluation_seed"])
    here = _costs(run, pair, 1, fields=count, seed=seed)
    same_plant = run.result.get("plant") == pair.fingerprint
    nodes = ", ".join(run.result.get("controller", {}).get("nodes", ()))
    for name, what, law in (
        ("none", "plant", "no control"),
        ("lqt", "control law", "the LQT law"),
        ("adapted", "control law", "the adapted policy"),
    ):
        there, own = run.costs[name][0], here[name][0]
        if not _agree(there, own, same_plant=same_plant):
            whose = f" (its controller: {nodes})" if nodes and name != "none" else ""
            if name == "none" and not same_plant:
                whose = " (with another fingerprint)"
            return (
                f"the {what} of the run was not the built-in one{whose}: {law} cost {_text(there)} "
                f"in the closing evaluation, but {_text(own)} here"
            )
    return ""


def mean_costs(
    pair: LocalPair,
    values: Mapping[str, Any],
    policies: Array,
    models: Sequence[int] | NDArray[np.intp],
    *,
    fields: int,
    seed: int,
    mean_field: bool = False,
) -> Array:
    """Mean stage costs (N, fields) of policies (N, *shape), each on the model of its index.

    The fields are those of a closing evaluation with this seed, or the mean field alone. Each has a
    noise of its own, the same for all policies.
    """
    starts = (
        [-1] if mean_field else [derive(seed, Purpose.EVALUATION_FIELD, i) for i in range(fields)]
    )
    noise = evaluation_noise(seed, len(starts)) if noisy(values) else []
    rows = [
        (start, -1, 0, model, *noise[i : i + 1])
        for model in models
        for i, start in enumerate(starts)
    ]
    batch = Batch(np.array(rows, dtype=np.float64), np.repeat(policies, len(starts), axis=0))
    result = pair.run(batch, values["max_batch"])
    return result.costs[:, CostColumn.MEAN].reshape(len(policies), len(starts))


def _costs(run: FinishedRun, pair: LocalPair, seeds: int, **fields: Any) -> dict[str, Array]:
    """Costs (seeds, fields) of the first training seeds; fields: as for `mean_costs`."""
    warm, adapted = run.warm[:seeds], run.policies[:seeds]
    laws = dict(zip(EVALUATED, (np.zeros_like(warm), warm, adapted), strict=True))
    policies = stacked([own for law in laws.values() for own in law])
    models = np.tile(np.arange(seeds), len(laws))
    costs = mean_costs(pair, run.values, policies, models, **fields)
    return dict(zip(laws, np.split(costs, len(laws)), strict=True))


def _pair(run: FinishedRun) -> LocalPair:
    """The built-in plant and law with a run's models; ValueError if they do not fit."""
    pair = LocalPair(run.values)
    pair.use_models(np.stack([pack(model) for model in run.models]))
    return pair


def _agree(there: Array, here: Array, *, same_plant: bool) -> bool:
    lost = [np.isnan(costs) | (costs >= DIVERGED_COST) for costs in (there, here)]
    if (lost[0] != lost[1]).any():
        return False
    there, here = there[~lost[0]], here[~lost[0]]
    if not same_plant:
        return np.allclose(there, here, rtol=SAME, atol=0.0)
    a, b = there.sum(), here.sum()
    return bool(abs(a - b) <= ROUNDED * max(abs(a), abs(b)))


def _text(costs: Array) -> str:
    return "diverged" if (costs >= DIVERGED_COST).any() else f"{costs.mean():.4g}"


def outcome(costs: Mapping[str, Array], first: int) -> dict[str, Any]:
    """The entries of a result.json by which a training is judged (`narration.warnings`, `failed`).

    first: the seed of the first row.
    """
    return {
        "costs": {name: table.mean(axis=1).tolist() for name, table in costs.items()},
        "diverged": {name: int((table >= DIVERGED_COST).sum()) for name, table in costs.items()},
        "evaluation_rollouts": costs["none"].size,
        "seed": first,
        "seeds": len(costs["none"]),
    }


def as_text(costs: Mapping[str, Array]) -> str:
    """The costs as text: mean and standard deviation over fields and seeds."""
    rows = [["controller", "mean cost", "std", "best", "worst", "diverged"]]
    for name, table in costs.items():
        good = table[table < DIVERGED_COST]
        statistics = (np.mean, np.std, np.min, np.max)
        shown = [f"{statistic(good):.5g}" if len(good) else "-" for statistic in statistics]
        rows.append([name, *shown, str(table.size - good.size)])
    return "\n".join(aligned(rows))
