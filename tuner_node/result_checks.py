# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Checks of what episodes gave that do not depend on the state of a training. Pure."""

from typing import Any

from pdeloop.messages.action_set import ANY_ACTION, ActionSet
from pdeloop.method.adapt import Trajectory
from pdeloop.method.laws import Affine, Law
from pdeloop.method.reduce.identifiability import examine_excitation
from pdeloop.method.reduce.input_delay import study_delays
from tuner_node.batch import BatchResult
from tuner_node.errors import ContradictionError


def same_steps(result: BatchResult, known: int) -> int:
    """The steps of an episode. ContradictionError if not all of this run have as many.

    known: those of the episodes before; 0: there were none.
    """
    steps = sorted({*result.steps, *([known] if known else [])})
    if len(steps) > 1:
        raise ContradictionError(
            f"episodes of this run ended after {' and '.join(map(str, steps))} steps, expected "
            "one horizon: stop the other publisher of episode/cost and start a new run"
        )
    return next(iter(steps), 0)


def check_excitation(
    explored: Trajectory,
    seed: int,
    action_set: ActionSet = ANY_ACTION,
    law: type[Law] = Affine,
    sensors: int = 0,
) -> list[dict[str, Any]]:
    """History rows about what an exploration hardly determines, whatever drew its actions.

    NotIdentifiableError if the effects of its inputs cannot be told apart; of actions with a mean of
    zero, those of their differences. law, sensors: those of the training. Readings of few sensors are
    late by themselves.
    """
    actions = explored.actions[: len(explored.states) - 1]
    if action_set.zero_mean:
        actions = actions @ action_set.free(actions.shape[1])
    found = examine_excitation((explored.states, actions))
    found.require()
    remarks = [*found.remarks]
    delays = study_delays([(explored.states, actions)])
    late = f"the actions act {' and '.join(map(str, dict.fromkeys(delays.best)))} steps late"
    acts_late = max(delays.best) > 0 and not sensors
    if acts_late and not law.filtered:
        remarks.append(
            f"{late} ({delays.gain:.3g} times smaller errors), which the "
            "law does not know: train with --law observer, whose state has the last actions"
        )
    rows = [{"event": "excitation", "seed": seed, "remark": remark} for remark in remarks]
    if acts_late and law.filtered:
        told = f"{late}, so the law '{law.name}' has the last ones in its state"
        rows.append({"event": "late", "seed": seed, "remark": told})
    return rows
