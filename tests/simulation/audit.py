# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Checks that a history kept what the loop promises, and finds the smallest plan that does not.

It knows nothing of the protocols: only the training in one process, and what an error may say.
"""

from __future__ import annotations

import re
from functools import cache

from tests.simulation.history import History
from tests.simulation.plan import Plan, aimed, draw
from tests.simulation.processes import remembering, values
from tests.support.small import same_bits, train_here
from tuner_node.batch import DispatchError
from tuner_node.training import Training

GAVE_UP = "gave up after"
CAUSES = re.compile(
    rf"{GAVE_UP} \d+ attempts|expected one|stop the|two different|withdrew"
    "|plant has other parameters|actions are not those of the law"
)
"""What an error says that names a cause."""


@cache
def undisturbed(iterations: int, own_plant: bool, law: str = "affine") -> Training:
    """The training in one process."""
    return train_here(values(iterations, own_plant, law))


def audit(plan: Plan) -> str:
    """'same bits', 'error: ...' where the training ended with one, or 'forged'.

    The last one is the limit that docs/security.md names: other bits, as a forged message, or the
    answer to a forged state, came to a process that the true one with its header never reached, or
    reached when the run's last cost, or the last before its tuner ended, was on its way.

    Raises
    ------
    AssertionError
        Other bits, an error that names no cause, or one although only the network was bad; or the end
        of a training that used an episode of which another action or start came later.
    """
    expected = undisturbed(plan.iterations, plan.own_plant, plan.law)
    with remembering():
        history = History(plan)
        end = history.run()
    if isinstance(end, DispatchError):
        assert CAUSES.search(str(end)), f"names no cause: {end}"
        assert not plan.harmless, f"messages for nobody ended it: {end}"
        assert plan.hostile or str(end).startswith(GAVE_UP), f"nobody else was there: {end}"
        return f"error: {end}"
    if plan.harmless:
        again = [row["reason"] for row in history.rows if row["event"] == "repeated"]
        assert not again, f"something followed from messages for nobody: {again[0]}"
    assert not history.overlooked, "a contradicted episode was used"
    assert end.evaluation is not None and expected.evaluation is not None
    for what, found, wanted in (
        ("another policy", end.policies(), expected.policies()),
        ("other costs", end.evaluation, expected.evaluation),
    ):
        if not same_bits(found, wanted):
            assert history.network.unopposed, what
            return "forged"
    return "same bits"


def verdict(plan: Plan) -> tuple[str, str]:
    """How `audit` begins, and nothing; or 'wrong', and why."""
    try:
        return audit(plan).split(":")[0], ""
    except Exception as error:  # whatever it is, it is the finding
        return "wrong", f"{type(error).__name__}: {error}".splitlines()[0]


def shrunk(plan: Plan) -> Plan:
    """A plan that still fails, of which nothing can be left out."""
    for smaller in plan.smaller():
        if verdict(smaller)[1]:
            return shrunk(smaller)
    return plan


def judged_aimed(seed: int) -> tuple[str, str]:
    """As `judge`, on the plan that `aimed` gives a seed."""
    plan = aimed(seed)
    end, reason = verdict(plan)
    return end, f"seed {seed}, aimed: {reason}\n  {shrunk(plan)}" if reason else ""


def judge(seed: int) -> tuple[str, str]:
    """The verdict on the plan of a seed; where it is wrong, with the smallest plan that is."""
    plan = draw(seed)
    end, reason = verdict(plan)
    return end, f"seed {seed}: {reason}\n  {shrunk(plan)}" if reason else ""
