"""Mean stage costs with their exact gradients: of the projected law's gains, and of open inputs.

With the adjoint eta_k = dJ/dz_k, eta_T = 0, of J = 1/(MT) sum (q |z_k - z_r|^2 + r |a_k|^2) and
the transposed derivative of the plant's own step (`pde_sim_node.solver.adjoint`),

    g_k   = (df/da)^T eta_{k+1} + 2r/(MT) a_k
    eta_k = (df/dz)^T eta_{k+1} + 2q/(MT) (z_k - z_r) + U K_a^T g_k

dJ/da_k = g_k for open inputs (without the last term), and dJ/dtheta = sum_k g_k [s_k; 1]^T for the
law a = K_a s + b = theta [s; 1], s = U^T z.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pde_sim_node.measurement import InstrumentedPlant
from pde_sim_node.plant import Plant
from pde_sim_node.solver.adjoint import Adjoint
from pdeloop.episode import Law, rollout

__all__ = ["Gradients", "features"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Path:
    """Trajectories of M environments.

    states (T, M, n_z): z_0 .. z_{T-1}; actions (T, M, n_a); costs (M,): mean stage costs; whole:
    none diverged.
    """

    states: Array
    actions: Array
    costs: Array
    whole: bool


def features(U: Array, target: Array, states: Array) -> Array:
    """[s; 1] of states (..., n_z), (..., n_s + 1).

    The last one is 0 where the target lies outside of U: the law then has no constant part.
    """
    s_r = U.T @ target
    one = 1.0 if s_r @ s_r > 1e-20 * (target @ target) else 0.0
    s = states @ U
    return np.concatenate([s, np.full((*s.shape[:-1], 1), one)], axis=-1)


class Gradients:
    """Costs and gradients on one plant.

    Parameters
    ----------
    plant
        Used for the rollouts, which end its episode.

    Raises
    ------
    ValueError
        The plant has noise, limits or sensors, or an equation without an adjoint.
    """

    def __init__(self, plant: Plant) -> None:
        if isinstance(plant, InstrumentedPlant):
            raise ValueError(
                "exact gradients are of a plant without noise, limits and sensors: leave "
                "measurement_noise, process_noise, action_limit and sensors at 0"
            )
        self.plant = plant
        self._adjoint = Adjoint(plant)

    def of_law(self, U: Array, theta: Array, fields: Sequence[int]) -> tuple[float, Array]:
        """J and dJ/dtheta, averaged over initial fields.

        Parameters
        ----------
        U : (n_z, n_s)
            Basis.
        theta : (n_a, n_s + 1)
            [K_a b].
        fields
            Seeds of the initial fields.

        Returns
        -------
        Infinite cost and zeros if a rollout diverges.
        """
        path = self.law(U, theta, fields)
        if not path.whole:
            return np.inf, np.zeros_like(theta)
        _, gradient = self._backwards(path, U, theta)
        return float(path.costs.mean()), gradient

    def of_inputs(self, actions: Array, fields: Sequence[int]) -> tuple[float, Array]:
        """J and dJ/da, (T, M, n_a), of open inputs a_k from each field; as `of_law` otherwise."""
        path = self._roll(fields, lambda k, _: actions[k])
        if not path.whole:
            return np.inf, np.zeros_like(actions)
        gradient, _ = self._backwards(path)
        return float(path.costs.mean()), gradient

    def law(self, U: Array, theta: Array, fields: Sequence[int]) -> Path:
        """The trajectories under a law."""
        return self._roll(
            fields, lambda _, states: features(U, self.plant.target, states) @ theta.T
        )

    def _roll(self, fields: Sequence[int], law: Law) -> Path:
        def finite(k: int, z: Array) -> Array:
            a = law(k, z)
            if not np.isfinite(a).all():
                raise FloatingPointError
            return a

        plant = self.plant
        try:
            episode = rollout(plant, finite, fields)
        except FloatingPointError:  # gains so large that the actions overflow
            nothing = np.empty((plant.horizon, len(fields), 0))
            return Path(nothing, nothing, np.full(len(fields), np.inf), False)
        whole = not (episode.costs.diverged_step >= 0).any()
        return Path(episode.states[:-1], episode.actions, episode.costs.mean, whole)

    def _backwards(
        self, path: Path, U: Array | None = None, theta: Array | None = None
    ) -> tuple[Array, Array]:
        """dJ/da_k along the path, (T, M, n_a), and with a law dJ/dtheta."""
        plant, (T, M, _) = self.plant, path.states.shape
        q, r = 2 * plant.state_weight / (M * T), 2 * plant.action_weight / (M * T)
        on_inputs = np.empty_like(path.actions)
        on_theta = np.zeros_like(theta) if theta is not None else np.zeros((0, 0))
        eta = np.zeros(path.states.shape[1:])
        for k in range(T - 1, -1, -1):
            z, a = path.states[k], path.actions[k]
            eta, g = self._adjoint.pull_back(z, a, eta)
            g += r * a
            on_inputs[k] = g
            eta += q * (z - plant.target)
            if U is not None and theta is not None:
                eta += g @ theta[:, :-1] @ U.T
                on_theta += g.T @ features(U, plant.target, z)
        return on_inputs, on_theta
