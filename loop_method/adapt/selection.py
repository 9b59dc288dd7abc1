# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Which fitted models to trust: those that predict how measured trajectories differ.

A model that follows one trajectory well can still be wrong about its neighbours, and a step needs
the neighbours. So a model is judged by what it will be used for: given the measured difference of
the initial fields, or the known difference of two policies, predict the difference of two measured
trajectories,

    delta_{k+1} = gamma ((A_k + B [K 0]) delta_k + B (theta_2 - theta_1) phi(s_k)),

with the law's features phi(s) = [s; 1, ...], and compare:
E = mean over pairs of min(2, sum_k |error_k|^2 / sum_k |delta_k|^2). No prediction at all has E = 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loop_interfaces.arrays import Array
from loop_method.adapt.local_model import LocalModel
from loop_method.adapt.sensitivity import ReducedTrajectory, predict_difference

# Ridges of the quadratic part.
RIDGES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
# Forgetting over an episode: gamma = exp(-kappa / T).
KAPPAS = (0.0, 5.0, 15.0, 50.0)
# A comparison with a rollout that costs more than this many times the incumbent is not local.
LOCAL = 3.0
# After an accepted step, the least forgetting whose error is within this factor and margin of the
# best.
_ENOUGH = (1.5, 0.03)
# Models are averaged whose error is within this factor and margin of the best, and no further from
# it than the last.
_ALIKE = (3.0, 0.03, 0.15)
_WORST = 2.0


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two measured trajectories, and by how much theta differs, (n_a, n_s + 1)."""

    first: ReducedTrajectory
    second: ReducedTrajectory
    change: Array


def mismatches(models: Sequence[LocalModel], pairs: Sequence[Comparison], horizon: int) -> Array:
    """E of every model and kappa, (models, kappas); zeros without pairs."""
    errors = np.zeros((len(models), len(KAPPAS)))
    if not pairs:
        return errors
    x = np.stack([pair.first.x for pair in pairs])
    measured = np.stack([pair.second.x for pair in pairs]) - x
    forcing = np.stack([pair.second.features @ pair.change.T for pair in pairs])
    size = np.maximum(np.sum(measured**2, axis=(1, 2)), 1e-300)
    free = None
    if pairs[0].first.free is not None:
        free = np.stack([pair.first.free for pair in pairs if pair.first.free is not None])
    gammas = np.exp(-np.array(KAPPAS) / horizon)
    for i, model in enumerate(models):
        # A model that is unstable along the trajectory overflows: it counts as the worst.
        with np.errstate(over="ignore", invalid="ignore"):
            predicted = predict_difference(
                model.jacobians(x),
                model.B,
                pairs[0].first.K,
                initial=measured[:, 0],
                forcing=forcing,
                gammas=gammas,
                free=free,
            )
            error = np.sum((predicted - measured) ** 2, axis=(2, 3)) / size
        error = np.where(np.isfinite(error), np.minimum(error, _WORST), _WORST)
        errors[i] = error.mean(axis=1)
    return errors


def choices(errors: Array, accepted: bool) -> list[tuple[float, list[int]]]:
    """Forgetting, and the models to average over with it; the choice to use first comes first.

    Parameters
    ----------
    errors : (models, kappas) array
        From `mismatches`.
    accepted : bool
        Whether the last candidate was accepted: if so little forgetting is preferred, as it sees
        the whole effect of a step, and otherwise the smallest error.
    """
    best = errors.min(axis=0)
    order = [int(j) for j in np.argsort(best, kind="stable")]
    if accepted:
        first = int(np.argmax(best <= _ENOUGH[0] * best.min() + _ENOUGH[1]))
        order = [first, *(j for j in order if j != first)]
    alike = np.minimum(_ALIKE[0] * best + _ALIKE[1], best + _ALIKE[2])
    return [(KAPPAS[j], [int(i) for i in np.flatnonzero(errors[:, j] <= alike[j])]) for j in order]
