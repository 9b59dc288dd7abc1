# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law with an observer in a closed loop on a model.

Its memory is the prediction p of the reduced state, and its theta, in the sense of `closed_loop`, is

    Theta = [D K b; G F c].
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from scipy import linalg

from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.closed_loop import ClosedLoop
from pdeloop.method.laws.observer import Observer

ROUND = 1e-2
"""Share of the identity in the cost matrix of a change of the memory, beyond that of the gains."""


@dataclass(frozen=True, eq=False)
class ObservedLoop(ClosedLoop):
    """A model under laws with an observer.

    Attributes
    ----------
    law : Observer
        That of the reduced model; policies are its theta, and theta here is Theta.
    """

    law: Observer = field(kw_only=True)

    constant_feature: ClassVar[float] = 1.0
    """b and c are gains of their own, whatever the target is."""

    def theta(self, policy: Array) -> Array:
        """Theta (n_a + n_s, 2 n_s + 1) of the law's vector."""
        p = self.law.parts(np.ravel(policy))
        return np.block([[p["D"], p["K"], p["b"][:, None]], [p["G"], p["F"], p["c"][:, None]]])

    def policy(self, theta: Array, near: Array) -> Array:
        """The law's vector, of the shape of `near`."""
        n_a, n_s = self.law.n_a, len(self.law.model.A)
        (D, K, b), (G, F, c) = (
            np.split(rows, [n_s, 2 * n_s], axis=1) for rows in (theta[:n_a], theta[n_a:])
        )
        parts = {"D": D, "K": K, "b": b[:, 0], "G": G, "F": F, "c": c[:, 0]}
        others = self.law.parts(np.zeros(self.law.size))  # of a law that is derived from it
        return self.law.vector({**others, **parts}).reshape(near.shape)

    @property
    def memory_input(self) -> Array:
        """B of the reduced model."""
        return self.law.model.B

    def curvature(self, own: Array) -> Array:
        """Cost matrix of a change of [a; u], from that of an action alone, (n_a, n_a).

        A prediction that is wrong by one moves the action by K.
        """
        K = self.law.model.K_a
        moved = K.T @ own @ K
        size = float(np.trace(moved)) / len(moved)
        moved[np.diag_indices(len(moved))] += ROUND * (size or 1.0)
        return np.asarray(linalg.block_diag(own, moved), dtype=np.float64)

    def _noise(self, drawn: Array) -> Array:
        """Effect of the noise on U^T z, where the columns of U need not be orthonormal."""
        R = linalg.qr(self.U, mode="r")[0][: min(self.U.shape)]
        return np.asarray(super()._noise(drawn)[..., : len(R)] @ R, dtype=np.float64)
