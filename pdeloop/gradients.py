# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Mean stage costs with their exact gradients: of actions, of policies, and of the initial fields.

With the adjoint eta_k = dJ/dz_k, eta_T = 0, of J = 1/(MT) sum (q |z_k - z_r|^2 + r |a_k|^2) and
the transposed derivative of the plant's own step (`pde_sim_node.plant.Adjoint`),

    g_k   = (df/da)^T eta_{k+1} + 2r/(MT) a_k
    eta_k = (df/dz)^T eta_{k+1} + 2q/(MT) (z_k - z_r) + U K_a^T g_k

dJ/da_k = g_k for given actions (without the last term), dJ/dz_0 = eta_0, and
dJ/dtheta = sum_k g_k [s_k; 1]^T for the law a = K_a s + b = theta [s; 1], s = U^T z. Any law with
derivatives stands in the place of the last term; its memory has an adjoint mu_k = dJ/dm_k of its own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from pde_sim_node.dynamics import Dynamics
from pde_sim_node.plant import EpisodeCosts, Plant
from pde_sim_node.plants.loading import as_plant
from pdeloop.episode import EpisodeRecord, finite_array, finite_basis, rollout
from pdeloop.episode import Law as Actions
from pdeloop.messages.arrays import Array
from pdeloop.method.laws.base import Law, differentiable
from pdeloop.method.laws.registry import action, arithmetic_of_laws, updated

__all__ = ["CostGradient", "Gradients"]


class CostGradient(NamedTuple):
    """A cost and its derivatives.

    Attributes
    ----------
    cost : float
        J, the mean stage cost, averaged over the M initial fields; infinite if a rollout diverges.
    gradient : (T, M, n_a), (n_a, 2 n_s) or (size,) array
        dJ/da, dJ/dpolicy or dJ/dtheta, of its argument's shape; zero if a rollout diverges.
    of_fields : (M, n_z) array
        dJ/dz_0.
    """

    cost: float
    gradient: Array
    of_fields: Array


def _features(U: Array, target: Array, states: Array) -> Array:
    """[s; 1] of states (..., n_z), (..., n_s + 1).

    The last one is 0 where the target lies outside of U: the law then has no constant part.
    """
    s_r = U.T @ target
    one = 1.0 if s_r @ s_r > 1e-20 * (target @ target) else 0.0
    s = states @ U
    return np.concatenate([s, np.full((*s.shape[:-1], 1), one)], axis=-1)


