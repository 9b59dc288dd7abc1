# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Mean stage costs with their exact gradients: of actions, of policies, and of the initial fields.

With the adjoint eta_k = dJ/dz_k, eta_T = 0, of J = 1/(MT) sum (q |z_k - z_r|^2 + r |a_k|^2) and
the transposed derivative of the plant's own step (`pde_sim_node.plant.Adjoint`),

    g_k   = (df/da)^T eta_{k+1} + 2r/(MT) a_k
    eta_k = (df/dz)^T eta_{k+1} + 2q/(MT) (z_k - z_r) + U K_a^T g_k

dJ/da_k = g_k for given actions (without the last term), dJ/dz_0 = eta_0, and
dJ/dtheta = sum_k g_k [s_k; 1]^T for the law a = K_a s + b = theta [s; 1], s = U^T z.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from loop_interfaces.arrays import Array
from pde_sim_node.dynamics import Dynamics
from pde_sim_node.plant import EpisodeCosts, Plant
from pde_sim_node.plants.loading import as_plant
from pdeloop.episode import EpisodeRecord, Law, finite_array, finite_basis, rollout

__all__ = ["CostGradient", "Gradients", "features"]


class CostGradient(NamedTuple):
    """A cost and its derivatives.

    Attributes
    ----------
    cost : float
        J, the mean stage cost, averaged over the M initial fields; infinite if a rollout diverges.
    gradient : (T, M, n_a) or (n_a, 2 n_s) array
        dJ/da or dJ/dpolicy, of its argument's shape; zero if a rollout diverges.
    of_fields : (M, n_z) array
        dJ/dz_0.
    """

    cost: float
    gradient: Array
    of_fields: Array


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

    Initial fields are given as to `Plant.reset`: seeds (M,), or the fields themselves (M, n_z).

    Parameters
    ----------
    plant
        Used for the rollouts, which end its episode; or a `Dynamics` with a method `pull_back`.

    Raises
    ------
    ValueError
        The plant has no derivatives, or noise, limits or sensors.

    Examples
    --------
    >>> import numpy as np
    >>> import pdeloop
    >>> plant = pdeloop.problem("burgers", horizon=20).plant()
    >>> cost, gradient, of_fields = pdeloop.Gradients(plant).of_actions(np.zeros((20, 1, 6)), [0])
    >>> gradient.shape, of_fields.shape
    ((20, 1, 6), (1, 128))
    """

    def __init__(self, plant: Plant | Dynamics) -> None:
        self.plant = as_plant(plant)
        self._adjoint = self.plant.adjoint()

    def of_actions(self, actions: ArrayLike, fields: ArrayLike) -> CostGradient:
        """J and dJ/da of given actions.

        Parameters
        ----------
        actions : (T, M, n_a)
            a_k from each of the M fields, for the T steps of an episode.
        fields : (M,) int, or (M, n_z)
            Initial fields.

        Returns
        -------
        CostGradient
            J, dJ/da (T, M, n_a) and dJ/dz_0 (M, n_z).

        Raises
        ------
        ValueError
            Shapes that do not fit the plant, NaN or infinity.
        """
        shape = self.plant.horizon, len(np.atleast_1d(fields)), self.plant.n_a
        given = finite_array("actions", actions, shape)
        return self._gradient(self._roll(fields, lambda k, _: given[k]), given)

    def of_policy(self, U: ArrayLike, policy: ArrayLike, fields: ArrayLike) -> CostGradient:
        """J and dJ/dpolicy of the law a = K_a U^T z + K_b U^T z_r.

        Parameters
        ----------
        U : (n_z, n_s)
            Basis, that of a reduced model.
        policy : (n_a, 2 n_s)
            [K_a K_b].
        fields : (M,) int, or (M, n_z)
            Initial fields.

        Returns
        -------
        CostGradient
            J, dJ/dpolicy (n_a, 2 n_s) and dJ/dz_0 (M, n_z).

        Raises
        ------
        ValueError
            Shapes that do not fit the plant, NaN or infinity.
        """
        basis = finite_basis(self.plant, U)
        n_s = basis.shape[1]
        gains = finite_array("policy", policy, (self.plant.n_a, 2 * n_s))
        s_r = basis.T @ self.plant.target
        theta = np.column_stack([gains[:, :n_s], gains[:, n_s:] @ s_r])
        found = self.of_law(basis, theta, fields)
        by_theta = found.gradient
        by_policy = np.hstack([by_theta[:, :n_s], np.outer(by_theta[:, n_s], s_r)])
        return found._replace(gradient=by_policy)

    def of_law(self, U: Array, theta: Array, fields: ArrayLike) -> CostGradient:
        """J and dJ/dtheta of the law a = theta [U^T z; 1].

        Parameters
        ----------
        U : (n_z, n_s)
            Basis.
        theta : (n_a, n_s + 1)
            [K b]; b counts nothing where the target lies outside of U.
        fields : (M,) int, or (M, n_z)
            Initial fields.

        Returns
        -------
        CostGradient
            J, dJ/dtheta (n_a, n_s + 1) and dJ/dz_0 (M, n_z).
        """
        return self._gradient(self.law(U, theta, fields), theta, U)

    def law(self, U: Array, theta: Array, fields: ArrayLike) -> EpisodeRecord:
        """An episode under the law a = theta [U^T z; 1].

        Parameters
        ----------
        U : (n_z, n_s)
            Basis.
        theta : (n_a, n_s + 1)
            [K b].
        fields : (M,) int, or (M, n_z)
            Initial fields.

        Returns
        -------
        EpisodeRecord
            Without states and with infinite costs where the law makes the actions overflow.
        """
        return self._roll(
            fields, lambda _, states: features(U, self.plant.target, states) @ theta.T
        )

    def _roll(self, fields: ArrayLike, law: Law) -> EpisodeRecord:
        def finite(k: int, z: Array) -> Array:
            a = law(k, z)
            if not np.isfinite(a).all():
                raise FloatingPointError
            return a

        try:
            return rollout(self.plant, finite, fields)
        except FloatingPointError:  # gains so large that the actions overflow
            M = self.plant.batch
            none, infinite = np.empty((0, M, 0)), np.full(M, np.inf)
            return EpisodeRecord(
                none, none, none, EpisodeCosts(infinite, infinite, np.zeros(M, int))
            )

    def _gradient(
        self, episode: EpisodeRecord, argument: Array, U: Array | None = None
    ) -> CostGradient:
        """Of the episode's cost, by its actions or, with U, by the law theta."""
        plant = self.plant
        T, M = plant.horizon, len(episode.costs.mean)
        gradient, eta = np.zeros_like(argument), np.zeros((M, plant.n_z))
        if not episode.whole:
            return CostGradient(np.inf, gradient, eta)
        q, r = 2 * plant.state_weight / (M * T), 2 * plant.action_weight / (M * T)
        if not plant.cost.plain:
            eta += plant.cost.terminal_slope(episode.states[T]) / (M * T)
        for k in range(T - 1, -1, -1):
            z, a = episode.states[k], episode.actions[k]
            eta, g = self._adjoint.pull_back(z, a, eta)
            if plant.cost.plain:
                g += r * a
                eta += q * (z - plant.target)
            else:
                on_z, on_a = plant.cost.slopes(z, a, k)
                g += on_a / (M * T)
                eta += on_z / (M * T)
            if U is None:
                gradient[k] = g
            else:
                eta += g @ argument[:, :-1] @ U.T
                gradient += g.T @ features(U, plant.target, z)
        return CostGradient(float(episode.costs.mean.mean()), gradient, eta)
