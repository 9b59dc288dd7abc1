# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The controller's fast path: maps a serialised state to its serialised action within an episode.

It answers the states of an episode that a law answers as `responder` does, to the bit.
"""

import math
from typing import Any

import numpy as np

from controller_node import law
from controller_node.law import LAW, act
from controller_node.policy import ProjectedLaw
from controller_node.responder import Responder
from pdeloop.fast_path import channel
from pdeloop.fast_path.handler import FastPath, fast_handler, plan_type
from pdeloop.fast_path.messages import FIRST, STEP, TIME, write_answer
from pdeloop.jit.cache import jit_in_closure
from pdeloop.jit.simd import load_unaligned
from pdeloop.messages.frames import MAX_ID, ArrayCodec, Frame
from pdeloop.messages.topics import ACTION

PLAN = plan_type(
    ("law", LAW),
    ("batch", np.int64),
    ("actions", np.int64),  # address of room for them
    ("step", np.int64),  # that was answered last
    ("furthest", np.int64),  # that was answered since it was armed: two plants may be served
    ("signature", np.float64),  # 0 where the tuner asks for none
)


@jit_in_closure
def respond(plan: Any, head: int, message: int, length: int) -> bool:
    """Fill in the action that the law answers with."""
    step = load_unaligned(head, STEP)
    if not (0.0 <= step < MAX_ID and step == math.floor(step)):
        return False
    act(plan.law, head + 8 * FIRST, plan.actions, plan.batch)
    plan.step = int(step)
    plan.furthest = max(plan.furthest, plan.step)
    numbers = plan.batch * plan.law.n_a
    time = plan.signature if plan.signature < 0.0 else load_unaligned(head, TIME)
    write_answer(plan.answer, plan.step, time, plan.actions, numbers)
    return True


handler = fast_handler(PLAN, respond, law)


def load_compiled() -> None:
    """Load what is compiled, or compile it."""
    channel.load_compiled()
    handler()


class ControllerFastPath(FastPath):
    """Answers states of the episode whose state the responder was given last.

    states: the codec of the messages that come in.
    """

    def __init__(self, responder: Responder, states: ArrayCodec) -> None:
        super().__init__(handler, PLAN, states, ACTION)
        self._responder = responder
        self._actions = np.zeros((0, 0))
        self._law: ProjectedLaw | None = None
        self.last_state: Frame | None = None
        """The last state that the responder was given."""

    def prepare(self) -> bool:
        """Within an episode that a law with a compiled form answers."""
        state, plan = self.last_state, self.plan
        answering = self._responder.answering(state) if state is not None else None
        if state is None or answering is None or answering.law is None:
            return False
        law = answering.law.compiled
        if law is None or law.action_set.zero_mean:
            return False
        batch, n_z = state.values.shape
        if not self.expect(state, (batch, n_z), (batch, law.n_a)):
            return False
        if self._actions.shape != (batch, law.n_a):
            self._actions = np.zeros((batch, law.n_a))
        self._law = law  # the record has addresses of what it owns
        plan["law"], plan["batch"] = law.plan, batch
        plan["actions"] = self._actions.ctypes.data
        plan["signature"], plan["furthest"] = answering.signature, -1
        return True

    def synchronise(self, answers: int, last: float) -> None:
        if answers:
            plan = self.plan
            self._responder.advance_counters(answers, int(plan["step"]), int(plan["furthest"]))
