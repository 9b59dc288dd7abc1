"""Trainings over a simulated network: the bits of one process, or an error that names a cause."""

from __future__ import annotations

from collections import Counter

import pytest

from pde_sim_node.lockstep import Episode, Lockstep
from tests.simulation.audit import audit, failure, shrunk
from tests.simulation.history import History
from tests.simulation.plan import Fault, Plan, draw

SEEDS = 60


def plan(*faults: Fault, **changed: object) -> Plan:
    quiet = {
        "loss": 0.0,
        "duplicates": 0.0,
        "delay": 1e-3,
        "rates": (1.0, 1.0, 1.0),
        "saved": 1.0,
        "trajectories": False,
    }
    return Plan(seed=1, faults=faults, **{**quiet, **changed})


@pytest.mark.parametrize("part", range(3))
def test_a_training_with_faults_ends_with_the_same_bits_or_names_the_cause(part: int):
    ends = Counter(audit(draw(seed)).split(":")[0] for seed in range(part, SEEDS, 3))
    assert ends["same bits"] >= 0.8 * sum(ends.values())


def test_a_history_is_a_function_of_its_plan():
    first, second = History(draw(3)), History(draw(3))
    first.run()
    second.run()
    assert first.time == second.time and first.rows == second.rows
    assert first.refused == second.refused


def test_the_auditor_finds_a_plant_that_takes_any_action_and_the_smallest_plan(
    monkeypatch: pytest.MonkeyPatch,
):
    rival = Fault(0.05, "second controller", "signs", 0.5)
    others = Fault(0.04, "pause plant", duration=0.01), Fault(0.06, "cut", "tuner>plant", 0.01)
    bad = plan(rival, *others)
    assert not failure(bad)
    monkeypatch.setattr(Lockstep, "_is_signed", lambda self, frame: True)
    monkeypatch.setattr(Episode, "contradicted_by", lambda self, action: False)
    for module in ("dispatch", "dispatch_state"):
        monkeypatch.setattr(f"tuner_node.{module}.digest", lambda values: 0)
    assert failure(bad) == "AssertionError: another policy"
    assert shrunk(bad).faults == (rival,)
