# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The constants of identification and of the design of the first law."""

from __future__ import annotations

from dataclasses import dataclass

from loop_method.settings import Settings, setting


@dataclass(frozen=True, kw_only=True)
class IdentificationSettings(Settings):
    """Constants of the reduced model and of the first law.

    All are dimensionless: errors are relative to the data.
    """

    order_pieces: int = setting(
        8, "number of pieces of an exploratory episode from which an order is suggested", 2, 1000
    )
    order_folds: int = setting(4, "number of groups of these pieces, each held out once", 2, 1000)
    order_share: float = setting(
        0.8,
        "share of the best order's reduction of the one-step error, on a logarithmic scale, that "
        "the suggested order reaches",
        0.0,
        1.0,
    )
    field_largest: int = setting(
        512,
        "largest state for which a model of the whole field is fitted for the first law",
        0,
        65536,
    )
    field_error: float = setting(
        0.05, "largest error of a model that a first law is designed from", 0.0, 1.0
    )
    field_pieces: int = setting(
        8, "pieces of an episode that the model may predict instead of the whole", 1, 1000
    )
    field_thinning: int = setting(
        5, "interval between the simulated states that the basis is computed from", 1, 1000
    )
    field_room: float = setting(
        2.0,
        "modes per actuator from which on the basis includes the rows of the full-state feedback",
        1.0,
        1000.0,
    )
    subspace_tolerance: float = setting(
        1.02, "multiple of the least held-out error up to which a lower order is chosen", 1.0, 100.0
    )
    noise_evidence: float = setting(
        2.0,
        "standard errors by which the residuals must show measurement noise before a filter is "
        "designed for it",
        0.0,
        100.0,
    )


DEFAULTS = IdentificationSettings()
