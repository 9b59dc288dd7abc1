# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Gradients of whole episodes by the parameters of any law, through its memory where it has one."""

from __future__ import annotations

import numpy as np
import pytest

import pdeloop
from pdeloop.messages.model_rows import ModelRows
from pdeloop.method.laws import Affine, FeedForward, Law, Observer

N_Z, N_A, N_S, T, SEEDS = 6, 2, 3, 12, [3, 1]


class Cubic(pdeloop.Dynamics):
    """z+ = A z - 0.05 z^3 + B a."""

    n_z, n_a, horizon, target = N_Z, N_A, T, 0.3
    A = 0.9 * np.eye(N_Z) + 0.1 * np.eye(N_Z, k=1)
    B = np.linspace(-1.0, 1.0, N_Z * N_A).reshape(N_Z, N_A)

    def initial_state(self, rng):
        return rng.standard_normal(N_Z)

    def step(self, z, a):
        return self.A @ z - 0.05 * z**3 + self.B @ a

    def pull_back(self, z, a, y):
        return self.A.T @ y - 0.15 * z**2 * y, self.B.T @ y


def law_of(kind: type[Law]) -> Law:
    rng = np.random.default_rng(7)
    U = np.linalg.qr(rng.standard_normal((N_Z, N_S)))[0]
    K_a, K_b = -0.2 * rng.standard_normal((2, N_A, N_S))
    model = ModelRows(U.T @ Cubic.A @ U, U.T @ Cubic.B, U, K_a, K_b, U.T @ np.full(N_Z, 0.3))
    return kind(model, T)


@pytest.mark.parametrize("kind", [Affine, FeedForward, Observer])
def test_they_agree_with_finite_differences(kind: type[Law]) -> None:
    law, gradients, rng = law_of(kind), pdeloop.Gradients(Cubic()), np.random.default_rng(1)
    theta = law.theta_start + 0.2 * rng.standard_normal(law.size)
    fields = gradients.plant.reset(SEEDS).copy()
    found = gradients.of_theta(law, theta, fields)
    for _ in range(3):
        d, e = rng.standard_normal(law.size), rng.standard_normal(fields.shape)
        up, down = (gradients.of_theta(law, theta + h * d, fields).cost for h in (1e-5, -1e-5))
        assert (up - down) / 2e-5 == pytest.approx(found.gradient @ d, rel=1e-6)
        up, down = (gradients.of_theta(law, theta, fields + h * e).cost for h in (1e-5, -1e-5))
        assert (up - down) / 2e-5 == pytest.approx((found.of_fields * e).sum(), rel=1e-6)


def test_of_the_affine_law_they_are_those_of_its_policy() -> None:
    law, gradients = law_of(Affine), pdeloop.Gradients(Cubic())
    own = gradients.of_theta(law, law.theta_start, SEEDS)
    known = gradients.of_policy(law.model.U, law.theta_start.reshape(law.shape), SEEDS)
    assert own.cost == pytest.approx(known.cost, rel=1e-12)
    np.testing.assert_allclose(own.gradient.reshape(law.shape), known.gradient, rtol=1e-9)
    np.testing.assert_allclose(own.of_fields, known.of_fields, rtol=1e-9, atol=1e-15)


def test_a_law_without_derivatives_is_refused_and_one_that_diverges_costs_infinity() -> None:
    class Bang(Law):
        def start(self):
            return {"a": np.zeros(N_A)}

        def action(self, theta, z, memory, k):
            return theta["a"]

    gradients = pdeloop.Gradients(Cubic())
    with pytest.raises(ValueError, match="the law 'Bang' has no derivatives"):
        gradients.of_theta(law_of(Bang), np.zeros(N_A), SEEDS)
    law = law_of(Affine)
    with pytest.raises(ValueError, match="theta must have shape"):
        gradients.of_theta(law, np.zeros(3), SEEDS)
    found = gradients.of_theta(law, np.full(law.size, 1e6), SEEDS)
    assert found.cost == np.inf and not found.gradient.any()
