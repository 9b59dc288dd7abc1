"""A training from resolved parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.parameters import noisy
from tuner_node.optimizers import NEED_TRAJECTORIES, OPTIMIZERS, Context, Optimizer
from tuner_node.training import UNKNOWN_PLANT, Training, TrainingSettings


def build_training(values: Mapping[str, Any]) -> Training:
    """The training that the tuner's and the problem's parameters describe."""
    from_zero = values["start"] == "zero"
    rate = values["learning_rate_from_zero" if from_zero else "learning_rate"]

    options: dict[str, Any] = {}
    if values["optimizer"] == "directions":
        most = min(values["iterations"], 2 * values["n_a"] * values["reduced_order"])
        if values["directions"] > most:
            raise ValueError(
                f"parameter 'directions' is {values['directions']}; expected at most {most}, as "
                "many as there are iterations and entries of the policy"
            )
        options["directions"] = values["directions"]

    def make_optimizer(
        policy: NDArray[np.float64], seed: int, context: Context | None
    ) -> Optimizer:
        return OPTIMIZERS[values["optimizer"]](
            policy,
            seed=seed,
            iterations=values["iterations"],
            learning_rate=rate,
            smoothing_radius=values["smoothing_radius"],
            context=context,
            **options,
        )

    settings = TrainingSettings(
        n_a=values["n_a"],
        seed=values["seed"],
        seeds=values["seeds"],
        evaluation_fields=values["evaluation_fields"],
        evaluation_seed=values["evaluation_seed"],
        start=values["start"],
        exploration_variance=values["exploration_variance"],
        identification_attempts=values["identification_attempts"],
        state_weight=values["state_weight"],
        action_weight=values["action_weight"],
        trajectories=values["optimizer"] in NEED_TRAJECTORIES,
        noise=noisy(values),
        action_limit=values["action_limit"],
    )
    return Training(settings, make_optimizer, plant=values["plant"] or UNKNOWN_PLANT)
