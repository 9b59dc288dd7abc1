# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Explorations in which the plant diverged, which are repeated with weaker inputs. Pure.

One rollout that diverges makes an exploration void: it is paid for, and repeated from other initial
fields with a quarter of the variance. No model is fitted to it: the states before a divergence are far
from those of a law, and models that predict both are worse for the law.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from pdeloop.messages.topics import COMPLETED, CostColumn
from tuner_node.batch import BatchResult, TrainingSettings

WEAKER = 0.25
"""Factor of the variance from one exploration to the next."""
MOST = 3
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
        shorter = f"set a horizon of {min(steps)} steps or fewer, " if min(steps) else ""
        return (
            f"{told}weaker inputs did not delay it: if the plant diverges without control "
            f"(`pdeloop check` shows this), {shorter}raise divergence_bound, or begin nearer to "
            "the target; otherwise lower exploration_variance further"
        )
    noise = ", or measurement_noise, which raises it" if settings.measurement_noise else ""
    return (
        f"{told}lower exploration_variance{noise}, or shorten the horizon if the plant also "
        "diverges without control"
    )
