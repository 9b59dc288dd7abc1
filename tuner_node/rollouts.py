# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The rollouts of a training's phases other than those of its optimisers. Pure.

All of them are functions of the training's seeds and of how often a seed has explored. One rollout
that diverges makes an exploration void: it is paid for, and repeated from other initial fields with a
quarter of the variance. No model is fitted to it: the states before a divergence are far from those of
a law, and models that predict both are worse for the law.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.messages.topics import COMPLETED, CostColumn, StartColumn
from pdeloop.method.adapt import Rollout
from pdeloop.method.seeds import Purpose, derive, evaluation_noise
from tuner_node.batch import BatchResult, TrainingSettings

CHECK = 2
"""Rollouts of a check: no control and the warm start, on one sampled field."""
EVALUATED = ("none", "lqt", "adapted")
"""The controllers of the closing evaluation, in the order of its rows."""
NOISE = {
    "identify": Purpose.EXPLORATORY_NOISE,
    "check": Purpose.CHECK_NOISE,
    "adapt": Purpose.ADAPT_NOISE,
}
"""Purpose of the noise seeds in the phases where each rollout has its own noise."""


def explorations(
    settings: TrainingSettings, pending: Sequence[int], attempts: Sequence[int], void: Sequence[int]
) -> Array:
    """The rows of `episode/start` of the explorations of each of the m pending seeds, (m E, 4).

    pending: their indices; attempts, void: how often each of all seeds has explored before, with a
    model and because the plant diverged.
    """
    E = settings.explorations
    rows = [
        (
            derive(settings.all_seeds[m], Purpose.EXPLORATORY_FIELD, number),
            derive(settings.all_seeds[m], Purpose.EXCITATION, number),
            variance(settings, void[m]),
            m,
        )
        for m in pending
        for number in range(E * (attempts[m] + void[m]), E * (attempts[m] + void[m] + 1))
    ]
    return np.array(rows, dtype=np.float64)


def checks(
    settings: TrainingSettings, pending: Sequence[int], warm: Array
) -> list[tuple[int, Rollout]]:
    """No control and the warm start of each pending seed on the same field.

    warm (S, *shape): the warm starts of all seeds. Each rollout comes with the index of its seed.
    """
    return [
        (m, Rollout(policy, derive(settings.all_seeds[m], Purpose.CHECK_FIELD)))
        for m in pending
        for policy in (np.zeros_like(warm[m]), warm[m])
    ]


def evaluations(
    settings: TrainingSettings, warm: Array, adapted: Array
) -> list[tuple[int, Rollout]]:
    """The controllers of EVALUATED for every seed on the fields of the evaluation.

    warm, adapted (S, *shape): the policies. Each rollout comes with the index of its seed.
    """
    fields = [
        derive(settings.evaluation_seed, Purpose.EVALUATION_FIELD, i)
        for i in range(settings.evaluation_fields)
    ]
    return [
        (m, Rollout(policy, field_seed))
        for m in range(settings.seeds)
        for policy in (np.zeros_like(warm[m]), warm[m], adapted[m])
        for field_seed in fields
    ]


def noise_seeds(
    settings: TrainingSettings, phase: str, rows: Array, counts: Sequence[int], again: Sequence[int]
) -> list[int]:
    """The seed of the noise of every row (R, 4) of a batch of that phase.

    counts: for every training a number that is never the same again in the phase, its attempts or how
    many batches its optimiser has had. In the evaluation all controllers share the noise, and the
    first rollouts of the trainings `again` have theirs once more.
    """
    if phase == "evaluate":
        fields = evaluation_noise(settings.evaluation_seed, settings.evaluation_fields)
        first = [derive(settings.all_seeds[m], NOISE["adapt"], 0) for m in again]
        return first + fields * (settings.seeds * len(EVALUATED))
    rows_of: Counter[int] = Counter()
    noise = []
    for m in rows[:, StartColumn.MODEL].astype(int).tolist():
        index = (counts[m] << 32) + rows_of[m]
        noise.append(derive(settings.all_seeds[m], NOISE[phase], index))
        rows_of[m] += 1
    return noise


WEAKER = 0.25
"""Factor of the variance from one exploration to the next."""
MOST_VOID = 3
"""Repetitions of a seed, at most."""


def variance(settings: TrainingSettings, void: int) -> float:
    """Variance of the inputs after that many void explorations."""
    return settings.exploration_variance * WEAKER**void


def diverged_steps(result: BatchResult, pending: Sequence[int], together: int) -> dict[int, int]:
    """Of each pending seed whose exploration diverged, the step at which its first rollout did."""
    ended = result.costs[:, CostColumn.ENDED].reshape(len(pending), together)
    return {
        m: int(own[own != COMPLETED].min())
        for m, own in zip(pending, ended, strict=True)
        if (own != COMPLETED).any()
    }


def steps_before(history: Sequence[Mapping[str, Any]], seed: int) -> list[int]:
    """The steps at which the plant diverged under the explorations of a seed so far."""
    return [
        row["step"] for row in history if row.get("event") == "diverged" and row["seed"] == seed
    ]


def no_model(settings: TrainingSettings, steps: Sequence[int], *, paid_up: bool) -> str:
    """Why a training ends with a void exploration.

    steps: those at which the plant diverged, exploration by exploration; paid_up: the budget allows no
    other.
    """
    times = "" if len(steps) == 1 else f" {len(steps)} times, last"
    told = (
        f"no reduced model: the plant diverged under exploration{times} at step {steps[-1]} with "
        f"inputs of variance {variance(settings, len(steps) - 1):.3g}; "
    )
    told += "no rollouts are left for another exploration; " if paid_up else ""
    if len(steps) > 1 and steps[-1] <= steps[0]:
        shorter = f"set a horizon of {min(steps)} steps or fewer, "
        if not any(steps):
            shorter = "see that step returns finite numbers, "
        elif not min(steps):
            shorter = ""
        return (
            f"{told}weaker inputs did not delay it: if the plant diverges without control "
            f"(`pdeloop check` shows this), {shorter}raise divergence_bound, or begin nearer to "
            "the target; otherwise lower exploration_variance further"
        )
    noise = ", or measurement_noise, which raises it" if settings.measurement_noise else ""
    return (
        f"{told}lower exploration_variance{noise}, raise divergence_bound if states beyond it are no "
        "failure, or shorten the horizon if the plant also diverges without control"
    )
