# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A policy to try, and its entries in the history."""

from __future__ import annotations

from dataclasses import dataclass

from loop_interfaces.arrays import Array
from loop_method.adapt.base import Row

LOCAL = "local"


@dataclass(frozen=True, eq=False)
class Proposal:
    """A policy to try.

    Attributes
    ----------
    policy : (n_a, 2 n_s) array
    fall : float
        The fall of the mean stage cost that the quadratic model predicts.
    models : int
        How many models were averaged.
    kappa : float
        Forgetting.
    mismatch : float
        Their smallest relative error in predicting measured differences of trajectories, or that of the
        model of the whole field in predicting rollouts.
    kind : str
        "local", "sensed", or the kind of the model of the whole field.
    believed : str
        The kind of the model of the whole field that was believed, also where the step is local; empty:
        none.
    whole : bool
        Whether that model predicts rollouts as a whole.
    """

    policy: Array
    fall: float
    models: int
    kappa: float
    mismatch: float
    kind: str = LOCAL
    believed: str = ""
    whole: bool = False

    def row(self) -> Row:
        """Its entries in a row of the history."""
        return {
            "predicted_fall": self.fall,
            "models": self.models,
            "kappa": self.kappa,
            "mismatch": self.mismatch,
            "model": self.kind,
        }
