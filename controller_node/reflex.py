"""What the controller does without thinking, within an episode: from a state to its action, in bytes.

One compiled call instead of decoding, answering and encoding, which is `responder`, to the bit, as
long as nothing but the next state of the episode comes. Everything else takes the long way. With a
line to the plant the compiled call does that again and again.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
from numba import carray  # type: ignore[attr-defined, unused-ignore]
from numpy.typing import NDArray

from controller_node import law
from controller_node.law import LAW, act, control
from controller_node.responder import Responder
from loop_interfaces.fast_path import line, wire
from loop_interfaces.fast_path.line import (
    GOING,
    LINE,
    Ear,
    announcement,
    attendance,
    received,
    send,
)
from loop_interfaces.fast_path.wire import (
    EXPECTED,
    FIRST,
    STEP,
    TIME,
    Expectation,
    OwnMessage,
    expected_header,
)
from loop_interfaces.frames import MAX_ID, ArrayCodec, Frame
from loop_interfaces.jit import atomics, cache, native, simd
from loop_interfaces.jit.cache import fingerprint, jit, kept
from loop_interfaces.jit.native import MachineCode
from loop_interfaces.jit.simd import peek, poke, read
from loop_interfaces.protocol import MORE, OTHER, UNABLE
from loop_interfaces.topics import ACTION

__all__ = ["Reflex", "load_compiled"]

PLAN = np.dtype(
    [
        ("line", LINE),
        ("expected", EXPECTED),
        ("law", LAW),
        ("batch", np.int64),
        ("actions", np.int64),  # address of room for them
        ("message", np.int64),  # address of the header of the message to be sent
        ("begin", np.int64),  # address of the message, and its length
        ("length", np.int64),
        ("answered", np.int64),
        ("limit", np.int64),  # how many may be
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


@jit
def deal(line: Any, plan: Any) -> int:
    """Answer the message that has come in; GOING, or why no more are wanted."""
    raw, length = received(line)
    if not fill_in(raw, length, plan):
        return OTHER
    send(line, plan.begin, plan.length)
    return MORE if plan.answered == plan.limit else GOING


attend, announced = attendance(deal)


def compile_answers(sources: str) -> tuple[Any, Any]:
    @kept
    def answer(raw: bytes, plans: NDArray[np.void]) -> bool:
        sources  # noqa: B018  # closed over to be part of the key on disk
        data = np.frombuffer(raw, np.uint8)
        return bool(fill_in(data.ctypes.data, len(data), plans[0]))

    @kept
    def answer_all(plans: NDArray[np.void], until: int) -> int:
        """Answer messages on the line, as many as may be; why it returns."""
        sources  # noqa: B018
        plan = plans[0]
        return attend(plan.line, plan, until) if plan.answered < plan.limit else MORE

    return answer, answer_all


def compile_answer_soon() -> Any:
    @numba.cfunc(announcement(PLAN), cache=True)
    def answer_soon(plans: Any, count: int) -> None:
        SOURCES  # noqa: B018  # part of the key on disk
        plan = carray(plans, 1)[0]
        announced(plan.line, plan)

    return answer_soon


SOURCES = fingerprint(cache, simd, atomics, native, line, wire, law)
answer, answer_all = compile_answers(SOURCES)
answer_soon = MachineCode(compile_answer_soon)


def load_compiled() -> None:
    """Load all that the controller has compiled, or compile it."""
    plans, nothing = np.zeros(1, PLAN), np.zeros((0, 1))
    answer(b"", plans)
    answer_all(plans, 0)
    answer_soon()
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

    @property
    def ear(self) -> Ear:
        """What a line to the plant is for."""
        code, _ = answer_soon()
        return Ear(self._plan["line"], code, self._plans.ctypes.data)

    def flow(self, rounds: int, until: int) -> tuple[int, int]:
        """Answer states on the line, so many, until a time (monotonic ns).

        How many were answered, and why it ends; OTHER: the line's message waits to be handled.
        """
        if not self._ready:
            return 0, UNABLE
        before = self._plan["answered"]
        self._plan["limit"] = before + rounds
        ended = answer_all(self._plans, until)
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
