"""What the controller does without thinking, within an episode: from a state to its action, in bytes.

One compiled call instead of decoding, answering and encoding, which is `responder`, to the bit, as
long as nothing but the next state of the episode comes. Everything else takes the long way. With a
line to the plant the compiled call does that again and again.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller_node import law
from controller_node.law import LAW, act, control
from controller_node.responder import Responder
from loop_interfaces import compiled, line, native, simd, wire
from loop_interfaces.compiled import fingerprint, jit, kept
from loop_interfaces.frames import MAX_ID, ArrayCodec, Frame
from loop_interfaces.line import LINE, Line, received, send, wait
from loop_interfaces.protocol import MORE, OTHER, QUIET, UNABLE
from loop_interfaces.simd import peek, poke, read
from loop_interfaces.topics import ACTION
from loop_interfaces.wire import (
    EXPECTED,
    FIRST,
    STEP,
    TIME,
    Expectation,
    OwnMessage,
    expected_header,
)

__all__ = ["Reflex", "load_compiled"]

PLAN = np.dtype(
    [
        ("expected", EXPECTED),
        ("law", LAW),
        ("batch", np.int64),
        ("actions", np.int64),  # address of room for them
        ("message", np.int64),  # address of the header of the message to be sent
        ("begin", np.int64),  # address of the message, and its length
        ("length", np.int64),
        ("answered", np.int64),
        ("step", np.int64),  # that was answered last
    ]
)


@jit
def fill_in(raw: int, length: int, plan: Any) -> bool:
    """Fill in the action that answers the message; False, if it is not the one expected."""
    head = expected_header(raw, length, plan.expected)
    if head == 0:
        return False
    step = peek(head, STEP)
    if not (0.0 <= step < MAX_ID and step == math.floor(step)):
        return False
    act(plan.law, head + 8 * FIRST, plan.actions, plan.batch)
    poke(plan.message, STEP, step)
    poke(plan.message, TIME, peek(head, TIME))
    for i in range(plan.batch * plan.law.n_a):
        poke(plan.message, FIRST + i, read(plan.actions, i))
    plan.answered += 1
    plan.step = int(step)
    return True


def compile_answers(sources: str) -> tuple[Any, Any]:
    @kept
    def answer(raw: bytes, plans: NDArray[np.void]) -> bool:
        sources  # noqa: B018  # closed over to be part of the key on disk
        data = np.frombuffer(raw, np.uint8)
        return bool(fill_in(data.ctypes.data, len(data), plans[0]))

    @kept
    def answer_all(
        lines: NDArray[np.void], plans: NDArray[np.void], rounds: int, patience: int
    ) -> int:
        """Answer so many messages on the line; why it returns."""
        sources  # noqa: B018
        line, plan = lines[0], plans[0]
        for _ in range(rounds):
            if not wait(line, patience):
                return QUIET
            raw, length = received(line)
            if not fill_in(raw, length, plan):
                return OTHER
            send(line, plan.begin, plan.length)
        return MORE

    return answer, answer_all


answer, answer_all = compile_answers(fingerprint(compiled, simd, native, line, wire, law))


def load_compiled() -> None:
    """Load all that the controller has compiled, or compile it."""
    plans, nothing = np.zeros(1, PLAN), np.zeros((0, 1))
    answer(b"", plans)
    answer_all(np.zeros(1, LINE), plans, 0, 0)
    control(np.zeros(1, LAW), nothing, nothing)


class Reflex:
    """Answers what a responder has answered before in the episode.

    After every frame that the responder was given: `learn` if it was a state, else `forget`.

    Parameters
    ----------
    responder
        The long way.
    states
        The codec of the messages that come in.
    """

    def __init__(self, responder: Responder, states: ArrayCodec) -> None:
        self._responder = responder
        self._states, self._actions = states, ArrayCodec(ACTION.labels)
        self._plans = np.zeros(1, PLAN)
        self._plan = self._plans[0]
        self._expectation = Expectation(self._plan["expected"])
        self._ready = False
        self._message = OwnMessage(self._actions, Frame(0, 0, 0, 0.0, np.zeros((0, 0))))
        self._room = np.zeros(0)
        self._law: Any = None
        load_compiled()

    def __call__(self, raw: bytes) -> bytearray | None:
        """The message that answers a state, valid until the next call; None: take the long way."""
        if self._ready and answer(raw, self._plans):
            return self._message.raw
        return None

    def flow(self, line: Line, rounds: int, patience: int) -> tuple[int, int]:
        """Answer states on the line, so many and as long as they come within `patience` ns.

        How many were answered, and why it ends; OTHER: `line.message` waits to be handled.
        """
        if not self._ready:
            return 0, UNABLE
        before = self._plan["answered"]
        ended = answer_all(line.records, self._plans, rounds, patience)
        return int(self._plan["answered"] - before), ended

    def forget(self) -> None:
        """Take the long way with the next state."""
        self.settle()
        self._ready = False

    def settle(self) -> None:
        """Let the responder know what was answered here."""
        plan = self._plan
        if plan["answered"]:
            self._responder.credit(int(plan["answered"]), int(plan["step"]))
            plan["answered"] = 0

    def learn(self, frame: Frame) -> None:
        """The responder was given the state `frame`: from now on answer more of its kind."""
        self.forget()
        law = self._responder.law_in_use
        if law is None or not self._expectation.learn(self._states, frame):
            return
        shape = len(frame.values), law.n_a
        if self._message.shape != shape:
            self._message = OwnMessage(self._actions, Frame(0, 0, 0, 0.0, np.zeros(shape)))
            self._room = np.zeros(shape)
        self._message.address_to(frame)
        self._law, plan = law, self._plan  # the law has what the plan has the addresses of
        plan["law"], plan["batch"] = law.plan, shape[0]
        plan["actions"], plan["message"] = self._room.ctypes.data, self._message.address
        plan["begin"], plan["length"] = self._message.begin, len(self._message.raw)
        self._ready = True
