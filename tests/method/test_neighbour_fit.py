# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Equations of products of neighbours are recovered exactly, with no other terms."""

from __future__ import annotations

import numpy as np
import pytest

from pdeloop.method.models import FieldModelSettings, finite_difference
from pdeloop.method.models.base import errors, samples_of
from pdeloop.method.models.finite_difference import fit_neighbours
from pdeloop.method.models.selection import NEAR_NEEDED
from tests.support.fitted import fit_field_model
from tests.support.ordinary import rolled_out

N_X, DT = 12, 0.1
SETTINGS = FieldModelSettings(folds=2)


@pytest.fixture(autouse=True)
def shorter_steps(monkeypatch):
    monkeypatch.setattr(finite_difference, "_NEAR_REACH", 0.2)


B = np.repeat(np.eye(3), 4, axis=0)


def neighbour(z, by):
    return np.roll(z, -by, axis=-1)


def explored(rate, count, n_z, steps=60, variance=1.0, start=1.0):
    """Rollouts of dz/dt = rate(z) + B a in fine steps, white inputs acting on the last cells."""
    rng = np.random.default_rng(0)
    actions = np.sqrt(variance) * rng.normal(size=(count, steps, B.shape[1]))
    force = np.zeros((count, steps, n_z))
    force[..., n_z - N_X :] = actions @ B.T
    first = start + 0.5 * rng.normal(size=(count, n_z))
    return rolled_out(rate, first, force, actions, DT / 20, 20)


def chain(z):
    """Products at distances 1, 2 and of three neighbours; no difference of any power."""
    product = 0.8 * neighbour(z, 1) * neighbour(z, -2) - 0.5 * neighbour(z, -1) ** 2
    return product - z + 0.7 * neighbour(z, 2) - 0.2 * z * neighbour(z, 1) * neighbour(z, -1) + 0.3


CHAIN = {
    ((0,), (0,)): -1.0,
    ((0,), (2,)): 0.7,
    ((0, 0), (-2, 1)): 0.8,
    ((0, 0), (-1, -1)): -0.5,
    ((0, 0, 0), (-1, 0, 1)): -0.2,
}


def test_a_plant_of_products_of_neighbours_is_recovered_to_1e_6_without_other_terms():
    rollouts = explored(chain, 2, N_X)
    model = fit_neighbours(samples_of(rollouts), kind="near-shared")
    found = {}
    for (n, *row), C in zip(model.table.tolist(), model.coefficients, strict=True):
        shifts = tuple(i if i < N_X / 2 else i - N_X for i in row[3 : 3 + n])
        found[tuple(row[:n]), shifts] = C
    assert found.keys() == CHAIN.keys()
    for term, C in found.items():
        np.testing.assert_allclose(C / DT, CHAIN[term], atol=1e-6)
    np.testing.assert_allclose(model.B / DT, B, atol=1e-6)
    np.testing.assert_allclose(model.constant / DT, 0.3, atol=1e-6)


def lorenz(z):
    """Lorenz-96, which is chaotic."""
    return (neighbour(z, 1) - neighbour(z, -2)) * neighbour(z, -1) - z + 8.0


def test_whole_rollouts_of_a_chaotic_plant_are_predicted():
    """Errors of the path's means alone, 1e-4 of a step, would be as large as the plant at the end."""
    rollouts = explored(lorenz, 4, N_X, steps=50, variance=4.0, start=4.0)
    fitted = fit_field_model(rollouts[:3], np.zeros(N_X), settings=SETTINGS, first="near-shared")
    assert fitted is not None
    assert fitted.model.kind == "near-shared" and fitted.error < 1e-4
    assert errors(fitted.model, rollouts[3:], np.zeros(N_X), 2.0)[0] < 1e-4
    assert len(fitted.model.table) == 3


GROWTH = 1.0 + 0.3 * np.cos(np.arange(N_X))


def species(z):
    """A ring of competing species, each with a growth of its own."""
    return z * (GROWTH - z - 0.4 * neighbour(z, 1) - 0.6 * neighbour(z, -1))


def oscillators(z):
    """A Fermi-Pasta-Ulam ring: displacements, then speeds, with cubic springs to neighbours."""
    q, p = np.split(z, 2, axis=-1)
    stretch = neighbour(q, 1) - q
    force = stretch + 0.5 * stretch**3
    return np.concatenate([p, force - neighbour(force, -1) - 0.1 * p], axis=-1)


def layers(z):
    """Lorenz-96 in two layers, with products of second neighbours in each of them."""
    x, y = np.split(z, 2, axis=-1)
    dx = (neighbour(x, 1) - neighbour(x, -2)) * neighbour(x, -1) - x - 0.5 * y + 4.0
    dy = 2.0 * (neighbour(y, -1) - neighbour(y, 2)) * neighbour(y, 1) - 2.0 * y + 0.5 * x
    return np.concatenate([dx, dy], axis=-1)


@pytest.mark.parametrize(
    ("rate", "components", "ridge", "variance", "terms"),
    [(species, 1, 1e-9, 0.05, 4), (oscillators, 2, None, 0.3, 11), (layers, 2, None, 1.0, 6)],
)
def test_cells_of_their_own_and_pairs_of_components_are_described(
    rate, components, ridge, variance, terms, monkeypatch
):
    """The oscillators': the speed, three displacements, and the seven cubes of (q_i, q_{i+1}).

    The layers': both values, and two products in each.
    """
    monkeypatch.setattr(finite_difference, "_NEAR_SAMPLES", 50)
    n_z, start = components * N_X, 1.0 if rate is species else 0.0
    rollouts = explored(rate, 4, n_z, variance=variance, start=start)
    model = fit_neighbours(
        samples_of(rollouts[:3]),
        kind="k",
        components=components,
        ridge=ridge,
    )
    assert len(model.table) == terms
    assert errors(model, rollouts[3:], np.zeros(n_z), 2.0)[0] < 1e-8


def test_they_are_not_tried_where_another_kind_predicts_the_rollouts():
    rollouts = explored(lambda z: 0.2 * (neighbour(z, 1) - 2 * z + neighbour(z, -1)) - z, 3, N_X)
    settings = FieldModelSettings(reproduced=0.0, largest_degree=2, folds=2)
    fitted = fit_field_model(rollouts, np.zeros(N_X), settings=settings)
    assert fitted is not None and fitted.error < NEAR_NEEDED
    assert not any(kind.startswith(("near", "two-near")) for kind, _ in fitted.candidates)
