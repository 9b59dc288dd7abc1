# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop check plant`: tuner and controller are played. Pure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from pdeloop.conformance.probing import (
    Ask,
    Check,
    NoAnswerError,
    NoteError,
    UnexpectedError,
    ids,
    require,
    require_same,
)
from pdeloop.messages.arrays import Array
from pdeloop.messages.frames import Frame
from pdeloop.messages.topics import ACTION, COMPLETED, COST, START, STATE, TARGET, VOID, Topic

SIZE, HUGE = 0.1, 1e6
"""Standard deviation of the actions, and what every actuator is told for a divergence."""
DIVERGED = 1e9
"""Mean stage cost of a row that diverged."""
BEGINNING = 8
"""Steps of an episode that is then left."""
MAX_BYTES = 2**28
"""Most bytes of the states of one episode."""
HELD, AT_ONCE, GIVE_UP = 10.0, 5.0, 60.0
"""Seconds for which the run of a killed check may hold a plant, in which a released one answers, and
after which an episode is given up, if --patience is not more."""
EXACT = 1e-6
"""Sums that miss the totals by less, relative to them, explain them."""
PLAIN = -1.0, 0.0, 0.0
"""A row's excitation, variance and model where a policy acts."""

Row = tuple[int, int]
"""Seeds of the initial state, and of the actions; 0: no control."""


@dataclass(frozen=True)
class Trace:
    """An environment's episode: its states and actions of steps 0 to T, and its cost."""

    states: Array
    actions: Array
    cost: Array


