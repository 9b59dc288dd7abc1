# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Per-run state of the controller: messages, the law in use, and costs that cannot be. Pure."""

from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from controller_node.exploration import Exploration
from controller_node.law_batch import LawBatch
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.frames import Frame
from pdeloop.messages.protocol import digest_of
from pdeloop.messages.topics import VOID
from pdeloop.method.laws.base import Law

MAX_RUNS = 8
"""Runs, and plants, that are remembered. The least recently used is dropped first, but never the one
that was answered last, whatever else comes in."""
MAX_KEPT = 4
"""Policies, sets of reduced models, and laws kept per run: room for an unknown publisher's as well."""


@dataclass(frozen=True)
class Answering:
    """The law in use in an episode of a plant, made at its first state.

    law: None where the controller explores; signature: what the actions carry, see
    pdeloop.messages.protocol.
    """

    plant: int
    episode: int
    law: LawBatch | None
    signature: float


@dataclass(frozen=True)
class Models:
    """Reduced models as a tuner has sent them: their number, which episodes name, and a digest.

    laws: that of each model.
    """

    number: int
    digest: int
    laws: list[Law]


KnownLaw: TypeAlias = tuple[tuple[int, ...], LawBatch]
"""The key of an episode and of all inputs of its law, and the law."""
EpisodeInputs: TypeAlias = tuple[Frame, Models]
"""Policies and models that answer an episode."""


@dataclass
class RunState:
    """Messages and results of one run. policies, models: the newest ones."""

    start: Frame | None = None
    exploration: Exploration | None = None
    """The exploration, if the episode is one."""
    policies: deque[Frame] = field(default_factory=lambda: deque(maxlen=MAX_KEPT))
    models: deque[Models] = field(default_factory=lambda: deque(maxlen=MAX_KEPT))
    answering: Answering | None = None
    """Dropped with whatever arrives that changes it."""
    laws: dict[int, KnownLaw] = field(default_factory=dict)
    """By plant those in use: their memories are of its states."""

    @property
    def nbytes(self) -> int:
        """Bytes of all stored arrays."""
        frames = [
            frame.values.nbytes for frame in (self.start, *self.policies) if frame is not None
        ]
        rows = [law.model for models in self.models for law in models.laws]
        matrices = [a.nbytes for model in rows for a in (model.U, model.A, model.B)]
        samples = self.exploration.nbytes if self.exploration else 0
        answers = sum(law.nbytes for _, law in self.laws.values())
        # The law has a copy of every U.
        return sum(frames) + 2 * sum(matrices) + samples + answers

    def use_law(self, plant: int, law: KnownLaw) -> None:
        """Keep a plant's law, and those that were used last."""
        self.laws.pop(plant, None)
        self.laws[plant] = law
        while len(self.laws) > MAX_KEPT:
            del self.laws[next(iter(self.laws))]

    def policies_of(self, episode: int) -> list[Frame]:
        """All policies that arrived for an episode."""
        return [policy for policy in self.policies if policy.episode == episode]

    def models_of(self, number: int) -> list[Models]:
        """All models that arrived under a number."""
        return [models for models in self.models if models.number == number]

    def episode_start(self, frame: Frame) -> Frame | None:
        """The start of the frame's episode, if it is the one this run is in."""
        start = self.start
        return start if start is not None and start.episode == frame.episode else None

    def inputs_for(self, start: Frame, action_set: ActionSet) -> EpisodeInputs | None:
        """Policies and models of the run's episode, None while they have not arrived.

        Of several those that the start signs, or the newest if it signs none of them; None if it
        signs nothing.
        """
        found = [
            (policy, models)
            for models in self.models_of(start.step)
            for policy in self.policies_of(start.episode)
        ]
        fitting = [named for named in found if len(named[0].values) == len(start.values)]
        if len(fitting) > 1:
            signed = [
                named
                for named in fitting
                if digest_of_start(start, named, action_set) == start.plant
            ]
            return (signed or fitting)[-1] if start.plant else None
        return next(iter(fitting or found), None)


def digest_of_start(start: Frame, inputs: EpisodeInputs | None, action_set: ActionSet) -> int:
    """D of an episode, see pdeloop.messages.protocol. inputs: None where it explores."""
    published: list[Any] = [start.values, action_set.signed]
    if inputs is not None:
        policy, models = inputs
        published += [policy.values, models.digest]
    return digest_of(*published)


def forget(
    known: OrderedDict[int, Any],
    newest: int,
    protected: int,
    full: Callable[[], bool] = lambda: False,
) -> None:
    """Keep `newest`, `protected`, and the most recently used others: MAX_RUNS, or less while full."""
    known.move_to_end(newest)
    others = [key for key in known if key not in (newest, protected)]
    while others and (len(known) > MAX_RUNS or full()):
        del known[others.pop(0)]


def differ(a: Frame, b: Frame) -> bool:
    """True if two starts of an episode contradict each other."""
    return (a.plant, a.step) != (b.plant, b.step) or not np.array_equal(a.values, b.values)


def contradict(a: Frame, b: Frame) -> bool:
    """True if two states of one step differ."""
    same = (a.run, a.plant, a.episode, a.step) == (b.run, b.plant, b.episode, b.step)
    return same and not np.array_equal(a.values, b.values)


Ids: TypeAlias = tuple[int, int, int]
"""Run, plant and episode."""
NONE: Ids = (-1, -1, -1)


class AnsweredSteps:
    """The last answered step of an episode, and its last step according to its cost.

    A cost that says that the episode went further, and the plant that gives it up before that step,
    together are a contradiction. One of the two alone is none: a second controller may have answered
    the others, or a second plant be slower.
    """

    def __init__(self) -> None:
        self._episode = NONE
        """The last one whose states were answered from the first one on."""
        self._furthest = -1
        """The last step of it that was answered."""
        self._claimed = NONE, -1
        """An episode, and the step to which it went by a cost: further than was answered."""

    def answered(self, episode: Ids, step: int) -> None:
        """Note that states of an episode were answered, `step` the furthest of them."""
        if step == 0 and episode != self._episode:
            self._episode, self._furthest = episode, 0
        if episode == self._episode:
            self._furthest = max(self._furthest, step)
        if episode == self._claimed[0] and step >= self._claimed[1]:
            self._claimed = NONE, -1

    def contradiction(self, cost: Frame) -> str:
        """Why the episode of a cost cannot be relied on; empty if nothing is known against it."""
        episode = cost.run, cost.plant, cost.episode
        if not (cost.values[:, -1:] == VOID).any():
            if episode == self._episode and cost.step > self._furthest:
                self._claimed = episode, cost.step
            return ""
        known, step = self._claimed
        if episode != known or cost.step >= step:
            return ""
        self._claimed = NONE, -1
        return (
            f"a cost claims that the episode reached step {step}, but the plant gave it up at step "
            f"{cost.step}"
        )
