"""Descent along several orthonormal directions at once.

Every direction alone is uniform on the sphere, so the mean of the D estimates has the mean of the
two-point estimate; orthogonal directions measure no component twice, and D = 2 n_a n_s of them give the
central difference gradient itself.

The mean of the 2 D costs estimates J(pi) + O(r^2). It judges the iterates: the best one is kept, and an
iterate that costs more than 1.5 times the best, or any diverged rollout, sends the policy back to the
best with half the learning rate.

References
----------
Mania, Guy, Recht, "Simple random search of static linear policies is competitive for reinforcement
learning", NeurIPS 2018. Choromanski et al., "Structured evolution with compact architectures for
scalable policy optimization", ICML 2018 (orthogonal directions).
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tuner_node.optimizers.base import Array, State, checked_policy
from tuner_node.optimizers.zeroth_order import ZerothOrder

# Initial fields differ in cost, so near 1 a good iterate is undone by an unlucky field.
_TOLERANCE = 1.5


class Directions(ZerothOrder):
    """`ZerothOrder` along several directions; its policy is the best iterate that was measured."""

    name = "directions"

    def __init__(self, policy0: ArrayLike, **settings: Any) -> None:
        super().__init__(policy0, **settings)
        self._best_policy = self._policy.copy()
        self._best_cost = np.inf

    @property
    def best_policy(self) -> Array:
        """The measured iterate with the lowest mean cost, which leaves out the last step."""
        return self._best_policy.copy()

    def _good(self, cost: float) -> bool:
        if cost < self._best_cost:
            self._best_cost, self._best_policy = cost, self._policy.copy()
        return cost <= _TOLERANCE * self._best_cost

    def state(self) -> State:
        """Those of a zeroth-order optimiser, and the best iterate."""
        best = {"best_policy": self.best_policy, "best_cost": np.array(self._best_cost)}
        return super().state() | best

    def restore(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Continue from a checkpoint with the same seed, radius and directions."""
        best = checked_policy(state.get("best_policy", self._best_policy))
        super().restore(state)
        self._best_policy, self._best_cost = best, float(state["best_cost"].item())
