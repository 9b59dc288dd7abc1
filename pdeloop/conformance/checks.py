# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop check plant|controller|tuner`: whether a stand-in keeps to docs/interfaces.md. Pure.

Each check plays the other two nodes with one environment. It repeats starts and states, withholds
answers, sends wrong ones, begins anew in the middle of an episode, and compares to the bit.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import count
from typing import Protocol

import numpy as np

from loop_interfaces import model_rows
from loop_interfaces.arrays import Array
from loop_interfaces.frames import Frame
from loop_interfaces.topics import (
    ACTION,
    COMPLETED,
    COST,
    MODEL,
    MODEL_IDENTIFIED,
    POLICY,
    START,
    STATE,
    TARGET,
    VOID,
    Topic,
)
from pdeloop.problem_check import Finding

ASK_AGAIN = 0.5
"""Seconds after which an unanswered message is sent again."""
PLANT = 31
"""Fingerprint of the plant that is played."""
N_Z = 8
"""Size of its state."""
EPISODES = 8
"""Rollouts that a tuner is served."""


class Wire(Protocol):
    """The loop's topics, as a check sees them."""

    def send(self, topic: Topic, frame: Frame) -> None: ...

    def next(self, *topics: Topic, seconds: float) -> tuple[Topic, Frame] | None:
        """The next message of these topics; None if none comes in time."""


class NoAnswerError(Exception):
    """What the rest of a check depends on does not come; the text says what was expected."""


class Check(ABC):
    """What the three checks share.

    n_a: actuators; patience (s): how long an answer may take; run: id of the run that is played.
    """

    published: tuple[Topic, ...]
    """What the checked node publishes; the check publishes the other topics."""

    def __init__(self, wire: Wire, n_a: int, *, patience: float = 10.0, run: int = 1) -> None:
        self.wire, self.n_a, self.patience, self.run = wire, n_a, patience, run
        self._numbers = count(1)

    def all(self) -> Iterator[Finding]:
        """The findings, as they come; the last one is bad if the check cannot go on."""
        try:
            yield from self.findings()
        except NoAnswerError as error:
            where = f"is it in this ROS_DOMAIN_ID, and has it {self.n_a} actuators (--n-a)?"
            yield Finding("no answer", False, f"{error}; {where}")

    @abstractmethod
    def findings(self) -> Iterator[Finding]:
        """The same; NoAnswerError if the check cannot go on."""

    def answer(
        self,
        what: str,
        wanted: Callable[[Topic, Frame], bool],
        *on: Topic,
        ask: Callable[[], None] = lambda: None,
    ) -> tuple[Topic, Frame]:
        """The first wanted message on these topics; `ask` is called now and again."""
        for _ in range(max(round(self.patience / ASK_AGAIN), 1)):
            ask()
            while (found := self.wire.next(*on, seconds=ASK_AGAIN)) is not None:
                if wanted(*found):
                    return found
        raise NoAnswerError(f"expected {what} within {self.patience:g} s")

    def start(self, *row: float, models: int = 0) -> Frame:
        """Send a start of one row with the next number; without a row it ends the run."""
        rows = np.array([row]) if row else np.empty((0, 4))
        start = Frame(self.run, next(self._numbers), models, 0.0, rows)
        self.wire.send(START, start)
        return start


