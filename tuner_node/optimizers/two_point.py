"""Two-point zeroth-order policy gradient: one direction a step.

Source: Zhang, Mowlavi, Benosman, Basar, "Policy Optimization for PDE Control with a Warm Start",
arXiv:2403.01005, section IV.
"""

from collections.abc import Sequence
from typing import Any

from numpy.typing import ArrayLike

from tuner_node.optimizers.base import RolloutResult, Row
from tuner_node.optimizers.zeroth_order import ZerothOrder


class TwoPoint(ZerothOrder):
    """`ZerothOrder` along one direction; its policy is the last one, as in the paper.

    An iteration takes two rollouts. Parameters: those of `ZerothOrder`, but `directions`.
    """

    name = "two_point"

    def __init__(self, policy0: ArrayLike, **settings: Any) -> None:
        super().__init__(policy0, directions=1, **settings)

    def tell(self, results: Sequence[RolloutResult]) -> Row:
        """Step along the estimate, or halve the learning rate; the row has both costs."""
        row = super().tell(results) | {"iteration": self.tells}
        for key, result in zip(("cost_plus", "cost_minus"), results, strict=True):
            if result.usable:
                row[key] = float(result.cost)
        return row
