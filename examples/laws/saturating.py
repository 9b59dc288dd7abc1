# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law of one's own: an action that never exceeds a limit, and is smooth where it comes near it."""

import numpy as np

import pdeloop

LIMIT = 0.5


class Saturating(pdeloop.Law):
    """a = A tanh((K s + b) / A), which begins with the LQ-tracking gains."""

    name = "saturating"

    def start(self):
        return {"K": self.model.K_a, "b": self.model.K_b @ self.model.s_r}

    def action(self, theta, z, memory, k):
        return LIMIT * np.tanh((theta["K"] @ self.reduced(z) + theta["b"]) / LIMIT)
