# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Measurement noise that the readings of a training show, whatever its optimiser made of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pdeloop.method.models.noise import contradicting_noise, rows_of, share_of_noise
from pdeloop.method.models.selection import PREDICTED
from tuner_node.training import Training

PREDICTS_NO_FIELD = ("sensed", "innovations")
"""Kinds of models whose `mismatch` is not the error of predicted whole states."""


def found_noise(history: Sequence[Mapping[str, Any]], seed: int) -> float:
    """The measurement noise that the optimiser of a seed found, and was not declared; 0: none."""
    found = [float(row["noise"]) for row in history if row["seed"] == seed and "noise" in row]
    return found[-1] if found else 0.0


def seeming_noise(training: Training, m: int) -> float:
    """The noise that the first rollouts of the m-th seed seem to have, or at most have.

    0 where it was found, does not contradict what was declared, or no rollouts are known. Noise cannot
    be predicted: where a model that was fitted for none predicts states better than noise of this size
    would allow, there is none.
    """
    settings, seed = training.settings, training.settings.all_seeds[m]
    known = [training.explorations[m], *training.further[m], *training.measured[m]]
    states = [own.states for own in known if own is not None]
    if not states or training.target is None or found_noise(training.history, seed):
        return 0.0
    if settings.sensors:  # the newest reading of each; earlier ones follow
        states = [z[:, : settings.sensors] for z in states]
    declared = settings.measurement_noise
    seeming = contradicting_noise(
        [row for z in states for row in rows_of(z, settings.shape)],
        declared,
    )
    if not declared and seeming and not settings.sensors:
        share = share_of_noise(seeming, states, training.target)
        errors = [
            row["mismatch"]
            for row in training.history
            if row["seed"] == seed and row.get("model") not in (None, *PREDICTS_NO_FIELD)
            if "mismatch" in row
        ]
        if min(errors, default=np.inf) < PREDICTED * share:
            return 0.0
    return seeming
