# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What is kept of runs and targets has a bound, and whose run is served keeps its place."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from controller_node.run_state import MAX_RUNS, Models, RunState, forget
from pdeloop.messages.frames import Frame, FrameError
from pdeloop.messages.protocol import ModelFailure
from pdeloop.messages.topics import MODEL_IDENTIFIED
from tests.support.responding import COSTS, RUN, explore, plant, start
from tests.support.small import same_bits


def test_a_flood_of_strangers_does_not_push_out_the_run_that_is_served(responder):
    responder.start(start(1, (1, 9, 0.1, 0)))
    state = Frame(RUN, 1, 0, 0.0, plant().reset(np.array([1])).copy())
    (before,) = responder.state(state)
    for stranger in range(100, 200):
        responder.start(start(1, (1, 9, 0.1, 0), run=stranger))
        responder.target(Frame(0, 0, 0, 0.0, np.ones(2), plant=stranger))
    (after,) = responder.state(state)
    assert same_bits(after.frame.values, before.frame.values)


def test_a_run_of_a_stranger_fills_no_memory(responder, monkeypatch):
    monkeypatch.setattr("controller_node.responder.MAX_BYTES", 100_000)
    states = plant().reset(np.array([1]))
    for run in range(100, 106):
        responder.start(start(1, (1, 2, 0.1, 0), run=run))
        for k in range(600):
            assert len(responder.state(Frame(run, 1, k, 0.0, states + k))) == 1
        assert sum(known.nbytes for known in responder._runs.values()) <= 100_000
    (failure,) = responder.cost(Frame(105, 1, 599, 1.0, COSTS))
    assert isinstance(failure, ModelFailure) and not failure.retry
    assert "more than 100000 bytes; explore fewer seeds at once" in failure.reason
    with pytest.raises(FrameError, match="expected fewer than 100000 bytes for all runs"):
        responder.policy(Frame(7, 1, 0, 0.0, np.ones((50, 4, 80))))
    (model,) = explore(responder, 5)  # the run with room is served as before
    assert model.topic is MODEL_IDENTIFIED


def test_targets_of_ever_new_plants_fill_no_memory(responder, monkeypatch):
    monkeypatch.setattr("controller_node.responder.MAX_BYTES", 100_000)
    explore(responder, 1)  # so that the plant of the run is known
    served = set(responder._targets)
    for number in range(1000, 1020):
        responder.target(Frame(0, 0, 0, 0.0, np.ones(3000), plant=number))
        assert sum(target.nbytes for target in responder._targets.values()) <= 50_000
    assert served < set(responder._targets)


def test_states_of_one_number_count_with_what_keeps_them(responder, monkeypatch):
    monkeypatch.setattr("controller_node.responder.MAX_BYTES", 100_000)
    responder.start(start(1, (1, 2, 0.1, 0)))
    for k in range(400):
        responder.state(Frame(RUN, 1, k, 0.0, np.ones((1, 1))))
    (failure,) = responder.cost(Frame(RUN, 1, 399, 1.0, COSTS))
    assert "more than 100000 bytes" in failure.reason


def test_of_more_runs_than_are_kept_the_least_recently_used_one_goes():
    known = OrderedDict((number, number) for number in range(MAX_RUNS))
    forget(known, 3, 0)
    assert list(known) == [*(n for n in range(MAX_RUNS) if n != 3), 3]
    known[77] = 77
    forget(known, 77, 0)
    assert list(known) == [0, *(n for n in range(2, MAX_RUNS) if n != 3), 3, 77]
    forget(known, 77, 0, full=lambda: len(known) > 3)
    assert list(known) == [0, 3, 77]


def test_a_run_takes_the_bytes_of_all_that_is_kept_of_it():
    one = Frame(RUN, 1, 0, 0.0, np.ones((1, 4)))
    state = RunState(start=one)
    state.policies.append(replace(one, values=np.ones((1, 4, 8))))
    assert state.nbytes == 8 * (4 + 32)
    state.laws[3] = ((1,), SimpleNamespace(nbytes=1000))
    state.exploration = SimpleNamespace(nbytes=500)
    assert state.nbytes == 8 * (4 + 32) + 1500
    model = SimpleNamespace(U=np.ones((9, 2)), A=np.ones((2, 2)), B=np.ones((2, 3)))
    state.models.append(Models(1, 7, [SimpleNamespace(model=model)]))  # the law copies them
    assert state.nbytes == 8 * (4 + 32) + 1500 + 2 * 8 * (18 + 4 + 6)
