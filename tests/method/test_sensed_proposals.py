# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`gauss_newton` on a model of the field between a few point sensors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

import pdeloop
from loop_method.adapt import Context, GaussNewton, Rollout, RolloutResult, Trajectory
from loop_method.adapt.base import Record
from loop_method.adapt.closed_loop import ClosedLoopProblem
from loop_method.adapt.sensed_step import SensedProposals
from loop_method.models.sensed_unknowns import EQUATION, FIRST, unknowns
from loop_method.models.settings import DEFAULTS
from pdeloop.episode import rollout
from tests.support.sensed import SENSORS, equally_spaced
from tests.support.small import same_bits

FEW_ITERATIONS = replace(DEFAULTS, sensed_iterations=2)
"""For readings that no equation explains, on which iterations are spent in vain."""


def test_readings_that_no_equation_explains_make_no_proposal_and_no_start_of_the_next() -> None:
    rng = np.random.default_rng(0)
    states, actions = rng.standard_normal((2, 25, 4)), rng.standard_normal((2, 24, 2))
    records = [Record(np.zeros((2, 8)), 1.0, *pair) for pair in zip(states, actions, strict=True)]
    loop = ClosedLoopProblem(np.eye(4), np.zeros(4), 1.0, 1.0, horizon=24)
    proposals = SensedProposals(
        loop, equally_spaced(2), noise=0.0, largest_cost=np.inf, settings=FEW_ITERATIONS
    )
    with threadpool_limits(1):
        assert proposals.propose(records, records[0].policy, damping=1.0) is None
    assert not proposals.equation.any()


@pytest.mark.parametrize("n_a", [2, 12])
def test_a_checkpoint_of_the_first_terms_alone_is_continued(n_a: int) -> None:
    loop = ClosedLoopProblem(np.eye(4), np.zeros(4), 1.0, 1.0, horizon=24)
    proposals = SensedProposals(loop, equally_spaced(n_a), noise=0.0, largest_cost=np.inf)
    older = np.arange(1.0, unknowns(n_a) - EQUATION + len(FIRST) + 1)
    proposals.restore({"equation": older})
    np.testing.assert_array_equal(proposals.equation[: len(FIRST)], older[: len(FIRST)])
    assert not proposals.equation[len(FIRST) : EQUATION].any()
    np.testing.assert_array_equal(proposals.equation[EQUATION:], older[len(FIRST) :])
    with pytest.raises(ValueError):
        proposals.restore({"equation": older[:-1]})


def test_gauss_newton_controls_with_few_sensors_and_continues_with_the_same_bits() -> None:
    problem = pdeloop.problem("allen-cahn", sensors=SENSORS, horizon=16)
    plant = problem.plant()
    explored, actions = problem.explore(0)
    U = np.eye(SENSORS)
    context = Context(
        U,
        plant.target,
        plant.state_weight,
        plant.action_weight,
        plant.horizon,
        Trajectory(explored[:-1], actions),
        sensors=SENSORS,
        field_models=replace(DEFAULTS, sensed_iterations=6, sensed_last_iterations=15),
    )

    def make() -> GaussNewton:
        start = np.zeros((plant.n_a, 2 * SENSORS))
        return GaussNewton(start, seed=0, rollouts=10, context=context)

    def measure(asked: Rollout) -> RolloutResult:
        K = asked.policy[:, :SENSORS]
        b = asked.policy[:, SENSORS:] @ plant.target
        episode = rollout(plant, lambda k, y: y @ K.T + b, [asked.field_seed])
        seen = Trajectory(episode.states[:, 0], episode.actions[:, 0])
        return RolloutResult(float(episode.costs.mean[0]), trajectory=seen)

    first, later = make(), make()
    row = first.tell([measure(asked) for asked in first.ask()])
    assert row["model"] == "sensed"
    for _ in range(2):
        first.tell([measure(first.ask()[0])])
    later.restore(first.state())
    rows = [optimizer.tell([measure(optimizer.ask()[0])]) for optimizer in (first, later)]
    assert rows[0] == rows[1] and rows[0]["accepted"] and rows[0]["relative_cost"] < 0.8
    for optimizer in (first, later):
        optimizer.tell([measure(asked) for asked in optimizer.ask()])
    assert same_bits(first.ask()[0].policy, later.ask()[0].policy)