class PlantCheck(Check):
    """Plays tuner and controller."""

    published = STATE, COST, TARGET

    def reply(
        self, episode: int, step: int, ask: Callable[[], None] = lambda: None
    ) -> tuple[Topic, Frame]:
        """State `step` of an episode, or its cost."""

        def wanted(topic: Topic, frame: Frame) -> bool:
            mine = (frame.run, frame.episode) == (self.run, episode)
            return mine and (topic is COST or frame.step == step)

        what = f"a state with step {step} in its header, or the cost"
        topic, frame = self.answer(what, wanted, STATE, COST, ask=ask)
        if topic is COST and frame.values[0, -1] == VOID:
            raise NoAnswerError(f"expected {what}, got a void one")
        return topic, frame

    def begin(self, seed: int) -> tuple[Frame, Frame]:
        """A start, and state 0."""
        start = self.start(seed, -1.0, 0.0, 0.0)
        return start, self.reply(start.episode, 0)[1]

    def action(self, state: Frame, other: bool = False) -> Frame:
        rng = np.random.default_rng([state.step, int(other)])
        return replace(state, values=0.1 * rng.standard_normal((1, self.n_a)))

    def episode(self, changed: int = -1) -> tuple[list[Array], Frame]:
        """States and cost of one from seed 1; `changed`: a step with another action."""
        start, state = self.begin(1)
        states, topic = [state.values], STATE
        while topic is STATE:
            action = self.action(state, other=state.step == changed)

            def act(action: Frame = action) -> None:
                self.wire.send(ACTION, action)

            topic, state = self.reply(start.episode, len(states), act)
            states.append(state.values)
        return states[:-1], state

    def findings(self) -> Iterator[Finding]:
        _, target = self.answer("`target`", lambda *_: True, TARGET)
        start, state = self.begin(1)
        fits = (state.plant, state.values.shape) == (target.plant, (1, len(target.values)))
        yield Finding("state", fits, "has the fingerprint and the size of `target`")
        _, again = self.reply(start.episode, 0, lambda: self.wire.send(START, start))
        yield Finding("start again", _same(again, state), "a repeated start gives state 0 again")
        for wrong in ("run", "episode", "step", "plant"):
            action = self.action(state)
            self.wire.send(ACTION, replace(action, **{wrong: getattr(action, wrong) + 1}))
        _, again = self.reply(start.episode, 0)
        yield Finding("silence", _same(again, state), "without its own action a state comes again")
        states, cost = self.episode()  # the one before is left in the middle
        steps, (mean, total, ended) = len(states) - 1, cost.values[0]
        fits = cost.step == steps and ended == COMPLETED and np.isclose(mean * steps, total)
        yield Finding(
            "cost", bool(fits), f"(mean, {steps} mean, -1), with step {steps} as its header"
        )
        states_again, cost_again = self.episode()
        same = all(map(np.array_equal, states_again, states)) and _same(cost_again, cost)
        yield Finding("repeat", same, "the same seed and actions give the same bits")
        differs = not _same(self.episode(changed=steps - 1)[1], cost)
        yield Finding("last action", differs, f"the cost counts the action of step {steps - 1}")
        same = _same(self.episode(changed=steps)[1], cost)
        yield Finding("acknowledgement", same, f"the answer to state {steps} moves nothing")
        differs = not _same(self.begin(2)[1], state)
        yield Finding("seeds", differs, "other seeds give other initial states")
        self.start()
        self.run += 1
        same = _same(self.begin(1)[1], state)
        yield Finding("release", same, "after a start without rows another run is served at once")
        self.start()


class ControllerCheck(Check):
    """Plays tuner and plant, a linear one."""

    published = ACTION, MODEL_IDENTIFIED

    def ask(self, start: Frame, step: int, z: Array) -> Array:
        """The action that answers a state."""
        state = Frame(self.run, start.episode, step, 0.1 * step, z, PLANT)

        def wanted(topic: Topic, frame: Frame) -> bool:
            ids = (frame.run, frame.episode, frame.step, frame.plant)
            return ids == (self.run, start.episode, step, PLANT)

        what = f"an action with run, episode, step and plant of state {step}"
        found = self.answer(what, wanted, ACTION, ask=lambda: self.wire.send(STATE, state))[1]
        if found.values.shape != (1, self.n_a):
            raise NoAnswerError(f"expected actions of shape (1, {self.n_a}): {found.values.shape}")
        return found.values

    def explore(self, excitation: int) -> tuple[Frame, list[Array]]:
        start = self.start(1.0, excitation, 0.1, 0.0)
        A, B = np.linspace(0.5, 0.9, N_Z), np.eye(self.n_a, N_Z)
        z, actions = np.ones((1, N_Z)), []
        for step in range(4 * (N_Z + self.n_a)):
            actions.append(self.ask(start, step, z))
            z = z * A + actions[-1] @ B
        return start, actions

    def model(self, start: Frame, steps: int) -> Frame:
        rows = np.array([[1.0, steps, COMPLETED]])
        cost = replace(start, step=steps, plant=PLANT, values=rows)
        return self.answer(
            "`model/identified` with run and episode of the cost",
            lambda _, frame: (frame.run, frame.episode) == (self.run, start.episode),
            MODEL_IDENTIFIED,
            ask=lambda: self.wire.send(COST, cost),
        )[1]

    def findings(self) -> Iterator[Finding]:
        self.wire.send(TARGET, Frame(0, 0, 0, 0.0, np.full(N_Z, 0.5), PLANT))
        start, actions = self.explore(5)
        same = np.array_equal(self.ask(start, 1, np.zeros((1, N_Z))), actions[1])
        yield Finding("state again", same, "exploratory actions depend on seed and step only")
        start, again = self.explore(5)
        same = all(map(np.array_equal, again, actions))
        yield Finding("seed again", same, "equal excitation seeds give equal actions")
        model = self.model(start, len(actions) - 1)
        same = _same(self.model(start, len(actions) - 1), model)
        yield Finding("cost again", same, "a repeated cost gives the same model again")
        other = self.explore(6)[1][0]
        differs = not any(np.array_equal(other, action) for action in actions[:2])
        yield Finding("excitation", differs, "other seeds and steps give other exploratory actions")
        self.wire.send(MODEL, Frame(self.run, 0, 1, 0.0, model.values))
        gains = model_rows.unpack(model.values[0], self.n_a).policy[np.newaxis] + 0.1
        answers = []
        for scale in (1.0, 1.0, 0.5):
            start = self.start(1.0, -1.0, 0.0, 0.0, models=1)
            self.wire.send(POLICY, replace(start, values=scale * gains))
            answers.append(self.ask(start, 0, np.ones((1, N_Z))))
        same, differs = (np.array_equal(answers[0], other) for other in answers[1:])
        yield Finding("policy", same and not differs, "equal ones act equally, others do not")
        self.start()


