# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law of your own: an action that stays within a limit and approaches it smoothly."""

from dataclasses import dataclass

import numpy as np

import pdeloop


@dataclass(frozen=True, kw_only=True)
class SaturatingSettings(pdeloop.Settings):
    """The constants of the law."""

    limit: float = pdeloop.setting(0.5, "magnitude that no action exceeds", 1e-6, 1e6)


class Saturating(pdeloop.Law):
    """a = A tanh((K s + b) / A), which begins with the LQ-tracking gains."""

    name = "saturating"
    Settings = SaturatingSettings

    def start(self):
        return {"K": self.model.K_a, "b": self.model.K_b @ self.model.s_r}

    def action(self, theta, z, memory, k):
        limit = self.settings.limit
        return limit * np.tanh((theta["K"] @ self.reduced(z) + theta["b"]) / limit)
