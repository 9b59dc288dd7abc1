# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Each probe of a check names the mistake of a stand-in that it looks for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
import pytest

from pdeloop.conformance.probing import FAILED, Check, Message
from pdeloop.messages.frames import Frame
from pdeloop.messages.protocol import Publication
from pdeloop.messages.topics import (
    ACTION,
    COST,
    MODEL,
    MODEL_IDENTIFIED,
    POLICY,
    START,
    STATE,
    TARGET,
    VOID,
    CostColumn,
    StartColumn,
    Topic,
)
from tests.support.conformance_harness import (
    MAKERS,
    Mistake,
    controller,
    findings,
    named,
    plant,
    tuner,
)


class Node:
    """What a mistake may look back at: the last message of each topic, all, and how many there were."""

    def __init__(self) -> None:
        self.last: dict[Topic, Any] = {}
        self.all: dict[tuple[Topic, int, int], Any] = {}
        self.count = count(1)


def mistaken(
    kind: str, side: str, topic: Topic | None, change: Callable[[Any, Node], Any]
) -> Check:
    """A check of a node that hears or says the messages of a topic with a mistake.

    change: of a message's copy, in place or to what it returns; False: it is lost.
    """
    node = Node()

    def both(own: bool) -> Mistake:
        def mistake(on: Topic, message: Message) -> Message:
            if own and topic in (None, on):
                if isinstance(message, Frame):
                    message = replace(message, values=message.values.copy())
                changed = change(message, node)
                message = None if changed is False else message if changed is None else changed
            if message is not None:
                node.last[on] = message
                node.all[on, message.episode, getattr(message, "step", 0)] = message
            return message

        return mistake

    return MAKERS[kind](heard=both(side == "hears"), said=both(side == "says"))


def column(index: int, value: Callable[[np.ndarray], Any]) -> Callable[[Any, Node], None]:
    """A mistake in a column of values."""

    def change(frame: Frame, node: Node) -> None:
        if len(frame.values):
            frame.values[:, index] = value(frame.values[:, index])

    return change


def reversed_rows(frame: Frame, node: Node) -> None:
    frame.values[:] = frame.values[::-1].copy()


def drawn_anew(frame: Frame, node: Node) -> None:
    frame.values[:] += 1e-9 * next(node.count)


def lost_again(frame: Frame, node: Node) -> bool | None:
    """The same message is taken once."""
    known = node.last.get("again")
    node.last["again"] = ids = (frame.run, frame.episode, frame.step, len(frame.values))
    return False if ids == known else None


def numbered_anew(frame: Frame, node: Node) -> Frame | None:
    """The same message again has another number."""
    return replace(frame, episode=frame.episode + 1) if lost_again(frame, node) is False else None


def random_mean(frame: Frame, node: Node) -> None:
    """Seed -1 is one of the others."""
    column(StartColumn.SEED, lambda seed: np.where(seed < 0, next(node.count), seed))(frame, node)


def with_ids_of(topic: Topic, *names: str) -> Callable[[Any, Node], Any]:
    """These ids are not checked: as if they were those of the last message of a topic."""

    def change(message: Any, node: Node) -> Any:
        last = node.last.get(topic)
        return None if last is None else replace(message, **{n: getattr(last, n) for n in names})

    return change


def where(good: Callable[[Any], bool], change: Callable[[Any, Node], Any]):
    return lambda frame, node: change(frame, node) if good(frame) else None


def lost(frame: Frame, node: Node) -> bool:
    return False


def explores(frame: Frame) -> bool:
    return len(frame.values) > 0 and frame.values[0, StartColumn.EXCITATION] >= 0


def ends(frame: Frame) -> bool:
    return not len(frame.values)


def diverged(frame: Frame) -> bool:
    return bool((frame.values[:, CostColumn.ENDED] >= 0).any())


def is_void(frame: Frame) -> bool:
    return bool((frame.values[:, CostColumn.ENDED] == VOID).any())


def counts(states: slice, actions: slice, of_target: float = 1.0) -> Callable[[Any, Node], None]:
    """The total counts these states and actions, the states less so much of the target."""

    def change(frame: Frame, node: Node) -> None:
        z, a = (
            np.array([node.all[on, frame.episode, k].values for k in range(frame.step + 1)])
            for on in (STATE, ACTION)
        )
        errors = (z - of_target * node.last[TARGET].values)[states]
        total = (errors**2).sum(axis=(0, 2)) + (a[actions] ** 2).sum(axis=(0, 2))
        frame.values[:, CostColumn.TOTAL] = total
        frame.values[:, CostColumn.MEAN] = total / frame.step

    return change


