"""The paper's optimiser: stochastic descent along two-point gradient estimates.

Each iteration draws a direction Theta with |Theta|_F = 1 and an initial field, measures J(pi + r
Theta) and J(pi - r Theta) on that field, and steps pi <- pi - eta (n_a n_s / r) (J+ - J-) Theta.

The one addition is about divergence, which the paper does not discuss: an iteration with a diverged
rollout changes no policy, halves the learning rate from then on, and is marked in the history.

References
----------
Zhang, Mowlavi, Benosman, Basar, "Policy Optimization for PDE Control with a Warm Start",
arXiv:2403.01005.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tuner_node import oracle
from tuner_node.optimizers.base import (
    Array,
    Context,
    Rollout,
    RolloutResult,
    Row,
    State,
    checked_policy,
    require_positive,
    require_results,
    require_state,
)

__all__ = ["TwoPoint"]


class TwoPoint:
    """Two-point zeroth-order policy gradient.

    Parameters
    ----------
    policy0 : (n_a, 2 n_s) array
        Where to start: the warm start, or zeros.
    seed : int
        Determines all directions and fields.
    rollouts : int
        The budget; an iteration takes two.
    learning_rate : float
        eta, for the mean stage cost. Too large: rollouts diverge and it halves itself.
    smoothing_radius : float
        r. Too large: the estimate is that of a smoother cost, and rollouts diverge.
    context : Context, optional
        Not used; every optimiser takes it.
    """

    name = "two_point"
    needs_trajectories = False

    def __init__(
        self,
        policy0: ArrayLike,
        *,
        seed: int,
        rollouts: int,
        learning_rate: float,
        smoothing_radius: float = 0.1,
        context: Context | None = None,
    ) -> None:
        require_positive(
            rollouts=rollouts, learning_rate=learning_rate, smoothing_radius=smoothing_radius
        )
        self._policy = checked_policy(policy0)
        self._seed = seed
        self._iterations = rollouts // 2
        self._learning_rate = learning_rate
        self._radius = smoothing_radius
        self._iteration = 0

    @property
    def policy(self) -> Array:
        """The current policy."""
        return self._policy.copy()

    @property
    def best_policy(self) -> Array:
        """The current policy: the paper keeps the last one."""
        return self.policy

    @property
    def tells(self) -> int:
        """Iterations that are over."""
        return self._iteration

    @property
    def done(self) -> bool:
        """Whether all iterations are over."""
        return self._iteration >= self._iterations

    def ask(self) -> list[Rollout]:
        """The pair pi + r Theta, pi - r Theta on one field."""
        if self.done:
            return []
        step = self._radius * oracle.unit_direction(self._seed, self._iteration, self._shape)
        field = oracle.field_seed(self._seed, self._iteration)
        return [Rollout(self._policy + step, field), Rollout(self._policy - step, field)]

    def tell(self, results: Sequence[RolloutResult]) -> Row:
        """Step along the estimate, or halve the learning rate if a rollout diverged."""
        require_results(results, 0 if self.done else 2)
        plus, minus = results
        row: Row = {
            "iteration": self._iteration + 1,
            "rollouts": 2 * (self._iteration + 1),
            "field_seed": oracle.field_seed(self._seed, self._iteration),
            "learning_rate": self._learning_rate,
            "diverged": sum(not result.usable for result in results),
        }
        for key, result in (("cost_plus", plus), ("cost_minus", minus)):
            if result.usable:
                row[key] = float(result.cost)
        updated = False
        if plus.usable and minus.usable:
            direction = oracle.unit_direction(self._seed, self._iteration, self._shape)
            # Finite costs can still be so large that the step overflows: refused below.
            with np.errstate(over="ignore", invalid="ignore"):
                estimate = oracle.gradient(plus.cost, minus.cost, direction, self._radius)
                policy = oracle.update(self._policy, estimate, self._learning_rate)
                norm = float(np.sqrt(np.sum(estimate * estimate)))
            if np.isfinite(policy).all() and np.isfinite(norm):
                self._policy, updated = policy, True
                row["cost"] = 0.5 * float(plus.cost) + 0.5 * float(minus.cost)
                row["gradient_norm"] = norm
        if not updated:
            self._learning_rate *= 0.5
        row["updated"] = updated
        self._iteration += 1
        return row

    def state(self) -> State:
        """The policy, the iteration and the learning rate, with the parameters they belong to."""
        return {
            "policy": self._policy.copy(),
            "iteration": np.array(self._iteration),
            "learning_rate": np.array(self._learning_rate),
            "seed": np.array(self._seed),
            "smoothing_radius": np.array(self._radius),
        }

    def restore(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Continue from a checkpoint with the same seed and radius."""
        require_state(state, self.state(), ("seed", "smoothing_radius"))
        self._policy = checked_policy(state["policy"])
        self._iteration = int(state["iteration"].item())
        self._learning_rate = float(state["learning_rate"].item())
        require_positive(learning_rate=self._learning_rate)

    @property
    def _shape(self) -> tuple[int, int]:
        n_a, columns = self._policy.shape
        return int(n_a), int(columns)
