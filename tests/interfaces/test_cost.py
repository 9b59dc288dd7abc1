# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Quadratic costs against their formula written out, and what is refused."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from pdeloop.messages.cost import Cost

N_Z, N_A, T, N_Y = 5, 2, 4, 3
RNG = np.random.default_rng(0)
C = RNG.standard_normal((N_Y, N_Z))
Q = C @ C.T
R = np.array([[2.0, 0.3], [0.3, 1.0]])
TARGETS = RNG.standard_normal((T + 1, N_Y))
WHOLE: dict[str, Any] = {
    "state_weight": Q,
    "action_weight": R,
    "target": TARGETS,
    "output": C,
    "action_target": [0.5, -1.0],
    "terminal_weight": [1.0, 0.0, 4.0],
}


def total(cost: Cost, states: np.ndarray, actions: np.ndarray) -> float:
    totals = np.zeros(1)
    for k in range(T):
        cost.add(totals, states[k : k + 1], actions[k : k + 1], k)
    cost.add_terminal(totals, states[T:])
    return float(totals[0])


def test_an_episode_costs_what_the_formula_says() -> None:
    states, actions = RNG.standard_normal((T + 1, N_Z)), RNG.standard_normal((T, N_A))
    expected = 0.0
    for k in range(T):
        y, a = C @ states[k] - TARGETS[k], actions[k] - [0.5, -1.0]
        expected += y @ Q @ y + a @ R @ a
    last = C @ states[T] - TARGETS[T]
    expected += last @ np.diag([1.0, 0.0, 4.0]) @ last
    cost = Cost(N_Z, N_A, T, **WHOLE)
    assert total(cost, states, actions) == pytest.approx(expected, rel=1e-13)
    again = Cost.parse(cost.texts)
    assert again is not None
    assert total(again, states, actions) == total(cost, states, actions)
    assert not cost.plain


def test_slopes_are_those_of_the_cost() -> None:
    cost, step = Cost(N_Z, N_A, T, **WHOLE), 1e-6
    z, a = RNG.standard_normal((1, N_Z)), RNG.standard_normal((1, N_A))

    def at(z: np.ndarray, a: np.ndarray) -> float:
        totals = np.zeros(1)
        cost.add(totals, z, a, 2)
        return float(totals[0])

    dz, da = RNG.standard_normal((1, N_Z)), RNG.standard_normal((1, N_A))
    along = (at(z + step * dz, a + step * da) - at(z - step * dz, a - step * da)) / (2 * step)
    on_z, on_a = cost.slopes(z, a, 2)
    assert np.sum(on_z * dz) + np.sum(on_a * da) == pytest.approx(along, rel=1e-7)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ({"state_weight": 2.0}, {"state_weight": np.full(N_Z, 2.0)}),
        ({"state_weight": [1.0, 2.0, 0.0, 3.0, 4.0]}, {"state_weight": np.diag([1, 2, 0, 3, 4.0])}),
        ({"action_weight": 3.0}, {"action_weight": 3.0 * np.eye(N_A)}),
        ({"target": [1.0, 2, 3, 4, 5]}, {"target": np.tile([1.0, 2, 3, 4, 5], (T, 1))}),
        ({"state_weight": 2.0}, {"state_weight": 2.0, "output": np.eye(N_Z)}),
    ],
)
def test_the_same_cost_in_other_words_is_the_same(one: Any, other: Any) -> None:
    states, actions = RNG.standard_normal((T + 1, N_Z)), RNG.standard_normal((T, N_A))
    costs = [Cost(N_Z, N_A, T, **words) for words in (one, other)]
    first, second = (total(cost, states, actions) for cost in costs)
    assert first == pytest.approx(second, rel=1e-13)
    basis = np.linalg.qr(RNG.standard_normal((N_Z, 3)))[0]
    squares = [cost.residual(basis).T @ cost.residual(basis) for cost in costs]
    np.testing.assert_allclose(squares[0], squares[1], atol=1e-13)


def test_rounding_does_not_depend_on_the_batch() -> None:
    cost = Cost(N_Z, N_A, T, **WHOLE)
    states, actions = RNG.standard_normal((7, N_Z)), RNG.standard_normal((7, N_A))
    together, alone = np.zeros(7), np.zeros(1)
    cost.add(together, states, actions, 1)
    for m in range(7):
        alone[0] = 0.0
        cost.add(alone, states[m : m + 1], actions[m : m + 1], 1)
        assert alone[0] == together[m]


def test_numbers_and_a_constant_target_need_no_text() -> None:
    cost = Cost(N_Z, N_A, T, state_weight=2.0, action_weight=0.1, target=np.arange(5.0))
    assert cost.plain and cost.texts == [] and cost.size == (2.0, 0.1)
    assert cost.field_target.tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ({"state_weight": -1.0}, "state_weight must not be negative"),
        ({"action_weight": [1.0, 1e308]}, r"action_weight must be at most 1e\+100, got 1e\+308"),
        ({"state_weight": -np.eye(N_Z)}, "state_weight must have no negative eigenvalue"),
        ({"state_weight": np.triu(np.ones((N_Z, N_Z)))}, "state_weight must be symmetric"),
        ({"state_weight": [1.0, 2.0]}, "state_weight must be a number, 5 numbers or 5 x 5"),
        ({"action_weight": [1.0, 0.0]}, "action_weight must be positive"),
        ({"target": np.zeros((3, N_Z))}, "or 4 or 5 rows of them, one for each step"),
        ({"target": np.nan}, "target must be finite"),
        ({"output": np.zeros((2, 3))}, r"output must have shape \(n_y, 5\)"),
    ],
)
def test_what_is_no_cost_is_refused(words: Any, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        Cost(N_Z, N_A, T, **words)


def test_a_text_that_claims_more_than_it_holds_is_refused() -> None:
    (text,) = Cost(N_Z, N_A, T, state_weight=np.ones(N_Z)).texts
    sizes = json.loads(text)
    sizes[3]["state_weight"]["shape"] = [10**9]
    for bad in (json.dumps(sizes), text[:-9], "[]", "3", "nonsense"):
        with pytest.raises(ValueError, match="is not a cost"):
            Cost.parse([bad])
