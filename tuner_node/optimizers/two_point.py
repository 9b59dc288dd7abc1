"""The paper's optimiser: stochastic descent along two-point gradient estimates.

One direction a step, an iteration. What happens to one with a diverged rollout is not in the paper.

References
----------
Zhang, Mowlavi, Benosman, Basar, "Policy Optimization for PDE Control with a Warm Start",
arXiv:2403.01005.
"""

from __future__ import annotations

from collections.abc import Sequence

from numpy.typing import ArrayLike

from tuner_node.optimizers.base import Context, RolloutResult, Row
from tuner_node.optimizers.zeroth_order import ZerothOrder

__all__ = ["TwoPoint"]


class TwoPoint(ZerothOrder):
    """Two-point zeroth-order policy gradient; its policy is the last one, as in the paper.

    Parameters
    ----------
    policy0, seed, rollouts, learning_rate, smoothing_radius
        See `ZerothOrder`; an iteration takes two rollouts.
    context : Context, optional
        Not used; every optimiser takes it.
    """

    name = "two_point"

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
        super().__init__(
            policy0,
            seed=seed,
            rollouts=rollouts,
            learning_rate=learning_rate,
            smoothing_radius=smoothing_radius,
            directions=1,
        )

    def tell(self, results: Sequence[RolloutResult]) -> Row:
        """Step along the estimate, or halve the learning rate; the row has both costs."""
        row = super().tell(results) | {"iteration": self.tells}
        for key, result in zip(("cost_plus", "cost_minus"), results, strict=True):
            if result.usable:
                row[key] = float(result.cost)
        return row
