"""The columns of a policy, which say what law it is.

    affine       [K_a K_b]      a = K_a s + K_b s_r
    quadratic    [K_a K_b Q]    a = K_a s + K_b s_r + sum_{i <= j} Q_ij e_i e_j,    e = s - s_r

with s = U^T z and s_r = U^T z_r. K_a and K_b have n_s columns each; Q has one for every pair i <= j,
in the order (0, 0), (0, 1), ..., (0, n_s - 1), (1, 1), ...: n_s (n_s + 1) / 2 more. As that is at least
one, the number of columns tells the two apart.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

POLICY_FEATURES = ("affine", "quadratic")
"""The laws, by the names that the parameter `policy_features` uses."""


def quadratic_columns(n_s: int) -> int:
    """Columns of Q: the products e_i e_j with i <= j."""
    return n_s * (n_s + 1) // 2


def policy_columns(n_s: int, features: str) -> int:
    """Columns of a policy of n_s modes."""
    return 2 * n_s + (quadratic_columns(n_s) if features == "quadratic" else 0)


def with_features(policies: NDArray[np.float64], features: str) -> NDArray[np.float64]:
    """Policies [K_a K_b], (..., n_a, 2 n_s), with Q = 0 where `features` has a Q: the same law."""
    *front, columns = policies.shape
    missing = policy_columns(columns // 2, features) - columns
    if not missing:
        return policies
    return np.concatenate([policies, np.zeros((*front, missing))], axis=-1)
