# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The plant's fast path: maps a serialised action to the next serialised state within an episode.

It answers the awaited action as `lockstep` does, to the bit, where a step is compiled code alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pde_sim_node.lockstep import Lockstep
from pde_sim_node.plants.batch import BatchPlant
from pdeloop.fast_path import channel
from pdeloop.fast_path.handler import FastPath, fast_handler, plan_type
from pdeloop.fast_path.messages import FIRST, SAMPLE_BATCH, STEP, TIME, append, full, write_answer
from pdeloop.jit.cache import jit, jit_in_closure
from pdeloop.jit.native import CLOCK, MonotonicClock, call_c, monotonic_ns
from pdeloop.jit.simd import load_unaligned, write
from pdeloop.messages.frames import ArrayCodec, digest
from pdeloop.messages.protocol import NOT_SIGNED
from pdeloop.messages.samples import ACTION_KIND, NO_TIME, SAMPLE_HEADER, STATE_KIND
from pdeloop.messages.topics import STATE

if TYPE_CHECKING:
    from pdeloop.ros.endpoints import SampleBatcher

PLAN = plan_type(
    # Addresses of the plant's compiled step, and of what it is called with.
    ("code", np.int64),  # see solver.batch_step.environments_of
    ("step_plan", np.int64),
    ("states", np.int64),
    ("actions", np.int64),
    ("totals", np.int64),
    ("diverged_step", np.int64),
    ("batch", np.int64),
    ("step", np.int64),  # k, of the states
    ("values", np.int64),  # numbers of all states
    ("log", np.int64),  # address of room for the actions that were applied
    ("steps", np.int64),  # done since the log was read
    ("limit", np.int64),  # how many may be
    ("signature", np.float64),  # of the actions
    ("time", np.float64),  # simulated, in s
    ("sample_time", np.float64),
    ("timed", np.int64),  # whether samples of states tell it
    ("batches", SAMPLE_BATCH, 2),
    ("begin", np.int64),  # address of the answer, and its length
    ("length", np.int64),
    ("clock", CLOCK),
)
LOG = 50_000
"""Numbers in actions that are applied before the lock-step is synchronised."""


@jit
def add_sample(plan: Any, kind: int, time: float, raw: int, length: int) -> None:
    """Add a message to the batches that take samples."""
    if plan.batches[0].open or plan.batches[1].open:
        stamp = monotonic_ns(plan.clock)
        for batch in plan.batches:
            append(batch, kind, stamp, time, raw, length)


@jit_in_closure
def advance(plan: Any, head: int, message: int, length: int) -> bool:
    """Apply the awaited action, and fill in the next state."""
    if load_unaligned(head, STEP) != plan.step or plan.steps == plan.limit:
        return False
    if min(load_unaligned(head, TIME), NOT_SIGNED) != plan.signature:
        return False
    if full(plan.batches[0]) or full(plan.batches[1]):
        return False
    add_sample(plan, ACTION_KIND, NO_TIME, message, length)
    numbers = plan.expected.values
    for i in range(numbers):
        number = load_unaligned(head, FIRST + i)
        write(plan.actions, i, number)
        write(plan.log, plan.steps * numbers + i, number)
    z, a, c, ended = plan.states, plan.actions, plan.totals, plan.diverged_step
    call_c(plan.code, (plan.step_plan, z, a, c, ended, 0, plan.batch, plan.step))
    plan.steps += 1
    plan.step += 1
    plan.time += plan.sample_time
    write_answer(plan.answer, plan.step, plan.time, plan.states, plan.values)
    add_sample(plan, STATE_KIND, plan.time if plan.timed else NO_TIME, plan.begin, plan.length)
    return True


handler = fast_handler(PLAN, advance)


def load_compiled() -> None:
    """Load what is compiled, or compile it."""
    channel.load_compiled()
    handler()


class PlantFastPath(FastPath):
    """Advances the plant of a lock-step within an episode.

    actions: the codec of the messages that come in; batcher: takes the samples.
    """

    def __init__(self, lockstep: Lockstep, actions: ArrayCodec, batcher: SampleBatcher) -> None:
        super().__init__(handler, PLAN, actions, STATE)
        assert isinstance(lockstep.plant, BatchPlant)
        assert lockstep.plant.parallel is not None
        self._lockstep, self._plant, self._batcher = lockstep, lockstep.plant, batcher
        self._parallel = lockstep.plant.parallel
        self._clock = MonotonicClock(self.plan["clock"])
        self._log = np.zeros((0, 0))
        self.suspended = False
        """True if every action is left to the lock-step."""

    def prepare(self) -> bool:
        """Within an episode of a plant whose step is compiled code alone."""
        lockstep, plant, plan = self._lockstep, self._plant, self.plan
        state, action = lockstep.awaiting, (plant.batch, plant.n_a)
        signature = lockstep.signature
        if self.suspended or state is None or signature is None:
            return False
        if not self.expect(state, action, state.values.shape):
            return False
        if self._parallel.shared:
            return False
        plan["code"], plan["step_plan"] = self._parallel.code, self._parallel.plans.ctypes.data
        for name in ("states", "actions", "totals", "diverged_step"):
            plan[name] = getattr(plant, name).ctypes.data
        plan["batch"], plan["step"] = plant.batch, plant.step_index
        if self._log.shape[1] != plant.actions.size:
            self._log = np.zeros((max(LOG // plant.actions.size, 1), plant.actions.size))
        plan["values"], plan["log"] = state.values.size, self._log.ctypes.data
        plan["steps"], plan["limit"] = 0, min(plant.horizon - plant.step_index, len(self._log))
        plan["signature"] = signature
        plan["time"], plan["sample_time"] = lockstep.time, plant.sample_time
        plan["timed"] = self._batcher.timed
        plan["begin"], plan["length"] = self.answer.begin, len(self.answer.raw)
        self._batcher.reserve(plan["batches"], 2 * SAMPLE_HEADER + sum(self._lengths))
        return True

    def synchronise(self, answers: int, last: float) -> None:
        plan = self.plan
        self._plant.step_index = int(plan["step"])
        if answers:
            self._lockstep.advance_counters([digest(row) for row in self._log[:answers]], last)
        self._batcher.commit(plan["batches"], self._lengths, answers)

    @property
    def _lengths(self) -> tuple[int, int]:
        """Bytes of a state and of an action."""
        expected = self.plan["expected"]
        numbers = FIRST + int(expected["values"])
        return len(self.answer.raw), int(expected["start"]) + 8 * numbers