class Gradients:
    """Costs and gradients on one plant.

    Initial fields are given as for `Plant.reset`: seeds (M,), or the fields themselves (M, n_z).

    Parameters
    ----------
    plant
        The plant, whose current episode ends; or a `Dynamics` with a method `pull_back`.

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
        target = self.plant.target
        episode = self._roll(fields, lambda _, z: _features(basis, target, z) @ theta.T)
        found = self._gradient(episode, theta, basis)
        by_theta = found.gradient
        by_policy = np.hstack([by_theta[:, :n_s], np.outer(by_theta[:, n_s], s_r)])
        return found._replace(gradient=by_policy)

    def of_theta(self, law: Law, theta: ArrayLike, fields: ArrayLike) -> CostGradient:
        """J and dJ/dtheta of any law that has derivatives, through its memory where it has one.

        Parameters
        ----------
        law : Law
            As `FinishedRun.laws` gives it, or made from a model.
        theta : (size,)
            Its parameters; more if the law `extends`.
        fields : (M,) int, or (M, n_z)
            Initial fields.

        Returns
        -------
        CostGradient
            J, dJ/dtheta, of the shape of theta, and dJ/dz_0 (M, n_z).

        Raises
        ------
        ValueError
            Shapes that do not fit the law, NaN or infinity, or a law without derivatives.
        """
        if not differentiable(type(law)):
            raise ValueError(
                f"the law '{law.name}' has no derivatives, which exact gradients need: it has no "
                "pull_back(theta, z, memory, k, y), or none of its memory"
            )
        size = max(np.size(theta), law.size) if law.extends else law.size
        given = finite_array("theta", theta, (size,))
        parts, memories = law.parts(given), []
        rows = [law.memory_start() for _ in range(len(np.atleast_1d(fields)))]

        def acted(k: int, z: Array) -> Array:
            nonlocal rows
            a = np.stack([action(law, parts, *own, k) for own in zip(z, rows, strict=True)])
            memories.append(rows)
            rows = [updated(law, parts, *own, k) for own in zip(z, rows, a, strict=True)]
            return a

        with arithmetic_of_laws():
            episode = self._roll(fields, acted)
            return self._gradient_of_theta(law, given, episode, memories)

    def _gradient_of_theta(
        self, law: Law, theta: Array, episode: EpisodeRecord, memories: list[list[Array]]
    ) -> CostGradient:
        M, parts = len(episode.costs.mean), law.parts(theta)
        gradient, eta = np.zeros_like(theta), np.zeros((M, self.plant.n_z))
        if not episode.whole:
            return CostGradient(np.inf, gradient, eta)
        mu = np.zeros((M, law.memory_size))
        eta += self._terminal_slope(episode)
        for k in range(self.plant.horizon - 1, -1, -1):
            z, a = episode.states[k], episode.actions[k]
            eta, g = self._pulled_back(k, z, a, eta)
            for m, memory in enumerate(memories[k]):
                on_memory = np.zeros_like(mu[m])
                if law.memory_size:
                    on_theta, on_z, on_memory, on_a = law.pull_back_memory(
                        parts, z[m], memory, a[m], k, mu[m]
                    )
                    gradient += law.vector(on_theta)
                    eta[m] += on_z
                    g[m] += on_a
                on_theta, on_z, directly = law.pull_back(parts, z[m], memory, k, g[m])
                gradient += law.vector(on_theta)
                eta[m] += on_z
                mu[m] = on_memory + directly
        return CostGradient(float(episode.costs.mean.mean()), gradient, eta)

    def _roll(self, fields: ArrayLike, law: Actions) -> EpisodeRecord:
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
                none, none, none, EpisodeCosts(infinite, infinite, np.zeros(M, int)), none
            )

    def _gradient(
        self, episode: EpisodeRecord, argument: Array, U: Array | None = None
    ) -> CostGradient:
        """Gradient of the episode's cost with respect to its actions or, with U, to theta."""
        plant = self.plant
        T, M = plant.horizon, len(episode.costs.mean)
        gradient, eta = np.zeros_like(argument), np.zeros((M, plant.n_z))
        if not episode.whole:
            return CostGradient(np.inf, gradient, eta)
        eta += self._terminal_slope(episode)
        for k in range(T - 1, -1, -1):
            z, a = episode.states[k], episode.actions[k]
            eta, g = self._pulled_back(k, z, a, eta)
            if U is None:
                gradient[k] = g
            else:
                eta += g @ argument[:, :-1] @ U.T
                gradient += g.T @ _features(U, plant.target, z)
        return CostGradient(float(episode.costs.mean.mean()), gradient, eta)

    def _terminal_slope(self, episode: EpisodeRecord) -> Array | float:
        """dJ/dz_T, of what z_T itself costs."""
        plant, M = self.plant, len(episode.costs.mean)
        if plant.cost.plain:
            return 0.0
        return plant.cost.at_end(episode.states[-1])[1] / (M * plant.horizon)

    def _pulled_back(self, k: int, z: Array, a: Array, eta: Array) -> tuple[Array, Array]:
        """dJ/dz_k and dJ/da_k for a given action, from dJ/dz_{k+1}."""
        plant = self.plant
        count = len(z) * plant.horizon
        eta, g = self._adjoint.pull_back(z, a, eta)
        if plant.cost.plain:
            g += 2 * plant.action_weight / count * a
            eta += 2 * plant.state_weight / count * (z - plant.target)
        else:
            on_z, on_a = plant.cost.slopes(z, a, k)
            g += on_a / count
            eta += on_z / count
        return eta, g
