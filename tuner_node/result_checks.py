# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Checks of what episodes gave, also of the law in them, whatever the state of a training. Pure."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pdeloop.messages.action_set import ANY_ACTION, ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.messages.topics import MAX_GAIN
from pdeloop.method.adapt import Rollout, Trajectory
from pdeloop.method.laws import Affine, Law
from pdeloop.method.laws.registry import along
from pdeloop.method.reduce.channels import listed
from pdeloop.method.reduce.identifiability import examine_excitation
from pdeloop.method.reduce.input_delay import study_delays
from tuner_node.batch import BatchResult, ContradictionError


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
    steps = [str(n) for n in (delays.best if len({*delays.best}) > 1 else delays.best[:1])]
    late = f"the actions act {listed(steps)} steps late"
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


TOLERANCE = 1e-6
"""Relative difference of actions that rounding may explain."""
NEARBY, MARGIN = 1e-10, 100.0
"""Relative change of the states, and the multiple of what it does to the actions that rounding may do.

The memory of a law that is unstable by itself amplifies both alike, from step to step."""
AFFINE = "a = K_a U^T z + K_b U^T z_r"


def check_law(
    asked: Sequence[Rollout],
    law: Law,
    seen: Sequence[Trajectory | None],
    action_set: ActionSet = ANY_ACTION,
) -> None:
    """See that the actions are the law's all along in rollouts of one model; a ValueError if not.

    asked, seen: the policies, and what was measured under them; action_set: admissible actions.
    """
    for rollout, trajectory in zip(asked, seen, strict=True):
        assert trajectory is not None
        actions = trajectory.actions
        states = trajectory.states[: len(actions)]
        theta = np.clip(rollout.policy, -MAX_GAIN, MAX_GAIN).ravel()
        with np.errstate(over="ignore", invalid="ignore"):
            expected = _actions(law, theta, states, actions)
            allowed = np.zeros(len(actions))
            if not law.has_gains(theta) and not np.array_equal(expected, actions):
                near = _actions(law, theta, (1.0 + NEARBY) * states, actions)
                moved = np.abs(near - expected).max(axis=1, initial=0.0)
                allowed = MARGIN * np.maximum.accumulate(moved)
        expected = action_set.applied(expected)
        scale = np.maximum.accumulate(np.abs(actions).max(axis=1, initial=1.0))  # so far
        allowed += TOLERANCE * scale
        if not (np.abs(actions - expected) <= allowed[:, None]).all():
            words = AFFINE if law.has_gains(theta) else f"'{law.name}'"
            raise ValueError(
                f"the actions are not those of the law {words}, which this optimizer needs; with a "
                "controller of your own, choose an optimizer that learns from costs alone"
            )


def _actions(law: Law, theta: Array, states: Array, actions: Array) -> Array:
    if not law.has_gains(theta):
        return along(law, theta, states, actions)
    K_a, K_b = np.hsplit(law.gains(theta), 2)
    return states @ law.model.U @ K_a.T + K_b @ law.model.s_r
