# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Models are chosen by what the cost sees of their errors."""

import numpy as np
import pytest

from pdeloop.messages.cost import Cost
from pdeloop.method.adapt.base import Context, Record, Trajectory
from pdeloop.method.adapt.belief import believe
from pdeloop.method.models.base import FieldModelSettings

N_Z, N_A, STEPS = 9, 2, 20


def rooms(rng: np.random.Generator, level: float) -> list[Record]:
    """Rollouts of eight states x' = A x + B a, and of a pressure that hardly moves from a level."""
    A = np.diag(rng.uniform(0.6, 0.95, 8)) + 0.05 * rng.standard_normal((8, 8))
    B = rng.standard_normal((8, N_A))
    records = []
    for _ in range(6):
        z, actions = [np.append(rng.standard_normal(8), level)], rng.standard_normal((STEPS, N_A))
        for a in actions:
            z.append(np.append(A @ z[-1][:8] + B @ a, level + 0.1 * np.tanh(z[-1][0])))
        records.append(Record(np.zeros((N_A, 2)), np.inf, np.array(z), actions))
    return records


@pytest.mark.parametrize("level", [0.0, 1e5])
def test_numbers_that_cost_nothing_have_no_say_in_the_choice_of_a_model(level: float) -> None:
    records = rooms(np.random.default_rng(0), level)
    cost = Cost(N_Z, N_A, STEPS, state_weight=np.append(np.ones(8), 0.0))
    known = [Trajectory(record.states, record.actions) for record in records]
    context = Context(
        np.eye(N_Z)[:, :1],
        np.zeros(N_Z),
        1.0,
        1.0,
        STEPS,
        known[0],
        further=known[1:],
        cost=cost,
        field_models=FieldModelSettings(folds=2, largest_degree=2),
    )
    belief = believe(context, records, 0.05)
    assert belief is not None
    assert belief.error < 1e-3
    before, after = (np.concatenate([own.states[i:][:STEPS] for own in records]) for i in (0, 1))
    actions = np.concatenate([own.actions for own in records])
    missed = belief.model.step(before, actions) - after
    change = after - before
    assert np.sum(missed[:, :8] ** 2) < 1e-4 * np.sum(change[:, :8] ** 2)
