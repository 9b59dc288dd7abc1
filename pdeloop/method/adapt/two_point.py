# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Descent along two-point estimates of the gradient, which need costs alone; the paper's method.

Each step draws one direction Theta with |Theta|_F = 1 and one initial field, measures the rollouts
pi +- r Theta on it, and steps along the estimate

    g = (n_a n_s / r) (J(pi + r Theta) - J(pi - r Theta)) Theta,        pi <- pi - eta g.

With d = 2 n_a n_s entries, E[d Theta Theta^T] = I for a uniform direction, so g = d (J+ - J-) / (2 r)
Theta estimates the gradient of J without bias, up to the smoothing. A step with a diverged rollout, or
that would not be finite, is not taken and halves eta from then on. Sums are elementwise (no BLAS), so
that a policy is the same to the last bit on every run.

References
----------
Zhang, Mowlavi, Benosman, Basar, "Policy Optimization for PDE Control with a Warm Start",
arXiv:2403.01005, section IV.
Spall, "Introduction to Stochastic Search and Optimization", chapter 7.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.base import Rollout, RolloutResult, Row, StepOptimizer, require_positive
from pdeloop.method.seeds import DIRECTION_STREAM
from pdeloop.method.settings import Settings


@dataclass(frozen=True, kw_only=True)
class TwoPointSettings(Settings):
    """The constants of the method, which are parameters of the problem, as the paper has them.

    Attributes
    ----------
    learning_rate : float
        eta, for the mean stage cost. Too large: rollouts diverge and it halves itself.
    smoothing_radius : float
        r. Too large: the estimate is that of a smoother cost, and rollouts diverge.
    """

    learning_rate: float
    smoothing_radius: float = 0.1

    def __post_init__(self) -> None:
        require_positive(learning_rate=self.learning_rate, smoothing_radius=self.smoothing_radius)


class TwoPoint(StepOptimizer):
    """Policy optimisation from costs alone, in steps of two rollouts; parameters as of `Optimizer`."""

    name = "two_point"
    Settings = TwoPointSettings
    step_rollouts = iteration_rollouts = 2
    kept = ("learning_rate",)
    # Its learning rates were chosen for the gains of this identification.
    preferences: ClassVar[Mapping[str, Any]] = {"identification": "dmdc"}

    def __init__(self, policy0: ArrayLike, *, settings: TwoPointSettings, **others: Any) -> None:
        super().__init__(policy0, settings=settings, **others)
        self.learning_rate = settings.learning_rate

    @classmethod
    def settings_of(cls, values: Mapping[str, Any], given: Mapping[str, Any]) -> TwoPointSettings:
        """From the problem's parameters; eta is another one where the policy starts from zero."""
        rate = "learning_rate_from_zero" if values["start"] == "zero" else "learning_rate"
        return TwoPointSettings(
            learning_rate=values[rate], smoothing_radius=values["smoothing_radius"]
        )

    def rollouts(self) -> list[Rollout]:
        """The rollouts pi + r Theta and pi - r Theta on one field."""
        moved = self.settings.smoothing_radius * self._direction()
        return [Rollout(self._policy + own, self.field_seed) for own in (moved, -moved)]

    def update(self, results: Sequence[RolloutResult]) -> Row:
        """Step along the estimate, or halve the learning rate."""
        row: Row = {
            "iteration": self.tells + 1,
            "field_seed": self.field_seed,
            "learning_rate": float(self.learning_rate),
        }
        for key, result in zip(("cost_plus", "cost_minus"), results, strict=True):
            if result.usable:
                row[key] = float(result.cost)
        row["updated"] = False
        if all(result.usable for result in results):
            plus, minus = (float(result.cost) for result in results)
            # Finite costs can still be so large that the step overflows.
            with np.errstate(over="ignore", invalid="ignore"):
                radius = self.settings.smoothing_radius
                estimate = gradient(plus, minus, self._direction(), radius)
                policy = self._policy - self.learning_rate * estimate
                norm = float(np.sqrt(np.sum(estimate * estimate)))
            if np.isfinite(policy).all() and np.isfinite(norm):
                self.policy = policy
                row |= {"gradient_norm": norm, "updated": True}
        if not row["updated"]:
            self.learning_rate *= 0.5
        return row

    def _direction(self) -> Array:
        return direction(self._seed, self.tells, self._policy.shape)


def direction(seed: int, iteration: int, shape: tuple[int, ...]) -> Array:
    """Theta of an iteration, uniform on the sphere of unit Frobenius norm; shape: of a policy."""
    theta: Array = np.random.default_rng([seed, DIRECTION_STREAM, iteration]).standard_normal(shape)
    theta /= np.sqrt(np.sum(theta * theta))
    return theta


def gradient(cost_plus: float, cost_minus: float, direction: Array, radius: float) -> Array:
    """The two-point estimate (d / 2 r) (J+ - J-) Theta, of the shape of Theta."""
    estimate: Array = direction.size / 2 / radius * (cost_plus - cost_minus) * direction
    return estimate
