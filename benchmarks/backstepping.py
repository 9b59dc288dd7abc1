# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Backstepping laws of the boundary-controlled plants: a = sum_i k_i u_i, from the kernels' equations.

Those of PDEControlGym's notebooks, `source_...`, are discretised as there, with rectangles and shifted
points.

References
----------
Krstic, Smyshlyaev, "Boundary Control of PDEs", SIAM 2008, chapters 4 and 9.
"""

from __future__ import annotations

import numpy as np

from pde_sim_node.plants.boundary import BoundaryControlled
from pdeloop.messages.arrays import Array


def transport_gain(beta: Array) -> Array:
    """Of u_t = u_x + beta(x) u(0, t) on equally spaced points (n + 1,).

    a = int_0^1 kappa(1 - y) u(y) dy with kappa = -beta + beta * kappa, a Volterra equation, which the
    trapezoidal rule makes triangular.
    """
    n = len(beta) - 1
    h, kappa = 1.0 / n, np.empty(n + 1)
    kappa[0] = -beta[0]
    for i in range(1, n + 1):
        known = 0.5 * beta[i] * kappa[0] + beta[i - 1 : 0 : -1] @ kappa[1:i]
        kappa[i] = (-beta[i] + h * known) / (1.0 - 0.5 * h * beta[0])
    return _trapezoidal(kappa[::-1])


def reaction_gain(beta: Array) -> Array:
    """Of u_t = u_xx + beta(x) u, u(0, t) = 0, on equally spaced points (n + 1,).

    a = int_0^1 k(1, y) u(y) dy with k_xx - k_yy = beta(y) k, k(x, 0) = 0 and k(x, x) = -1/2 int_0^x
    beta, which is marched in x.
    """
    n = len(beta) - 1
    h, k = 1.0 / n, np.zeros((n + 1, n + 1))
    diagonal = -0.5 * h * np.concatenate([[0.0], np.cumsum(0.5 * (beta[1:] + beta[:-1]))])
    k[1, 1] = diagonal[1]
    for i in range(1, n):
        k[i + 1, i + 1] = diagonal[i + 1]
        # Next to the diagonal, where the point before lies beyond it: half of the two on it.
        k[i + 1, i] = 0.5 * (diagonal[i] + diagonal[i + 1])
        inside = slice(1, i)
        around = k[i, 2 : i + 1] + k[i, 0 : i - 1]
        k[i + 1, inside] = -k[i - 1, inside] + around * (1.0 + 0.5 * h**2 * beta[inside])
    return _trapezoidal(k[n])


def source_transport_gain(plant: BoundaryControlled) -> Array:
    """As in HyperbolicPDEExample.ipynb: 100 points, h = 0.01."""
    n = plant.grid.size
    h = 1.0 / n
    theta = plant.strength * np.cos(plant.rate * np.arccos(np.linspace(h, 1.0, n + 1)))
    kappa = -theta
    for i in range(2, n + 1):
        kappa[i] = h * (kappa[i - 1 : 0 : -1] @ theta[1:i]) - theta[i]
    gain: Array = h * kappa[n:0:-1]
    return gain


def source_reaction_gain(plant: BoundaryControlled) -> Array:
    """As in ParabolicPDEExample.ipynb: 201 points, of which the last has no part."""
    n = plant.grid.size - 1
    h = 1.0 / n
    beta = plant.strength * np.cos(plant.rate * np.arccos(np.linspace(h, 1.0, n)))
    k = np.zeros((n, n))
    k[1, 1] = -0.25 * h * (beta[1] + beta[0])
    for i in range(1, n - 1):
        k[i + 1, i + 1] = k[i, i] - 0.25 * h * (beta[i - 1] + beta[i])
        k[i + 1, i] = k[i, i] - 0.5 * h * beta[i]
        around = k[i, 2 : i + 1] + k[i, 0 : i - 1]
        k[i + 1, 1:i] = -k[i - 1, 1:i] + around * (1.0 + 0.5 * h**2 * beta[1:i])
    return np.append(h * k[-1], 0.0)


def _trapezoidal(values: Array) -> Array:
    """The weights of the integral of values times u."""
    weights = np.full(len(values), 1.0 / (len(values) - 1))
    weights[[0, -1]] *= 0.5
    scaled: Array = weights * values
    return scaled
