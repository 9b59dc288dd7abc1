# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The constants of identification and of the design of the first law."""

from __future__ import annotations

from dataclasses import dataclass

from pdeloop.method.settings import Settings, setting


@dataclass(frozen=True, kw_only=True)
class IdentificationSettings(Settings):
    """Constants of the reduced model and of the first law.

    All are dimensionless: errors are relative to the data.
    """

    order_folds: int = setting(
        4, "number of groups of pieces of an exploratory episode, each held out once", 2, 1000
    )
    order_share: float = setting(
        0.8,
        "share of the best order's reduction of the one-step error, on a logarithmic scale, that "
        "the suggested order reaches",
        0.0,
        1.0,
    )
    field_error: float = setting(
        0.05, "largest error of a model that a first law is designed from", 0.0, 1.0
    )
    noise_evidence: float = setting(
        2.0,
        "standard errors by which the residuals must show measurement noise before a filter is "
        "designed for it",
        0.0,
        100.0,
    )


DEFAULTS = IdentificationSettings()
