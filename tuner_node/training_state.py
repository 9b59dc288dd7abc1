"""The state of a training as the arrays of a checkpoint, and back."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tuner_node.optimizers import Measured, Trajectory

if TYPE_CHECKING:
    from tuner_node.training import Training

Arrays = dict[str, NDArray[Any]]
PLAIN = ("phase", "plant", "attempts", "pending", "history", "law_seen", "worse")
"""What is stored as JSON."""
ARRAYS = ("models", "target", "evaluation", "ended")


def arrays_of(training: Training) -> Arrays:
    """Everything that `fill` needs."""
    plain = {name: getattr(training, name) for name in PLAIN}
    arrays = {"plain": np.array(json.dumps(plain)), "budget": training.budget.state()}
    for name in ARRAYS:
        if (array := getattr(training, name)) is not None:
            arrays[name] = array
    for m, exploration in enumerate(training.explorations):
        if exploration is not None:
            arrays |= _trajectory_arrays(f"exploration{m}", exploration)
    for m, rollouts in enumerate(training.measured):
        for i, rollout in enumerate(rollouts):
            name = f"measured{m}.{i}"
            arrays |= {f"{name}.policy": rollout.policy, f"{name}.cost": np.array(rollout.cost)}
            arrays |= _trajectory_arrays(name, rollout.trajectory)
    for m, optimizer in enumerate(training.optimizers):
        arrays |= {f"optimizer{m}.{key}": value for key, value in optimizer.state().items()}
    return arrays


def fill(training: Training, arrays: Arrays) -> None:
    """Bring a new training to the state of `arrays_of`.

    Raises
    ------
    ValueError, LookupError, TypeError
        The arrays are not those of a training with these settings.
    """
    plain = json.loads(str(arrays["plain"]))
    for name in PLAIN:
        setattr(training, name, plain[name])
    training.budget.restore(arrays["budget"])
    for name in ARRAYS:
        setattr(training, name, arrays.get(name))
    for m, rollouts in enumerate(training.measured):
        if f"exploration{m}.states" in arrays:
            training.explorations[m] = _trajectory(arrays, f"exploration{m}")
        while (name := f"measured{m}.{len(rollouts)}") + ".policy" in arrays:
            cost = float(arrays[f"{name}.cost"])
            rollouts.append(Measured(arrays[f"{name}.policy"], cost, _trajectory(arrays, name)))
    if training.phase in ("adapt", "evaluate", "done"):
        training.start_optimizers()
    for m, optimizer in enumerate(training.optimizers):
        prefix = f"optimizer{m}."
        own = {key: value for key, value in arrays.items() if key.startswith(prefix)}
        optimizer.restore({key.removeprefix(prefix): value for key, value in own.items()})


def _trajectory_arrays(name: str, trajectory: Trajectory) -> Arrays:
    return {f"{name}.states": trajectory.states, f"{name}.actions": trajectory.actions}


def _trajectory(arrays: Arrays, name: str) -> Trajectory:
    return Trajectory(arrays[f"{name}.states"], arrays[f"{name}.actions"])
