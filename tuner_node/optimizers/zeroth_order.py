"""Descent along estimates of the gradient that need costs alone.

Each step draws D directions Theta_i, orthonormal in the Frobenius inner product, and one initial field,
measures the 2 D rollouts pi +- r Theta_i on it, and steps along the mean of the two-point estimates,

    g = (1 / D) sum_i (n_a n_s / r) (J(pi + r Theta_i) - J(pi - r Theta_i)) Theta_i,
    pi <- pi - eta g.

A step with a diverged rollout, or that would not be finite, is not taken and halves eta from then on.

Every direction alone is uniform on the sphere, so the mean of the D estimates has the mean of the
two-point estimate; orthogonal directions measure no component twice, and D = 2 n_a n_s of them give the
central difference gradient itself.

References
----------
Zhang, Mowlavi, Benosman, Basar, "Policy Optimization for PDE Control with a Warm Start",
arXiv:2403.01005, section IV (D = 1). Mania, Guy, Recht, "Simple random search of static linear policies
is competitive for reinforcement learning", NeurIPS 2018. Choromanski et al., "Structured evolution with
compact architectures for scalable policy optimization", ICML 2018 (orthogonal directions).
"""

from collections.abc import Mapping, Sequence
from typing import Any

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

# Initial fields differ in cost, so near 1 a good iterate is undone by an unlucky field.
_TOLERANCE = 1.5


class ZerothOrder:
    """What the optimisers that learn from costs have in common.

    Parameters
    ----------
    policy0 : (n_a, 2 n_s) array
        Where to start.
    seed : int
        Determines all directions and fields.
    rollouts : int
        The budget, spent in floor(rollouts / (2 directions)) steps.
    learning_rate : float
        eta, for the mean stage cost. Too large: rollouts diverge and it halves itself.
    smoothing_radius : float
        r. Too large: the estimate is that of a smoother cost, and rollouts diverge.
    directions : int
        D, at most rollouts / 2 and 2 n_a n_s.
    context : Context, optional
        Not used; every optimiser takes it.
    """

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
        context: Context | None = None,
    ) -> None:
        require_positive(
            rollouts=rollouts, learning_rate=learning_rate, smoothing_radius=smoothing_radius
        )
        self._policy = checked_policy(policy0)
        most = max(min(rollouts // 2, self._policy.size), 1)
        if not 1 <= directions <= most:
            raise ValueError(
                f"directions must lie in 1 .. {most} (half the rollouts and the entries of the policy "
                f"allow no more), but it is {directions}."
            )
        self._seed = seed
        self._steps = rollouts // (2 * directions)
        self._learning_rate = learning_rate
        self._radius = smoothing_radius
        self._count = directions
        self._tells = 0

    @property
    def policy(self) -> Array:
        """The current policy."""
        return self._policy.copy()

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
        """Step along the mean estimate, or halve the learning rate."""
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
                policy = self._policy - self._learning_rate * estimate
                norm = float(np.sqrt(np.sum(estimate * estimate)))
            if np.isfinite(cost):
                row["cost"] = cost
            if self._good(cost) and np.isfinite(policy).all() and np.isfinite(norm):
                self._policy, updated = policy, True
                row["gradient_norm"] = norm
        if not updated:
            self._learning_rate *= 0.5
            self._policy = self.best_policy
        row["updated"] = updated
        self._tells += 1
        return row

    @property
    def best_policy(self) -> Array:
        """The policy that a step which is not taken goes back to: the current one."""
        return self.policy

    def _good(self, cost: float) -> bool:
        """Whether to go on from a policy whose 2 D rollouts have this mean cost."""
        return True

    def state(self) -> State:
        """The policy, the steps and the learning rate, with the parameters they belong to."""
        return {
            "policy": self._policy.copy(),
            "tells": np.array(self._tells),
            "learning_rate": np.array(self._learning_rate),
            "seed": np.array(self._seed),
            "smoothing_radius": np.array(self._radius),
            "directions": np.array(self._count),
        }

    def restore(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Continue from a checkpoint with the same seed, radius and directions."""
        require_state(state, self.state(), ("seed", "smoothing_radius", "directions"))
        policy, learning_rate = checked_policy(state["policy"]), state["learning_rate"].item()
        require_positive(learning_rate=float(learning_rate))
        self._policy, self._learning_rate = policy, float(learning_rate)
        self._tells = int(state["tells"].item())

    def _directions(self) -> Array:
        n_a, columns = self._policy.shape
        return oracle.orthonormal_directions(self._seed, self._tells, (n_a, columns), self._count)


class TwoPoint(ZerothOrder):
    """Along one direction a step, and with the last policy, as in the paper (`ZerothOrder`)."""

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


class Directions(ZerothOrder):
    """Along several directions a step, and with the best iterate that was measured (`ZerothOrder`).

    The mean of a step's 2 D costs estimates J(pi) + O(r^2). It judges the iterates: one that costs more
    than 1.5 times the best, or any diverged rollout, sends the policy back to the best with half the
    learning rate.
    """

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
