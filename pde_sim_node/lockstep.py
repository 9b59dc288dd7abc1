# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The plant's side of the loop: lock-step, at-least-once, idempotent. Pure: no ROS, no clock.

    start(e) -> state(e, 0) <- action(e, 0) -> state(e, 1) ... state(e, T) <- action(e, T) -> cost(e)

The plant advances only on the action stamped with the run, episode and step it waits for. The answer to
state T advances nothing: it acknowledges the last state.

    phase     event                                 next phase   messages
    IDLE      start(e)                              AWAITING     state(e, 0)
    AWAITING  action(e, k), k < T                   AWAITING     state(e, k + 1)
    AWAITING  the same, while paused or paced       READY        none
    READY     its instant, a single step, resume    AWAITING     state(e, k + 1)
    AWAITING  action(e, T)                          IDLE         cost(e)
    AWAITING  no answer for `action_timeout`        AWAITING     state(e, k) again
    AWAITING  no answer after `max_repeats`         IDLE         cost(e), void: not a cost
    active    contradicts what was taken of e       IDLE         cost(e), void; active: not IDLE
    active    start(f), f > e                       AWAITING     cost(e), void before T; state(f, 0)
    any       end of the run, start of another run  IDLE         none; or as a start in IDLE

Which starts and actions contradict, and which are signed: pde_sim_node.taken_actions.

