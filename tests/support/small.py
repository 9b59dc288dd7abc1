# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The small problem of the tests: its parameters, and a training of it in this process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pdeloop.in_process import LocalPair, train
from pdeloop.method.adapt import ModelBased
from pdeloop.method.adapt.registry import OWN_OPTIMIZERS
from pdeloop.training_run import resolve
from tuner_node.build import build_training
from tuner_node.dispatch import Dispatcher
from tuner_node.training import Training

_OWN = ("law", "optimizer", "seed", "seeds", "rollouts", "iterations", "start")

SMALL = Path(__file__).parents[1] / "data" / "small.yaml"
REPRODUCED = (str(SMALL), "--seeds", "2", "--iterations", "8")
"""What a small reproduction is asked for."""
RECORDED = {"iterations": "6", "seeds": "2"}
"""What the small recorded run is asked for."""
FEW_FITS = {"field_model_settings.folds": 2, "field_model_settings.largest_degree": 2}
"""For trainings whose model does not matter: fits of all kinds would be most of their time."""
FEW_STEPS = {"optimizer_settings.iterations": 3, "optimizer_settings.mixtures": 2, **FEW_FITS}
"""For trainings by `model_based` whose law does not matter either."""
CHECKED = "tests.support.small:Checked"


class Checked(ModelBased):
    """`model_based` for a first law that the training checks, as it does for most optimisers."""

    name = "checked"
    judges_first_law = False
    explorations = 1


OWN_OPTIMIZERS.allow(CHECKED)


def paced(folder: Path, factor: float) -> Path:
    """A file of the small problem in real time: its nodes wait most of the time.

    factor: simulated seconds per second. An episode lasts 1.5 s.
    """
    path = folder / f"paced-{factor:g}.yaml"
    path.write_text(f"{SMALL.read_text()}    real_time_factor: {factor}\n")
    return path


def parameters(**options: Any) -> dict[str, Any]:
    """The resolved parameters of a training of the small problem; any of them can be replaced."""
    tuner = {k: v for k, v in options.items() if k in _OWN}
    return {**resolve(str(SMALL), tuner), **options}


def train_here(values: dict[str, Any], **how: Any) -> Training:
    """A finished training in this process."""
    training = build_training(values)
    train(training, LocalPair(values), lambda row: None, **how)
    return training


def dispatcher_of(**settings: Any) -> Dispatcher:
    """A dispatcher of one pair with two actuators, which has not been seen yet, unless said so."""
    ids = {"run": 7, "n_a": 2, "pairs": 1, "incarnation": 0}
    limits = {"max_batch": 3, "episode_timeout": 10.0, "max_attempts": 3}
    return Dispatcher(**(ids | limits | settings))


def same_bits(a: np.ndarray, b: np.ndarray) -> bool:
    """True if two float64 arrays agree in shape and in every bit."""
    return a.shape == b.shape and a.tobytes() == b.tobytes()
