# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The nearest admissible action and its derivative, against the definition of a projection."""

from __future__ import annotations

import numpy as np
import pytest

from pdeloop.messages.action_set import ANY_ACTION, ActionSet
from pdeloop.messages.spec import ParameterError

LOW, HIGH = -np.array([0.5, 1.0, 0.2, 3.0]), np.array([0.7, 0.1, 2.0, np.inf])
SETS = {
    "one side": ActionSet(4, 0.0, np.inf),
    "each its own": ActionSet(4, LOW, HIGH),
    "limit": ActionSet(4, limit=0.4),
    "both": ActionSet(4, LOW, HIGH, limit=0.4),
    "mean zero": ActionSet(4, zero_mean=True),
    "mean zero and bounds": ActionSet(4, LOW, HIGH, True),
}


def requests(count: int = 30) -> np.ndarray:
    return 2.0 * np.random.default_rng(4).standard_normal((count, 4))


@pytest.mark.parametrize("name", SETS)
def test_a_projection_is_the_nearest_point_and_leaves_admissible_ones_as_they_are(
    name: str,
) -> None:
    allowed, asked = SETS[name], requests()
    nearest = allowed.project(asked)
    assert (nearest >= allowed.low).all() and (nearest <= allowed.high).all()
    if allowed.zero_mean:
        assert np.abs(nearest.sum(axis=1)).max() < 1e-14
    np.testing.assert_array_equal(allowed.project(nearest), nearest)
    # The angle to every other point of a convex set is obtuse.
    others = allowed.project(requests()[::-1])
    assert (np.einsum("mi,mi->m", asked - nearest, others - nearest) < 1e-12).all()


@pytest.mark.parametrize("name", SETS)
def test_an_action_has_the_same_bits_in_any_batch_and_in_place(name: str) -> None:
    allowed, asked = SETS[name], requests()
    together = allowed.project(asked)
    alone = np.stack([allowed.project(a) for a in asked])
    np.testing.assert_array_equal(alone, together)
    spaced = np.repeat(asked, 2, axis=1)[:, ::2]
    np.testing.assert_array_equal(allowed.project(spaced), together)
    np.testing.assert_array_equal(allowed.project(spaced, out=spaced), together)
    np.testing.assert_array_equal(spaced, together)


@pytest.mark.parametrize("name", SETS)
def test_the_derivative_is_that_of_differences(name: str) -> None:
    allowed, asked = SETS[name], requests()
    y, d = np.random.default_rng(5).standard_normal((2, *asked.shape))
    up, down = (allowed.project(asked + e * d) for e in (1e-7, -1e-7))
    slope = np.einsum("mi,mi->m", y, up - down) / 2e-7
    pulled = np.einsum("mi,mi->m", allowed.pull_back(asked, y)[0], d)
    np.testing.assert_allclose(pulled, slope, atol=1e-6)


def test_at_a_bound_the_derivative_is_that_from_inside() -> None:
    # No control of heaters is at their bound: a descent from there must not stop.
    heaters, y = ActionSet(low=0.0, high=4.0), np.array([[1.0, 2.0, 3.0]])
    np.testing.assert_array_equal(
        heaters.pull_back(np.array([[0.0, -1.0, 4.0]]), y)[0], [[1, 0, 3]]
    )
    assert heaters.held_back(np.array([0.0, 2.0, 4.0])).tolist() == [True, False, True]


def test_what_is_not_finite_disturbs_no_other_action() -> None:
    for allowed in SETS.values():
        asked = requests(3)
        kept = allowed.project(asked)
        asked[1] = np.nan
        found = allowed.project(asked)
        assert np.isnan(found[1]).all()
        np.testing.assert_array_equal(found[[0, 2]], kept[[0, 2]])


def test_parameters_give_the_set_and_the_set_its_parameters() -> None:
    values = {"n_a": 4, "action_limit": 0.0, "action_bounds": []}
    assert ActionSet.of(values) == ANY_ACTION and not ANY_ACTION.bounded
    for allowed in SETS.values():
        limit = float(allowed.signed[0])
        again = ActionSet.of({**values, "action_limit": limit, "action_bounds": allowed.bounds})
        assert again == allowed and again.zero_mean == allowed.zero_mean
        np.testing.assert_array_equal([again.low, again.high], [allowed.low, allowed.high])


