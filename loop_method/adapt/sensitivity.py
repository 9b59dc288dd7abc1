# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The sensitivity of a trajectory to the gains, along a measured trajectory.

The law a = K s + b has the parameters theta = [K b], of shape (n_a, n_s + 1), in row-major order; s
is the first n_s entries of x = V^T z. Along a measured trajectory, with Jacobians A_k and input
matrix B of a fitted model, X_k = dx_k/dtheta and G_k = da_k/dtheta follow

    G_k = K X_k[:n_s] + I (x) [s_k; 1]^T,        X_{k+1} = gamma (A_k X_k + B G_k),        X_0 = 0.

A saturated action does not depend on theta: its row of G_k is zero. The forgetting factor gamma <= 1
limits the growth of sensitivities where the model is unstable but the plant is not.

The cost itself needs no model. With the measured x_k and a_k its gradient and Gauss-Newton curvature
are

    g = (2 / T) sum_k (q X_k^T (x_k - V^T z_r) + r G_k^T a_k),     H = (2 / T) sum_k (q X_k^T X_k +
    r G_k^T G_k).

References
----------
Nocedal, Wright, "Numerical Optimization", 2nd ed., chapter 10. Sutton et al. (iterative learning
control) and Abbeel, Quigley, Ng, "Using inaccurate models in reinforcement learning", ICML 2006
(measured trajectory, modelled derivative).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from loop_interfaces.arrays import Array
from loop_method.adapt.local_model import LocalModel


@dataclass(frozen=True, eq=False)
class ReducedTrajectory:
    """A measured trajectory in reduced coordinates.

    x (T, r): its first n_s columns are s; a (T, n_a); features (T, n_s + 1): phi(s_k) = [s_k; 1],
    or [s_k; 0] where the law has no constant part; K (n_a, n_s): feedback da/ds of the law that it
    was measured under; free (T, n_a): 1 where the action moves with the gains, 0 where it was
    saturated, None: it never was.
    """

    x: Array
    a: Array
    features: Array
    K: Array
    free: Array | None = None


@dataclass(frozen=True, eq=False)
class Expansion:
    """The cost of a trajectory to second order in theta: gradient (p,) and curvature (p, p)."""

    gradient: Array
    curvature: Array


def expand(
    path: ReducedTrajectory,
    jacobians: Array,
    B: Array,
    *,
    target: Array,
    state_weight: float,
    action_weight: float,
    gamma: float,
) -> Expansion:
    """Gradient and Gauss-Newton curvature of the mean stage cost along a path.

    Parameters
    ----------
    path : ReducedTrajectory
        A measured trajectory.
    jacobians : (T, r, r) array
        A_k at the states of the path.
    B : (r, n_a) array
        Input matrix of the model.
    target : (r,) array
        V^T z_r.
    state_weight, action_weight : float
        q and r.
    gamma : float
        Forgetting, in (0, 1].
    """
    steps, n_f = path.features.shape
    r, n_a = B.shape
    K = path.K
    n_s, p = K.shape[-1], n_a * n_f
    X = np.zeros((r, p))
    stacked = np.empty((steps, r + n_a, p))
    diagonal = np.arange(n_a)
    for k in range(steps):
        G = K @ X[:n_s]
        G.reshape(n_a, n_a, n_f)[diagonal, diagonal] += path.features[k]
        if path.free is not None:
            G *= path.free[k][:, None]
        stacked[k, :r] = X
        stacked[k, r:] = G
        X = gamma * (jacobians[k] @ X + B @ G)
    stacked[:, :r] *= np.sqrt(state_weight)
    stacked[:, r:] *= np.sqrt(action_weight)
    residual = np.hstack(
        [np.sqrt(state_weight) * (path.x - target), np.sqrt(action_weight) * path.a]
    )
    flat = stacked.reshape(steps * (r + n_a), p)
    return Expansion(
        gradient=(2.0 / steps) * (residual.reshape(-1) @ flat),
        curvature=(2.0 / steps) * (flat.T @ flat),
    )


def damped_step(
    models: Sequence[LocalModel],
    paths: Sequence[ReducedTrajectory],
    *,
    target: Array,
    state_weight: float,
    action_weight: float,
    gamma: float,
    damping: float,
    isotropy: float = 0.3,
) -> tuple[Array, float]:
    """The damped Gauss-Newton step of theta, and the fall of the cost that it predicts.

        (H + lambda D) d = -g,        D = 2 r I (x) (F + iota tr(F) / (n_s + 1) I),        F = mean
        phi phi^T

    g and H are averaged over paths and models. An average over models that disagree has a large H
    where they do, and so a small step. F alone measures a step by the input energy that it adds;
    its second term, with iota the isotropy, bounds the gains in directions of s that the rollouts
    hardly excite, through which the closed loop would otherwise leave the range of the linearisation.

    Returns
    -------
    (n_a, n_s + 1) array and float
        NaN if g and H are not finite.
    """
    n_a, n_f = models[0].B.shape[1], paths[0].features.shape[1]
    p = n_a * n_f
    g, H, energy = np.zeros(p), np.zeros((p, p)), np.zeros((n_f, n_f))
    # A model that is unstable along a path overflows.
    with np.errstate(over="ignore", invalid="ignore"):
        for path in paths:
            share = 1.0 / (len(paths) * len(models))
            for model in models:
                expansion = expand(
                    path,
                    model.jacobians(path.x),
                    model.B,
                    target=target,
                    state_weight=state_weight,
                    action_weight=action_weight,
                    gamma=gamma,
                )
                g += share * expansion.gradient
                H += share * expansion.curvature
            energy += path.features.T @ path.features / (len(path.features) * len(paths))
        energy[np.diag_indices(n_f)] += isotropy * np.trace(energy) / n_f
        matrix = H + damping * 2.0 * action_weight * np.kron(np.eye(n_a), energy)
        matrix[np.diag_indices(p)] += 1e-9 * np.trace(H) / p
        nothing = np.full((n_a, n_f), np.nan), np.nan
        if not (np.isfinite(g).all() and np.isfinite(matrix).all()):
            return nothing
        try:
            d = -linalg.cho_solve(linalg.cho_factor(matrix), g)
        except linalg.LinAlgError:
            return nothing
        return d.reshape(n_a, n_f), float(-(g @ d + 0.5 * d @ H @ d))
