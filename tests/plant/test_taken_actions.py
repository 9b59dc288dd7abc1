# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A cost is taken back by each late action that could have been taken, and by no other."""

from __future__ import annotations

import numpy as np
import pytest

from pde_sim_node.taken_actions import Episode, TakenActions
from pdeloop.messages.frames import Frame, digest
from pdeloop.messages.topics import VOID, CostColumn

SIGNATURE = -0.25
TAKEN = np.ones((1, 2))


def action(values: np.ndarray, time: float) -> Frame:
    return Frame(7, 3, 0, time, values, 99)


def ended(signs: bool) -> TakenActions:
    """The actions of a run whose episode 3 came to a cost."""
    taken = TakenActions(signs)
    taken.episode = Episode(np.zeros((1, 4)), SIGNATURE, [digest(TAKEN)])
    taken.end(Frame(7, 3, 1, 0.0, np.array([[1.0, 2.0, -1.0]]), 99), void=False)
    return taken


@pytest.mark.parametrize(
    ("signs", "time", "values", "taken_back"),
    [
        (True, SIGNATURE, 2 * TAKEN, True),
        (True, SIGNATURE, TAKEN, False),  # the same again
        (True, 0.5, 2 * TAKEN, False),  # not signed: it could never have been taken
        (True, -0.5, 2 * TAKEN, False),  # signed for another episode
        (False, 0.5, 2 * TAKEN, True),
        (False, 0.5, TAKEN, False),
        (False, SIGNATURE, 2 * TAKEN, True),  # of a second controller, which signs
        (True, SIGNATURE, np.ones((2, 2)), False),  # of another number of environments
    ],
)
def test_a_late_action_takes_the_cost_back_where_it_contradicts(signs, time, values, taken_back):
    known = ended(signs)
    cost = known.retract(action(values, time))
    assert (cost is not None) == taken_back
    if cost is not None:
        assert cost.values[0, CostColumn.ENDED] == VOID and cost.episode == 3
        assert known.retract(action(values, time)) is None  # once
