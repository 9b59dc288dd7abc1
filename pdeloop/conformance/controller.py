# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop check controller`: tuner and plant are played; the plant is linear. Pure."""

from __future__ import annotations

from collections.abc import Container
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from pdeloop.conformance.probing import (
    FAILED,
    Ask,
    Check,
    Message,
    NoAnswerError,
    NoteError,
    UnexpectedError,
    ids,
    require,
    require_same,
)
from pdeloop.messages import model_rows, topics
from pdeloop.messages.arrays import Array
from pdeloop.messages.frames import Frame


class LinearPlant:
    """Advection and diffusion on a ring, z+ = A z + B a; one mode grows. number: fingerprint."""

    def __init__(self, number: int, n_z: int, n_a: int) -> None:
        rng = np.random.default_rng(number)
        self.number, self.n_z, self.target = number, n_z, rng.uniform(0.2, 0.8, n_z)
        shift = np.roll(np.eye(n_z), 1, axis=0)
        self.A = 0.75 * np.eye(n_z) + 0.2 * shift + 0.06 * shift.T
        self.B = rng.standard_normal((n_z, n_a)) / np.sqrt(n_z)


@dataclass(frozen=True)
class Explored:
    """An exploratory episode: its start, and states and actions of steps 0 to T."""

    start: Frame
    plant: LinearPlant
    states: Array
    actions: Array

    def cost(self, ended: float = topics.COMPLETED) -> Frame:
        """Its cost. ended: in each row."""
        steps, mean = len(self.states) - 1, 1e9 if ended >= 0 else 1.0
        rows = np.tile([mean, steps * mean, ended], (len(self.start.values), 1))
        return replace(self.start, step=steps, values=rows, plant=self.plant.number)


N_Z, STEPS = 64, 300
"""Size of the state, if it is not given, and steps of an exploratory episode."""
SILENT = 1.0
"""Seconds in which a controller would publish a premature message."""
ROUNDED = 1e-5
"""Largest difference of numbers that are the same but for rounding, also to float32."""
SPREAD = 0.5
"""Largest error of a sample covariance, relative to the variance: six standard errors."""

Row = tuple[Array, int, Array]
"""A row of an episode under policies: gains, index of the model, state."""


