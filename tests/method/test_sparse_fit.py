# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Networks in no order and inputs that act late: equations and maps of few products are recovered."""

from __future__ import annotations

import numpy as np
import pytest

from pdeloop.method.models import (
    FieldModelSettings,
    Measured,
    finite_difference,
)
from pdeloop.method.models.base import Samples, errors
from pdeloop.method.models.files import model_of
from pdeloop.method.models.finite_difference import (
    Feature,
    FiniteDifferenceModel,
    chosen,
    fit_sparse,
    products,
)
from pdeloop.method.models.selection import SPARSE, kinds_of
from tests.support.fitted import fit_field_model
from tests.support.ordinary import rolled_out

SETTINGS = FieldModelSettings(folds=2)


@pytest.fixture(autouse=True)
def shorter_steps(monkeypatch):
    monkeypatch.setattr(finite_difference, "_NEAR_REACH", 0.2)


N_Z, DT, LATE = 9, 0.1, 3
PRODUCTS = {(0, 7): -0.5, (2, 5): 0.6, (4, 4): -0.3, (1, 3, 8): 0.4, (6, 6, 6): -0.5}
"""Of the equation of each number in turn."""


def rate(z):
    """dz/dt of a network: a number rests by itself, and products of any two or three drive others."""
    found = -0.5 * z + 0.3 * np.roll(z, 2, axis=-1)
    for i, (own, c) in enumerate(PRODUCTS.items()):
        found[..., i] += c * np.prod(z[..., own], axis=-1)
    return found


def network(count=3, steps=60):
    """Rollouts under white inputs, in fine steps."""
    rng = np.random.default_rng(0)
    actions = rng.normal(size=(count, steps, 2))
    force = np.zeros((count, steps, N_Z))
    force[..., [0, 4]] = actions
    return rolled_out(rate, rng.normal(size=(count, N_Z)), force, actions, DT / 10, 10)


def late(count=3, steps=80):
    """A map: an oscillator x, v with a cube, whose input acts after three samples, which are kept."""
    rng = np.random.default_rng(1)
    rollouts = []
    for _ in range(count):
        z = np.zeros(2 + LATE)
        z[:2] = rng.normal(size=2)
        states, actions = [z], rng.normal(size=(steps, 1))
        for a in actions:
            x, v, *line = z
            v = v + 0.1 * (-x + 0.5 * v - 0.8 * x * x * v + line[0])
            z = np.array([x + 0.1 * v, v, *line[1:], a[0]])
            states.append(z)
        rollouts.append(Measured(np.array(states), actions))
    return rollouts


def test_the_products_of_a_network_are_found_and_its_equation_recovered():
    rollouts = network()
    samples = Samples.of(rollouts[:2])
    assert set(PRODUCTS) <= set(chosen(samples))
    model = fit_sparse(samples, kind="sparse", is_map=False)
    assert model is not None and model.substeps > 0
    found = {f.factors: model.coefficients[n, :, 0] for n, f in enumerate(model.features)}
    for i, (own, c) in enumerate(PRODUCTS.items()):
        assert found[own] == pytest.approx(np.where(np.arange(N_Z) == i, DT * c, 0.0), abs=1e-6)
    assert errors(model, rollouts[2:], np.zeros(N_Z), 2.0).max() < 1e-6


def test_inputs_that_act_late_are_a_map_and_no_equation():
    rollouts = late()
    fitted = fit_field_model(rollouts, np.zeros(2 + LATE), settings=SETTINGS)
    tried = dict(fitted.candidates)
    assert fitted.model.kind == "sparse-map" and fitted.error < 1e-10
    assert tried["linear"] > 0.05
    flow = fit_sparse(Samples.of(rollouts), kind="sparse", is_map=False)
    assert flow is None or errors(flow, rollouts, np.zeros(2 + LATE), 2.0).min() > 1e-3


def test_a_map_has_the_transposed_derivatives_of_its_step_and_is_read_again():
    rng = np.random.default_rng(2)
    features = tuple(Feature(own) for own in ((0,), (1,), (2,), (0, 2), (1, 1, 2)))
    C, B, c = rng.normal(size=(5, 3, 1)), rng.normal(size=(3, 2)), rng.normal(size=3)
    model = FiniteDifferenceModel("sparse-map", features, C, B, c, 0)
    again = model_of(model.arrays())
    z, a, y = rng.normal(size=(4, 3)), rng.normal(size=(4, 2)), rng.normal(size=(4, 3))
    rates = np.stack([np.prod(z[:, f.factors], axis=1) for f in features], axis=1)
    np.testing.assert_allclose(model.step(z, a), z + rates @ C[:, :, 0] + a @ B.T + c, rtol=1e-12)
    assert np.array_equal(again.step(z, a), model.step(z, a))
    on_z, on_a = model.pull_back(z, a, y)
    h = 1e-6
    for i in range(3):
        e = h * np.eye(3)[i]
        by_z = np.sum(y * (model.step(z + e, a) - model.step(z - e, a)), axis=1) / (2 * h)
        np.testing.assert_allclose(on_z[:, i], by_z, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(on_a, y @ B, rtol=1e-12)


def test_what_no_product_explains_has_no_such_model():
    rng = np.random.default_rng(3)
    z = rng.normal(size=(200, 6))
    samples = Samples(z, rng.normal(size=(200, 1)), z + np.sign(np.roll(z, 1, axis=1)))
    assert all(
        fit_sparse(samples, kind="sparse", is_map=is_map) is None for is_map in SPARSE.values()
    )


def test_products_of_three_different_numbers_are_left_out_where_they_are_many():
    assert len(products(4, 2500)) == 10 + 20
    assert len(products(40, 2500)) == 820 + 1600
    small, large = ({kind.name for kind in kinds_of(n, SETTINGS)} for n in (40, 41))
    assert set(SPARSE) <= small and not set(SPARSE) & large
