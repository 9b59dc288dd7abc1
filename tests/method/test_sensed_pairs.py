# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A fit between few sensors begins with other rollouts where the first ones show no equation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pdeloop.method.models.sensed import sensed_model
from pdeloop.method.models.sensed_fit import few_rollouts, fit_sensed
from pdeloop.method.models.sensed_unknowns import TERMS, unknowns
from pdeloop.method.models.settings import DEFAULTS
from tests.support.sensed import DECLARED, SENSORS, readings_of

STEPS, N_A = 30, 3
FEW_ITERATIONS = replace(DEFAULTS, sensed_iterations=5)
"""Most are spent in vain, on the calmest rollouts."""


def test_a_fit_begins_with_the_calmest_rollouts_and_then_with_the_largest_inputs() -> None:
    y, a = np.ones((4, 2, 1)), np.zeros((4, 2, 1))
    y *= np.array([3.0, 1.0, 4.0, 2.0])[:, None, None]
    a[[0, 2, 3], 0] = np.array([[5.0], [1.0], [2.0]])
    assert few_rollouts(y, a, 2) == [[3, 1], [3, 0]]
    assert few_rollouts(y, a, 8) == [[3, 1], [3, 0], [3], [0], [3, 2]]
    assert few_rollouts(y[:2], a[:2], 8) == [[0, 1], [0], [1]]
    assert few_rollouts(y[1:2], a[1:2], 8) == [[0]]


def test_an_equation_that_the_calmest_rollouts_do_not_show_is_found_from_large_inputs() -> None:
    """The calmest ones have only what no equation explains, too small to matter in the others."""
    shared, random = np.zeros(unknowns(N_A)), np.random.default_rng(0)
    shared[TERMS.index((1, 2))] = 5e-3
    shared[TERMS.index((1, 0))] = 0.02
    model = sensed_model(shared, SENSORS, DECLARED, 10.0)
    x = (np.arange(model.n_z) + 0.5) / model.n_z
    actions = random.normal(size=(4, STEPS, N_A)) * np.array([1e-4, 1e-4, 3.0, 1.0])[:, None, None]
    fields = [np.cos(2 * np.pi * (x - shift)) for shift in (0.1, 0.4)]
    readings = [*1e-3 * random.normal(size=(2, STEPS, SENSORS))]
    readings += [readings_of(model, a, z) for a, z in zip(actions[2:], fields, strict=True)]
    assert set(few_rollouts(np.stack(readings), actions, 1)[0]) == {0, 1}
    _, _, alone = fit_sensed(readings[:2], list(actions[:2]), DECLARED, settings=FEW_ITERATIONS)
    _, _, error = fit_sensed(readings, list(actions), DECLARED, settings=FEW_ITERATIONS)
    assert alone == np.inf and error < 1e-4
