"""What the plant does without thinking, within an episode: from an action to the next state, in bytes.

It is `lockstep`, to the bit, as long as nothing but the awaited action comes. Everything else takes
the long way. With a line to the controller, and where a step is machine code alone, a compiled
function does that again and again.
"""

from __future__ import annotations

from dataclasses import replace
from time import monotonic
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from loop_interfaces import compiled, line, native, simd, wire
from loop_interfaces.compiled import fingerprint, jit, kept
from loop_interfaces.frames import HEADER, ArrayCodec, Frame
from loop_interfaces.line import LINE, Line, monotonic_ns, received, send, wait
from loop_interfaces.native import call_c
from loop_interfaces.protocol import MORE, OTHER, QUIET, UNABLE
from loop_interfaces.samples import ACTION_KIND, NO_TIME, SAMPLE_HEADER, STATE_KIND
from loop_interfaces.simd import WIDTH, load, peek, poke, poke_lanes, read, write
from loop_interfaces.topics import STATE
from loop_interfaces.wire import (
    BUNDLE,
    EXPECTED,
    FIRST,
    STEP,
    TIME,
    Expectation,
    OwnMessage,
    append,
    expected_header,
)
from pde_sim_node.lockstep import Lockstep
from pde_sim_node.plant import Machine

if TYPE_CHECKING:
    from loop_interfaces.endpoints import Bundler

__all__ = ["Reflex", "load_compiled"]

PLAN = np.dtype(
    [
        ("expected", EXPECTED),
        ("message", np.int64),  # address of the header of the message to be sent
        # The following are of a plant that advances in machine code.
        ("begin", np.int64),  # address of the message to be sent, and its length
        ("length", np.int64),
        *((name, np.int64) for name in Machine._fields),
        ("batch", np.int64),
        ("values", np.int64),  # numbers of all states
        ("log", np.int64),  # address of room for the actions that were applied
        ("step", np.int64),
        ("rounds", np.int64),  # done since the log was read
        ("time", np.float64),  # simulated, in s
        ("sample_time", np.float64),
        ("timed", np.int64),  # whether samples of states tell it
        ("bundles", BUNDLE, 2),
    ]
)
IDS = ("run", "episode", "step", "plant")
NONE = -2
"""Number of no episode, nor of a lock-step that does not flow."""


@jit
def fill_in(head: int, step: int, time: float, source: int, values: int) -> None:
    """The message of the states."""
    last = values % WIDTH
    poke(head, STEP, step)
    poke(head, TIME, time)
    for i in range(0, values - last, WIDTH):
        poke_lanes(head, FIRST + i, load(source, i))
    for i in range(values - last, values):
        poke(head, FIRST + i, read(source, i))


@jit
def keep(line: Any, plan: Any, kind: int, time: float, raw: int, length: int) -> None:
    """For those who record or look."""
    if plan.bundles[0].open or plan.bundles[1].open:
        stamp = monotonic_ns(line)
        for bundle in plan.bundles:
            append(bundle, kind, stamp, time, raw, length)


@jit
def full(bundle: Any) -> bool:
    return bool(bundle.open and bundle.end >= bundle.limit)


def compile_reflexes(sources: str) -> tuple[Any, Any, Any]:
    @kept
    def awaited(raw: bytes, plans: NDArray[np.void], step: int) -> bool:
        """Whether the message is the action for a step."""
        sources  # noqa: B018  # closed over to be part of the key on disk
        data = np.frombuffer(raw, np.uint8)
        head = expected_header(data.ctypes.data, len(data), plans[0].expected)
        return head != 0 and bool(peek(head, STEP) == step)

    @kept
    def answer(
        plans: NDArray[np.void], step: int, time: float, states: NDArray[np.float64]
    ) -> None:
        sources  # noqa: B018
        fill_in(plans[0].message, step, time, states.ctypes.data, states.size)

    @kept
    def advance(
        lines: NDArray[np.void], plans: NDArray[np.void], rounds: int, patience: int
    ) -> int:
        """Take so many actions on the line, and send the states; why it returns."""
        sources  # noqa: B018
        line, plan = lines[0], plans[0]
        for _ in range(rounds):
            if full(plan.bundles[0]) or full(plan.bundles[1]):
                return MORE
            if not wait(line, patience):
                return QUIET
            raw, length = received(line)
            head = expected_header(raw, length, plan.expected)
            if head == 0 or peek(head, STEP) != plan.step:
                return OTHER
            keep(line, plan, ACTION_KIND, NO_TIME, raw, length)
            numbers = plan.expected.values
            for i in range(numbers):
                number = peek(head, FIRST + i)
                write(plan.actions, i, number)
                write(plan.log, plan.rounds * numbers + i, number)
            arrays = plan.states, plan.actions, plan.totals, plan.diverged_step
            call_c(plan.code, (plan.plan, *arrays, 0, plan.batch, plan.step))
            plan.rounds += 1
            plan.step += 1
            plan.time += plan.sample_time
            fill_in(plan.message, plan.step, plan.time, plan.states, plan.values)
            send(line, plan.begin, plan.length)
            told = plan.time if plan.timed else NO_TIME
            keep(line, plan, STATE_KIND, told, plan.begin, plan.length)
        return MORE

    return awaited, answer, advance