A pause is independent of the phase: a paused plant takes the answer it waits for, and sends no further
state. Nothing is repeated or abandoned during a pause; `episode/paused` informs the nodes
that wait for the plant.
"""

import math
from collections import Counter
from collections.abc import Sequence
from enum import Enum, auto

import numpy as np

from pde_sim_node.plant import Plant
from pde_sim_node.real_time import RealTimePacer, Timing
from pde_sim_node.taken_actions import Episode, TakenActions, two_actions, two_starts
from pdeloop.messages import topics
from pdeloop.messages.frames import MAX_VALUES, Frame, FrameError, digest
from pdeloop.messages.protocol import Publication, signature
from pdeloop.messages.topics import VOID, CostColumn, StartColumn, Topic, noise_seeds, start_rows

PAUSED_REPORT = 1.0
"""Seconds between two messages on `episode/paused` while the plant is paused."""
SLOW = 2**16
"""Numbers of a state, all environments together, from which on `action_timeout` grows with it."""

_STALE = (
    "actions of another episode",
    "actions for another plant",
    "actions of another step",
    "actions before their state",
    "starts of an earlier episode",
)


class Phase(Enum):
    """The event that the protocol waits for."""

    IDLE = auto()
    """The start of an episode."""
    AWAITING = auto()
    """The action that answers the state that was sent."""
    READY = auto()
    """The instant at which the next state, already computed, is due, or the end of a pause."""


class Lockstep:
    """One plant serving the episodes of one run at a time. `now` is any monotonic time in s.

    fingerprint: of the plant's parameters, see build.fingerprint; paused, signed_run: whether this
    plant was paused when its process ended, and the run whose controller signed; 0: none.
    """

    def __init__(
        self,
        plant: Plant,
        timing: Timing,
        *,
        fingerprint: int = 0,
        paused: bool = False,
        signed_run: int = 0,
    ) -> None:
        self.plant = plant
        self.counters: Counter[str] = Counter()
        """Events, counted by name."""
        self.run = 0
        self.episode = -1
        self.time = 0.0
        """Simulated time in s, continuing from one episode to the next."""
        self.steps_total = self.rounds_total = self.episodes_total = 0
        self.last_cost: np.ndarray | None = None
        """The rows of the last `episode/cost`."""
        self.contradiction = ""
        """Why the last cost that was sent is void, if two different messages came in one place."""
        self.deadline: float | None = 0.0 if paused else None
        """Time of the next call of `tick`; None while nothing is due."""
        self.paused = paused
        self._fingerprint = fingerprint
        self._stepping = False
        """True while a paused plant waits for the one action that it may still take."""
        self._phase = Phase.IDLE
        self._actions = TakenActions()
        self._state = np.empty((0, 0))
        """The last measurement."""
        self.signed_run = signed_run
        """The last run whose controller signs."""
        self._repeats = 0
        self._tuner_heard = -math.inf
        self._timing = timing
        self.pacer = self._make_pacer()

    @property
    def active(self) -> bool:
        """True while an episode is under way."""
        return self._phase is not Phase.IDLE

    @property
    def step(self) -> int:
        return self.plant.step_index

    @property
    def last_state(self) -> Frame | None:
        """The state of the episode under way, whether it was sent or is ready."""
        return self._stamped(topics.STATE, self._state).frame if self.active else None

    @property
    def awaiting(self) -> Frame | None:
        """The state that was sent, if its action will advance the plant at once.

        None while the plant is paused or kept to the wall clock.
        """
        waits = self._phase is Phase.AWAITING and not self.paused and not self.pacer
        return self.last_state if waits else None

    @property
    def stale(self) -> int:
        """Messages that arrived too late, too early or for another node."""
        return sum(count for reason, count in self.counters.items() if reason in _STALE)

    @property
    def signature(self) -> float | None:
        """The key that the actions of the episode carry; None before the run's first one."""
        return self._actions.signature

    @property
    def _patience(self) -> float:
        """Seconds until a state without an answer is sent again; longer for a large one."""
        return self._timing.action_timeout * max(1.0, self._state.size / SLOW)

    def overdue(self) -> bool:
        """True if the awaited action has been missing for many repeats."""
        if self._phase is not Phase.AWAITING or (self.paused and not self._stepping):
            return False
        return self._repeats * self._patience > 2.0

    def announcement(self) -> Publication:
        """The target z_r, sent once at the start and latched."""
        return Publication(topics.TARGET, Frame(0, 0, 0, 0.0, self.plant.target, self._fingerprint))

    def paused_report(self) -> Publication:
        """The latched message that says whether the plant is paused."""
        return self._stamped(topics.PAUSED, np.array([float(self.paused)]))

    def pause(self, now: float) -> list[Publication]:
        """Send no further state."""
        self.paused, self._stepping = True, False
        self.deadline = now + PAUSED_REPORT
        return [self.paused_report()]

    def resume(self, now: float) -> list[Publication]:
        """Send the state that is ready, or again the one that is not answered."""
        if not self.paused:
            return []
        self.paused, self._stepping, self.deadline = False, False, None
        if self.pacer:
            self.pacer.begin(now)
        return [self.paused_report(), *(self._send_state(now) if self.active else [])]

    def adjust(self, now: float, timing: Timing) -> list[Publication]:
        """Take other times from now on."""
        former, self._timing = self._timing, timing
        if timing.real_time_factor == former.real_time_factor:
            return []
        self.pacer = self._make_pacer()
        if self.pacer:
            self.pacer.begin(now)
        waited = self._phase is Phase.READY and not self.paused  # for an instant of the former pace
        return self._send_state(now) if waited else []

    def step_once(self, now: float) -> list[Publication]:
        """Send one state although the plant is paused, and take its action.

        Raises ValueError, one sentence, when there is nothing to step.
        """
        if not self.paused:
            raise ValueError("the plant is not paused; expected a pause before a step")
        if not self.active:
            raise ValueError("no episode is under way; a step needs one")
        if self._stepping:
            raise ValueError(f"step {self.step} still waits for its action")
        self._stepping = True
        return self._send_state(now)

    def start(self, frame: Frame, now: float) -> list[Publication]:
        """Begin an episode, or answer again for one that is known.

        Raises FrameError for a malformed seed list or another run's episode while one is under way.
        """
        rows = start_rows(frame)
        if len(rows) * max(self.plant.state_size, self.plant.n_a) > MAX_VALUES:
            raise FrameError(f"{len(rows)} environments are more than one message can hold")
        if frame.run != self.run:
            hold = self._timing.run_hold
            if self.run and now - self._tuner_heard < hold:
                raise FrameError(
                    f"run {frame.run} asked for an episode, but run {self.run} holds this plant "
                    f"(until it ends, or is silent for {hold:g} s)"
                )
            self._serve(frame.run, now)
        self._tuner_heard = now
        if not len(rows):
            self._serve(0, now)
            return []
        signed = signature(frame.plant, self.plant.target)
        if frame.episode <= self.episode:
            return self._start_again(frame, rows, signed, now)
        replaced: list[Publication] = []
        if self.active:  # its result is known once the last state is sent
            replaced = [self._finish(now, void=self.step < self.plant.horizon)]
        seeds = rows[:, StartColumn.SEED].astype(np.int64)
        self._state = self.plant.reset(seeds, noise_seeds(rows))
        self._actions.episode = Episode(rows.copy(), signed)
        self.episode, self.contradiction, self._stepping = frame.episode, "", False
        self.time = max(self.time, frame.time) + self.plant.sample_time
        if self.pacer:
            self.pacer.begin(now)
        return replaced + self._send_unless_paused(now)

    def action(self, frame: Frame, now: float) -> list[Publication]:
        """Advance on the awaited action; ignore any other.

        Raises FrameError when the awaited action has the wrong shape or signature.
        """
        plant = self.plant
        if not self.active or frame.run != self.run or frame.episode != self.episode:
            self.counters["actions of another episode"] += 1
            return self._check_late_action(frame)
        if frame.plant != self._fingerprint:
            self.counters["actions for another plant"] += 1
            return []
        awaited = frame.step == plant.step_index
        if not awaited:
            self.counters["actions of another step"] += 1
        fits = frame.values.shape == plant.actions.shape
        if awaited and not fits:
            raise FrameError(
                f"expected an action of shape {plant.actions.shape} (env, actuator), "
                f"got {frame.values.shape}"
            )
        # One that does not fit could never have been taken: nothing is in doubt.
        if fits and (contradiction := self._actions.contradiction(frame)):
            return [self._finish(now, void=True, contradiction=contradiction)]
        if not awaited:
            return []
        if self._phase is Phase.READY:
            self.counters["actions before their state"] += 1
            return []
        if plant.step_index == plant.horizon:
            self._tuner_heard = now
            return [self._finish(now, void=False)]
        if self._actions.take_signature(frame):
            self.signed_run = self.run
        self._state = plant.step(frame.values)
        self.advance_counters([digest(frame.values)], now)
        if self.pacer and not self.paused:
            self._phase, self.deadline = Phase.READY, self.pacer.next(now)
            return []
        return self._send_unless_paused(now)

    def awaits(self, frame: Frame) -> bool:
        """True if `action` will take this: it answers the state that was sent, and has its shape."""
        ids = self.run, self.episode, self.step, self._fingerprint
        return (
            self._phase is Phase.AWAITING
            and (frame.run, frame.episode, frame.step, frame.plant) == ids
            and frame.values.shape == self.plant.actions.shape
            and self._actions.is_signed(frame)
        )

    def advance_counters(self, digests: Sequence[int], now: float) -> None:
        """Account for awaited actions, the last of them at `now`, that the plant has taken.

        digests: of the values of the actions, see frames.digest.
        """
        self._tuner_heard = now
        self._actions.episode.taken += digests
        self.steps_total += len(digests) * self.plant.batch
        self.rounds_total += len(digests)
        for _ in digests:  # rounded as often as they are counted one by one
            self.time += self.plant.sample_time
        self._repeats = 0
        self.deadline = now + self._patience

    def tick(self, now: float) -> list[Publication]:
        """Perform due work: send the state that is ready, repeat it, or give up the episode.

        With a pace, also call it once right after `action`, so that a state which is ready too late is
        distinguished from one that is sent too late.
        """
        if self._phase is Phase.READY and self.pacer and not self.paused and self.pacer.ready(now):
            return self._send_state(now)
        if self.deadline is None or now < self.deadline:
            return []
        if self.paused and not self._stepping:
            self.deadline = now + PAUSED_REPORT
            return [self.paused_report()]
        if not self.active:
            return []
        if self._repeats >= self._timing.max_repeats and not self.paused:
            return [self._finish(now, void=True)]
        self._repeats += 1
        self.counters["states repeated"] += 1
        self.deadline = now + self._patience
        state = self._stamped(topics.STATE, self._state)
        return [state, self.paused_report()] if self.paused else [state]

    def _make_pacer(self) -> RealTimePacer | None:
        factor = self._timing.real_time_factor
        return RealTimePacer(self.plant.sample_time / factor) if factor else None

    def _serve(self, run: int, now: float) -> None:
        """Belong to a run, 0: to none, and forget the one before."""
        self.run, self.episode = run, -1
        self._actions = TakenActions(True if run == self.signed_run else None)
        self._end_episode(now)

    def _start_again(
        self, frame: Frame, rows: np.ndarray, signed: float, now: float
    ) -> list[Publication]:
        """Answer again for an episode that is known, which is void if its start was another one."""
        episode = self._actions.episode
        present = frame.episode == self.episode
        if present and self.active and episode.started_otherwise(rows, signed):
            return [self._finish(now, void=True, contradiction=two_starts(frame))]
        if cost := self._actions.retract_start(frame.episode, rows, signed):
            return [self._take_back(cost, two_starts(frame))]
        if not present:
            self.counters["starts of an earlier episode"] += 1
            return []
        self.counters["starts repeated"] += 1
        if self._phase is Phase.AWAITING:
            return [self._stamped(topics.STATE, self._state)]
        return [Publication(topics.COST, episode.cost)] if episode.cost else []

    def _take_back(self, cost: Frame, contradiction: str) -> Publication:
        self.contradiction = contradiction
        self.counters["costs taken back"] += 1
        return Publication(topics.COST, cost)

    def _check_late_action(self, frame: Frame) -> list[Publication]:
        """Take the cost of an ended episode back, if this action contradicts one of its own."""
        if frame.run != self.run or frame.plant != self._fingerprint:
            return []
        cost = self._actions.retract(frame) if frame.values.shape[1] == self.plant.n_a else None
        return [self._take_back(cost, two_actions(frame))] if cost else []

    def _send_unless_paused(self, now: float) -> list[Publication]:
        if not self.paused:
            return self._send_state(now)
        self._phase, self._stepping = Phase.READY, False
        self.deadline = now + PAUSED_REPORT
        return []

    def _send_state(self, now: float) -> list[Publication]:
        self._phase, self._repeats = Phase.AWAITING, 0
        self.deadline = now + self._patience
        return [self._stamped(topics.STATE, self._state)]

    def _end_episode(self, now: float) -> None:
        """No episode is under way; a pause outlasts it."""
        self._phase, self._stepping = Phase.IDLE, False
        self.deadline = now + PAUSED_REPORT if self.paused else None

    def _finish(self, now: float, *, void: bool, contradiction: str = "") -> Publication:
        self.contradiction = contradiction
        values = self.last_cost = self.plant.episode_costs().rows()
        if void:
            values[:, CostColumn.ENDED] = VOID
            self.counters["episodes void"] += 1
        publication = self._stamped(topics.COST, values)
        self._actions.end(publication.frame, void=void)
        self._end_episode(now)
        self.episodes_total += not void
        return publication

    def _stamped(self, topic: Topic, values: np.ndarray) -> Publication:
        ids = self.run, max(self.episode, 0), self.step  # the episode is -1 before the first
        return Publication(topic, Frame(*ids, self.time, values, self._fingerprint))
