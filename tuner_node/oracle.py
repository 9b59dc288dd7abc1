# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Perturbations of a policy, and the two-point gradient estimate.

For a policy pi = [K_a K_b] of shape (n_a, 2 n_s), a direction Theta with |Theta|_F = 1 and a
smoothing radius r,

    g = (n_a n_s / r) (J(pi + r Theta) - J(pi - r Theta)) Theta,        pi <- pi - eta g.

Both rollouts start from the same initial field. With d = 2 n_a n_s entries, E[d Theta Theta^T] = I
for a uniform direction, so g = d (J+ - J-) / (2 r) Theta estimates the gradient of J without bias,
up to the smoothing.

Every draw is a pure function of (seed, stream, iteration): a training that is interrupted and goes
on draws what it would have drawn. Sums are elementwise (no BLAS), so that a policy is the same to
the last bit on every run.

References
----------
Zhang, Mowlavi, Benosman, Basar, "Policy Optimization for PDE Control with a Warm Start",
arXiv:2403.01005.
Spall, "Introduction to Stochastic Search and Optimization", chapter 7.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Large constants: numpy pads a short seed sequence with zeros, so [seed, stream, 0] would equal the
# [seed, step] of another user of the same seed if the stream were a small number.
_DIRECTION_STREAM = 0x5448455441  # "THETA"
_FIELD_STREAM = 0x4649454C44  # "FIELD"
# Field seeds travel as float64, which holds every integer below 2^53.
_SEED_LIMIT = 2**53


def direction(seed: int, iteration: int, shape: tuple[int, int]) -> Array:
    """Theta of an iteration, uniform on the sphere of unit Frobenius norm.

    Parameters
    ----------
    seed, iteration : int
        Not negative.
    shape : tuple of int
        (n_a, 2 n_s), the shape of a policy.

    Returns
    -------
    (n_a, 2 n_s) array
    """
    theta: Array = np.random.default_rng([seed, _DIRECTION_STREAM, iteration]).standard_normal(
        shape
    )
    theta /= np.sqrt(np.sum(theta * theta))
    return theta


def field_seed(seed: int, iteration: int) -> int:
    """The seed of the initial field that the rollouts of an iteration share, in 0 .. 2^53 - 1."""
    return int(np.random.default_rng([seed, _FIELD_STREAM, iteration]).integers(_SEED_LIMIT))


def gradient(cost_plus: float, cost_minus: float, direction: Array, radius: float) -> Array:
    """The two-point estimate (n_a n_s / r) (J+ - J-) Theta, shape (n_a, 2 n_s)."""
    n_a, columns = direction.shape
    estimate: Array = n_a * (columns // 2) / radius * (cost_plus - cost_minus) * direction
    return estimate
