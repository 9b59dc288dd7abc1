"""The plant's side of the loop: lock-step, at-least-once, idempotent. Pure: no ROS, no clock.

    start(e) -> state(e, 0) <- action(e, 0) -> state(e, 1) ... state(e, T) <- action(e, T) -> cost(e)

The plant advances only on the action stamped with the run, episode and step it waits for. Without
one for `action_timeout` it sends its state again; after `max_repeats` the episode is void, which
is not a cost. The answer to state T moves nothing: it says that the last state has arrived.

Whoever is asked twice answers the same to the bit. So another answer to a state that was answered
already comes from somebody else, or from a controller that cannot be relied on: which of the two was
taken is chance, and the episode is void. When it comes after the end of one of the last episodes, the
cost of that episode is taken back: it is sent again, void.

Where the tuner asks for it (loop_interfaces.signature), the first action of a run says whether its
controller signs. If so, only actions with the signature of their episode are taken; if not, a signed
one comes from a second controller, and contradicts.

A paused plant takes the answer it waits for and holds the next state back. Nothing is sent again and
nothing is given up meanwhile; `episode/paused` tells everybody who waits for the plant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from loop_interfaces.frames import MAX_VALUES, Frame, FrameError
from loop_interfaces.protocol import Counters, Publication
from loop_interfaces.samples import MAX_TIME
from loop_interfaces.signature import NOT_SIGNED, signature, signature_in
from loop_interfaces.topics import (
    COMPLETED,
    COST,
    PAUSED,
    START_COLUMNS,
    STATE,
    TARGET,
    VOID,
    CostColumn,
    StartColumn,
    Topic,
    noise_seeds,
)
from pde_sim_node.plant import Plant
from pde_sim_node.real_time import RealTimePacer

REMEMBERED = 16
"""Episodes whose actions can still be contradicted."""
PAUSED_REPORT = 1.0
"""Seconds between two messages on `episode/paused` while the plant is paused."""

_STALE = (
    "actions of another episode",
    "actions for another plant",
    "actions of another step",
    "actions before their state",
    "starts of an earlier episode",
)


class Lockstep:
    """One plant serving the episodes of one run at a time.

    plant: what is stepped; fingerprint: of its parameters (see build.fingerprint); sample_time (s):
    simulated time per step; real_time_factor: simulated seconds per second, 0 as fast as
    possible; paused_run: the run that this plant was paused in when its process ended, 0 for none:
    it begins paused; action_timeout (s), max_repeats, run_hold (s): see
    loop_interfaces.parameters. `now` is any monotonic time in s.
    """

    def __init__(
        self,
        plant: Plant,
        *,
        fingerprint: int = 0,
        sample_time: float,
        action_timeout: float,
        max_repeats: int,
        run_hold: float,
        real_time_factor: float = 0.0,
        paused_run: int = 0,
    ) -> None:
        self.plant = plant
        self._fingerprint = fingerprint
        self._sample_time = sample_time
        self._action_timeout = action_timeout
        self._max_repeats = max_repeats
        self._run_hold = run_hold
        self.counters = Counters()
        self.time = 0.0
        self.run = 0
        self.episode = -1
        self.steps_total = 0
        self.rounds_total = 0
        self.episodes_total = 0
        self.last_cost: np.ndarray | None = None
        """The rows of the last `episode/cost`."""
        self._rows = np.empty((0, START_COLUMNS))
        self._active = False
        self._state = np.empty((0, 0))
        """What was measured last."""
        self._cost: Publication | None = None
        """What the last episode that ended came to; None once another run has the plant."""
        self._taken: list[int] = []
        """A digest of the action that was taken at each step of the episode."""
        self._past: dict[int, tuple[list[int], float, Frame]] = {}
        """The same of the last episodes that came to a cost, their signature, and that cost."""
        self._signature = NOT_SIGNED
        """What an action of the episode carries if its controller signs."""
        self._signs: bool | None = None
        """Whether the run's controller signs; None before its first action."""
        self.contradiction = ""
        """Why the last cost that was sent is void, if two answers to one state came."""
        self._repeats = 0
        self._tuner_heard = -np.inf
        self._deadline: float | None = None
        self._held = False
        """Whether the next state is ready and waits for its instant, or for the end of a pause."""
        self.pacer = RealTimePacer(sample_time / real_time_factor) if real_time_factor else None
        self.paused = False
        self._paused_run = paused_run
        self._stepping = False
        """Whether a paused plant waits for the one action that it may still take."""

    @property
    def deadline(self) -> float | None:
        """When `tick` wants to be called next; None while no answer is awaited."""
        return self._deadline

    @property
    def active(self) -> bool:
        """Whether an episode is under way."""
        return self._active

    @property
    def last_state(self) -> Frame | None:
        """The state of the episode under way, sent or held back."""
        return self._stamped(STATE, self._state).frame if self._active else None

    @property
    def awaiting(self) -> Frame | None:
        """The state that was sent, if its action will advance the plant at once.

        None at the end of an episode, and while the plant is paused or kept to the wall clock.
        """
        plant = self.plant
        if self._held or self.paused or self.pacer or plant.step_index >= plant.horizon:
            return None
        return self.last_state

    @property
    def _reply(self) -> Publication | None:
        """What is to be sent again: the state that is not answered, or the cost."""
        return self._stamped(STATE, self._state) if self._active else self._cost

    @property
    def sample_time(self) -> float:
        """Simulated time of a step in s."""
        return self._sample_time

    @property
    def step(self) -> int:
        return self.plant.step_index

    @property
    def horizon(self) -> int:
        return self.plant.horizon

    @property
    def batch(self) -> int:
        """Environments of the present or last episode."""
        return self.plant.batch

    @property
    def stale(self) -> int:
        """Messages that came too late, too early or for somebody else."""
        return sum(count for reason, count in self.counters.items() if reason in _STALE)

    def overdue(self) -> bool:
        """Whether the awaited action has been missing for many repeats."""
        awaited = self._active and not self._held and self._deadline is not None
        return awaited and self._repeats * self._action_timeout > 2.0

    def announcement(self) -> Publication:
        """The target z_r, sent once at the start and latched."""
        return Publication(TARGET, Frame(0, 0, 0, 0.0, self.plant.target, self._fingerprint))

    def paused_report(self) -> Publication:
        """Whether the plant is paused, latched."""
        episode = max(self.episode, 0)  # -1 before the first
        paused = np.array([float(self.paused)])
        return Publication(
            PAUSED, Frame(self.run, episode, self.step, self.time, paused, self._fingerprint)
        )

    def pause(self, now: float) -> list[Publication]:
        """Hold every further state back."""
        self.paused, self._stepping = True, False
        self._deadline = now + PAUSED_REPORT
        return [self.paused_report()]

    def resume(self, now: float) -> list[Publication]:
        """Go on: send the state that was held back, or again the one that is not answered."""
        self._paused_run = 0
        if not self.paused:
            return []
        self.paused, self._stepping, self._deadline = False, False, None
        report = [self.paused_report()]
        if not self._active:
            self._held = False
            return report
        if self.pacer:
            self.pacer.begin(now)
        return report + self._send_state(now)

    def adjust(
        self,
        now: float,
        *,
        action_timeout: float,
        max_repeats: int,
        run_hold: float,
        real_time_factor: float,
    ) -> list[Publication]:
        """Take other times from now on. They decide when messages go out, never what is in them."""
        self._action_timeout, self._max_repeats = action_timeout, max_repeats
        self._run_hold = run_hold
        period = self._sample_time / real_time_factor if real_time_factor else None
        if period == (self.pacer.period if self.pacer else None):
            return []
        self.pacer = RealTimePacer(period) if period else None
        if self.pacer:
            self.pacer.begin(now)
        if self.paused or not self._held:
            return []
        return self._send_state(now)  # it waited for an instant of the former pace

    def step_once(self, now: float) -> list[Publication]:
        """Send one state although the plant is paused, and take its action.

        Raises ValueError, one sentence, when there is nothing to step.
        """
        if not self.paused:
            raise ValueError("the plant is not paused; expected a pause before a step")
        if not self._active:
            raise ValueError("no episode is under way; expected one to step in")
        if self._stepping:
            raise ValueError(f"step {self.step} still waits for its action")
        self._stepping = True
        return self._send_state(now)

    def start(self, frame: Frame, now: float) -> list[Publication]:
        """Begin an episode, or answer again for one that is known.

        Raises FrameError for a malformed seed list or another run's episode while one is under way.
        """
        rows = self._check_rows(frame)
        if not 0.0 <= frame.time < MAX_TIME:
            raise FrameError(f"expected a time from 0 to {MAX_TIME:g} s, got {frame.time:g}")
        if frame.run != self.run:
            if self.run and now - self._tuner_heard < self._run_hold:
                raise FrameError(
                    f"run {frame.run} asked for an episode, but run {self.run} has this plant "
                    f"(until it ends, or is silent for {self._run_hold:g} s)"
                )
            self.run, self.episode, self._cost = frame.run, -1, None
            self._past, self._signs = {}, None
            self._idle(now)
        report: list[Publication] = []
        if frame.run == self._paused_run:
            self._paused_run = 0
            report = self.pause(now)
        self._tuner_heard = now
        if not len(rows):
            self.run, self.episode = 0, -1
            self._idle(now)
            return []
        if frame.episode < self.episode:
            self.counters["starts of an earlier episode"] += 1
            return []
        if frame.episode == self.episode:
            if not np.array_equal(rows, self._rows):
                raise FrameError(
                    f"episode {frame.episode} was started with other seeds; "
                    "a new episode needs a new number"
                )
            self.counters["starts repeated"] += 1
            reply = self._reply
            return [reply] if reply and not self._held else []
        states = self.plant.reset(rows[:, StartColumn.SEED].astype(np.int64), noise_seeds(rows))
        self.episode, self._rows, self._active = frame.episode, rows.copy(), True
        self._state = states
        self._taken, self.contradiction = [], ""
        self._signature = signature(frame.plant, self.plant.target)
        self.time = max(self.time, frame.time) + self._sample_time
        self._stepping = False
        if self.pacer:
            self.pacer.begin(now)
        return report + self._publish_state(now)

    def action(self, frame: Frame, now: float) -> list[Publication]:
        """Advance on the awaited action; ignore any other.

        Raises FrameError when the awaited action has the wrong shape or signature.
        """
        plant = self.plant
        if not self._active or frame.run != self.run or frame.episode != self.episode:
            self.counters["actions of another episode"] += 1
            return self._judge_late(frame)
        if frame.plant != self._fingerprint:
            self.counters["actions for another plant"] += 1
            return []
        awaited = frame.step == plant.step_index
        if not awaited:
            self.counters["actions of another step"] += 1
        expected = (plant.batch, plant.n_a)
        if frame.values.shape != expected:  # it could never have been taken: nothing is in doubt
            if not awaited:
                return []
            raise FrameError(
                f"expected an action of shape {expected} (env, actuator), got {frame.values.shape}"
            )
        if not self._is_signed(frame):
            if self._signs is False:
                return [self._finish(now, void=True, contradiction=_TWO_CONTROLLERS)]
            raise FrameError(
                f"the action for step {frame.step} was not computed from the policy, model and target "
                "of its episode; expected one controller and one tuner"
            )
        if not awaited:
            past = frame.step < plant.step_index
            if past and frame.digest() != self._taken[frame.step]:
                return [self._finish(now, void=True, contradiction=_contradiction(frame))]
            return []
        if self._held:
            self.counters["actions before their state"] += 1
            return []
        if plant.step_index == plant.horizon:
            self._tuner_heard = now
            return [self._finish(now, void=False)]
        self._signs = frame.time < 0.0
        self._state = plant.step(frame.values)
        self.advance_counters([frame.digest()], now)
        if self.pacer and not self.paused:
            self._held = True
            self._deadline = self.pacer.next(now)
            return []
        return self._publish_state(now)

    def awaits(self, frame: Frame) -> bool:
        """Whether `action` will take this: it answers the state that was sent, and has its shape."""
        ids = self.run, self.episode, self.plant.step_index, self._fingerprint
        return (
            self._active
            and not self._held
            and (frame.run, frame.episode, frame.step, frame.plant) == ids
            and frame.values.shape == (self.plant.batch, self.plant.n_a)
            and self._is_signed(frame)
        )

    @property
    def signature(self) -> float | None:
        """What the actions of the episode carry; None before the run's first one."""
        if self._signs is None:
            return None
        return self._signature if self._signs else NOT_SIGNED

    def _is_signed(self, frame: Frame) -> bool:
        """Whether an action of the episode is signed as the run's controller signs."""
        found, expected = signature_in(frame.time), self.signature
        return found in (NOT_SIGNED, self._signature) if expected is None else found == expected

    def _judge_late(self, frame: Frame) -> list[Publication]:
        """Take back the cost of one of the last episodes, if this action contradicts one of its own."""
        if frame.run != self.run or frame.plant != self._fingerprint:
            return []
        taken, signed, cost = self._past.get(frame.episode, ([], NOT_SIGNED, frame))
        shape = len(cost.values), self.plant.n_a
        if frame.step >= len(taken) or frame.values.shape != shape:
            return []
        if self._signs and signature_in(frame.time) != signed:
            return []  # it could never have been taken
        if frame.digest() == taken[frame.step]:
            return []
        del self._past[frame.episode]
        self.contradiction = _contradiction(frame)
        self.counters["costs taken back"] += 1
        values = cost.values.copy()
        values[:, CostColumn.ENDED] = VOID
        return [Publication(COST, replace(cost, values=values))]

    def advance_counters(self, digests: Sequence[int], now: float) -> None:
        """Account for awaited actions, the last of them at `now`, that the plant has taken.

        digests: of the actions, see Frame.digest.
        """
        self._tuner_heard = now
        self._taken += digests
        self.steps_total += len(digests) * self.plant.batch
        self.rounds_total += len(digests)
        for _ in digests:  # rounded as often as they are counted one by one
            self.time += self._sample_time
        self._repeats = 0
        self._deadline = now + self._action_timeout

    def tick(self, now: float) -> list[Publication]:
        """Send the state again when its answer is overdue; give the episode up after max_repeats.

        With a pace also: send the next state at its instant. Call it once right after `action`,
        too, so that a state which is ready too late is told from one that is sent too late.
        """
        if self.paused and not self._stepping:
            return self._still_paused(now)
        if self._held and self.pacer and self.pacer.ready(now):
            return self._send_state(now)
        if not self._active or self._deadline is None or now < self._deadline:
            return []
        if self._repeats >= self._max_repeats and not self.paused:
            return [self._finish(now, void=True)]
        self._repeats += 1
        self.counters["states repeated"] += 1
        self._deadline = now + self._action_timeout
        state = self._stamped(STATE, self._state)
        return [state, self.paused_report()] if self.paused else [state]

    def _publish_state(self, now: float) -> list[Publication]:
        if self.paused:
            self._held, self._stepping = True, False
            self._deadline = now + PAUSED_REPORT
            return []
        return self._send_state(now)

    def _send_state(self, now: float) -> list[Publication]:
        self._held, self._repeats = False, 0
        self._deadline = now + self._action_timeout
        return [self._stamped(STATE, self._state)]

    def _still_paused(self, now: float) -> list[Publication]:
        if self._deadline is not None and now < self._deadline:
            return []
        self._deadline = now + PAUSED_REPORT
        return [self.paused_report()]

    def _idle(self, now: float) -> None:
        """No episode is under way; a pause outlasts it."""
        self._active = self._held = self._stepping = False
        self._deadline = now + PAUSED_REPORT if self.paused else None

    def _finish(self, now: float, *, void: bool, contradiction: str = "") -> Publication:
        self.contradiction = contradiction
        costs = self.plant.episode_costs()
        ended = np.where(costs.diverged_step >= 0, costs.diverged_step, COMPLETED)
        if void:
            ended = np.full(self.plant.batch, VOID)
            self.counters["episodes void"] += 1
        values = np.column_stack([costs.mean, costs.total, ended.astype(np.float64)])
        self.last_cost = values
        self._cost = self._stamped(COST, values)
        if not void:
            self._past[self.episode] = self._taken, self._signature, self._cost.frame
            if len(self._past) > REMEMBERED:
                del self._past[min(self._past)]
        self._idle(now)
        self.episodes_total += not void
        return self._cost

    def _stamped(self, topic: Topic, values: np.ndarray) -> Publication:
        step = self.plant.step_index
        frame = Frame(self.run, self.episode, step, self.time, values, self._fingerprint)
        return Publication(topic, frame)

    def _check_rows(self, frame: Frame) -> np.ndarray:
        rows = frame.values
        if rows.shape[1] not in (START_COLUMNS, len(StartColumn)):
            raise FrameError(
                f"expected rows of {START_COLUMNS} numbers (seed, excitation, variance, model), "
                f"or one more (noise), got {rows.shape[1]}"
            )
        if rows.shape[0] * max(self.plant.state_size, self.plant.n_a) > MAX_VALUES:
            raise FrameError(f"{rows.shape[0]} environments are more than one message can hold")
        seeds = rows[:, StartColumn.SEED]
        if len(rows) and (seeds.min() < -1 or (seeds != np.floor(seeds)).any()):
            raise FrameError("expected seeds that are whole numbers of at least -1")
        noise = rows[:, START_COLUMNS:]
        if noise.size and (noise.min() < 0 or (noise != np.floor(noise)).any()):
            raise FrameError("expected noise seeds that are whole numbers of at least 0")
        return rows


_TWO_CONTROLLERS = (
    "a signed action came in a run whose controller does not sign; expected one controller"
)


def _contradiction(action: Frame) -> str:
    return (
        f"two different actions came for step {action.step} of episode {action.episode}; "
        "expected one controller, which answers a repeated state with the same action"
    )