class PlantCheck(Check):
    """Compares episodes to the bit: the same seed and actions, with and without a disturbance."""

    published = STATE, COST, TARGET

    @cached_property
    def z_r(self) -> Frame:
        """The target."""
        target: Frame = self.expect("`target`", lambda _, frame: frame.values.size > 0, TARGET)[1]
        return target

    @cached_property
    def reference(self) -> Trace:
        """The episode that others are compared with."""
        try:
            return self.episode((1, 1))[0]
        except UnexpectedError as error:
            raise NoAnswerError(str(error)) from error

    @cached_property
    def second(self) -> Trace:
        """One from another initial state, with other actions."""
        return self.episode((2, 2))[0]

    @property
    def horizon(self) -> int:
        """T."""
        return len(self.reference.states) - 1

    @cached_property
    def serves_two(self) -> bool:
        """True if a start of two rows is answered."""
        try:
            self.begin((1, 1), (2, 2))
        except NoAnswerError:
            self.begin((1, 1))  # still there?
            return False
        return True

    def resend(self) -> None:
        self.transport.send(START, self.start)

    def drawn(self, step: int, *rows: Row) -> Array:
        """The actions of a step."""
        draws = [np.random.default_rng([seed, step]).standard_normal(self.n_a) for _, seed in rows]
        actions: Array = SIZE * np.array(draws) * np.array([[seed > 0] for _, seed in rows])
        return actions

    def begin(self, *rows: Row, columns: Sequence[float] = PLAIN, patience: float = 0.0) -> Frame:
        """Start an episode; its state 0."""
        self.start = self.new_start([(seed, *columns) for seed, _ in rows])
        topic, state = self.reply(0, self.resend, patience=patience)
        require(topic is STATE, "state 0", "a cost")
        return state

    def reply(
        self, step: int, ask: Ask | None = None, answers: Frame | None = None, patience: float = 0.0
    ) -> tuple[Topic, Frame]:
        """State `step` of the episode, or its cost, unless that is void."""
        start, rows = self.start, len(self.start.values)

        def wanted(topic: Topic, frame: Frame) -> bool:
            mine = ids(frame)[:2] == ids(start)[:2]
            return mine and (VOID not in frame.values if topic is COST else frame.step == step)

        what = f"state {step} of episode {start.episode}, of {rows} rows, or its cost"
        what += f" (--n-a {self.n_a})" if answers else ""
        topic, frame = self.expect(
            what, wanted, STATE, COST, ask=ask, answers=answers, patience=patience
        )
        expected = (rows, 3 if topic is COST else self.z_r.values.size), self.z_r.plant
        found = frame.values.shape, frame.plant
        require(found == expected, f"shape and plant {expected} in `{topic.name}`", found)
        return topic, frame

    def episode(
        self,
        *rows: Row,
        like: Sequence[Trace] = (),
        steps: int | None = None,
        before: Callable[[Frame], None] | None = None,
        draw: Callable[..., Array] | None = None,
        columns: Sequence[float] = PLAIN,
    ) -> list[Trace]:
        """Run an episode; the trace of each row.

        like: what they must be; steps: leave it there; before: called with each state before its
        answer; draw: the actions of a step, if not `drawn`.
        """
        topic, state = STATE, self.begin(*rows, columns=columns)
        states, actions = [], []
        while topic is STATE:
            step = state.step
            states.append(state.values)
            for i, known in enumerate(like):
                require_same(state.values[i], known.states[step], f"state {step} of row {i}")
            if step == steps:
                return []
            if state.values.nbytes * len(states) > MAX_BYTES:
                raise NoAnswerError(f"expected fewer than {step} steps; set a smaller horizon")
            if before is not None:
                before(state)
            actions.append((draw or self.drawn)(step, *rows))
            act = partial(self.transport.send, ACTION, replace(state, values=actions[-1]))
            topic, state = self.reply(step + 1, act, answers=state)
        what = f"the cost, of step {state.step}, after state {state.step}"
        require(state.step == step > 0, what, f"the cost after state {step}")
        for i, row in enumerate(state.values):
            _check_cost(step, *row.tolist())
            if i < len(like):
                require_same(row, like[i].cost, f"the cost of row {i}")
        parts = zip(np.stack(states, axis=1), np.stack(actions, axis=1), state.values, strict=True)
        return [Trace(*part) for part in parts]

    def beginning(self, **how: Any) -> None:
        """The first steps of the reference, whatever is different."""
        steps = min(BEGINNING, self.horizon)
        self.episode((1, 1), like=[self.reference], steps=steps, **how)

    # The probes.

    def first_state(self) -> None:
        """`target` is published, latched, and state 0 has its fingerprint and its size."""
        assert self.z_r
        try:
            self.begin((1, 1), patience=self.patience + HELD)
        except NoAnswerError as error:
            held = str(error).endswith("nothing")
            hint = " (is it paused, or held by another run?)" if held else ""
            raise NoAnswerError(f"{error}{hint}") from error

    def cost(self) -> None:
        """The cost has (mean, T mean, -1) for each row, and T as its step."""
        if (ended := self.reference.cost[2]) != COMPLETED:
            raise NoteError(f"diverged at step {ended:g}, by actions of standard deviation {SIZE}")

    def repeat(self) -> None:
        """The same seed and actions give the same bits, whatever came in between."""
        assert self.reference and self.second
        self.episode((1, 1), like=[self.reference])

    def start_again(self) -> None:
        """A repeated start gives the last message again, in an episode and after it."""

        def again(state: Frame) -> None:
            if state.step < BEGINNING:
                self.resend()

        self.episode((1, 1), like=[self.reference], before=again)
        topic, _ = self.reply(0, self.resend)
        require(topic is COST, "the cost again", "state 0")

    def other_starts(self) -> None:
        """The start of an earlier episode and the end of another run change nothing."""
        self.begin((2, 2))
        earlier = self.start
        end = replace(earlier, run=self.run + 1, values=np.empty((0, 4)))

        def disturb(state: Frame) -> None:
            self.transport.send(START, earlier)
            self.transport.send(START, end)

        self.beginning(before=disturb)

    def other_actions(self) -> None:
        """Only an action with the ids of the last state moves the plant."""

        def disturb(state: Frame) -> None:
            wrong = replace(state, values=self.drawn(state.step, (9, 9)))
            self.transport.send(ACTION, replace(wrong, run=state.run + 1))
            self.transport.send(ACTION, replace(wrong, episode=state.episode + 1))
            self.transport.send(ACTION, replace(wrong, step=state.step + 1))
            self.transport.send(ACTION, replace(wrong, plant=state.plant ^ 1))
            if state.step:  # that of the step before, again
                taken = self.drawn(state.step - 1, (1, 1))
                self.transport.send(ACTION, replace(state, step=state.step - 1, values=taken))

        self.beginning(before=disturb)

    def silence(self) -> None:
        """Without its action the last state, even state T, comes again, and no cost."""

        def withhold(state: Frame) -> None:
            if state.step in (0, self.horizon):
                topic, again = self.reply(state.step)
                require(topic is STATE, f"state {state.step} again", "the cost")
                require_same(again.values, state.values, f"state {state.step}")

        self.episode((1, 1), like=[self.reference], before=withhold)

    def acknowledgement(self) -> None:
        """The answer to state T moves nothing."""

        def draw(step: int, *rows: Row) -> Array:
            return self.drawn(step, *rows) * float(step < self.horizon)

        self.episode((1, 1), like=[self.reference], draw=draw)

    def stage_costs(self) -> None:
        """The totals sum q |z_k - z_r|^2 + r |a_k|^2 over the steps before T."""
        more = [self.episode(row)[0] for row in ((1, 0), (2, 0), (3, 3))]
        traces = [t for t in (self.reference, self.second, *more) if t.cost[2] == COMPLETED]
        if len(traces) < 5:
            raise NoteError("not checked, as the plant diverges")
        sums = [_sums(trace, self.z_r.values) for trace in traces]
        totals = np.array([trace.cost[1] for trace in traces])
        misses = {what: _miss(np.array([s[what] for s in sums]), totals) for what in sums[0]}
        right = misses.pop("")
        if right < EXACT:
            return
        likely = min(misses, key=lambda what: misses[what])
        require(misses[likely] > EXACT, "q and r that give the totals", f"totals with {likely}")
        raise NoteError(
            f"no q and r give {len(traces)} totals from the published states and actions (they "
            f"miss {right:.1g} of them): right if there are noise, sensors or limits in between"
        )

    def start_columns(self) -> None:
        """The plant uses only the seed of a row; the rest is for the controller."""
        self.beginning(columns=(7.0, 0.1, 1.0))

    def seeds(self) -> None:
        """Every seed below 2^53 has a state of its own, and -1 always the same one."""
        states = {seed: self.begin((seed, 1)).values for seed in (1, 2, 1 + 2**31, 1 + 2**32, -1)}
        require_same(self.begin((-1, 1)).values, states[-1], "state 0 for seed -1")
        equal = [seed for seed in states if seed != 1 and np.array_equal(states[seed], states[1])]
        if len(equal) == len(states) - 1:
            raise NoteError(
                "all seeds give the same state: right for an initial distribution of one value"
            )
        require(not equal, "other states than that of seed 1", f"the same for the seeds {equal}")

    def two_rows(self) -> None:
        """Two rows give the same bits as two single episodes, in either order."""
        one, two = self.reference, self.second
        if not self.serves_two:
            raise NoteError("two rows are not answered: right for a plant of one environment")
        self.episode((1, 1), (2, 2), like=[one, two])
        self.episode((2, 2), (1, 1), like=[two, one])

    def divergence(self) -> None:
        """A row that diverges is frozen and marked with the step; another one continues."""
        step, others = min(2, self.horizon - 1), int(self.serves_two)

        def draw(now: int, *rows: Row) -> Array:
            actions = self.drawn(now, *rows)
            actions[-1] = HUGE if now == step else actions[-1]
            return actions

        rows = *[(1, 1)][:others], (2, 2)
        found = self.episode(*rows, like=[self.reference][:others], draw=draw)[-1]
        ended, moved = int(found.cost[2]), np.array(np.diff(found.states, axis=0).any(axis=1))
        if ended == COMPLETED and moved[step]:
            raise NoteError(f"actions of {HUGE:g} did not make it diverge")
        if ended != COMPLETED and moved[ended:].any():
            raise NoteError(
                f"diverged at step {ended}, but kept moving: right with noise or delays"
            )
        good = ended >= 0 and moved[:ended].all()
        require(good, f"`ended` {moved.argmin()}, the step from which it is frozen", ended)

    def release_of_the_run(self) -> None:
        """After a start without rows another run is served at once."""
        self.begin((1, 1))
        end = self.new_start([])
        self.run += 1
        self.start = self.new_start([(1, *PLAIN)])

        def ask() -> None:
            self.transport.send(START, end)
            self.resend()

        self.reply(0, ask, patience=AT_ONCE)

    def giving_up(self) -> None:
        """Without answers the plant gives the episode up, with -2 in every row of the cost."""
        start = self.begin((2, 2))

        def wanted(topic: Topic, frame: Frame) -> bool:
            return topic is COST and ids(frame)[:2] == ids(start)[:2]

        seconds = max(GIVE_UP, self.patience)
        what = f"the cost of an episode that had no answer for {seconds:g} s"
        with suppress(NoAnswerError):
            self.expect(what, wanted, STATE, COST, patience=seconds)
        _, void = self.expect(what, wanted, STATE, COST, ask=self.resend)
        require((void.values[:, -1] == VOID).all(), f"{VOID:g} in its rows", void.values.tolist())
        self.beginning()

    probes = (
        first_state,
        cost,
        repeat,
        start_again,
        other_starts,
        other_actions,
        silence,
        acknowledgement,
        stage_costs,
        start_columns,
        seeds,
        two_rows,
        divergence,
        release_of_the_run,
        giving_up,
    )


