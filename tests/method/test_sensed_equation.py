# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The equation of a field between a few point sensors, its actuators, and simulations of it."""

from __future__ import annotations

import numpy as np
from threadpoolctl import threadpool_limits

from pde_sim_node.plants.kuramoto_sivashinsky_eight import KuramotoSivashinskyEight
from pdeloop.method.models.sensed import (
    COEFFICIENTS,
    SHARED,
    TERMS,
    sensed_model,
    unit,
    unknowns,
)
from pdeloop.method.models.sensed_fit import fit_sensed
from tests.support.sensed import DECLARED, PLACES, SENSORS, equally_spaced, readings_of


def test_each_actuator_may_be_as_strong_as_it_is() -> None:
    """The second of three is reversed and the third does nothing."""
    actuators, rng = equally_spaced(3), np.random.default_rng(2)
    shared = np.zeros(unknowns(3))
    shared[[TERMS.index((1, 0)), TERMS.index((1, 2)), COEFFICIENTS]] = 1.0, 0.5, 5.0
    shared[SHARED:] = 0.0, -10.0, -5.0
    model = sensed_model(shared, PLACES, actuators, 4.0)
    x = np.arange(model.n_z) / model.n_z
    actions = 5.0 * rng.standard_normal((2, 14, 3))
    fields = [np.cos(2 * np.pi * x), 0.5 + np.sin(4 * np.pi * x)]
    readings = [readings_of(model, *pair) for pair in zip(actions, fields, strict=True)]
    with threadpool_limits(1):
        found = fit_sensed(readings, list(actions), PLACES, actuators)
    assert found.error < 1e-4
    strengths = found.shared[COEFFICIENTS] + found.shared[SHARED:]
    np.testing.assert_allclose(strengths, [5.0, -5.0, 0.0], atol=0.3)
    B = sensed_model(found.shared, PLACES, actuators, 4.0).B
    assert np.linalg.norm(B - model.B) < 0.15 * np.linalg.norm(model.B)


def test_an_equation_that_the_calmest_rollouts_do_not_show_is_found_from_large_inputs() -> None:
    """The calmest ones have only what no equation explains, too small to matter in the others."""
    shared, random = np.zeros(unknowns(3)), np.random.default_rng(0)
    shared[[TERMS.index((1, 2)), TERMS.index((1, 0)), COEFFICIENTS]] = 5.0, 1.0, 5.0
    model = sensed_model(shared, PLACES, DECLARED, 10.0)
    x = (np.arange(model.n_z) + 0.5) / model.n_z
    actions = random.normal(size=(4, 30, 3)) * np.array([1e-4, 1e-4, 3.0, 1.0])[:, None, None]
    fields = [np.cos(2 * np.pi * (x - shift)) for shift in (0.1, 0.4)]
    readings = [*1e-3 * random.normal(size=(2, 30, SENSORS))]
    readings += [readings_of(model, a, z) for a, z in zip(actions[2:], fields, strict=True)]
    with threadpool_limits(1):
        found = fit_sensed(readings, list(actions), PLACES, DECLARED)
    assert found.error < 1e-4
    np.testing.assert_allclose(found.fields[2:], fields, atol=0.02)


def test_a_chaotic_equation_is_found_from_eight_noisy_sensors() -> None:
    """Kuramoto-Sivashinsky, z_t = -z_xx / L^2 - z_xxxx / L^4 - z z_x / L in steps of 0.5."""
    plant = KuramotoSivashinskyEight(sample_time=0.5, substeps=10, burn_in=100, first=1 / 16)
    rng, seen = np.random.default_rng(1), plant.grid.measured(8)
    z = np.stack([plant.initial_state(np.random.default_rng(100 + i)) for i in range(2)])
    actions = np.clip(0.5 * rng.standard_normal((2, 60, 8)), -1.0, 1.0)
    readings = np.empty((2, 60, 8))
    for k in range(60):
        readings[:, k] = z[:, seen] + 0.1 * rng.standard_normal((2, 8))
        z = plant.step(z, actions[:, k])
    with threadpool_limits(1):
        found = fit_sensed(list(readings), list(actions), PLACES, equally_spaced(8), 0.1)
    length = plant.grid.axes[0].length
    known = {(1, 2): -0.5 / length**2, (1, 4): -0.5 / length**4, (2, 1): -0.25 / length}
    for i, term in enumerate(TERMS):
        expected = known.get(term, 0.0) / unit(*term)
        assert abs(found.shared[i] - expected) <= 0.05 * abs(expected), term
    assert found.error < 1e-3
