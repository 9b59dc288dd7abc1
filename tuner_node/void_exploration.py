# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Explorations in which the plant diverged, which are repeated with weaker inputs. Pure.

One rollout that diverges makes an exploration void: it is paid for, and repeated from other initial
fields with a quarter of the variance. No model is fitted to it: the states before a divergence are far
from those of a law, and models that predict both are worse for the law.
"""

from collections.abc import Sequence

from loop_interfaces.topics import COMPLETED, CostColumn
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


def no_model(settings: TrainingSettings, void: int, step: int, *, paid_up: bool) -> str:
    """Why a training ends with a void exploration. paid_up: its budget allows no other."""
    noise = ", or measurement_noise, which raises it" if settings.measurement_noise else ""
    times = "" if void == 1 else f" {void} times, last"
    budget = "no rollouts are left for another exploration; " if paid_up else ""
    return (
        f"no reduced model: the plant diverged under exploration{times} at step {step} with inputs "
        f"of variance {variance(settings, void - 1):.3g}; {budget}lower exploration_variance{noise}, "
        "or shorten the horizon where the plant diverges without control too"
    )
