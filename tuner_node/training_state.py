# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The state of a training as the arrays of a checkpoint, and back."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages import model_rows
from pdeloop.messages.array_files import checked_array
from pdeloop.messages.documents import parse_json
from pdeloop.messages.frames import MAX_ID
from pdeloop.messages.text import shown
from pdeloop.method.adapt import Rollout, registry
from pdeloop.method.adapt.trajectories import (
    is_kept,
    record_arrays,
    taken_record,
    taken_trajectory,
    trajectory_arrays,
)
from tuner_node.budget import PURPOSES
from tuner_node.results import check_history
from tuner_node.training import Training

PHASES = (*PURPOSES, "done")
_LARGEST = 1e150
"""Largest number of a model."""
Arrays = dict[str, NDArray[Any]]


def arrays_of(training: Training) -> Arrays:
    """Everything that a checkpoint must hold."""
    arrays: Arrays = {
        "phase": np.array(training.phase),
        "plant": np.array(training.plant),
        "steps": np.array(training.steps),
        "attempts": np.array(training.attempts),
        "pending": np.array(training.pending, dtype=np.int64),
        "history": np.array(json.dumps(training.history)),
        "budget": training.budget.state(),
        "law_seen": np.array(training.law_seen),
        "worse": np.array(training.worse),
        "void": np.array(training.void),
    }
    for m, first in enumerate(training.first):
        if first is not None:
            costs = np.array(training.repeated[m])
            arrays |= {f"first{m}.policy": first.policy, f"first{m}.costs": costs}
            arrays[f"first{m}.field_seed"] = np.array(first.field_seed)
    for m, rollouts in enumerate(training.measured):
        for i, rollout in enumerate(rollouts):
            arrays |= record_arrays(f"measured{m}.{i}", rollout)
    for m, exploration in enumerate(training.explorations):
        if exploration is not None:
            arrays |= trajectory_arrays(f"exploration{m}", exploration)
        for i, other in enumerate(training.further[m]):
            arrays |= trajectory_arrays(f"further{m}.{i}", other)
    for name in ("models", "target", "evaluation", "ended"):
        if (array := getattr(training, name)) is not None:
            arrays[name] = array
    for m, optimizer in enumerate(training.optimizers):
        arrays |= {f"optimizer{m}.{key}": value for key, value in registry.state(optimizer).items()}
    return arrays


def restore(training: Training, arrays: Arrays) -> None:
    """Continue from `arrays_of`. ValueError, and nothing changed, if those are of another training."""
    restored = Training(training.settings, training.make_optimizer)
    try:
        _fill(restored, arrays)
        restored.next_batch()  # there is one, or the training is done
    except (ValueError, LookupError, TypeError, OverflowError) as error:
        raise ValueError(f"does not fit this training ({error})") from error
    vars(training).update(vars(restored))


def _fill(training: Training, arrays: Arrays) -> None:
    """Bring a new training to that state; an error of any of these kinds if the arrays do not fit."""
    seeds, n_a = training.settings.seeds, training.settings.n_a
    training.phase = str(checked_array(arrays, "phase", "U", ()))
    training.budget.restore(checked_array(arrays, "budget", "i", training.budget.state().shape))
    training.law_seen = bool(checked_array(arrays, "law_seen", "b", ()))
    training.plant = int(checked_array(arrays, "plant", "i", ()))
    training.steps = int(checked_array(arrays, "steps", "i", ()))
    if not 0 <= training.steps < MAX_ID:
        raise ValueError("its number of steps is out of range")
    training.attempts = checked_array(arrays, "attempts", "i", (seeds,)).tolist()
    training.pending = checked_array(arrays, "pending", "i", (None,)).tolist()
    training.void = checked_array(arrays, "void", "i", (seeds,)).tolist()
    training.history = parse_json(str(checked_array(arrays, "history", "U", ())))
    training.worse = checked_array(arrays, "worse", "b", (seeds,)).tolist()
    n_z = None
    if "models" in arrays:
        training.models = checked_array(arrays, "models", "f", (seeds, None, None))
        if np.abs(training.models).max(initial=0.0) > _LARGEST:
            raise ValueError("its models have numbers whose products are infinite")
        n_z = len(model_rows.unpack(training.models[0], n_a, training.settings.law.filtered).U)
    if "target" in arrays:
        training.target = checked_array(arrays, "target", "f", (n_z,))
    if "evaluation" in arrays:
        training.evaluation = checked_array(arrays, "evaluation", "f", training.evaluation_shape)
        training.ended = checked_array(arrays, "ended", "f", training.evaluation_shape)
    for m in range(seeds):
        if is_kept(arrays, f"exploration{m}"):
            training.explorations[m] = taken_trajectory(arrays, f"exploration{m}", n_z, n_a)
        while is_kept(arrays, name := f"further{m}.{len(training.further[m])}"):
            training.further[m].append(taken_trajectory(arrays, name, n_z, n_a))
        while (name := f"measured{m}.{len(training.measured[m])}") + ".policy" in arrays:
            shape = (n_a, None) if training.settings.law.axes == 2 else (None,)
            training.measured[m].append(taken_record(arrays, name, n_z, n_a, shape))
    for m in range(seeds):
        if (name := f"first{m}.policy") in arrays:
            seed = int(checked_array(arrays, f"first{m}.field_seed", "i", ()))
            policy = checked_array(arrays, name, "f", (None,) * np.ndim(arrays[name]))
            training.first[m] = Rollout(policy, seed)
            training.repeated[m] = checked_array(arrays, f"first{m}.costs", "f", (None,)).tolist()
    _check(training)
    if training.phase in ("adapt", "evaluate", "done"):
        training.start_optimizers()
    for m, optimizer in enumerate(training.optimizers):
        prefix = f"optimizer{m}."
        own = {key: value for key, value in arrays.items() if key.startswith(prefix)}
        registry.restore(optimizer, {key.removeprefix(prefix): value for key, value in own.items()})


def _check(training: Training) -> None:
    """A ValueError unless this is a state that a training can be in."""
    phase, pending, settings = training.phase, training.pending, training.settings
    if phase not in PHASES:
        raise ValueError(f"its phase is {shown(phase)}; expected one of {', '.join(PHASES)}")
    if (
        not set(pending) <= set(range(settings.seeds))
        or min([*training.attempts, *training.void]) < 0
    ):
        raise ValueError("its seeds or attempts are out of range")
    check_history(training.history, settings.seed, settings.seeds)
    if training.models is None and phase != "identify":
        raise ValueError("it has no models")
    if training.evaluation is None and phase == "done":
        raise ValueError("it has no evaluation")
    if not pending and phase in ("identify", "check"):
        raise ValueError("it has no seed to identify")
    explored = training.target is not None and None not in training.explorations
    if settings.trajectories and phase != "identify" and not explored:
        raise ValueError("it has no target, or not all explorations")
