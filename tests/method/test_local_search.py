# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The verdict on local steps: on which fields it rests, and how many."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from loop_method.adapt import Context, RolloutResult, Trajectory
from loop_method.adapt.base import Record
from loop_method.adapt.local_search import CONFIRMING, LocalSearch
from loop_method.adapt.proposal import Proposal
from loop_method.adapt.proposer import Proposer
from loop_method.adapt.settings import ModelBasedSettings
from loop_method.adapt.verdict import ADAPTED, FIRST, NONE
from loop_method.seeds import field_seed

N_Z, N_A, T, SEED = 6, 2, 5, 3
FIRST_LAW, FOUND = np.full((N_A, 4), 0.1), np.full((N_A, 4), 0.2)


def trajectory(seed: int) -> Trajectory:
    rng = np.random.default_rng(seed)
    return Trajectory(rng.standard_normal((T + 1, N_Z)), rng.standard_normal((T, N_A)))


def search(
    known: int, rollouts: int, monkeypatch: pytest.MonkeyPatch, **changes: Any
) -> LocalSearch:
    """After `known` rollouts of the first law; its only step is to another law."""
    steps = iter([Proposal(FOUND, 1.0, 1, 0.0, 0.1, "", "", False)])
    monkeypatch.setattr(Proposer, "propose", lambda *_, **__: next(steps, None))
    context = Context(np.eye(N_Z)[:, :2], np.zeros(N_Z), 1.0, 1.0, T, trajectory(99))
    records = [
        Record(FIRST_LAW, 10.0 + i, trajectory(i).states, trajectory(i).actions, i)
        for i in range(known)
    ]
    settings = ModelBasedSettings(**changes)
    return LocalSearch(context, FIRST_LAW, records, seed=SEED, rollouts=rollouts, settings=settings)


Cost = Callable[[np.ndarray, int], float]


def costs(none: float, gain: float, of_search: float | None = None) -> Cost:
    """From each field: no control, the first law, and the law found, which gains; on the fields of the
    search perhaps something else.
    """

    def cost(policy: np.ndarray, number: int) -> float:
        if not policy.any():
            return none + number
        own = of_search if of_search is not None and 4 <= number < 7 else gain
        return 10.0 + number - (own if np.array_equal(policy, FOUND) else 0.0)

    return cost


def carried_out(
    found: LocalSearch, cost: Cost
) -> tuple[list[tuple[np.ndarray, int]], dict[str, Any]]:
    """Laws and fields of the verdict, and the last row; continued from a checkpoint at every step."""
    numbers = {field_seed(SEED, i): i for i in range(100)}
    row: dict[str, Any] = {}
    judged: list[tuple[np.ndarray, int]] = []
    while asked := found.ask():
        found.restore(found.state())
        pairs = [(rollout.policy, numbers[rollout.field_seed]) for rollout in asked]
        judged = pairs if found.stage == CONFIRMING else judged
        results = [
            RolloutResult(cost(law, number), False, trajectory(number)) for law, number in pairs
        ]
        row = dict(found.tell(results))
    return judged, row


@pytest.mark.parametrize("gain", [0.5, -0.5])
def test_all_fields_of_the_first_law_and_the_rollouts_that_are_left_decide(
    gain: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A law that is better on the fields of the search, where it is accepted, whatever on others."""
    found = search(4, 20, monkeypatch)
    judged, row = carried_out(found, costs(99.0, gain, of_search=0.5))
    own = [number for law, number in judged if np.array_equal(law, FOUND)]
    base = [number for law, number in judged if np.array_equal(law, FIRST_LAW)]
    assert own[:4] == [0, 1, 2, 3], "those on which the first law was measured before"
    assert own[4:] == base and min(base) >= 7, "the others are fresh, for both laws"
    assert len(judged) >= 10 and len(own) == 4 + len(base)
    assert row["chosen"] == (ADAPTED if gain > 0.0 else FIRST)
    assert np.array_equal(found.policy, FOUND if gain > 0.0 else FIRST_LAW)


def test_there_are_no_more_pairs_than_the_setting_allows(monkeypatch: pytest.MonkeyPatch) -> None:
    judged, _ = carried_out(search(4, 60, monkeypatch, pairs=6), costs(99.0, 0.5))
    assert len(judged) == 6 + 2


def test_where_no_control_was_better_both_run_on_fresh_fields_as_well(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two rollouts without control are known; as many pairs as judge a law are kept for it."""
    judged, row = carried_out(search(4, 15, monkeypatch), costs(5.0, 9.0))
    fields = {number for _, number in judged}
    assert len(fields) >= ModelBasedSettings().judging
    assert row["chosen"] == ADAPTED and "no control" in row["reason"]
    assert sum(not law.any() for law, _ in judged) == len(judged) - len(fields) > 0


def test_a_step_that_is_never_found_leaves_the_law_that_was_better(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = search(4, 20, monkeypatch)
    monkeypatch.setattr(Proposer, "propose", lambda *_, **__: None)
    judged, row = carried_out(found, costs(5.0, 0.0))
    assert not judged and row["chosen"] == NONE and not found.policy.any()
    assert row["early"] == "no model gives a finite step that lowers the cost"


def test_a_first_law_that_diverges_from_fewer_fields_than_no_control_is_the_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Means are infinite where one rollout diverges, and then tell the two apart no more."""
    found = search(4, 14, monkeypatch)
    found._records[0] = replace(found._records[0], cost=np.inf)
    found.tell([RolloutResult(1e9, True, trajectory(i)) for i in range(2)])
    assert np.array_equal(found.policy, FIRST_LAW)


def test_no_step_is_tried_from_no_control_under_which_the_plant_diverges(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Halved, no control is itself: its rollouts would use up the budget."""
    found = search(4, 14, monkeypatch)
    found._records[0] = replace(found._records[0], cost=np.inf)
    found._records[1] = replace(found._records[1], cost=np.inf)
    found.tell([RolloutResult(10.0, False, trajectory(i)) for i in range(2)])
    row = dict(found.tell([RolloutResult(1e9, True, trajectory(i)) for i in range(3)]))
    assert found.ask() == [] and row["chosen"] == NONE
    assert row["early"] == "no control diverges, and no step starts from it"
