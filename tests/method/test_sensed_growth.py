# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Terms beyond the first ones are found from few sensors where they predict other rollouts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from pdeloop.messages.arrays import Array
from pdeloop.method.models import sensed_growth
from pdeloop.method.models.sensed import SensedEquation, grid_points, sensed_model
from pdeloop.method.models.sensed_growth import Found, further_terms, start_with
from pdeloop.method.models.sensed_problem import SensedProblem
from pdeloop.method.models.sensed_unknowns import COEFFICIENTS, FIRST, TERMS, unknowns, well_posed
from pdeloop.method.models.settings import DEFAULTS
from tests.support.sensed import DECLARED, SENSORS, equally_spaced, readings_of
from tests.support.small import same_bits


def _of_further_terms(sigma: float) -> tuple[SensedProblem, Array]:
    """Readings of u' = u - u^5 with diffusion, and its unknowns."""
    actuators, rng = DECLARED, np.random.default_rng(3)
    shared = np.zeros(unknowns(3))
    for term, value in {(1, 0): 5.0, (1, 2): 1.0, (5, 0): -10.0}.items():
        shared[TERMS.index(term)] = value
    shared[COEFFICIENTS] = 10.0
    model = sensed_model(shared, SENSORS, actuators, 4.0)
    x = np.arange(model.n_z) / model.n_z
    actions, drawn = 2.0 * rng.standard_normal((3, 30, 3)), rng.uniform(-1, 1, (3, 3))
    fields = [4.0 * a * np.cos(2 * np.pi * (x - b)) + 2.0 * c for a, b, c in drawn]
    readings = np.stack([readings_of(model, *pair) for pair in zip(actions, fields, strict=True)])
    readings += sigma * rng.standard_normal(readings.shape)
    zero, unknown = np.zeros(SENSORS), np.full(3, np.nan)
    return SensedProblem(readings, actions, actuators, sigma, zero, unknown), shared


def test_a_term_that_the_first_ones_lack_is_found_and_no_other() -> None:
    problem, shared = _of_further_terms(0.05)
    with threadpool_limits(1):
        error, *found = problem.fit(np.zeros(len(shared)), problem.interpolated())
        further = further_terms(problem, (error - problem.noise, found[0], found[1]), DEFAULTS)
    quintic = TERMS.index((5, 0))
    assert found[0][quintic] == 0.0
    assert further[quintic] == pytest.approx(-10.0, rel=0.2)
    assert np.flatnonzero(further[len(FIRST) : len(TERMS)]).tolist() == [quintic - len(FIRST)]


def test_terms_that_predict_no_other_rollout_are_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are fitted to every other one."""
    problem, _ = _of_further_terms(0.05)
    with threadpool_limits(1):
        error, *found = problem.fit(np.zeros(problem.shared), problem.interpolated())
        first = error - problem.noise, found[0], found[1]
        seen = []

        def of_junk(some: SensedProblem, begin: Found, *_: Any) -> Found:
            seen.append(len(some.y))
            junk = begin[1].copy()
            junk[TERMS.index((2, 2))] = 1.0
            return 0.0, junk, begin[2]

        monkeypatch.setattr(sensed_growth, "grown", of_junk)
        assert further_terms(problem, first, DEFAULTS) is found[0]
    assert seen == [2]


def test_a_term_begins_on_the_side_where_it_is_well_posed() -> None:
    fourth, quintic = TERMS.index((1, 4)), TERMS.index((5, 0))
    start = start_with(np.zeros(unknowns(2)), (fourth, 3.0))
    assert start[fourth] < 0.0 and np.count_nonzero(start) == 1
    start[: len(FIRST)] = 1.0
    both = start_with(start, (quintic, -2.0))
    assert both[fourth] < 0.0 > both[quintic] and np.count_nonzero(both) == 2


def test_a_fourth_derivative_allows_a_negative_diffusion_and_the_fifth_power_a_positive_third() -> (
    None
):
    shared = np.zeros(unknowns(2))
    for term in ((1, 2), (1, 4), (3, 0), (5, 0)):
        shared[TERMS.index(term)] = 1.0 if term == (3, 0) else -1.0
    assert same_bits(well_posed(shared), shared)
    for highest in ((1, 4), (5, 0)):
        shared[TERMS.index(highest)] = 0.5
    bounded = well_posed(shared)
    assert not bounded.any()


def test_short_waves_that_a_fourth_derivative_damps_need_no_internal_steps() -> None:
    """Phase separation: the waves that follow others would ask for eight times as many."""
    shared, actuators, n = np.zeros(unknowns(1)), equally_spaced(1), grid_points(16)
    for term, value in {(1, 2): -630.0, (1, 4): -31.0, (3, 2): 39.5}.items():
        shared[TERMS.index(term)] = value
    equation, x = SensedEquation(shared, n, actuators), np.arange(n) / n
    (substeps,) = equation.substeps(np.array([4.0]))
    assert 1 < substeps <= 8

    def after(substeps: int) -> Array:
        step = equation.compiled(substeps, equation.supports)
        z = step.spectra(4.0 * np.cos(2 * np.pi * x)[None] + np.sin(14 * np.pi * x))
        for _ in range(20):
            step.advance(z, np.zeros((1, 2)))
        return step.states(z)

    np.testing.assert_allclose(after(int(substeps)), after(64), atol=1e-3)
