# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The fast path of plant and controller, which differ in one compiled function each.

Within an episode only the step, the time and the values of a message differ from the one before. A
handler compares everything else with what is expected and lets the node's compiled function compute
the answer. Every message that is not the expected one is left to the node's own thread. The answer is
that of the node's protocol, to the bit.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
from numba import carray, types  # type: ignore[attr-defined, unused-ignore]

from pdeloop.fast_path import messages
from pdeloop.fast_path.channel import RclChannel
from pdeloop.fast_path.messages import EXPECTED, OwnMessage, expected_header
from pdeloop.jit import cache, native, simd
from pdeloop.jit.native import MachineCode, pointer_to
from pdeloop.messages.frames import ArrayCodec, Frame
from pdeloop.messages.topics import Topic


def plan_type(*fields: Any) -> np.dtype[np.void]:
    """The type of the record that a handler works on.

    Its first fields are `expected`, what a message is compared with, and `answer`, the address of the
    answer's header; `fields` follow, for the node's own function.
    """
    return np.dtype([("expected", EXPECTED), ("answer", np.int64), *fields])


def fast_handler(
    plan: np.dtype[np.void], answer: Callable[[Any, int, int, int], bool], *sources: ModuleType
) -> MachineCode:
    """Machine code that handles the messages of a channel, see `RclChannel`.

    plan: type of the record that it is called with, see `plan_type`. answer(plan, head, message,
    length), which can be compiled, fills in the answer to the message with its header at the
    address `head`, and returns True, or leaves the message alone and returns False. sources: the
    modules that `answer` calls; when one of them changes, it is compiled anew.
    """

    def handle(plans: Any, message: int, length: int) -> int:
        plan = carray(plans, 1)[0]
        head = expected_header(message, length, plan.expected)
        return 1 if head != 0 and answer(plan, head, message, length) else 0

    signature = types.int32(pointer_to(plan), types.intp, types.intp)
    return MachineCode(handle, signature, answer, cache, native, simd, messages, *sources)


class FastPath(ABC):
    """Answers the messages of one topic on another in the thread that receives them.

    Before the node's thread waits it calls `arm`, and afterwards `disarm`. In between the protocol
    belongs to the other thread.

    handler: made by `fast_handler`; plan: the type of its record; incoming: the codec that decodes what
    comes in; outgoing: the topic of the answers.
    """

    def __init__(
        self, handler: MachineCode, plan: np.dtype[np.void], incoming: ArrayCodec, outgoing: Topic
    ) -> None:
        self.plans = np.zeros(1, plan)
        self.plan = self.plans[0]
        self.handle = handler()
        self.channel = RclChannel(self.handle, self.plans.ctypes.data)
        self._incoming, self._outgoing = incoming, ArrayCodec(outgoing.labels)
        self.answer = OwnMessage(self._outgoing, Frame(0, 0, 0, 0.0, np.zeros((0, 0))))
        self._prepared = False

    @abstractmethod
    def prepare(self) -> bool:
        """Fill in the plan, if the protocol awaits messages that the handler can answer."""

    @abstractmethod
    def synchronise(self, answers: int, last: float) -> None:
        """Tell the protocol how many messages were answered, and when the last one was (s)."""

    def expect(self, like: Frame, shape: tuple[int, ...], answer: tuple[int, ...]) -> bool:
        """Expect messages with the run, episode and plant of `like`, a message of the episode.

        shape, answer: of the values that are expected, and of those of the answer. False if nothing is
        expected, as the peer that was decoded last sends other messages.
        """
        prefix = self._incoming.prefix_of(shape)
        if prefix is None:
            return False
        self._prefix = np.frombuffer(prefix, np.uint8)  # kept alive: the record has its address
        expected = self.plan["expected"]
        expected["prefix"], expected["start"] = self._prefix.ctypes.data, len(prefix)
        expected["values"] = math.prod(shape)
        expected["run"], expected["episode"], expected["plant"] = like.run, like.episode, like.plant
        if self.answer.shape != answer:
            self.answer = OwnMessage(self._outgoing, Frame(0, 0, 0, 0.0, np.zeros(answer)))
        self.answer.address_to(like)
        self.plan["answer"] = self.answer.header
        self.channel.answer_with(self.answer.begin, len(self.answer.raw))
        return True

    def arm(self) -> bool:
        """Let messages be answered, if they can be; False if one waits for the node's thread."""
        self._prepared = self.prepare()
        if not self._prepared:
            return not self.channel.waits
        if self.channel.arm():
            return True
        self.disarm()
        return False

    def disarm(self) -> int:
        """The node's thread has the protocol again; how many messages were answered."""
        answers, last = self.channel.disarm()
        if not self._prepared:
            return 0
        self._prepared = False
        self.synchronise(answers, last)
        return answers
