# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop check tuner`: plant and controller are played. Pure.

Each probe answers the start that is under way in its own way, in the order of a run.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pdeloop.conformance.probing import (
    FAILED,
    Check,
    Message,
    NoAnswerError,
    NoteError,
    UnexpectedError,
    ids,
    require,
    require_same,
)
from pdeloop.messages.arrays import Array
from pdeloop.messages.frames import Frame, FrameError
from pdeloop.messages.model_rows import ModelRows, pack
from pdeloop.messages.protocol import ModelFailure
from pdeloop.messages.topics import (
    COMPLETED,
    COST,
    MAX_GAIN,
    MODEL,
    MODEL_IDENTIFIED,
    POLICY,
    START,
    TARGET,
    VOID,
    StartColumn,
    Topic,
    start_rows,
)

PLANT, N_Z, STEPS = 31, 8, 100
"""Fingerprint and state of the plant, and steps of an episode."""


class TunerCheck(Check):
    """Serves a run from its first start to its end."""

    published = START, POLICY, MODEL

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.run = 0  # it is the tuner's
        self.start = self.cost = self.models = self.frame([])
        """The start under way, without rows before and after the run; the last of the others."""
        self.policies: Array | None = None
        """Policies of the episode under way; None if it explores."""
        self.rollouts, self.knows_gains = 0, False
        self._answers: list[tuple[Topic, Message]] = []
        n_s = 3 if self.n_a == 4 else 2  # no policy is a square matrix, so that its sides are told
        U = np.linalg.qr(np.random.default_rng(0).standard_normal((N_Z, n_s)))[0]
        B, K_a, K_b = 0.1 * np.random.default_rng(1).standard_normal((3, self.n_a, n_s))
        self.gains = np.hstack([K_a, K_b])
        model = ModelRows(A=0.9 * np.eye(n_s), B=B.T, U=U, K_a=K_a, K_b=K_b, s_r=U.sum(axis=0))
        self.model_rows = pack(model)

    def release(self) -> None:
        """Nothing: the run is the tuner's."""

    def resend(self) -> None:
        self.transport.send(TARGET, Frame(0, 0, 0, 0.0, np.ones(N_Z), PLANT))
        for topic, message in self._answers:
            self.transport.send(topic, message)

    def advance(self) -> None:
        """Wait for the next start, which has to be in order."""
        last = self.start

        def wanted(topic: Topic, frame: Frame) -> bool:
            again = ids(frame) == ids(last) and np.array_equal(frame.values, last.values)
            return not again and (frame.run == last.run if last.run else frame.values.size > 0)

        what = f"an `episode/start` above {last.episode}" + ", or the end of the run" * bool(
            last.run
        )
        self.start = self.expect(what, wanted, START, ask=self.resend)[1]
        self.run, self._answers = self.start.run, []
        try:
            if self.start.values.size:
                self._check_start(self.start, last)
        except UnexpectedError as error:
            raise NoAnswerError(str(error)) from error

    def rollout(self) -> Frame:
        """The start under way, if a policy acts; the explorations before it are served."""
        while self.start.values.size and self.policies is None:
            self.answer()
            self.advance()
        if not self.start.values.size:
            raise NoteError(f"not checked, as the run ended after {self.rollouts} rollouts")
        return self.start

    def again(self, on: Topic, expected: Array) -> None:
        """UnexpectedError unless the next message on a topic is one of this episode again."""
        what = f"the same `{on.name}` again"
        found = self.expect(what, lambda _, frame: frame.run == self.run, on)[1]
        require(found.episode == self.start.episode, what, self.described(on, found))
        require_same(found.values, expected, f"`{on.name}` before")

    def costs(self, ended: float = COMPLETED) -> Frame:
        """Those of the episode: any control costs half of none. ended: of its first row."""
        rows = np.full((len(self.start.values), 3), [2.0, 2.0 * STEPS, COMPLETED])
        if self.policies is not None:
            rows[self.policies.any(axis=(1, 2)), :2] /= 2.0
        rows[0, 2] = ended
        if ended >= 0:
            rows[0, :2] = 1e9, STEPS * 1e9
        return replace(self.start, step=STEPS, time=self.start.time + 1.0, plant=PLANT, values=rows)

    def identified(self) -> Frame:
        """The models of the exploration."""
        costs = self.costs()
        return replace(costs, step=0, values=np.stack([self.model_rows] * len(costs.values)))

    def answer(self, ended: float = COMPLETED, failure: str = "") -> None:
        """Let `advance` send costs, and models, or the failure to identify any."""
        self.cost = self.costs(ended)
        self._answers = [(COST, self.cost)]
        self.rollouts += self.policies is not None
        if failure:
            told = ModelFailure(self.cost.run, self.cost.episode, True, failure)
            self._answers.append((FAILED, told))
        elif self.policies is None and ended == COMPLETED:
            self._answers.append((MODEL_IDENTIFIED, self.identified()))

    # The probes.

    def exploration(self) -> None:
        """The first episode explores, in a run with an id."""
        self.advance()
        if self.policies is not None:
            raise NoAnswerError("expected excitation seeds, got -1 (does it begin with a model?)")

    def start_again(self) -> None:
        """An unanswered start comes again, with the same rows."""
        self.again(START, self.start.values)

    def void(self) -> None:
        """The rows of a void episode are started again, under a new number."""
        self._started_anew(ended=VOID)

    def failure(self) -> None:
        """The rows of an exploration with `model/failed`, retry true, are started again."""
        self._started_anew(failure="states are missing, says the check")

    def other_models(self) -> None:
        """The models of another run or episode are not taken."""
        right = self.identified()
        other = replace(right, values=2.0 * right.values)
        self.drain(START, MODEL)
        self.transport.send(COST, self.costs())
        self.transport.send(MODEL_IDENTIFIED, replace(other, run=right.run ^ 1))
        self.transport.send(MODEL_IDENTIFIED, replace(other, episode=right.episode - 1))
        self.again(START, self.start.values)

    def first_rollout(self) -> None:
        """`model`, `policy` and the start of a rollout fit each other."""
        self.rollout()

    def policy_again(self) -> None:
        """An unanswered rollout is started again with the same policies, before any other."""
        self.again(START, self.rollout().values)
        assert self.policies is not None
        self.again(POLICY, self.policies)

    def other_costs(self) -> None:
        """The costs of another run, episode or plant are not taken."""
        start, right = self.rollout(), self.costs()
        self.drain(START)
        self.transport.send(COST, replace(right, run=right.run ^ 1))
        self.transport.send(COST, replace(right, episode=right.episode + 1))
        self.transport.send(COST, replace(right, plant=PLANT + 1))
        self.again(START, start.values)

    def divergence(self) -> None:
        """After a row that diverged the run continues."""
        self.rollout()
        self.answer(ended=50.0)
        self.advance()

    def end_of_the_run(self) -> None:
        """Every further start and policy is in order, and the end of the run is published."""
        while self.start.values.size:
            self.answer()
            self.advance()
        if self.rollouts and not self.knows_gains:
            raise NoteError(
                "no policy was [K_a K_b] of the model: right if it begins with other laws"
            )

    def another_run(self) -> None:
        """Started once more, the tuner has another run id."""
        try:
            start = self.expect("another run", lambda _, frame: frame.values.size > 0, START)[1]
        except NoAnswerError as error:
            raise NoteError("not checked: start the tuner again when its run is over") from error
        require(start.run != self.run, "another id", f"{start.run} again")

    probes = (
        exploration,
        start_again,
        void,
        failure,
        other_models,
        first_rollout,
        policy_again,
        other_costs,
        divergence,
        end_of_the_run,
        another_run,
    )

    def _started_anew(self, **how: Any) -> None:
        rows = self.start.values
        self.answer(**how)
        self.advance()
        require_same(self.start.values, rows, "the rows")

    def _check_start(self, start: Frame, last: Frame) -> None:
        """UnexpectedError unless a start has the form of the page, with what belongs to it."""
        try:
            rows = start_rows(start)
        except FrameError as error:
            raise UnexpectedError(str(error)) from error
        variance, explores = rows[:, StartColumn.VARIANCE], rows[0, StartColumn.EXCITATION] >= 0
        good = start.run > 0 and start.episode > last.episode
        what = f"a run above 0 and an episode above {last.episode} in the start"
        require(good, what, (start.run, start.episode))
        what = f"variances {'above 0 to explore' if explores else '0 where a policy acts'}"
        require(((variance > 0) == explores).all(), what, variance.tolist())
        self.policies = None
        if not explores:
            self._take_models(start)
            self._take_policies(start)
            return
        while (found := self.transport.next(POLICY, seconds=0.0)) is not None:
            has_policy = ids(found[1])[:2] == ids(start)[:2]
            require(not has_policy, "excitation -1 in a start with a policy", rows.tolist())

    def _take_models(self, start: Frame) -> None:
        if start.step > self.models.step:
            what = f"`model` number {start.step}, which the start names (--n-a {self.n_a})"
            of = start.run, start.step
            self.models = self.expect(what, lambda _, f: (f.run, f.step) == of, MODEL)[1]
        expected = self.model_rows.shape, start.step
        found = self.models.values.shape[1:], self.models.step
        require(found == expected, f"shape and number {expected} of `model`", found)
        count = len(self.models.values)
        good = (start.values[:, StartColumn.MODEL] < count).all()
        require(good, f"indices of {count} models", start.values.tolist())

    def _take_policies(self, start: Frame) -> None:
        what = f"`policy` of episode {start.episode}"
        policy = self.expect(what, lambda _, frame: ids(frame)[:2] == ids(start)[:2], POLICY)[1]
        expected = (len(start.values), *self.gains.shape), start.step
        found = policy.values.shape, policy.step
        require(found == expected, f"shape and number {expected} of `policy`", found)
        require(np.abs(policy.values).max() <= MAX_GAIN, f"gains of at most {MAX_GAIN:g}", "larger")
        self.policies = policy.values
        self.knows_gains |= bool((policy.values == self.gains).all(axis=(1, 2)).any())
