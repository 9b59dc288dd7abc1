"""Whether a history kept what the loop promises; the smallest plan that does not."""

from __future__ import annotations

import re
from functools import cache

from tests.simulation.history import History, values
from tests.simulation.plan import Plan
from tests.small import same_bits, train_here
from tuner_node.dispatch import DispatchError
from tuner_node.training import Training

CAUSES = re.compile(
    r"gave up after \d+ attempts|expected one|stop the|two different|took back the cost"
)
"""What an error says that names a cause."""


@cache
def undisturbed(trajectories: bool) -> Training:
    """The training in one process."""
    return train_here(values(trajectories))


def audit(plan: Plan) -> str:
    """'same bits', or 'error: ...' where the training ended with one.

    Raises
    ------
    AssertionError
        Other bits, an error that names no cause, or one although only the network was bad.
    """
    end = History(plan).run()
    if isinstance(end, DispatchError):
        assert CAUSES.search(str(end)), f"names no cause: {end}"
        assert plan.hostile or str(end).startswith("gave up after"), f"nobody else was there: {end}"
        return f"error: {end}"
    expected = undisturbed(plan.trajectories)
    assert same_bits(end.policies(), expected.policies()), "another policy"
    assert end.evaluation is not None and expected.evaluation is not None
    assert same_bits(end.evaluation, expected.evaluation), "other costs"
    return "same bits"


def failure(plan: Plan) -> str:
    """Why the plan's history is wrong, or empty."""
    try:
        audit(plan)
    except Exception as error:  # whatever it is, it is the finding
        return f"{type(error).__name__}: {error}".splitlines()[0]
    return ""


def shrunk(plan: Plan) -> Plan:
    """A plan that still fails, of which no fault can be left out."""
    for index in range(len(plan.faults)):
        if failure(smaller := plan.without(index)):
            return shrunk(smaller)
    return plan
