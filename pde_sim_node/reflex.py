"""What the plant does without thinking, within an episode: from an action to the next state, in bytes.

It is `lockstep`, to the bit, as long as nothing but the awaited action comes. Everything else takes
the long way.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loop_interfaces import compiled, simd, wire
from loop_interfaces.compiled import fingerprint, kept
from loop_interfaces.frames import HEADER, ArrayCodec, Frame
from loop_interfaces.simd import WIDTH, load, peek, poke, poke_lanes, read
from loop_interfaces.topics import STATE
from loop_interfaces.wire import (
    EXPECTED,
    FIRST,
    STEP,
    TIME,
    Expectation,
    OwnMessage,
    expected_header,
)
from pde_sim_node.lockstep import Lockstep

__all__ = ["Reflex"]

PLAN = np.dtype(
    [
        ("expected", EXPECTED),
        ("message", np.int64),  # address of the header of the message to be sent
    ]
)
IDS = ("run", "episode", "step", "plant")
NONE = -2
"""Number of no episode, nor of a lock-step that does not flow."""


def compile_reflex(sources: str) -> Any:
    @kept
    def awaited(raw: bytes, plans: NDArray[np.void], step: int) -> bool:
        """Whether the message is the action for a step."""
        sources  # noqa: B018  # closed over to be part of the key on disk
        head = expected_header(raw, plans[0].expected)
        return head != 0 and bool(peek(head, STEP) == step)

    @kept
    def fill_in(
        plans: NDArray[np.void], step: int, time: float, states: NDArray[np.float64]
    ) -> None:
        """The message of the states."""
        sources  # noqa: B018
        head, source, last = plans[0].message, states.ctypes.data, states.size % WIDTH
        poke(head, STEP, step)
        poke(head, TIME, time)
        for i in range(0, states.size - last, WIDTH):
            poke_lanes(head, FIRST + i, load(source, i))
        for i in range(states.size - last, states.size):
            poke(head, FIRST + i, read(source, i))

    return awaited, fill_in


awaited, fill_in = compile_reflex(fingerprint(compiled, simd, wire))


class Reflex:
    """Advances a lock-step that has taken an action of the episode before.

    Parameters
    ----------
    lockstep
        The long way. After every action that it was given, call `learn`.
    actions
        The codec of the messages that come in.
    """

    def __init__(self, lockstep: Lockstep, actions: ArrayCodec) -> None:
        self._lockstep = lockstep
        self._actions, self._states = actions, ArrayCodec(STATE.labels)
        self._plans = np.zeros(1, PLAN)
        self._expectation = Expectation(self._plans[0]["expected"])
        self._message = OwnMessage(self._states, Frame(0, 0, 0, 0.0, np.zeros((1, 1))))
        self._serial = NONE
        self._shape: tuple[int, ...] = ()
        self._values = 0
        self._plans[0]["message"] = self._message.address
        awaited(b"", self._plans, 0)  # load them, or compile them
        fill_in(self._plans, 0, 0.0, np.zeros((1, 1)))

    def __call__(self, raw: bytes, now: float) -> bytearray | None:
        """The message of the next state, valid until the next call; None: take the long way."""
        lockstep = self._lockstep
        if lockstep.flowing != self._serial or not awaited(raw, self._plans, lockstep.step):
            return None
        values = np.ndarray(self._shape, np.float64, raw, self._values)
        states = lockstep.advance(values, hash(raw[self._values :]), now)
        if not states.flags.c_contiguous:  # what is measured may be chosen columns
            states = np.ascontiguousarray(states)
        fill_in(self._plans, lockstep.step, lockstep.time, states)
        return self._message.raw

    def learn(self, frame: Frame) -> None:
        """The lock-step was given the action `frame`: from now on take more of its kind."""
        serial, state = self._lockstep.flowing, self._lockstep.last_state
        self._serial = NONE
        if serial < 0 or state is None:
            return
        taken = replace(state, step=state.step - 1)
        if any(getattr(frame, name) != getattr(taken, name) for name in IDS):
            return  # somebody else's, or too late: nothing to learn from
        if not self._expectation.learn(self._actions, frame):
            return
        if self._message.shape != state.values.shape:
            self._message = OwnMessage(self._states, state)
            self._plans[0]["message"] = self._message.address
        self._message.address_to(state)
        self._shape = frame.values.shape
        self._values = len(self._actions.prefix or b"") + 8 * HEADER
        self._serial = serial