def last_answer_counts(frame: Frame, node: Node) -> None:
    frame.values[:, :2] *= 1.0 + 1e-9 * np.abs(node.last[ACTION].values).sum()


def seed_from_excitation(frame: Frame, node: Node) -> None:
    frame.values[:, StartColumn.SEED] += 1 + frame.values[:, StartColumn.EXCITATION]


def a_model_all_the_same(message: Message, node: Node) -> Message:
    """In place of a failure."""
    if isinstance(message, Frame):
        node.last["model"] = message
        return message
    known = node.last["model"]
    values = known.values.copy()
    values[:, -1 - 2 * 2 : -1] *= 1.01  # gains
    return Frame(message.run, message.episode, 0, 0.0, values, known.plant)


def other_retry(message: Message, node: Node) -> Message:
    return replace(message, retry=not message.retry)


def part(rows: slice, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Any, Node], None]:
    """A mistake in some rows of a model of order 4 with 2 actuators."""

    def of(frame: Frame, node: Node) -> None:
        frame.values[:, rows] = [change(model[rows]) for model in frame.values]

    return of


U, A = slice(0, -11), slice(-11, -7)
B_AND_KA = slice(-7, -3)

PLANT = (
    ("says", TARGET, lost, "first state"),
    ("says", STATE, lambda frame, node: replace(frame, plant=1), "first state"),
    ("says", STATE, lambda frame, node: replace(frame, step=0), "cost"),
    ("says", COST, column(CostColumn.MEAN, lambda mean: 1.01 * mean), "cost"),
    ("says", COST, lambda frame, node: replace(frame, step=0), "cost"),
    ("says", COST, lambda frame, node: replace(frame, values=frame.values[:0]), "cost"),
    ("says", COST, lambda frame, node: replace(frame, values=frame.values[:, :2]), "cost"),
    ("says", STATE, drawn_anew, "repeat"),
    ("hears", START, lost_again, "start again"),
    ("hears", START, where(ends, with_ids_of(START, "run")), "other starts"),
    ("hears", ACTION, with_ids_of(STATE, "run"), "other actions"),
    ("hears", ACTION, with_ids_of(STATE, "episode"), "other actions"),
    ("hears", ACTION, with_ids_of(STATE, "step"), "other actions"),
    ("hears", ACTION, with_ids_of(STATE, "plant"), "other actions"),
    ("says", STATE, lost_again, "silence"),
    ("says", COST, last_answer_counts, "acknowledgement"),
    ("says", COST, counts(slice(1, None), slice(-1)), "stage costs"),
    ("says", COST, counts(slice(None), slice(-1)), "stage costs"),
    ("says", COST, counts(slice(1, -1), slice(1, -1)), "stage costs"),
    ("says", COST, counts(slice(-1), slice(-2)), "stage costs"),
    ("says", COST, counts(slice(-1), slice(-1), of_target=0.0), "stage costs"),
    ("says", COST, column(slice(2), lambda costs: costs + np.array([0.1, 3.0])), "(stage costs)"),
    ("hears", START, seed_from_excitation, "start columns"),
    ("hears", START, column(StartColumn.SEED, lambda seed: seed % 2**31), "seeds"),
    ("hears", START, column(StartColumn.SEED, lambda seed: 0 * seed), "(seeds)"),
    ("hears", START, random_mean, "seeds"),
    ("says", STATE, reversed_rows, "two rows"),
    ("says", COST, reversed_rows, "two rows"),
    ("says", COST, column(slice(2), lambda costs: costs.mean(axis=0)), "two rows"),
    ("hears", ACTION, column(slice(4), lambda actions: actions[0]), "two rows"),
    ("hears", START, where(lambda frame: len(frame.values) > 1, lost), "(two rows)"),
    ("says", COST, where(diverged, column(CostColumn.ENDED, lambda k: k + (k >= 0))), "divergence"),
    (
        "says",
        COST,
        where(diverged, column(slice(3), lambda c: np.where(c < 0, c, -1))),
        "divergence",
    ),
    ("says", COST, where(diverged, column(slice(2), lambda costs: 0 * costs)), "divergence"),
    ("hears", START, where(ends, lost), "release of the run"),
    ("says", COST, where(is_void, lost), "giving up"),
    ("says", COST, where(is_void, column(CostColumn.ENDED, lambda ended: -1)), "giving up"),
)
CONTROLLER = (
    ("says", ACTION, lambda frame, node: replace(frame, step=0), "every state"),
    ("says", ACTION, lambda frame, node: replace(frame, time=-1.0), "every state"),
    ("says", ACTION, lambda frame, node: replace(frame, values=frame.values[:, :1]), "every state"),
    ("hears", STATE, lost_again, "every state"),
    ("says", MODEL_IDENTIFIED, lambda f, node: replace(f, values=f.values[:, :-1]), "model"),
    ("says", MODEL_IDENTIFIED, lambda frame, node: replace(frame, plant=0), "model"),
    ("says", MODEL_IDENTIFIED, lambda frame, node: replace(frame, run=0), "model"),
    ("says", MODEL_IDENTIFIED, part(U, lambda basis: 2.0 * basis), "model"),
    ("says", MODEL_IDENTIFIED, part(slice(-1, None), lambda s_r: 0.0 * s_r), "model"),
    ("says", ACTION, drawn_anew, "exploration"),
    ("hears", START, column(StartColumn.EXCITATION, lambda seed: seed % 2**31), "draws"),
    ("hears", START, column(StartColumn.VARIANCE, lambda variance: variance**2), "draws"),
    ("says", ACTION, column(slice(1, 2), lambda a: 0 * a), "draws"),
    ("hears", STATE, where(lambda f: f.step != 300, lambda f, node: replace(f, step=0)), "draws"),
    ("says", MODEL_IDENTIFIED, part(A, lambda matrix: matrix.T), "known plant"),
    ("says", MODEL_IDENTIFIED, part(B_AND_KA, lambda rows: rows[[2, 3, 0, 1]]), "known plant"),
    ("says", MODEL_IDENTIFIED, part(B_AND_KA, lambda rows: 0.5 * rows), "(known plant)"),
    ("says", MODEL_IDENTIFIED, part(slice(-5, -3), lambda gain: -gain), "(known plant)"),
    ("says", MODEL_IDENTIFIED, part(slice(-5, -1), lambda K: K[[2, 3, 0, 1]]), "known plant"),
    ("says", MODEL_IDENTIFIED, drawn_anew, "result again"),
    ("hears", COST, lost_again, "result again"),
    ("says", None, a_model_all_the_same, "lost states"),
    ("says", FAILED, other_retry, "lost states"),
    ("says", FAILED, lost, "void"),
    ("says", FAILED, other_retry, "void"),
    ("says", None, a_model_all_the_same, "divergence"),
    ("says", FAILED, other_retry, "divergence"),
    ("says", MODEL_IDENTIFIED, reversed_rows, "two explorations"),
    ("says", MODEL_IDENTIFIED, lambda f, node: replace(f, values=f.values[:1]), "two explorations"),
    ("says", ACTION, reversed_rows, "two explorations"),
    ("hears", START, column(StartColumn.VARIANCE, lambda v: v[:1]), "two explorations"),
    ("hears", START, column(StartColumn.EXCITATION, lambda seed: seed[:1]), "two explorations"),
    ("hears", POLICY, with_ids_of(START, "run"), "policy held back"),
    ("hears", POLICY, with_ids_of(START, "episode"), "policy held back"),
    ("hears", MODEL, with_ids_of(START, "run", "step"), "model held back"),
    ("hears", START, with_ids_of(MODEL, "step"), "model held back"),
    ("says", ACTION, column(slice(2), lambda a: a + (a == 0)), "no control"),
    ("says", ACTION, column(slice(2), lambda a: -a), "(law of the page)"),
    ("hears", POLICY, column(slice(2), lambda gains: gains[..., ::-1]), "(law of the page)"),
    ("hears", START, column(StartColumn.MODEL, lambda model: 0 * model), "(law of the page)"),
    ("says", ACTION, reversed_rows, "two policies"),
    ("hears", POLICY, column(slice(2), lambda gains: gains[0]), "two policies"),
    ("hears", TARGET, lambda frame, node: replace(frame, plant=31), "target held back"),
)
TUNER = (
    ("says", START, lambda frame, node: replace(frame, run=0), "exploration"),
    ("says", START, column(StartColumn.EXCITATION, lambda seed: -1), "exploration"),
    ("says", START, column(StartColumn.EXCITATION, lambda seed: seed + 0.5), "exploration"),
    ("says", START, where(explores, column(StartColumn.VARIANCE, lambda v: 0)), "exploration"),
    ("says", START, where(ends, lost), "end of the run"),
    (
        "says",
        START,
        where(ends, lambda f, node: replace(f, values=np.zeros((1, 4)))),
        "end of the run",
    ),
    ("says", START, where(ends, lambda f, node: replace(f, run=f.run + 1)), "end of the run"),
    ("says", START, lost_again, "start again"),
    ("says", START, lambda f, node: column(0, lambda s: next(node.count))(f, node), "start again"),
    ("says", START, numbered_anew, "start again"),
    ("says", START, lambda f, node: column(0, lambda s: s + f.episode)(f, node), "void"),
    ("hears", FAILED, lost, "failure"),
    ("hears", MODEL_IDENTIFIED, lambda frame, node: replace(frame, run=9), "other models"),
    (
        "says",
        POLICY,
        lambda f, node: replace(f, values=f.values.transpose(0, 2, 1)),
        "first rollout",
    ),
    ("says", POLICY, lambda frame, node: replace(frame, step=0), "first rollout"),
    ("says", START, where(lambda f: f.step > 0, column(2, lambda v: 0.1)), "first rollout"),
    ("says", START, where(lambda f: f.step > 0, column(3, lambda m: 1)), "first rollout"),
    ("says", START, where(lambda f: f.step > 0, column(1, lambda e: 3)), "first rollout"),
    ("says", START, where(lambda f: f.step > 0, lambda f, n: replace(f, step=2)), "first rollout"),
    ("says", START, lambda f, node: replace(f, values=f.values[:, [1, 0, 2, 3]]), "first rollout"),
    ("says", POLICY, drawn_anew, "policy again"),
    ("hears", COST, lambda frame, node: replace(frame, run=9), "other costs"),
    ("hears", COST, with_ids_of(START, "episode"), "other costs"),
    ("hears", COST, lambda frame, node: replace(frame, plant=31), "other costs"),
    ("hears", COST, where(diverged, lost), "divergence"),
    ("says", POLICY, column(slice(4), lambda gains: gains[..., ::-1]), "(end of the run)"),
)