awaited, answer, advance = compile_reflexes(fingerprint(compiled, simd, native, line, wire))


def load_compiled() -> None:
    """Load what is compiled, or compile it."""
    plans = np.zeros(1, PLAN)
    plans[0]["message"] = (room := np.zeros(FIRST + 1)).ctypes.data
    awaited(b"", plans, 0)
    answer(plans, 0, 0.0, room[:1].reshape(1, 1))
    advance(np.zeros(1, LINE), plans, 0, 0)


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
        self._plan = self._plans[0]
        self._expectation = Expectation(self._plan["expected"])
        self._message = OwnMessage(self._states, Frame(0, 0, 0, 0.0, np.zeros((1, 1))))
        self._serial = NONE
        self._shape: tuple[int, ...] = ()
        self._values = 0
        self._log = np.zeros((0, 0))
        self._advances = False
        self._plan["message"] = self._message.address
        load_compiled()

    def __call__(self, raw: bytes, now: float) -> bytearray | None:
        """The message of the next state, valid until the next call; None: take the long way."""
        lockstep = self._lockstep
        if lockstep.flowing != self._serial or not awaited(raw, self._plans, lockstep.step):
            return None
        values = np.ndarray(self._shape, np.float64, raw, self._values)
        states = lockstep.advance(values, hash(raw[self._values :]), now)
        if not states.flags.c_contiguous:  # what is measured may be chosen columns
            states = np.ascontiguousarray(states)
        answer(self._plans, lockstep.step, lockstep.time, states)
        return self._message.raw

    def flow(self, bundler: Bundler, line: Line, rounds: int, patience: int) -> tuple[int, int]:
        """Advance with the actions on the line, so many and as long as they come within `patience` ns.

        How many were taken, and why it ends; OTHER: `line.message` waits to be handled.
        """
        lockstep, plan = self._lockstep, self._plan
        if not self._advances or lockstep.flowing != self._serial:
            return 0, UNABLE
        rounds = min(rounds, lockstep.horizon - lockstep.step)
        if len(self._log) < rounds:
            self._log = np.zeros((rounds, plan["expected"]["values"]))
            plan["log"] = self._log.ctypes.data
        plan["step"], plan["time"], plan["rounds"] = lockstep.step, lockstep.time, 0
        plan["timed"] = bundler.timed
        lengths = len(self._message.raw), self._values + self._log.itemsize * self._log.shape[1]
        bundler.lend(plan["bundles"], 2 * SAMPLE_HEADER + sum(lengths))
        ended = advance(line.records, self._plans, rounds, patience)
        count = int(plan["rounds"])
        if count:
            lockstep.credit(self._log[:count], float(plan["time"]), monotonic())
        bundler.settle(plan["bundles"], lengths, count)
        return count, ended

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
        plan = self._plan
        if self._message.shape != state.values.shape:
            self._message = OwnMessage(self._states, state)
            plan["message"] = self._message.address
        self._message.address_to(state)
        self._shape = frame.values.shape
        self._values = len(self._actions.prefix or b"") + 8 * HEADER
        self._serial = serial
        machine = self._lockstep.machine
        self._advances = machine is not None
        if machine is None:
            return
        for name, address in machine._asdict().items():
            plan[name] = address
        plan["begin"], plan["length"] = self._message.begin, len(self._message.raw)
        plan["batch"], plan["values"] = len(state.values), state.values.size
        plan["sample_time"] = self._lockstep.sample_time
        self._log = np.zeros((0, frame.values.size))
