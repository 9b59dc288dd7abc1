# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Laws on an estimate, improved through its filter on the plants of several equations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from loop_interfaces.action_set import ActionSet
from loop_method.adapt.estimated_loop import simulate_estimated
from loop_method.adapt.filtered_loop import FilteredLoop, improve_through_filter
from loop_method.adapt.progress import Progress
from loop_method.adapt.sensed_loop import SensedLoop
from loop_method.adapt.settings import ModelBasedSettings
from loop_method.laws import ExtendedKalman
from loop_method.models.sensed_ensemble import SensedEnsemble, ensemble
from loop_method.models.settings import DEFAULTS
from tests.support.estimated import CUBIC, N_A, T, fields, filter_of, loop_of, model_of
from tests.support.small import same_bits

OTHER = model_of(z1_x0=7.0, z1_x1=3.0, z1_x2=0.4, z3_x0=-0.8)
"""An equation that is not the filter's."""
MODES = np.linalg.qr(np.random.default_rng(7).standard_normal((64, 5)))[0]


def plants() -> SensedEnsemble:
    return ensemble(CUBIC, [OTHER.shared], DEFAULTS)


def uncertain() -> tuple[SensedLoop, ExtendedKalman]:
    loop, law = loop_of(CUBIC)
    return replace(loop, model=plants()), law


def law_vector(law: ExtendedKalman, gains: np.ndarray) -> np.ndarray:
    return law.theta_of(gains[:, :-1] @ MODES.T, gains[:, -1], filter_of(CUBIC), DEFAULTS)


def filtered(limit: float = 0.0, count: int = 6) -> tuple[FilteredLoop, np.ndarray, np.ndarray]:
    """The loop with the gains of a law, that law, and initial fields."""
    loop, law = uncertain()
    loop = replace(loop, action_set=ActionSet(limit=limit))
    theta = 0.05 * np.random.default_rng(5).standard_normal((N_A, 6))
    begin, gains = fields(count), []
    simulate_estimated(loop, law, law_vector(law, theta), begin, gains)
    found = FilteredLoop(
        MODES,
        loop.target,
        loop.state_weight,
        loop.action_weight,
        T,
        ActionSet(limit=limit),
        model=loop.model,
        known=filter_of(CUBIC),
        gains=gains,
        noise=loop.noise,
    )
    return replace(found, target=np.full(64, 0.1)), theta, begin


def test_environments_follow_the_equations_in_turn() -> None:
    own, z, a = plants(), fields(5), np.random.default_rng(1).standard_normal((5, N_A))
    expected = np.stack(
        [(CUBIC, OTHER)[i % 2].step(z[i : i + 1], a[i : i + 1])[0] for i in range(5)]
    )
    assert same_bits(own.step(z, a), expected)
    assert not same_bits(own.step(z, a), CUBIC.step(z, a))
    y, size = fields(5, seed=2), 1e-6
    on_z, on_a = own.pull_back(z, a, y)
    for by, moved in ((on_z, fields(5, seed=3)), (on_a, np.ones((5, N_A)))):
        dz, da = (moved, 0.0 * a) if by is on_z else (0.0 * z, moved)
        ahead, behind = (own.step(z + s * dz, a + s * da) for s in (size, -size))
        slope = np.sum(y * (ahead - behind), axis=1) / (2.0 * size)
        np.testing.assert_allclose(np.sum(by * moved, axis=1), slope, rtol=1e-5)
    assert same_bits(own.linearise(z[0], a[0])[0], CUBIC.linearise(z[0], a[0])[0])
    assert own.step(z[:1], a[:1]).shape == (1, 64), "fewer environments than equations"


def test_with_the_gains_of_its_law_it_is_the_loop_with_the_filter() -> None:
    loop, theta, begin = filtered()
    whole, law = uncertain()
    expected = replace(whole, target=loop.target).costs(law_vector(law, theta), begin)
    np.testing.assert_allclose(loop.costs(theta, begin), expected, rtol=1e-9)
    other = replace(loop, model=CUBIC).costs(theta, begin)
    np.testing.assert_allclose(other[::2], expected[::2], rtol=1e-9)
    assert (np.abs(other[1::2] / expected[1::2] - 1.0) > 1e-3).all(), "those of the other equation"