@pytest.mark.parametrize(
    ("bounds", "limit", "words"),
    [
        ([0.0, 1.0], 0.0, "2 lower bounds, 2 upper bounds, and 1 .* got 2 numbers"),
        ([0.0, 0.0, 1.0, 1.0, 0.5], 0.0, "and 1 where actions have mean zero, else 0"),
        (
            [2.0, 2.0, 3.0, 3.0, 0.0],
            1.0,
            "at most action_high for each actuator, and within action_",
        ),
        (
            [1.0, 1.0, 3.0, 3.0, 1.0],
            0.0,
            "no action between action_low and action_high has mean zero",
        ),
    ],
)
def test_bounds_that_admit_nothing_are_refused(
    bounds: list[float], limit: float, words: str
) -> None:
    with pytest.raises(ParameterError, match=f"'action_bounds': .*{words}"):
        ActionSet.of({"n_a": 2, "action_limit": limit, "action_bounds": bounds})


def test_an_exploration_is_around_mid_range_and_a_quarter_of_half_the_range_wide() -> None:
    mixed = ActionSet(4, [0.0, -2.0, 1.0, -np.inf], [4.0, 2.0, np.inf, np.inf])
    draws = np.random.default_rng(6).standard_normal((20_000, 4))
    actions = mixed.explored(np.sqrt(mixed.exploration_variance) * draws)
    unit = np.sqrt(0.1)
    np.testing.assert_allclose(actions.mean(axis=0), [2.0, 0.0, 1.0 + 2 * unit, 0.0], atol=0.02)
    np.testing.assert_allclose(actions.std(axis=0), [0.5, 0.5, unit, unit], rtol=0.03)
    np.testing.assert_array_equal(mixed.project(actions), actions)
    reactor = ActionSet(3, -0.3, 0.3)
    assert np.sqrt(reactor.exploration_variance) == pytest.approx(0.075)
    wide = ActionSet(2, [-2.0, -1.0], [2.0, 1.0])
    np.testing.assert_allclose(wide.explored(np.ones((1, 2))), [[1.0, 0.5]])


def test_without_declared_bounds_an_exploration_is_what_is_drawn() -> None:
    draws = requests()
    np.testing.assert_array_equal(ANY_ACTION.explored(draws), draws)
    limited = ActionSet(4, limit=0.4)
    np.testing.assert_array_equal(limited.explored(draws), np.clip(draws, -0.4, 0.4))
    assert ANY_ACTION.exploration_variance == limited.exploration_variance == 0.1


def test_an_operating_point_of_mean_zero_and_one_that_is_given() -> None:
    balanced = SETS["mean zero and bounds"]
    m = balanced.exploration_mean
    np.testing.assert_array_equal(balanced.project(m), m)
    assert balanced.explored(requests()).sum(axis=1) == pytest.approx(0.0, abs=1e-12)
    values = {"n_a": 2, "action_limit": 0.0, "action_bounds": [0.0, 0.0, 4.0, 4.0, 0.0]}
    given = ActionSet.of(values | {"exploration_mean": [1.0, 3.0]})
    np.testing.assert_array_equal(given.explored(np.zeros((1, 2))), [[1.0, 3.0]])
    assert given.signed.tolist() == [0.0, 0.0, 0.0, 4.0, 4.0, 0.0, 1.0, 3.0]
    for bad in ([1.0], [1.0, 5.0]):
        with pytest.raises(
            ParameterError, match=r"'exploration_mean': .* 2 numbers that are an admi"
        ):
            ActionSet.of(values | {"exploration_mean": bad})


@pytest.mark.parametrize("zero_mean", [False, True])
def test_actions_within_rate_limits_stay_as_they_are(zero_mean: bool) -> None:
    """Small ones after large ones as well, whose mean rounding makes as large as theirs allows."""
    allowed = ActionSet(3, -1.0, 1.0, zero_mean, rate=[0.1, 0.2, 0.3])
    asked = 3.0 * np.random.default_rng(0).normal(size=(300, 20, 3))
    asked[150:] *= 1e-3
    applied = allowed.applied(asked)
    np.testing.assert_array_equal(allowed.applied(applied), applied)
    np.testing.assert_array_equal(allowed.project(applied), applied)
    moves = np.diff(applied, axis=0, prepend=np.zeros((1, 20, 3)))
    assert (np.abs(moves) <= allowed.rate + 1e-15).all()
    assert (np.abs(applied.sum(axis=-1)) < 1e-14).all() == zero_mean
    with pytest.raises(ValueError, match="goes with bounds, not with action_limit"):
        ActionSet(3, limit=0.4, rate=0.1)