class TunerCheck(Check):
    """Plays plant and controller, with a model and costs of its own."""

    published = START, POLICY, MODEL

    def begun(self, after: int) -> Frame:
        """The first start with rows and a number above `after`."""
        what = f"an `episode/start` with rows and a number above {after}"
        return self.answer(what, lambda _, f: f.episode > after and len(f.values) > 0, START)[1]

    def end(self, start: Frame, ended: int, policies: Array | None = None) -> None:
        """Send the costs of an episode: any control costs half of none."""
        costs = np.full(len(start.values), 2.0)
        if policies is not None:
            costs[policies.any(axis=(1, 2))] = 1.0
        rows = np.column_stack([costs, 100 * costs, np.full(len(costs), ended)])
        self.wire.send(COST, replace(start, step=100, plant=PLANT, values=rows))

    def findings(self) -> Iterator[Finding]:
        self.wire.send(TARGET, Frame(0, 0, 0, 0.0, np.zeros(N_Z), PLANT))
        start = self.begun(0)
        explores = start.run > 0 and bool((start.values[:, 1] >= 0).all())
        yield Finding("exploration", explores, "the first episode explores, in a run with an id")
        what = "the same `episode/start` again while nothing is answered"
        _, again = self.answer(what, lambda _, frame: frame.episode == start.episode, START)
        yield Finding("start again", _same(again, start), "an unanswered start comes again")
        self.end(start, VOID)
        void, start = start, self.begun(start.episode)
        yield Finding("void", _same(start, void), "the same rows are started with a new number")
        model = np.full((len(start.values), N_Z + 1 + 3 * self.n_a + 1, 1), 0.1)
        self.end(start, COMPLETED)
        self.wire.send(MODEL_IDENTIFIED, replace(start, step=0, plant=PLANT, values=model))
        _, sent = self.answer("`model`", lambda _, frame: frame.run == start.run, MODEL)
        fits = sent.values.shape[1:] == model.shape[1:]
        yield Finding("model", fits, "`model` is laid out as `model/identified`")
        fits = True
        for _ in range(EPISODES):
            start = self.begun(start.episode)
            ids = start.run, start.episode, sent.step
            what = f"`policy` of episode {start.episode}, with the `step` of `model`"
            policy = self.answer(what, partial(_has, ids), POLICY)[1]
            fits &= len(policy.values) == len(start.values) and start.step == sent.step
            if not fits:
                break
            self.end(start, COMPLETED, policy.values)
        yield Finding("policy", fits, "one for each row of its start; both name the newest `model`")


CHECKS: dict[str, type[Check]] = {
    "plant": PlantCheck,
    "controller": ControllerCheck,
    "tuner": TunerCheck,
}


def _same(a: Frame, b: Frame) -> bool:
    return a.values.tobytes() == b.values.tobytes()


def _has(ids: tuple[int, int, int], topic: Topic, frame: Frame) -> bool:
    return (frame.run, frame.episode, frame.step) == ids
