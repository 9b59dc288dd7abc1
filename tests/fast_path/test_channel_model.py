# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The hand-over between the middleware's thread and the node's own, over all interleavings.

A model of pdeloop.fast_path.channel: every line of the two programs there is one atomic step.
All orders of the steps are explored, with messages that the handler answers and others that it leaves
alone. The same exploration finds what is wrong with each of several broken protocols.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from graphlib import TopologicalSorter
from itertools import product
from typing import NamedTuple

import pytest

MESSAGES, WAKES = 3, 2
"""Messages that arrive, and times that the node's thread wakes up for another reason."""


class State(NamedTuple):
    """Both threads between two steps; the messages are numbered from 0."""

    arrived: int = 0
    queue: tuple[int, ...] = ()
    """Of the middleware."""
    mailbox: tuple[int, ...] = ()
    lock: str = ""
    """Who holds it."""
    armed: bool = False
    triggered: bool = False
    """The guard condition."""
    middleware: str = "idle"
    taken: int = -1
    seen_armed: bool = False
    answering: bool = False
    """True while the middleware's thread is in the handler."""
    node: str = "arm"
    owns: bool = True
    """True if the protocol is the node's."""
    popped: int = -1
    handled: tuple[int, ...] = ()
    dropped: int = 0
    wakes: int = WAKES

    @property
    def finished(self) -> bool:
        return len(self.handled) + self.dropped == MESSAGES and self.node == "wait"


@dataclass(frozen=True)
class Model:
    """broken: what is done in another way than it should be; fast: whether the handler answers each
    of the messages.
    """

    fast: tuple[bool, ...]
    capacity: int = 2
    broken: str = ""

    def steps(self, s: State) -> Iterator[State]:
        """All states that one step of anybody leads to."""
        if s.arrived < MESSAGES:
            yield s._replace(arrived=s.arrived + 1, queue=(*s.queue, s.arrived))
        yield from self.middleware(s)
        yield from self.node(s)

    def middleware(self, s: State) -> Iterator[State]:
        match s.middleware:
            case "idle" if s.queue:
                yield s._replace(middleware="lock", seen_armed=s.armed)
            case "lock" if not s.lock:
                yield s._replace(middleware="take", lock="middleware")
            case "take" if not s.queue:
                yield s._replace(middleware="idle", lock="")
            case "take":
                yield s._replace(middleware="decide", taken=s.queue[0], queue=s.queue[1:])
            case "decide":
                early = self.broken == "it looks whether it is armed before it has the lock"
                armed = s.seen_armed if early else s.armed
                if armed and self.fast[s.taken]:
                    lock = "" if self.broken == "it answers without the lock" else s.lock
                    yield s._replace(middleware="answer", answering=True, lock=lock)
                else:
                    yield s._replace(middleware="mail")
            case "answer":
                handled = (*s.handled, s.taken)
                yield s._replace(middleware="unlock", answering=False, handled=handled)
            case "mail":
                armed = s.armed and self.broken == "it stays armed while a message waits"
                room = len(s.mailbox) < self.capacity
                mailbox = (*s.mailbox, s.taken) if room else s.mailbox
                counted = not room and self.broken != "what is dropped is not counted"
                # A guard condition keeps it; an event would be lost where nobody waits for it.
                heard = s.node == "wait" or self.broken != "the guard condition forgets"
                triggered = heard and self.broken != "nobody is told of a message that waits"
                yield s._replace(
                    middleware="unlock",
                    armed=armed,
                    mailbox=mailbox,
                    dropped=s.dropped + counted,
                    triggered=s.triggered or triggered,
                )
            case "unlock":
                lock = "" if s.lock == "middleware" else s.lock
                yield s._replace(middleware="lock", lock=lock, seen_armed=s.armed)

    def node(self, s: State) -> Iterator[State]:
        match s.node:
            case "arm":
                if not s.lock:  # without an episode under way there is nothing to arm
                    yield s._replace(node="pop" if s.mailbox else "go to sleep")
                if self.broken == "it arms without the lock":
                    yield s._replace(node="answer waiting" if s.mailbox else "armed")
                elif not s.lock:
                    yield s._replace(node="answer waiting", lock="node")
            case "answer waiting":
                lock = "" if s.lock == "node" else s.lock
                if s.mailbox and self.fast[s.mailbox[0]]:
                    handled = (*s.handled, s.mailbox[0])
                    yield s._replace(mailbox=s.mailbox[1:], handled=handled)
                elif s.mailbox and self.broken != "it arms while a message waits":
                    yield s._replace(node="pop", lock=lock)
                else:
                    yield s._replace(node="go to sleep", lock=lock, armed=True, owns=False)
            case "armed":
                yield s._replace(node="go to sleep", armed=True, owns=False)
            case "go to sleep":
                yield s._replace(node="wait")
            case "wait":
                if s.triggered:
                    yield s._replace(node="disarm", triggered=False)
                if s.wakes:
                    yield s._replace(node="disarm", wakes=s.wakes - 1)
            case "disarm":
                yield s._replace(node="disarmed", armed=False)
            case "disarmed" if not s.lock or self.broken == "it does not wait for the answer":
                yield s._replace(node="work", owns=True)
            case "work":  # messages of other topics
                yield s._replace(node="arm")
            case "pop" if not s.lock:
                yield s._replace(node="handle", popped=s.mailbox[0], mailbox=s.mailbox[1:])
            case "handle":
                yield s._replace(node="arm", handled=(*s.handled, s.popped))

    def check(self) -> int:
        """Explore everything; how many states there are. AssertionError says what is wrong."""
        graph: dict[State, list[State]] = {}
        todo = [State()]
        while todo:
            s = todo.pop()
            if s in graph:
                continue
            assert not (s.answering and s.owns), f"two owners: {s}"
            assert list(s.handled) == sorted(set(s.handled)), f"out of order: {s}"
            graph[s] = list(self.steps(s))
            assert graph[s] or s.finished, f"lost: {s}"
            todo += graph[s]
        # Nobody can go round for ever, and so every message is handled in the end.
        TopologicalSorter(graph).prepare()
        return len(graph)


CASES = [
    (kinds, capacity)
    for kinds in product((True, False), repeat=MESSAGES)
    for capacity in (1, MESSAGES)
]


def test_no_interleaving_loses_a_message_or_has_two_owners() -> None:
    assert sum(Model(fast, capacity).check() for fast, capacity in CASES) > 20_000


@pytest.mark.parametrize(
    "broken, found",
    [
        ("it looks whether it is armed before it has the lock", "two owners"),
        ("it answers without the lock", "two owners"),
        ("it does not wait for the answer", "two owners"),
        ("it stays armed while a message waits", "lost|out of order"),
        ("it arms while a message waits", "lost|out of order"),
        ("it arms without the lock", "out of order|two owners"),
        ("the guard condition forgets", "lost"),
        ("nobody is told of a message that waits", "lost"),
        ("what is dropped is not counted", "lost"),
    ],
)
def test_a_broken_hand_over_is_found(broken: str, found: str) -> None:
    with pytest.raises(AssertionError, match=found):
        for fast, capacity in CASES:
            Model(fast, capacity, broken).check()