@pytest.mark.parametrize("limit", [0.0, 0.2])
def test_its_gradient_is_that_of_its_cost(limit: float) -> None:
    loop, theta, begin = filtered(limit)
    weights = np.random.default_rng(6).dirichlet(np.ones(len(begin)))
    cost, gradient = loop.gradient(theta, begin, weights)
    simulation = loop.simulate(theta, begin)
    assert cost == pytest.approx(simulation.costs @ weights)
    if limit:
        assert (np.abs(simulation.actions) == limit).any()
        assert (np.abs(simulation.actions) < limit).any()
    size, expected = 1e-6, np.empty_like(theta)
    for index in np.ndindex(theta.shape):
        step = np.zeros_like(theta)
        step[index] = size
        ahead, behind = (loop.costs(theta + s * step, begin) @ weights for s in (1.0, -1.0))
        expected[index] = (ahead - behind) / (2.0 * size)
    np.testing.assert_allclose(gradient, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


def test_of_a_law_that_diverges_it_has_no_gradient() -> None:
    loop, theta, begin = filtered()
    with np.errstate(all="ignore"):
        cost, gradient = loop.gradient(1e200 * theta, begin, np.full(6, 1.0 / 6.0))
    assert np.isinf(cost) and not gradient.any()


def test_a_law_improved_through_the_filter_costs_less_on_the_plants() -> None:
    loop, law = uncertain()
    every, weights = fields(24), np.full(24, 1.0 / 24.0)
    settings = ModelBasedSettings(filter_iterations=8)
    begin = law_vector(law, 0.01 * np.random.default_rng(5).standard_normal((N_A, 6)))
    found, steps = improve_through_filter(loop, law, begin, MODES, every, weights, settings)
    assert 0 < steps <= settings.filter_iterations
    costs, before = (loop.costs(theta, every) for theta in (found, begin))
    assert costs[::2].mean() < 0.96 * before[::2].mean()
    assert costs[1::2].mean() < 0.96 * before[1::2].mean(), "on the other equation"
    own, known = (dict(law.parts(theta)) for theta in (found, begin))
    for name in own.keys() - {"K_e", "b"}:
        assert same_bits(own[name], known[name]), f"{name} is that of the filter"


def test_fields_of_no_weight_are_left_out_with_their_gains() -> None:
    loop, law = uncertain()
    every, weights = fields(7), np.array([0.0, 0.25, 0.25, 0.0, 0.0, 0.25, 0.25])
    settings = ModelBasedSettings(filter_iterations=2)
    begin = law_vector(law, 0.01 * np.random.default_rng(5).standard_normal((N_A, 6)))
    found, others = (
        improve_through_filter(loop, law, begin, MODES, *given, settings)[0]
        for given in ((every, weights), (every[weights > 0.0], weights[weights > 0.0]))
    )
    assert same_bits(found, others) and not same_bits(found, begin)


def test_a_law_that_is_not_finite_on_every_plant_stays() -> None:
    loop, law = uncertain()
    wild = law.theta_of(np.full((N_A, 64), 1e200), np.zeros(N_A), filter_of(CUBIC), DEFAULTS)
    every, weights = fields(4), np.full(4, 0.25)
    settings = ModelBasedSettings()
    found, steps = improve_through_filter(loop, law, wild, MODES, every, weights, settings)
    assert found is wild and steps == 0


def test_equations_are_kept_in_checkpoints() -> None:
    own = Progress(np.zeros((1, 4)), equations=[CUBIC.shared, OTHER.shared])
    again = Progress.of(own.state(), (1, 4))
    assert same_bits(np.stack(again.equations), np.stack(own.equations))
    older = {name: value for name, value in own.state().items() if name != "equations"}
    assert Progress.of(older, (1, 4)).equations == []
    with pytest.raises(ValueError, match="equations"):
        Progress.of(own.state() | {"equations": CUBIC.shared}, (1, 4))