class ControllerCheck(Check):
    """Explores with the controller, and lets it answer states under policies."""

    published = topics.ACTION, topics.MODEL_IDENTIFIED, FAILED

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.plant = LinearPlant(31, self.n_z or N_Z, self.n_a)
        self.z = np.ones(self.plant.n_z)
        self._sent: dict[tuple[topics.Topic, int], Frame] = {}

    @cached_property
    def first(self) -> tuple[Explored, Frame]:
        """An exploration and its model, with which others are compared."""
        explored = self.explore(5)
        try:
            return explored, self.identified(explored)
        except UnexpectedError as error:
            raise NoAnswerError(str(error)) from error

    @cached_property
    def gains(self) -> Array:
        """A policy so small that no action saturates."""
        n_s = self.first[1].values.shape[2]
        return 1e-5 * np.random.default_rng(1).standard_normal((self.n_a, 2 * n_s))

    @cached_property
    def models(self) -> Frame:
        """The first model, and the same with -U, as `model`; published."""
        models = self.frame(np.repeat(self.first[1].values, 2, axis=0), step=1)
        models.values[1, : self.plant.n_z] *= -1.0
        self.publish(topics.MODEL, models)
        return models

    def resend(self) -> None:
        for (topic, _), frame in self._sent.items():
            self.transport.send(topic, frame)

    def publish(self, topic: topics.Topic, frame: Frame) -> None:
        """Send what `resend` sends again."""
        self._sent[topic, frame.plant if topic is topics.TARGET else 0] = frame
        self.transport.send(topic, frame)

    def state(self, start: Frame, step: int, *rows: Array, plant: int = 0) -> Frame:
        """A state of an episode, not sent yet. plant: a number, if not that of the check's."""
        number = plant or self.plant.number
        return replace(start, step=step, time=0.1 * step, values=np.array(rows), plant=number)

    def answer(self, state: Frame, patience: float = 0.0) -> Array:
        """The actions that answer a state."""
        what = f"an `action` with the ids of state {state.step} of episode {state.episode}"
        ask = partial(self.transport.send, topics.STATE, state)
        wanted = partial(_answers, state)
        found = self.expect(what, wanted, topics.ACTION, ask=ask, patience=patience)[1]
        expected = (len(state.values), self.n_a), state.time
        got = found.values.shape, found.time
        require(got == expected, f"((rows, --n-a), time) = {expected} in `action`", got)
        values: Array = found.values
        return values

    def held_back(self, state: Frame, topic: topics.Topic, frame: Frame) -> Array:
        """The answer to a state after a message; before it there is none, or already the same."""
        early = None
        with suppress(NoAnswerError):
            early = self.answer(state, patience=SILENT)
        self.publish(topic, frame)
        self.transport.wait_delivered()
        self.drain(topics.ACTION)
        answer = self.answer(state)
        if early is not None:
            require_same(early, answer, f"the answer after `{topic.name}`")
        return answer

    def explore(
        self,
        *seeds: int,
        steps: int = STEPS,
        lost: Container[int] = (),
        plant: LinearPlant | None = None,
    ) -> Explored:
        """An exploratory episode. seeds: each row's excitation; lost: steps that are not published."""
        plant = plant or self.plant
        self.publish(topics.TARGET, _target(plant))
        # Each row has a model of its own: a controller may identify one from several rows of one model.
        start = self.new_start([(1, seed, variance(seed), m) for m, seed in enumerate(seeds)])
        self.publish(topics.START, start)
        z = [np.random.default_rng(seed).uniform(0.5, 1.5, plant.n_z) for seed in seeds]
        states, actions = [], []
        for step in range(steps + 1):
            states.append(z)
            state = self.state(start, step, *z, plant=plant.number)
            a = np.zeros((len(z), self.n_a)) if step in lost else self.answer(state)
            actions.append(a)
            z = [plant.A @ row + plant.B @ action for row, action in zip(z, a, strict=True)]
        return Explored(start, plant, np.array(states), np.array(actions))

    def outcome(self, cost: Frame, ask: Ask | None = None) -> Message:
        """The outcome of an exploration: its models, or a ModelFailure."""
        what = f"`model/identified` or `model/failed` of episode {cost.episode}"
        ask = ask or partial(self.transport.send, topics.COST, cost)
        return self.expect(what, partial(_of, cost), topics.MODEL_IDENTIFIED, FAILED, ask=ask)[1]

    def identified(self, explored: Explored) -> Frame:
        """The models of an exploration, with the parts that the page gives them."""
        models = self.outcome(explored.cost())
        require(isinstance(models, Frame), "`model/identified`", self.described(FAILED, models))
        plant, (count, rows, n_s) = explored.plant, models.values.shape
        expected = len(explored.start.values), plant.n_z + n_s + 3 * self.n_a + 1, plant.number
        what = f"(models, n_z + n_s + 3 n_a + 1 rows, plant) = {expected}"
        require((count, rows, models.plant) == expected, what, (count, rows, models.plant))
        for model in models.values:
            U, s_r = model[: plant.n_z], model[-1]
            good = np.allclose(U.T @ U, np.eye(n_s), atol=ROUNDED)
            require(good, "U, the first n_z rows, with orthonormal columns", "others")
            good = np.allclose(s_r, U.T @ plant.target, atol=ROUNDED)
            require(good, "s_r = U^T z_r in the last row", s_r.tolist())
        found: Frame = models
        return found

    def fails(self, cost: Frame, *, retry: bool) -> None:
        """UnexpectedError unless an exploration gives `model/failed`."""
        found = self.outcome(cost)
        topic = topics.MODEL_IDENTIFIED if isinstance(found, Frame) else FAILED
        good = topic is FAILED and found.retry == retry
        require(good, f"`model/failed` with retry {retry}", self.described(topic, found))

    def law(self, *rows: Row) -> Array:
        """The actions of a new episode under policies."""
        start, policy, state = self.under_policies(*rows)
        self.publish(topics.POLICY, policy)
        self.publish(topics.START, start)
        return self.answer(state)

    def under_policies(self, *rows: Row) -> tuple[Frame, Frame, Frame]:
        """Start, policies and state 0 of such an episode, not sent yet."""
        start = self.new_start([(1, -1, 0, i) for _, i, _ in rows], step=self.models.step)
        policy = replace(start, values=np.array([gains for gains, _, _ in rows]))
        return start, policy, self.state(start, 0, *(z for _, _, z in rows))

    # The probes.

    def every_state(self) -> None:
        """Every state is answered, with its ids and time; if repeated, with the same actions."""
        explored = self.explore(5, steps=20)
        for step in (20, 20, 3):
            again = self.answer(self.state(explored.start, step, *explored.states[step]))
            require_same(again, explored.actions[step], f"the answer to state {step}")

    def model(self) -> None:
        """`model/identified` has the ids of the cost, and the parts U to s_r of the page."""
        assert self.first

    def exploration(self) -> None:
        """An exploratory action depends only on excitation seed, variance and step."""
        known = self.first[0].actions
        start = self.new_start([(4, 5, variance(5), 0)])
        self.publish(topics.START, start)
        for step in (9, 2):
            found = self.answer(self.state(start, step, 0 * self.z))
            require_same(found, known[step], "the same seed and step")

    def draws(self) -> None:
        """The exploratory actions of each seed and step are drawn anew from N(0, variance I)."""
        drawn, v = self.first[0].actions[:, 0], variance(5)
        for seed in (7, 5 + 2**31, 5 + 2**32):
            other = self.explore(seed, steps=4).actions[:, 0]
            require((other != drawn[:5]).any(), f"other actions for seed {seed}", "those of seed 5")
        first = np.abs(drawn[:, 0])
        require(np.ptp(drawn, axis=0).any(), "different ones in each step", "the same in all steps")
        if (first == first.max()).sum() > 1:
            raise NoteError("they saturate, so their variance cannot be measured")
        covariance = drawn.T @ drawn / len(drawn)
        good = np.abs(covariance - v * np.eye(self.n_a)).max() < SPREAD * v
        require(good, f"the covariance {v} I", covariance.tolist())

    def result_again(self) -> None:
        """The same data give the same result, and a repeated cost or start brings it again."""
        explored = self.explore(5)
        cost = explored.cost()
        for topic, frame in (
            (topics.COST, cost),
            (topics.COST, cost),
            (topics.START, explored.start),
        ):
            self.drain(topics.MODEL_IDENTIFIED, FAILED)
            found = self.outcome(cost, ask=partial(self.transport.send, topic, frame))
            require(isinstance(found, Frame), "a model", self.described(FAILED, found))
            require_same(found.values, self.first[1].values, f"the model, asked by `{topic.name}`")

    def known_plant(self) -> None:
        """A and B are those of a linear plant with n_s states, which the gains stabilise."""
        n_s = self.first[1].values.shape[2]
        if self.n_z not in (None, n_s):
            raise NoteError(f"not checked, as --n-z is not the order n_s = {n_s}")
        explored = self.explore(5, plant=LinearPlant(33, n_s, self.n_a))
        found, plant = self.outcome(explored.cost()), explored.plant
        if not isinstance(found, Frame):
            raise NoteError(f"not checked: {self.described(FAILED, found)}")
        m = model_rows.unpack(self.identified(explored).values[0], self.n_a)
        layouts = {
            "A and B": (m.A, m.B),
            "A^T and B": (m.A.T, m.B),
            "A and B, reshaped": (m.A, m.B.T.reshape(m.B.shape)),
            "A and, in place of K_a, B": (m.A, m.K_a.T),
        }
        fits = [
            what
            for what, (A, B) in layouts.items()
            if np.allclose(m.U @ A @ m.U.T, plant.A, atol=ROUNDED)
            and np.allclose(m.U @ B, plant.B, atol=ROUNDED)
        ]
        if not fits:
            raise NoteError(
                "A and B are not those of that plant: right for an approximate model, or one of "
                "your own"
            )
        require("A and B" in fits, "A and B", fits)
        radius, other = (
            np.abs(np.linalg.eigvals(plant.A + plant.B @ K @ m.U.T)).max() for K in (m.K_a, m.K_b)
        )
        require(radius < 1.0 or other >= 1.0, "K_a before K_b", "gains that stabilise if exchanged")
        if radius >= 1.0:
            raise NoteError(f"with K_a the spectral radius of the plant is {radius:.3g}")

    def lost_states(self) -> None:
        """An exploration with missing states gives `model/failed`, retry true."""
        known = self.first[1]
        self.explore(6, steps=20)
        cost = self.explore(5, lost=(7, 8)).cost()
        found = self.outcome(cost)
        if not isinstance(found, Frame) or not np.array_equal(found.values, known.values):
            self.fails(cost, retry=True)  # else: a model that needs no data

    def void(self) -> None:
        """A void exploration gives `model/failed`, retry true."""
        self.fails(self.explore(5).cost(topics.VOID), retry=True)

    def divergence(self) -> None:
        """An exploration in which the plant diverged gives `model/failed`, retry false."""
        self.fails(self.explore(5).cost(50.0), retry=False)

    def two_explorations(self) -> None:
        """Two rows are explored, and give models, to the bit as two single ones."""
        (one, first), two = self.first, self.explore(6)
        second = self.identified(two)
        both = self.explore(5, 6)
        for i, single in enumerate((one, two)):
            require_same(both.actions[:, i], single.actions[:, 0], f"the actions of row {i} alone")
        if first.values.shape != second.values.shape:
            raise NoteError("models not checked, as their order depends on the data")
        expected = np.concatenate([first.values, second.values])
        require_same(self.identified(both).values, expected, "the models of the single rows")

    def target_held_back(self) -> None:
        """A state is answered with the target of its fingerprint, however late that comes."""
        plant = LinearPlant(32, self.plant.n_z, self.n_a)
        known = self.law((self.gains, 0, self.z))
        start, policy, state = self.under_policies((self.gains, 0, self.z))
        self.publish(topics.POLICY, policy)
        self.publish(topics.START, start)
        self.held_back(replace(state, plant=plant.number), topics.TARGET, _target(plant))
        require_same(self.law((self.gains, 0, self.z)), known, "the target of the plant before")

    def policy_held_back(self) -> None:
        """A state is answered with the policy of its run and episode, however late that comes."""
        start, policy, state = self.under_policies((self.gains, 0, self.z))
        self.publish(topics.START, start)
        other = replace(policy, values=2.0 * policy.values)
        self.transport.send(topics.POLICY, replace(other, run=self.run + 1))
        self.transport.send(topics.POLICY, replace(other, episode=self.new_start([]).episode))
        answer = self.held_back(state, topics.POLICY, policy)
        require_same(answer, self.law((self.gains, 0, self.z)), "the same policy later")

    def model_held_back(self) -> None:
        """A state is answered with the models of its run and number, however late these come."""
        known, other = self.law((self.gains, 1, self.z)), self.models
        new = self.models = replace(other, step=other.step + 1, values=other.values[::-1])
        start, policy, state = self.under_policies((self.gains, 0, self.z))
        self.publish(topics.POLICY, policy)
        self.publish(topics.START, start)
        self.transport.send(topics.MODEL, replace(new, run=self.run + 1, values=2.0 * new.values))
        require_same(self.held_back(state, topics.MODEL, new), known, "the same model before")

    def no_control(self) -> None:
        """A policy of zeros is no control."""
        actions = self.law((0.0 * self.gains, 0, self.z))
        require_same(np.abs(actions), np.zeros_like(actions), "no control")

    def law_of_the_page(self) -> None:
        """An action is K_a U^T z + K_b U^T z_r, with U from the model that the row names."""
        z_r, K = self.plant.target, np.hsplit(self.gains, 2)
        z = np.random.default_rng(2).uniform(0.5, 1.5, self.plant.n_z)
        for i, model in enumerate(self.models.values):
            U, found = model[: self.plant.n_z], self.law((self.gains, i, z))[0]
            expected = K[0] @ U.T @ z + K[1] @ U.T @ z_r
            error = np.abs(found - expected).max() / np.abs(expected).max()
            if error > ROUNDED:
                raise NoteError(
                    f"another law, whose action with model {i} differs by a share of {error:.2g}: "
                    "right for a law of your own, or if actions of 1e-4 saturate"
                )

    def two_policies(self) -> None:
        """Two rows are answered to the bit as two single ones, in either order."""
        n_z = self.plant.n_z
        one = self.gains, 1, np.linspace(0.5, 1.5, n_z)
        two = 2.0 * self.gains[::-1], 0, np.linspace(1.5, 0.0, n_z)
        for rows in ((one, two), (two, one)):
            alone = np.concatenate([self.law(row) for row in rows])
            require_same(self.law(*rows), alone, "the single rows")

    probes = (
        every_state,
        model,
        exploration,
        draws,
        result_again,
        known_plant,
        lost_states,
        void,
        divergence,
        two_explorations,
        target_held_back,
        policy_held_back,
        model_held_back,
        no_control,
        law_of_the_page,
        two_policies,
    )


def variance(seed: int) -> float:
    """Variance of the actions of an excitation seed."""
    return 0.1 * (1 + seed % 2)


def _target(plant: LinearPlant) -> Frame:
    return Frame(0, 0, 0, 0.0, plant.target, plant.number)


def _of(cost: Frame, topic: topics.Topic, message: Message) -> bool:
    return ids(message)[:2] == ids(cost)[:2]


def _answers(state: Frame, topic: topics.Topic, action: Frame) -> bool:
    return (*ids(action), action.plant) == (*ids(state), state.plant)
