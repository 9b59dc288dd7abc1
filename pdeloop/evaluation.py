"""`pdeloop evaluate`: the cost of a run's policies on sampled fields or the mean field."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.parameters import noisy
from loop_interfaces.topics import CostColumn
from pde_sim_node.build import fingerprint
from pde_sim_node.plant import DIVERGED_COST
from pdeloop.in_process import LocalPair
from tuner_node.batch import Batch
from tuner_node.results import RunFolder, RunFolderError
from tuner_node.seeds import Purpose, derive, evaluation_noise
from tuner_node.training import CONTROLLERS

Array = NDArray[np.float64]
AGREE = 0.1
"""Relative difference of a mean cost that other rounding may explain where the field is chaotic."""


def evaluate(folder: Path, *, fields: int, seed: int, mean_field: bool) -> dict[str, Any]:
    """Costs of no control, LQT and the adapted policy of the run in `folder`.

    The built-in plant and law compute them. A run that had others is refused with a RunFolderError:
    its closing evaluation is computed again for that, for its first seed.

    fields, seed: how many initial fields are drawn, from which seed; mean_field: use the mean of the
    initial distribution instead. Returns {controller: (training seeds, fields) nested lists}.
    """
    values = RunFolder(folder).values()
    arrays = RunFolder(folder).policies()
    policies, warm, models = arrays["policy"], arrays["lqt"], arrays["model"]
    pair = LocalPair(values)
    try:
        pair.use_models(models)
    except ValueError as error:
        raise RunFolderError(
            f"the run in {folder} had another plant than the built-in one, so its policies cannot be "
            f"evaluated here: {error}"
        ) from error
    _refuse_another_loop(folder, values, pair, policies[:1], warm[:1])
    costs = _costs(pair, values, policies, warm, fields, seed, mean_field)
    return {name: costs[:, i].tolist() for i, name in enumerate(CONTROLLERS)}


def another_plant(values: Mapping[str, Any], result: Mapping[str, Any]) -> str:
    """That a run's plant has another fingerprint than the built-in one, in words; empty: it has not.

    values: of the run's parameters; result: the content of its result.json. The fingerprint covers the
    source of the equation, so a plant with another one may still compute the same costs.
    """
    own = fingerprint(values)
    if result.get("plant", own) == own:
        return ""
    return (
        f"the run's plant has the fingerprint {result['plant']}, the built-in one {own}: its "
        "parameters or the source of its equation are others"
    )


def _costs(
    pair: LocalPair,
    values: Mapping[str, Any],
    policies: Array,
    warm: Array,
    fields: int,
    seed: int,
    mean_field: bool = False,
) -> Array:
    """Mean stage costs (S, controllers, fields)."""
    field_seeds = (
        [-1] if mean_field else [derive(seed, Purpose.EVALUATION_FIELD, i) for i in range(fields)]
    )
    # A noise of its own for every field, the same for all controllers.
    noise = evaluation_noise(seed, len(field_seeds)) if noisy(values) else []
    rows, gains = [], []
    for m in range(len(policies)):
        for policy in (np.zeros_like(warm[m]), warm[m], policies[m]):
            for i, field_seed in enumerate(field_seeds):
                rows.append((field_seed, -1, 0, m, *noise[i : i + 1]))
                gains.append(policy)
    result = pair.run(Batch(np.array(rows, dtype=np.float64), np.stack(gains)))
    shape = len(policies), len(CONTROLLERS), len(field_seeds)
    costs: Array = result.costs[:, CostColumn.MEAN].reshape(shape)
    return costs


def _refuse_another_loop(
    folder: Path, values: Mapping[str, Any], pair: LocalPair, policies: Array, warm: Array
) -> None:
    """RunFolderError if the run's costs are not those of the built-in plant and law."""
    result = RunFolder(folder).result()
    there = [np.array(result["costs_by_field"][name][0], dtype=float) for name in CONTROLLERS]
    seed = int(values["evaluation_seed"])
    (own,) = _costs(pair, values, policies, warm, len(there[0]), seed)
    differs = [not _agree(*both) for both in zip(there, own, strict=True)]
    if not any(differs):
        return
    number = differs.index(True)
    what = ("plant", "control law", "control law")[number]
    controller = ("no control", "the LQT law", "the adapted policy")[number]
    nodes = ", ".join(result.get("controller", {}).get("nodes", ())) if number else ""
    raise RunFolderError(
        f"the run in {folder} had another {what} than the built-in one"
        + (f" (its controller: {nodes})" if nodes else "")
        + f", so its policies cannot be evaluated here: {controller} cost "
        f"{_text(there[number])} in its closing evaluation, and {_text(own[number])} here"
    )


def _agree(there: Array, here: Array) -> bool:
    lost = [np.isnan(costs) | (costs >= DIVERGED_COST) for costs in (there, here)]
    if (lost[0] != lost[1]).any():
        return False
    good = ~lost[0]
    a, b = there[good].sum(), here[good].sum()
    return bool(abs(a - b) <= AGREE * max(abs(a), abs(b)))


def _text(costs: Array) -> str:
    return "diverged" if (costs >= DIVERGED_COST).any() else f"{costs.mean():.4g}"


def all_diverged(costs: Mapping[str, Sequence[Sequence[float]]]) -> list[str]:
    """The controllers of which no rollout came to its end."""
    return [name for name, rows in costs.items() if (np.array(rows) >= DIVERGED_COST).all()]


def as_text(costs: dict[str, Any]) -> str:
    """The costs as text: mean and standard deviation over fields and seeds."""
    lines = [
        f"{'controller':<12}{'mean cost':>12}{'std':>12}{'best':>12}{'worst':>12}{'diverged':>10}"
    ]
    for name, values in costs.items():
        flat = np.array(values).ravel()
        diverged = int((flat >= DIVERGED_COST).sum())
        good = flat[flat < DIVERGED_COST]
        shown = [f"{f(good):12.5g}" if len(good) else f"{'-':>12}" for f in _STATISTICS]
        lines.append(f"{name:<12}{''.join(shown)}{diverged:>10}")
    return "\n".join(lines)


_STATISTICS = (np.mean, np.std, np.min, np.max)
