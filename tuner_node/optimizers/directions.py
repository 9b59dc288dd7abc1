"""Descent along several orthonormal directions at once.

Each step draws D directions Theta_i, orthonormal in the Frobenius inner product, and one
initial field, measures the 2 D rollouts pi +- r Theta_i on it, and steps along the mean of the
two-point estimates,

    g = (1 / D) sum_i (n_a n_s / r) (J(pi + r Theta_i) - J(pi - r Theta_i)) Theta_i.

Every Theta_i alone is uniform on the sphere, so g has the same mean as the two-point estimate;
orthogonal directions measure no component twice, and D = 2 n_a n_s of them give the central
difference gradient itself.

The mean of the 2 D costs estimates J(pi) + O(r^2). It judges the iterates: the best one is kept,
and an iterate that costs more than `tolerance` times the best, or any diverged rollout, sends the
policy back to the best with half the learning rate.

References
----------
Mania, Guy, Recht, "Simple random search of static linear policies is competitive for reinforcement
learning", NeurIPS 2018. Choromanski et al., "Structured evolution with compact architectures for
scalable policy optimization", ICML 2018 (orthogonal directions).
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

__all__ = ["Directions"]


class Directions:
    """Zeroth-order policy gradient along orthonormal directions.

    Parameters
    ----------
    policy0 : (n_a, 2 n_s) array
        Where to start.
    seed : int
        Determines all directions and fields.
    rollouts : int
        The budget, spent in floor(rollouts / (2 directions)) steps.
    learning_rate, smoothing_radius : float
        eta and r, as for the two-point optimiser.
    directions : int
        D, at most rollouts / 2 and 2 n_a n_s.
    tolerance : float
        Above 1. Initial fields differ in cost, so near 1 a good iterate is undone by an unlucky
        field.
    context : Context, optional
        Not used; every optimiser takes it.
    """

    name = "directions"
    needs_trajectories = False

    def __init__(
        self,
        policy0: ArrayLike,
        *,
        seed: int,
        rollouts: int,
        learning_rate: float,
        smoothing_radius: float = 0.1,
        directions: int = 4,
        tolerance: float = 1.5,
        context: Context | None = None,
    ) -> None:
        require_positive(
            rollouts=rollouts, learning_rate=learning_rate, smoothing_radius=smoothing_radius
        )
        self._policy = checked_policy(policy0)
        most = min(rollouts // 2, self._policy.size)
        if not 1 <= directions <= most:
            raise ValueError(
                f"directions must lie in 1 .. {most} (half the rollouts and the entries of the policy "
                f"allow no more), but it is {directions}."
            )
        if not tolerance > 1.0:
            raise ValueError(f"tolerance must be above 1, but it is {tolerance}.")
        self._seed = seed
        self._steps = rollouts // (2 * directions)
        self._learning_rate = learning_rate
        self._radius = smoothing_radius
        self._count = directions
        self._tolerance = tolerance
        self._tells = 0
        self._best_policy = self._policy.copy()
        self._best_cost = np.inf

    @property
    def policy(self) -> Array:
        """The current policy."""
        return self._policy.copy()

    @property
    def best_policy(self) -> Array:
        """The measured iterate with the lowest mean cost, which leaves out the last step."""
        return self._best_policy.copy()

    @property
    def tells(self) -> int:
        """Steps that are over, 2 D rollouts each."""
        return self._tells

    @property
    def done(self) -> bool:
        """Whether the budget is used."""
        return self._tells >= self._steps

    def ask(self) -> list[Rollout]:
        """The rollouts pi + r Theta_1, pi - r Theta_1, pi + r Theta_2, ... on one field."""
        if self.done:
            return []
        field = oracle.field_seed(self._seed, self._tells)
        return [
            Rollout(self._policy + sign * self._radius * direction, field)
            for direction in self._directions()
            for sign in (1.0, -1.0)
        ]

    def tell(self, results: Sequence[RolloutResult]) -> Row:
        """Step along the mean estimate, or go back to the best iterate."""
        require_results(results, 0 if self.done else 2 * self._count)
        usable = [result.usable for result in results]
        row: Row = {
            "rollouts": 2 * self._count * (self._tells + 1),
            "field_seed": oracle.field_seed(self._seed, self._tells),
            "learning_rate": self._learning_rate,
            "diverged": len(usable) - sum(usable),
        }
        updated = False
        if all(usable):
            # Finite costs can still be so large that a sum overflows: refused below.
            with np.errstate(over="ignore", invalid="ignore"):
                cost = float(np.sum([result.cost for result in results])) / len(results)
                estimate = np.zeros_like(self._policy)
                for plus, minus, direction in zip(
                    results[::2], results[1::2], self._directions(), strict=True
                ):
                    estimate += oracle.gradient(plus.cost, minus.cost, direction, self._radius)
                estimate /= self._count
                policy = oracle.update(self._policy, estimate, self._learning_rate)
                norm = float(np.sqrt(np.sum(estimate * estimate)))
            if np.isfinite(cost):
                row["cost"] = cost
            if cost < self._best_cost:
                self._best_cost, self._best_policy = cost, self._policy.copy()
            finite = bool(np.isfinite(policy).all() and np.isfinite(norm))
            if finite and cost <= self._tolerance * self._best_cost:
                self._policy, updated = policy, True
                row["gradient_norm"] = norm
        if not updated:
            self._learning_rate *= 0.5
            self._policy = self._best_policy.copy()
        row["updated"] = updated
        self._tells += 1
        return row

    def state(self) -> State:
        """The policies, the steps so far and the learning rate, with the parameters they belong to."""
        return {
            "policy": self._policy.copy(),
            "best_policy": self._best_policy.copy(),
            "best_cost": np.array(self._best_cost),
            "tells": np.array(self._tells),
            "learning_rate": np.array(self._learning_rate),
            "seed": np.array(self._seed),
            "smoothing_radius": np.array(self._radius),
            "directions": np.array(self._count),
        }

    def restore(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Continue from a checkpoint with the same seed, radius and directions."""
        require_state(state, self.state(), ("seed", "smoothing_radius", "directions"))
        policies = checked_policy(state["policy"]), checked_policy(state["best_policy"])
        self._policy, self._best_policy = policies
        self._best_cost = float(state["best_cost"].item())
        self._tells = int(state["tells"].item())
        self._learning_rate = float(state["learning_rate"].item())
        require_positive(learning_rate=self._learning_rate)

    def _directions(self) -> Array:
        n_a, columns = self._policy.shape
        return oracle.orthonormal_directions(self._seed, self._tells, (n_a, columns), self._count)
