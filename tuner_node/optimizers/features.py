"""The features of the law, and what it feeds back along a trajectory.

    a = theta phi(s),        theta = [K_a b] or [K_a b Q],
    phi(s) = [s; 1] or [s; 1; (e_i e_j)_{i <= j}],        e = s - s_r

K_b acts only through b = K_b s_r. The law is linear in theta, so da/dtheta = I (x) phi^T whatever the
features are, and a change of s acts through

    K(s) = theta dphi/ds = K_a + sum_{i <= j} Q_ij (e_i u_j + u_i e_j)^T        (u_i: unit vectors).

The products vanish at the target to second order, so Q does not change the linearised loop there.
"""

from __future__ import annotations

import numpy as np

from loop_interfaces.policy_columns import POLICY_FEATURES, policy_columns
from tuner_node.optimizers.base import Array

__all__ = ["Features", "known_columns"]


def known_columns(n_s: int) -> tuple[int, ...]:
    """The numbers of columns that a policy of n_s modes can have."""
    return tuple(policy_columns(n_s, features) for features in POLICY_FEATURES)


class Features:
    """phi of one basis.

    Parameters
    ----------
    s_r : (n_s,) array
        U^T z_r.
    one : float
        1, or 0 where the law has no constant part.
    quadratic : bool
        Whether there are products.
    """

    def __init__(self, s_r: Array, one: float, *, quadratic: bool) -> None:
        self._s_r, self._one, self._quadratic = s_r, one, quadratic
        self._rows, self._columns = np.triu_indices(s_r.size)

    def __call__(self, s: Array) -> Array:
        """phi at the states s (T, n_s), (T, n_f)."""
        parts = [s, np.full((len(s), 1), self._one)]
        if self._quadratic:
            e = s - self._s_r
            parts.append(e[:, self._rows] * e[:, self._columns])
        return np.hstack(parts)

    def feedback(self, theta: Array, s: Array) -> Array:
        """K(s): (n_a, n_s) where it is the same everywhere, (T, n_a, n_s) at the states s otherwise.

        theta : (n_a, n_f) array
        """
        n_s = self._s_r.size
        K = np.ascontiguousarray(theta[:, :n_s])
        if not self._quadratic:
            return K
        Q = theta[:, n_s + 1 :]
        # Symmetric in both indices, twice the diagonal: d(sum Q_ij e_i e_j)/de_l = sum_m S_lm e_m.
        symmetric = np.zeros((len(theta), n_s, n_s))
        symmetric[:, self._rows, self._columns] += Q
        symmetric[:, self._columns, self._rows] += Q
        along: Array = K + np.einsum("alm,km->kal", symmetric, s - self._s_r)
        return np.ascontiguousarray(along)
