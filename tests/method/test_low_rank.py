# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A model in POD modes recovers a planted one, and is written whole."""

from __future__ import annotations

import numpy as np

from pdeloop.method.models import Measured
from pdeloop.method.models.base import model_of
from pdeloop.method.models.linear import LinearModel, ProjectedModel
from tests.support.fitted import fit_field_model

N_Z, R, N_A = 3000, 5, 2
RNG = np.random.default_rng(0)
V = np.linalg.qr(RNG.standard_normal((N_Z, R)))[0]
A = 0.9 * np.linalg.qr(RNG.standard_normal((R, R)))[0]
INNER = LinearModel("linear", A, RNG.standard_normal((R, N_A)), RNG.standard_normal(R))
PLANTED = ProjectedModel(INNER, V.T, V)


def rollouts(count: int) -> list[Measured]:
    found = []
    for _ in range(count):
        states, actions = [V @ RNG.standard_normal(R)], RNG.standard_normal((30, N_A))
        for a in actions:
            states.append(PLANTED.step(states[-1][None], a[None])[0])
        found.append(Measured(np.array(states), actions))
    return found


def test_a_planted_model_of_a_large_field_on_two_axes_is_recovered() -> None:
    fitted = fit_field_model(rollouts(3), np.zeros(N_Z), line=False)
    assert fitted is not None and fitted.error < 1e-12
    assert fitted.model.kind == "linear"
    z, a = (V @ RNG.standard_normal(R))[None], RNG.standard_normal((1, N_A))
    np.testing.assert_allclose(fitted.model.step(z, a), PLANTED.step(z, a), atol=1e-6)
    again = model_of(fitted.model.arrays())
    assert np.array_equal(again.step(z, a), fitted.model.step(z, a))
