# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The base of the three checks: messages that are awaited, and a list of probes. Pure.

A probe is a method whose name and docstring are printed: what docs/protocol.md promises there. It
raises UnexpectedError where the node does otherwise. Each can be run alone: what several need is made
by the first of them.

A lost message never makes a correct node BAD: who waits asks again by the clock, and who is asked
again answers again.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import count
from typing import Any, ClassVar, Protocol, TypeAlias

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.messages.frames import Frame
from pdeloop.messages.protocol import ModelFailure
from pdeloop.messages.topics import COST, MODEL_FAILED, START, VOID, Topic
from pdeloop.problem_check import Finding

ASK_AGAIN = 0.5
"""Seconds after which an unanswered message is sent again."""
DISCOVERY = 2.0
"""Seconds after a failed probe in which other publishers are looked for."""
FAILED = Topic(MODEL_FAILED, (), latched=True)
"""Its messages are ModelFailure."""
Message: TypeAlias = Any
"""A Frame, or a ModelFailure."""
Ask: TypeAlias = Callable[[], None]


class UnexpectedError(Exception):
    """The node breaks a rule: what was expected, and what was received."""


class NoAnswerError(UnexpectedError):
    """The same, and the check cannot continue."""


class NoteError(Exception):
    """A remark that only a person who knows the node can judge."""


class Transport(Protocol):
    """The loop's topics. received_any: whether one came; refused: why the last one was, if any."""

    received_any: bool
    refused: str

    def now(self) -> float:
        """Monotonic time in s."""

    def send(self, topic: Topic, message: Message) -> None: ...

    def next(self, *topics: Topic, seconds: float) -> tuple[Topic, Message] | None:
        """The next message of these topics; None if none comes in time."""

    def wait_delivered(self) -> None:
        """Wait until sent messages have arrived, for at most a second."""

    def disturbance(self, seconds: float = 0.0) -> str:
        """Why no node can be checked here: others beside it, or a QoS that does not fit; or empty.

        seconds: for which it is looked at least. A message may come before its publisher is known.
        """


class Check(ABC):
    """Plays the other two nodes to one.

    n_a, n_z: size of action and state; patience, limit (s): for one answer, and for all; run: its id.
    """

    published: ClassVar[tuple[Topic, ...]]
    """Topics of the checked node; the check publishes the others."""
    probes: ClassVar[tuple[Callable[[Any], None], ...]]

    def __init__(
        self,
        transport: Transport,
        n_a: int = 1,
        *,
        n_z: int | None = None,
        patience: float = 10.0,
        limit: float = 600.0,
        run: int = 1,
    ) -> None:
        self.transport, self.n_a, self.n_z, self.run = transport, n_a, n_z, run
        self.patience, self._limit, self._end = patience, limit, transport.now() + limit
        self._numbers = count(1)

    def findings(self) -> Iterator[Finding]:
        """Yield the finding of each probe; the node is left free on every way out."""
        try:
            for probe in self.probes:
                name, promise = probe.__name__.replace("_", " "), str(probe.__doc__).rstrip(".")
                try:
                    probe(self)
                    yield Finding(name, True, promise)
                except NoteError as note:
                    yield Finding(name, True, str(note), note=True)
                except UnexpectedError as error:
                    if self.transport.disturbance(DISCOVERY):  # said below, and the cause
                        break
                    ends = isinstance(error, NoAnswerError)
                    rest = "; the rest is not checked" if ends else ""
                    yield Finding(name, False, f"{promise}: {error}{rest}")
                    if ends:
                        break
            if disturbance := self.transport.disturbance():
                yield Finding("topics", False, disturbance)
            if self.transport.received_any:
                refused = self.transport.refused
                yield Finding("messages", not refused, refused or "all of them are well formed")
        finally:
            self.release()

    def release(self) -> None:
        """Publish that the run is over, which leaves the node free for the next check."""
        self.transport.send(START, self.new_start([]))
        self.transport.wait_delivered()

    @abstractmethod
    def resend(self) -> None:
        """Send again what the node needs for its answer, as it may have been lost."""

    def expect(
        self,
        what: str,
        wanted: Callable[[Topic, Message], bool],
        *on: Topic,
        ask: Ask | None = None,
        answers: Frame | None = None,
        patience: float = 0.0,
    ) -> tuple[Topic, Message]:
        """The first wanted message on these topics; NoAnswerError if none comes.

        ask: sends what it answers, again by the clock and whenever the message comes again that it
        `answers`; patience (s): if not that of the check.
        """
        patience = patience or self.patience
        end = min(self.transport.now() + patience, self._end)
        due, others = None, Counter[str]()
        while (now := self.transport.now()) < end:
            if ask is not None and (due is None or now >= due):
                if due is not None:
                    self.resend()
                ask()
                due = now + ASK_AGAIN
            found = self.transport.next(*on, seconds=(end if due is None else min(due, end)) - now)
            if found is None:
                continue
            if wanted(*found):
                return found
            if ask is not None and answers is not None and ids(found[1]) == ids(answers):
                ask()
            others[self.described(*found)] += 1
        if end == self._end:
            raise NoAnswerError(f"--limit {self._limit:g} s was reached while waiting for {what}")
        got = " and ".join(f"{what} ({n} times)" for what, n in others.most_common(2)) or "nothing"
        if not self.transport.received_any:
            got += "; is it in this ROS_DOMAIN_ID and --namespace?"
        raise NoAnswerError(f"expected {what} within {patience:g} s, got {got}")

    def drain(self, *topics: Topic) -> None:
        """Discard messages received on these topics."""
        while self.transport.now() < self._end and self.transport.next(*topics, seconds=0.0):
            pass

    def frame(self, values: Any, **header: Any) -> Frame:
        """A message of the run."""
        known = {"run": self.run, "episode": 0, "step": 0, "time": 0.0} | header
        return Frame(values=np.array(values, dtype=float), **known)

    def new_start(self, rows: Any, **header: Any) -> Frame:
        """A start with the next number, not sent yet; no rows: the end of the run."""
        return self.frame(rows or np.empty((0, 4)), episode=next(self._numbers), **header)

    def described(self, topic: Topic, message: Message) -> str:
        """A message in words."""
        run = "" if message.run == self.run else " of another run"
        if isinstance(message, ModelFailure):
            return f"`{topic.name}`{run} with retry {message.retry}: {message.reason[:200]}"
        void = "void " if topic is COST and VOID in message.values else ""
        return f"{void}`{topic.name}`{run} with episode {message.episode}, step {message.step}"


def ids(message: Message) -> tuple[int, int, int]:
    """Run, episode and step."""
    return message.run, message.episode, getattr(message, "step", 0)


def require(good: object, expected: object, got: object) -> None:
    """UnexpectedError unless something is as it has to be."""
    if not good:
        raise UnexpectedError(f"expected {expected}, got {got}")


def require_same(found: Array, expected: Array, what: str) -> None:
    """UnexpectedError unless two arrays are the same to the bit."""
    require(found.shape == expected.shape, f"the shape {expected.shape} of {what}", found.shape)
    others = np.flatnonzero(found.view(np.int64) != expected.view(np.int64))
    if len(others):
        a, b = (float(array.flat[others[0]]) for array in (expected, found))
        require(False, f"the bits of {what}, there {a!r}", repr(b))
