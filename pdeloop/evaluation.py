"""`pdeloop evaluate`: the cost of a run's policies on sampled fields or the mean field."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from loop_interfaces.parameters import noisy, table
from loop_interfaces.spec import check
from loop_interfaces.topics import CostColumn
from pde_sim_node.plant import DIVERGED_COST
from pdeloop.in_process import LocalPair
from tuner_node.batch import Batch
from tuner_node.noise import evaluation_noise
from tuner_node.results import RunFolder, RunFolderError
from tuner_node.seeds import Purpose, derive
from tuner_node.training import CONTROLLERS


def evaluate(folder: Path, *, fields: int, seed: int, mean_field: bool) -> dict[str, Any]:
    """Costs of no control, LQT and the adapted policy of the run in `folder`.

    fields, seed: how many initial fields are drawn, from which seed; mean_field: use the mean of the
    initial distribution instead. Returns {controller: (training seeds, fields) nested lists}.
    """
    given = RunFolder(folder).parameters()
    values = {**given, **check(table(), given)}
    path = folder / "policy.npz"
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            policies, warm, models = arrays["policy"], arrays["lqt"], arrays["model"]
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise RunFolderError(
            f"{path} cannot be read; is the run finished? "
            f"(continue it with: pdeloop train --resume {folder})"
        ) from error
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
    pair = LocalPair(values)
    pair.use_models(models)
    result = pair.run(Batch(np.array(rows, dtype=np.float64), np.stack(gains)))
    costs = result.costs[:, CostColumn.MEAN].reshape(len(policies), 3, len(field_seeds))
    return {name: costs[:, i].tolist() for i, name in enumerate(CONTROLLERS)}


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