def _check_cost(steps: int, mean: float, total: float, ended: float) -> None:
    """UnexpectedError unless the numbers of a row belong together."""
    if ended == COMPLETED:
        good = bool(np.isclose(steps * mean, total, rtol=1e-5))
    else:
        good = 0 <= ended < steps and (mean, total) == (DIVERGED, steps * DIVERGED)
    expected = f"(mean, {steps} mean, -1) or ({DIVERGED:g}, {steps * DIVERGED:g}, k) as a cost"
    require(good, expected, (mean, total, ended))


def _sums(trace: Trace, z_r: Array) -> dict[str, tuple[float, float]]:
    """Candidate sums whose factors are q and r: the stage costs, and common mistakes."""
    e = ((trace.states - z_r) ** 2).sum(axis=1)
    z, a = (trace.states**2).sum(axis=1), (trace.actions**2).sum(axis=1)
    return {
        "": (e[:-1].sum(), a[:-1].sum()),
        "the states after the steps": (e[1:].sum(), a[:-1].sum()),
        "state T, too": (e.sum(), a[:-1].sum()),
        "nothing of step 0": (e[1:-1].sum(), a[1:-1].sum()),
        "no action of step T - 1": (e[:-1].sum(), a[:-2].sum()),
        "|z|^2 instead of |z - z_r|^2": (z[:-1].sum(), a[:-1].sum()),
    }


def _miss(sums: Array, totals: Array) -> float:
    """By how much the best q and r miss, relative to the largest total."""
    columns = sums / np.maximum(np.abs(sums).max(axis=0), np.finfo(float).tiny)
    error = columns @ np.linalg.lstsq(columns, totals, rcond=None)[0] - totals
    return float(np.abs(error).max() / max(np.abs(totals).max(), np.finfo(float).tiny))
