# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The checks of stand-ins: correct nodes pass, whatever is lost, and a check ends in time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pdeloop.conformance.controller import ControllerCheck
from pdeloop.conformance.plant import PlantCheck
from pdeloop.conformance.probing import Message
from pdeloop.conformance.tuner import TunerCheck
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.frames import Frame
from pdeloop.messages.topics import ACTION, START, TARGET, Topic
from tests.support.conformance_harness import MAKERS, findings, named, plant

ONE_FIELD = {f"physical.amplitude_{end}": 1.0 for end in ("min", "max")}
ONE_FIELD |= {f"physical.spread_{end}": 0.05 for end in ("min", "max")}
"""An initial distribution of one value."""


@pytest.mark.parametrize(
    ("kind", "parameters", "notes"),
    [
        ("plant", {}, []),
        ("plant", {"horizon": 1}, []),
        ("plant", {"measurement_noise": 0.1}, ["(stage costs)", "(divergence)"]),
        ("plant", {"action_limit": 0.05}, ["(stage costs)", "(divergence)"]),
        ("plant", {"action_weight": 1e-6}, []),
        ("plant", ONE_FIELD, ["(seeds)"]),
        ("plant", {"divergence_bound": 0.3}, ["(cost)", "(stage costs)"]),
        ("controller", {}, []),
        ("controller", {"reduced_order": 12}, []),
        ("controller", {"reduced_order": 0}, []),
        ("controller", {"identification": "dmdc", "dmdc_rank": 40}, ["(known plant)"]),
        ("controller", {"identification": "field"}, []),
        ("controller", {"action_set": ActionSet(limit=1e-3)}, ["(draws)"]),
        ("tuner", {}, ["(another run)"]),
        ("tuner", {"rollouts": 0, "iterations": 3}, ["(another run)"]),
        ("tuner", {"seeds": 3}, ["(another run)"]),
        ("tuner", {"start": "zero"}, ["(another run)"]),
    ],
)
def test_the_nodes_of_this_project_keep_to_the_interface(kind, parameters, notes):
    found = findings(MAKERS[kind](parameters))
    print(*(f for f in found if f.note or not f.good), sep="\n")
    assert named(found) == notes


@pytest.mark.parametrize("kind", MAKERS)
def test_lost_and_doubled_messages_make_no_node_bad(kind):
    rng = np.random.default_rng(0)

    def unreliable(topic: Topic, message: Message) -> Any:
        return [message] * int(rng.choice(3, p=[0.02, 0.93, 0.05]))

    found = findings(MAKERS[kind](heard=unreliable, said=unreliable))
    assert [finding for finding in found if not finding.good] == []


class Flood:
    """A transport on which one message comes all the time."""

    received_any, refused = True, ""

    def __init__(self, topic: Topic, message: Message) -> None:
        self.sent, self.closed, self._now = 0, False, 0.0
        self._found = topic, message

    def now(self) -> float:
        return self._now

    def send(self, topic: Topic, message: Message) -> None:
        self.sent += 1

    def next(self, *topics: Topic, seconds: float) -> tuple[Topic, Message] | None:
        self._now += 0.005
        return self._found if self._found[0] in topics else None

    def wait_delivered(self) -> None:
        self.closed = True

    def disturbance(self, seconds: float = 0.0) -> str:
        return ""


@pytest.mark.parametrize(
    ("make", "topic", "values"),
    [
        (PlantCheck, TARGET, [0.0]),
        (ControllerCheck, ACTION, [[0.0]]),
        (TunerCheck, START, [[0.0] * 4]),
    ],
)
def test_a_flood_of_messages_ends_the_check_in_time(make, topic, values):
    transport = Flood(topic, Frame(99, 1, 0, 0.0, np.array(values)))
    found = list(make(transport, patience=10.0, limit=30.0).findings())
    assert transport.now() < 31.0
    assert not found[-2].good and "the rest is not checked" in found[-2].text
    assert "`action` of another run" in found[-2].text or make is not ControllerCheck
    assert transport.sent < 200 and transport.closed == (make is not TunerCheck)


def test_the_limit_ends_a_check_that_gets_on():
    check = plant({"horizon": 1000})
    check._end = check.transport.now() + 0.05
    *_, last, _ = findings(check)
    assert "--limit 600 s was reached while waiting for state" in last.text


def test_a_check_that_is_left_leaves_the_node_free():
    check = plant()
    protocol = check.transport._handlers[START].__self__
    for finding in check.findings():
        if finding.name == "first state":
            assert protocol.run == check.run
            break
    assert protocol.run == 0
