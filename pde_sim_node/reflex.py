"""What the plant does without thinking, within an episode: from an action to the next state, in bytes.

It is `lockstep`, to the bit, as long as nothing but the awaited action comes. Everything else takes
the long way. With a line to the controller, and where a step is machine code alone, a compiled
function does that again and again.
"""

from __future__ import annotations

from dataclasses import replace
from time import monotonic
from typing import TYPE_CHECKING, Any

import numba
import numpy as np
from numba import carray  # type: ignore[attr-defined, unused-ignore]
from numpy.typing import NDArray

from loop_interfaces.fast_path import line, wire
from loop_interfaces.fast_path.line import (
    GOING,
    LINE,
    Ear,
    announcement,
    attendance,
    monotonic_ns,
    received,
    send,
)
from loop_interfaces.fast_path.wire import (
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
from loop_interfaces.frames import HEADER, ArrayCodec, Frame
from loop_interfaces.jit import atomics, cache, native, simd
from loop_interfaces.jit.cache import fingerprint, jit, kept
from loop_interfaces.jit.native import MachineCode
from loop_interfaces.jit.simd import WIDTH, load, peek, poke, poke_lanes, read, write
from loop_interfaces.protocol import MORE, OTHER, UNABLE
from loop_interfaces.samples import ACTION_KIND, NO_TIME, SAMPLE_HEADER, STATE_KIND
from loop_interfaces.topics import STATE
from pde_sim_node.lockstep import Lockstep
from pde_sim_node.solver import step_context, work_queue
from pde_sim_node.solver.step_context import MACHINE, step_together

if TYPE_CHECKING:
    from loop_interfaces.ros.endpoints import Bundler

__all__ = ["Reflex", "load_compiled"]

PLAN = np.dtype(
    [
        ("line", LINE),
        ("expected", EXPECTED),
        ("message", np.int64),  # address of the header of the message to be sent
        # The following are of a plant that advances in machine code.
        ("begin", np.int64),  # address of the message to be sent, and its length
        ("length", np.int64),
        ("machine", MACHINE),
        ("values", np.int64),  # numbers of all states
        ("log", np.int64),  # address of room for the actions that were applied
        ("rounds", np.int64),  # done since the log was read
        ("limit", np.int64),  # how many may be
        ("time", np.float64),  # simulated, in s
        ("sample_time", np.float64),
        ("timed", np.int64),  # whether samples of states tell it
        ("bundles", BUNDLE, 2),
    ]
)
IDS = ("run", "episode", "step", "plant")
LOG = 50_000
"""Numbers in actions that are applied before the lock-step hears of it."""
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


@jit
def deal(line: Any, plan: Any) -> int:
    """Take the action that has come in, and send the state; GOING, or why no more are wanted."""
    raw, length = received(line)
    head = expected_header(raw, length, plan.expected)
    machine = plan.machine
    if head == 0 or peek(head, STEP) != machine.step:
        return OTHER
    keep(line, plan, ACTION_KIND, NO_TIME, raw, length)
    numbers = plan.expected.values
    for i in range(numbers):
        number = peek(head, FIRST + i)
        write(machine.actions, i, number)
        write(plan.log, plan.rounds * numbers + i, number)
    step_together(machine)
    plan.rounds += 1
    plan.time += plan.sample_time
    fill_in(plan.message, machine.step, plan.time, machine.states, plan.values)
    send(line, plan.begin, plan.length)
    told = plan.time if plan.timed else NO_TIME
    keep(line, plan, STATE_KIND, told, plan.begin, plan.length)
    done = plan.rounds == plan.limit or full(plan.bundles[0]) or full(plan.bundles[1])
    return MORE if done else GOING


attend, announced = attendance(deal)


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
    def advance(plans: NDArray[np.void], until: int) -> int:
        """Take actions on the line, as many as may be, and send the states; why it returns."""
        sources  # noqa: B018
        plan = plans[0]
        return attend(plan.line, plan, until) if plan.rounds < plan.limit else MORE

    return awaited, answer, advance


def compile_advance_soon() -> Any:
    @numba.cfunc(announcement(PLAN), cache=True)
    def advance_soon(plans: Any, count: int) -> None:
        SOURCES  # noqa: B018  # part of the key on disk
        plan = carray(plans, 1)[0]
        announced(plan.line, plan)

    return advance_soon


SOURCES = fingerprint(cache, simd, atomics, native, line, wire, work_queue, step_context)
awaited, answer, advance = compile_reflexes(SOURCES)
advance_soon = MachineCode(compile_advance_soon)


def load_compiled() -> None:
    """Load what is compiled, or compile it."""
    plans = np.zeros(1, PLAN)
    plans[0]["message"] = (room := np.zeros(FIRST + 1)).ctypes.data
    awaited(b"", plans, 0)
    answer(plans, 0, 0.0, room[:1].reshape(1, 1))
    advance(plans, 0)
    advance_soon()


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

    @property
    def ear(self) -> Ear:
        """What a line to the controller is for."""
        code, _ = advance_soon()
        return Ear(self._plan["line"], code, self._plans.ctypes.data)

    def flow(self, bundler: Bundler, rounds: int, until: int) -> tuple[int, int]:
        """Advance with the actions on the line, so many, until a time (monotonic ns).

        How many were taken, and why it ends; OTHER: the line's message waits to be handled.
        """
        lockstep, plan = self._lockstep, self._plan
        if not self._advances or lockstep.flowing != self._serial:
            return 0, UNABLE
        rounds = min(rounds, lockstep.horizon - lockstep.step, len(self._log))
        plan["machine"]["step"], plan["time"], plan["rounds"] = lockstep.step, lockstep.time, 0
        plan["limit"] = rounds
        plan["timed"] = bundler.timed
        lengths = len(self._message.raw), self._values + self._log.itemsize * self._log.shape[1]
        bundler.lend(plan["bundles"], 2 * SAMPLE_HEADER + sum(lengths))
        with lockstep.helping(self._plans["machine"]):
            ended = advance(self._plans, until)
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
        for name, value in machine._asdict().items():
            plan["machine"][name] = value
        plan["begin"], plan["length"] = self._message.begin, len(self._message.raw)
        plan["values"] = state.values.size
        plan["sample_time"] = self._lockstep.sample_time
        if self._log.shape[1] != frame.values.size:
            self._log = np.zeros((max(LOG // frame.values.size, 1), frame.values.size))
            plan["log"] = self._log.ctypes.data
