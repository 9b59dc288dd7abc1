# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Trainings over a simulated network: the bits of one process, or an error that names a cause."""

from __future__ import annotations

import random
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from controller_node.run_state import AnsweredSteps
from pde_sim_node.taken_actions import Episode, TakenActions
from tests.simulation.audit import audit, shrunk, verdict
from tests.simulation.disk import Disk
from tests.simulation.history import History
from tests.simulation.plan import KINDS, Fault, Plan, aimed, draw
from tests.simulation.planted import BUGS, OPEN, found, planted

SEEDS = [*range(26), 47]
"""A sample with every kind of fault, as of the bugs below; `.ci/run` has thousands, and all bugs."""


def test_a_training_with_faults_ends_with_the_same_bits_or_names_the_cause():
    plans = [draw(seed) for seed in SEEDS]
    assert {fault.kind for plan in plans for fault in plan.faults} == set(KINDS)
    ends = Counter(audit(plan).split(":")[0] for plan in plans)
    assert ends["same bits"] >= 0.9 * len(SEEDS)


def test_messages_for_nobody_change_nothing_and_late_contradictions_are_never_overlooked():
    plans = [aimed(seed) for seed in range(12)]
    ends = Counter(audit(plan).split(":")[0] for plan in plans)
    assert set(ends) == {"same bits", "error"}


@pytest.mark.parametrize(
    "name",
    [
        "plant: late actions",
        "tuner: costs that are taken back",
        "controller: a memory that it has not",
    ],
)
def test_a_check_that_is_gone_is_found(name: str):
    _, seed, reason = found(name, 15)
    assert seed is not None and reason


def test_each_planted_bug_is_still_in_the_source_once():
    for bug in BUGS.values():
        with planted(bug):
            pass
    assert set(OPEN) < set(BUGS)


def test_a_history_is_a_function_of_its_plan():
    first, second = History(draw(3)), History(draw(3))
    first.run()
    second.run()
    assert first.time == second.time and first.rows == second.rows
    assert first.refused == second.refused


def test_the_auditor_finds_a_plant_that_takes_any_action_and_the_smallest_plan(
    monkeypatch: pytest.MonkeyPatch,
):
    rival = Fault(0.02, "second controller", "does not sign", 0.5)
    others = Fault(0.01, "pause plant", "plant", 0.01), Fault(0.04, "cut", "tuner>plant", 0.01)
    bad = Plan(1, duplicates=0.02, faults=(others[0], rival, others[1]))
    assert verdict(bad)[0] != "wrong"
    monkeypatch.setattr(TakenActions, "is_signed", lambda self, frame: True)
    monkeypatch.setattr(Episode, "contradicted_by", lambda self, action: False)
    assert verdict(bad)[1] in ("AssertionError: another policy", "AssertionError: other costs")
    assert shrunk(bad) == replace(bad, duplicates=0.0, faults=(rival,))


def test_the_auditor_finds_a_controller_that_compares_no_cost_with_what_it_has_answered(
    monkeypatch: pytest.MonkeyPatch,
):
    bad = Plan(1, faults=(Fault(0.065, "early cost"),))
    assert verdict(bad)[0] == "error"
    monkeypatch.setattr(AnsweredSteps, "contradiction", lambda self, cost: "")
    assert verdict(bad)[1] == "AssertionError: another policy"


@pytest.mark.parametrize("power", [False, True])
@pytest.mark.parametrize("rot", [False, True])
def test_a_checkpoint_that_was_written_is_found_after_a_crash_at_any_call(power: bool, rot: bool):
    found = set()
    for seed in range(100):
        disk = Disk(random.Random(seed))
        for number in range(4):
            disk.save({"round": np.array(number)})
        taken: list[int] = []
        disk.restart(lambda arrays, t=taken: t.append(int(arrays["round"])), power=power, rot=rot)
        found.add(taken[0] if taken else -1)
    assert found >= {2, 3}


def test_the_disk_loses_what_was_not_synced(monkeypatch: pytest.MonkeyPatch):
    disk = Disk(random.Random(0))
    monkeypatch.setattr("os.fsync", lambda descriptor: None)
    with pytest.raises(AssertionError, match=r"checkpoint \d was written, \d was found"):
        for _ in range(50):
            for number in range(3):
                disk.save({"round": np.array(number)})
            disk.restart(lambda arrays: None, power=True, rot=False)