@pytest.mark.parametrize(
    ("kind", "side", "topic", "change", "name"),
    [("plant", *row) for row in PLANT]
    + [("controller", *row) for row in CONTROLLER]
    + [("tuner", *row) for row in TUNER],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_mistake_is_named(kind, side, topic, change, name):
    names = () if kind == "tuner" else (name.strip("()"),)
    found = named(findings(mistaken(kind, side, topic, change), *names))
    assert name in found
    assert not names or found == [name]


def test_what_came_instead_is_said():
    check = mistaken("plant", "says", STATE, lambda frame, node: replace(frame, step=0))
    (text,) = (finding.text for finding in findings(check) if not finding.good)
    assert "expected state 1 of episode 2" in text
    assert "got void `episode/cost` with episode 2, step 1 (" in text
    assert "`state` with episode 2, step 0 (" in text and text.endswith("not checked")


def test_a_cost_before_the_answer_to_the_last_state_is_named():
    check = plant()
    transport, take = check.transport, check.transport.take
    answer = transport._handlers[ACTION]

    def take_and_answer(sends):
        sends = list(sends)
        take(sends)
        for frame in (send.frame for send in sends if send.topic is STATE):
            if frame.step == 30:
                zeros = np.zeros((len(frame.values), 4))
                take(answer(replace(frame, values=zeros), transport.now()))

    transport.take = take_and_answer
    assert named(findings(check, "silence")) == ["silence"]


def test_a_controller_that_takes_any_target_is_named():
    check = controller()
    check.transport.send(TARGET, Frame(0, 0, 0, 0.0, np.zeros(64), plant=32))
    assert named(findings(check, "target held back")) == ["target held back"]


@pytest.mark.parametrize("known", [True, False])
def test_a_tuner_that_is_started_once_more_needs_another_run_id(known):
    check = tuner()
    served = check.findings()
    found = [next(served) for _ in range(10)]
    start = check.frame([[0.0, 1.0, 0.1, 0.0]], episode=1, run=9 if known else 10)
    check.transport.take([Publication(START, start)])
    assert named([*found, *served]) == (["another run"] if known else [])
