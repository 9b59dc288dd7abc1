# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The beginning of a training, which every method has and pays for: exploration, model, check."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from pdeloop.in_process import LocalPair
from pdeloop.messages.spec import OPTIMIZER_SETTINGS
from tuner_node.build import build_training
from tuner_node.training import Training


def warm_start(
    values: Mapping[str, Any], pair: LocalPair, optimizer: str = "two_point"
) -> Training:
    """A training of one seed that is about to adapt, with the trajectories that it has measured.

    Parameters
    ----------
    values
        Resolved parameters.
    pair
        Runs the rollouts, and has the training's model afterwards.
    optimizer
        Says how many explorations there are, and whether the first law is checked.

    Returns
    -------
    Training
        `starts()[0]` is the law it begins with, `models[0]` the reduced model, `explorations[0]` and
        `measured[0]` are trajectories, and `budget.paid[0]` is what they cost.
    """
    # The settings of another optimizer are none of this one's.
    own = {k: v for k, v in values.items() if not k.startswith(OPTIMIZER_SETTINGS)}
    own = dict(values) if values["optimizer"] == optimizer else own
    training = build_training({**own, "optimizer": optimizer, "seeds": 1})
    training.settings = replace(training.settings, trajectories=True)
    while training.phase in ("identify", "check"):
        batch = training.next_batch()
        assert batch is not None
        training.finish(pair.run(batch))
        pair.follow(training)
    return training
