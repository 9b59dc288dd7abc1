# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Distributes the rollouts of a batch to pairs of nodes, as episodes. Pure: no ROS, no clock.

A batch is cut into chunks of at most `max_batch` rows. Each becomes an episode of a pair that is free,
and what a pair does not finish is started again with the same rows under a new episode number, on any
pair. A rollout's cost does not depend on which episode or pair it ran in, so neither does the batch's
result. Episode numbers only increase, also across restarts of the tuner (`incarnation` is in their
upper part): an answer to an earlier tuner's episode is recognised.

    pair        event                               next        what follows
    FREE        a chunk waits                       BUSY        policy and start are sent
    BUSY        no answer for REQUEST_PERIOD        BUSY        model, policy and start are sent again
    BUSY        cost, or model of an exploration    FREE        once the batch needs no more
    BUSY        cost, and samples still missing     COLLECTING
    COLLECTING  the last sample                     FREE
    COLLECTING  SAMPLE_GRACE is over                FREE        the chunk is started again
    BUSY        void cost; failure to be retried    FREE        the chunk is started again
    BUSY        silent for `episode_timeout`        FREE        the chunk is started again
    BUSY        its nodes are gone, a pair is free  FREE        the chunk is started again, there
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from pdeloop.messages import topics
from pdeloop.messages.action_set import ANY_ACTION, ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.messages.frames import Frame, FrameError
from pdeloop.messages.protocol import ModelFailure, Publication, digest_of
from pdeloop.messages.topics import (
    EPISODES_PER_START,
    START_COLUMNS,
    VOID,
    CostColumn,
    Topic,
    episode_name,
)
from tuner_node.batch import (
    UNKNOWN_PLANT,
    Batch,
    BatchResult,
    ContradictionError,
    less_often,
    most_environments,
)
from tuner_node.chunk import ChunkQueue, messages_of
from tuner_node.pair import Pair, PairPublication

MAX_TARGETS, MAX_TARGET_BYTES = 64, 2**28
"""Plants whose targets are remembered, and the bytes of all."""


class Targets:
    """z_r by the fingerprints of plants."""

    def __init__(self) -> None:
        self._known: dict[int, Array] = {}

    def of(self, plant: int) -> Array | None:
        """The target of a plant; None if it has not arrived."""
        return self._known.get(plant)

    def keep_only(self, plant: int) -> None:
        """Forget those of other plants."""
        self._known = {p: target for p, target in self._known.items() if p == plant}

    def take(self, frame: Frame) -> None:
        """Take a message on `target`.

        ContradictionError if that of its plant was another. FrameError if there is no room for it.
        """
        known = self._known.get(frame.plant)
        if known is None:
            size = sum(target.nbytes for target in self._known.values()) + frame.values.nbytes
            if len(self._known) == MAX_TARGETS or size > MAX_TARGET_BYTES:
                raise FrameError(
                    f"expected the targets of at most {MAX_TARGETS} plants, {MAX_TARGET_BYTES} bytes"
                )
            self._known[frame.plant] = frame.values.copy()
        elif not np.array_equal(known, frame.values):
            raise ContradictionError(
                f"two different targets arrived for the plant {frame.plant} of this run; expected "
                "one plant with this fingerprint: stop the other and start a new run"
            )


SAMPLE_GRACE = 0.5
"""Seconds after its cost within which the last samples of an episode must have come in."""
REQUEST_PERIOD = 2.0
"""Seconds without an answer after which an episode's policy and start are sent once more."""
PAUSE_LEASE = 10.0
"""Seconds for which a plant's report that it is paused holds; it comes once a second."""


class Dispatcher:
    """Serves one batch at a time. `now` is any monotonic time in s.

    run, incarnation: id of the run, in every message, and starts of its tuner so far; pairs: how
    many; max_batch, episode_timeout, max_attempts: see pdeloop.messages.parameters.TUNER, they may
    be set later; state_size, horizon: of an episode, 0: not known; plant: fingerprint of the one
    that this run is about, that of the first cost if not known; design: digest of how the run's
    models are identified, see pdeloop.messages.protocol, 0: not known.
    """

    def __init__(
        self,
        *,
        run: int,
        n_a: int,
        pairs: int,
        incarnation: int,
        max_batch: int,
        state_size: int = 0,
        horizon: int = 0,
        episode_timeout: float,
        max_attempts: int,
        plant: int = UNKNOWN_PLANT,
        action_set: ActionSet = ANY_ACTION,
        design: int = 0,
    ) -> None:
        self.run, self.n_a, self.incarnation = run, n_a, incarnation
        self.max_batch, self.episode_timeout = max_batch, episode_timeout
        self.max_attempts = max_attempts
        self.state_size, self.horizon = state_size, horizon
        self.plant, self.action_set, self.design = plant, action_set, design
        self.pairs = [Pair(number) for number in range(pairs)]
        self.counters: Counter[str] = Counter()
        """Events, counted by name."""
        self.notes: list[str] = []
        """Why episodes were started again, in words."""
        self.sim_time = 0.0
        self.paused = False
        """True while an operator lets no new episode begin."""
        self.last_costs: Array | None = None
        """Mean stage costs of the last episode that was answered."""
        self._queue: ChunkQueue | None = None
        self._models: Frame | None = None
        self._models_digest = 0
        self._targets = Targets()
        self._issued = 0

    def assign(self, batch: Batch, now: float) -> list[PairPublication]:
        """Begin a batch; the previous one must be complete."""
        largest = most_environments(self.max_batch, self.state_size, self.horizon)
        self._queue = ChunkQueue(batch.within(self.max_batch), largest, len(self._present()))
        return self._begin_episodes(now)

    def models(self, models: Array, generation: int) -> list[PairPublication]:
        """Give every pair the run's reduced models.

        generation: their number; episodes name the one that they are about, so that a policy never
        meets the models before it.
        """
        frame = self._models = Frame(self.run, 0, generation, self.sim_time, models.copy())
        self._models_digest = digest_of(models)
        return [(pair, Publication(topics.MODEL, frame)) for pair in range(len(self.pairs))]

    def release(self) -> list[PairPublication]:
        """Tell every pair that the run is over."""
        frame = Frame(self.run, 0, 0, self.sim_time, np.empty((0, START_COLUMNS)))
        return [(pair, Publication(topics.START, frame)) for pair in range(len(self.pairs))]

    def presence(self, pair: int, missing: Sequence[str], now: float) -> list[PairPublication]:
        """Take which nodes of a pair are not on the network."""
        known = self.pairs[pair]
        known.missing = tuple(missing)
        if "plant" in missing:
            known.paused_until = -math.inf
        return self._begin_episodes(now)

    def cost(self, pair: int, frame: Frame, now: float) -> list[PairPublication]:
        """Take an episode's costs. Raises FrameError when their shape is not the episode's."""
        known = self._answering(pair, frame, topics.COST)
        if known is None or known.chunk is None or self._batch is None:
            return []
        if frame.values.shape != (shape := (known.chunk.size, len(CostColumn))):
            raise FrameError(f"expected costs of shape {shape}, got {frame.values.shape}")
        if self.plant == UNKNOWN_PLANT:
            self.plant = frame.plant
            self._targets.keep_only(self.plant)
        known.check_plant(frame, self.plant, now)
        self.sim_time = max(self.sim_time, frame.time)
        known.last_heard = now
        if (frame.values[:, CostColumn.ENDED] == VOID).any():
            void = f"the plant declared episode {episode_name(known.episode)} void"
            self._retry(known, f"{void}: no action came, or different starts or actions arrived")
        else:
            known.take_answer(topics.COST.name, frame)
            known.chunk.costs, known.chunk.steps = frame.values.copy(), frame.step
            self.last_costs = known.chunk.costs[:, CostColumn.MEAN]
            if self._batch.trajectories:
                known.pending_cost, known.pending_since = frame, now
                self._collect(known)
            known.release_if_done(self._batch)
        return self._begin_episodes(now)

    def pause(self) -> None:
        """Begin no new episode; those under way continue."""
        self.paused = True

    def resume(self, now: float) -> list[PairPublication]:
        """Begin episodes again."""
        self.paused = False
        return self._begin_episodes(now)

    def plant_paused(self, pair: int, frame: Frame, now: float) -> list[PairPublication]:
        """Take whether a pair's plant is paused: it is not silent then.

        It gets a new episode only if no other pair can take it, so that it can be stepped through.
        """
        if frame.values.shape != (1,) or frame.values[0] not in (0.0, 1.0):
            raise FrameError(f"expected one number, 0 or 1, got {frame.values.tolist()}")
        if self.plant in (UNKNOWN_PLANT, frame.plant):
            paused = bool(frame.values[0])
            self.pairs[pair].paused_until = now + PAUSE_LEASE if paused else -math.inf
        return self._begin_episodes(now)

    def paused_pairs(self, now: float) -> list[int]:
        """The pairs whose plants are paused."""
        return [pair.number for pair in self.pairs if now < pair.paused_until]

    def episodes(self) -> list[int]:
        """Numbers of the episodes under way."""
        return [pair.episode for pair in self.pairs if pair.chunk is not None]

    @property
    def newest_episode(self) -> int | None:
        """Number of the episode that was begun last."""
        newest = max(pair.episode for pair in self.pairs)
        return newest if newest >= 0 else None

    def target(self, pair: int, frame: Frame, now: float) -> list[PairPublication]:
        """Take the target z_r of a plant. ContradictionError if that of the run's plant was another.

        FrameError if there is no room for it.
        """
        if self.plant not in (UNKNOWN_PLANT, frame.plant):
            return []
        self._targets.take(frame)
        self.pairs[pair].announced.add(frame.plant)
        return []

    def state(self, pair: int, frame: Frame) -> bool:
        """Take a sample z_k of a pair's episode.

        True if `tick` must run now: the trajectory is complete, or a used sample was contradicted.
        Raises FrameError for a sample of another shape.
        """
        known, target = self.pairs[pair], self._targets.of(frame.plant)
        known.sample("states", frame, frame.values.shape[1] if target is None else len(target))
        last = known.pending_cost is not None and frame.step == known.pending_cost.step
        return last or any(samples.contradiction for samples in known.used_samples())

    def action(self, pair: int, frame: Frame) -> None:
        """Take a sample a_k of a pair's episode. Raises FrameError for one of another shape."""
        self.pairs[pair].sample("actions", frame, self.n_a)

    def model(self, pair: int, frame: Frame, now: float) -> list[PairPublication]:
        """Take the reduced models of an exploratory episode.

        FrameError for another shape or plant, and the signature of a controller with other
        parameters.
        """
        if frame.run == self.run and self.design:
            self.pairs[pair].check_signature(frame, self.design)
        known = self._answering(pair, frame, topics.MODEL_IDENTIFIED)
        if known is None or known.chunk is None or self._batch is None:
            return []
        count = known.chunk.size
        if len(frame.values) != count or not self._batch.exploratory:
            raise FrameError(f"expected {count} models, got {len(frame.values)}")
        if self.plant not in (UNKNOWN_PLANT, frame.plant):
            raise FrameError(f"expected a model of plant {self.plant}, got one of {frame.plant}")
        # A repetition says nothing about a plant that does not answer.
        if known.chunk.models is None:
            known.last_heard = now
        known.take_answer(topics.MODEL_IDENTIFIED.name, frame)
        known.chunk.models = frame.values.copy()
        known.release_if_done(self._batch)
        return self._begin_episodes(now)

    def failure(self, pair: int, failure: ModelFailure, now: float) -> list[PairPublication]:
        """Take the report that an episode gave no model, or that it cannot be relied on."""
        known, batch = self.pairs[pair], self._batch
        if failure.run != self.run:
            return []
        if not known.runs(failure.episode) or batch is None:
            known.check_failure(failure)
            return []
        if batch.exploratory and not failure.retry:
            known.take_failure(failure)
            known.release_if_done(batch)
        else:
            self._retry(known, failure.reason)
        return self._begin_episodes(now)

    def tick(self, now: float) -> list[PairPublication]:
        """Ask again for missing answers; restart episodes that have been silent for too long.

        A pair that is at work ignores being asked again, one that was done answers again.
        """
        publications: list[PairPublication] = []
        for pair in self.pairs:
            due = now - pair.last_sent > REQUEST_PERIOD * pair.less_often(self.state_size, now)
            if pair.chunk is None:
                if self.paused and pair.last_start is not None and due:
                    pair.last_sent = now
                    publications.append((pair.number, pair.last_start))
            elif pair.pending_cost is not None:
                self._collect(pair)
                if pair.pending_cost is not None and now - pair.pending_since > SAMPLE_GRACE:
                    target = self._targets.of(pair.pending_cost.plant)
                    lost = pair.lost_samples(0 if target is None else len(target))
                    episode = episode_name(pair.episode)
                    self._retry(pair, f"the tuner missed {lost} samples of episode {episode}")
                elif self._batch is not None:
                    pair.release_if_done(self._batch)
            elif pair.missing:  # not silent: the latched topics serve it when it is back
                pair.last_heard = now
            elif now >= pair.paused_until and now - pair.last_heard > self.episode_timeout:
                silent = f"pair {pair.number} was silent for {self.episode_timeout:g} s"
                self._retry(pair, f"{silent} in episode {episode_name(pair.episode)}")
            else:
                if now < pair.paused_until:  # not silent either
                    pair.last_heard = now
                if due:  # of a paused plant it keeps it for this run
                    models = 0 if self._models is None else self._models.values.size
                    again = pair.repeats % less_often(models) == 0
                    pair.repeats += 1
                    publications += self._request(pair, now, again=again)
        return publications + self._begin_episodes(now)

    def resend(self, now: float) -> list[PairPublication]:
        """Everything that is under way, once more."""
        busy = [pair for pair in self.pairs if pair.chunk]
        return [message for pair in busy for message in self._request(pair, now)]

    def result(self) -> BatchResult | None:
        """The batch's result once every row has one, in the batch's order."""
        if self._queue is None:
            return None
        result = self._queue.result(self.plant, self._targets.of(self.plant))
        if result is not None:
            self._queue = None
        return result

    @property
    def _batch(self) -> Batch | None:
        """The batch that is served; None between two."""
        return self._queue.batch if self._queue is not None else None

    def missing(self) -> list[str]:
        """The nodes that are missing on the network, in words."""
        return [
            f"{node} of pair {pair.number}" if len(self.pairs) > 1 else node
            for pair in self.pairs
            for node in pair.missing
        ]

    def _present(self) -> list[Pair]:
        return [pair for pair in self.pairs if not pair.missing]

    def _answering(self, pair: int, frame: Frame, topic: Topic) -> Pair | None:
        """The pair, if this answers its episode; a ContradictionError if another answer was used."""
        known = self.pairs[pair]
        if frame.run != self.run:
            self.counters["answers of another run"] += 1
            return None
        if self.plant in (UNKNOWN_PLANT, frame.plant):
            known.check_answer(frame, topic.name)
        if not known.runs(frame.episode):
            self.counters["answers of another episode"] += 1
            return None
        return known

    def _collect(self, pair: Pair) -> None:
        """Take the trajectories of a pair's episode, if all samples and the target are there."""
        assert pair.pending_cost is not None
        if pair.samples.contradiction:
            self._retry(pair, pair.samples.contradiction)
            return
        target = self._targets.of(pair.pending_cost.plant)
        if target is not None and not pair.lost_samples(len(target)):
            pair.take_trajectories()

    def _retry(self, pair: Pair, reason: str) -> None:
        assert self._queue is not None
        chunk = pair.drop()
        self.notes.append(f"{reason}; starting the episode again with the same seeds")
        self.counters["episodes repeated"] += 1
        self._queue.retry(chunk, reason, self.max_attempts)

    def _begin_episodes(self, now: float) -> list[PairPublication]:
        for samples in (used for pair in self.pairs for used in pair.used_samples()):
            if samples.contradiction:
                raise ContradictionError(
                    f"{samples.contradiction}, one of which was used: stop the other publisher and "
                    "start a new run"
                )
        queue, publications = self._queue, list[PairPublication]()
        if self.paused or queue is None:
            return publications
        others = any(now >= pair.paused_until for pair in self._present())
        for pair in self.pairs:
            if pair.chunk is not None or pair.missing or (others and now < pair.paused_until):
                continue
            if not queue.waiting:
                self._reclaim_from_absent(queue)
            if queue.waiting:
                self._issued += 1
                episode = self.incarnation * EPISODES_PER_START + self._issued
                pair.begin(queue.waiting.pop(0), self.run, episode, now)
                publications += self._request(pair, now, again=False)
        return publications

    def _reclaim_from_absent(self, queue: ChunkQueue) -> None:
        """Take an absent pair's episode back, for a pair that is free to run it."""
        for pair in self.pairs:
            if pair.missing and pair.chunk is not None:
                self.notes.append(
                    f"pair {pair.number} lost its {' and '.join(pair.missing)} in episode "
                    f"{episode_name(pair.episode)}; another pair runs the episode again with the "
                    "same seeds"
                )
                self.counters["episodes taken over"] += 1
                queue.waiting.append(pair.drop())
                return

    def _request(self, pair: Pair, now: float, *, again: bool = True) -> list[PairPublication]:
        chunk = pair.chunk
        assert self._batch is not None and chunk is not None
        pair.last_sent = now
        generation = self._models.step if self._models is not None else 0

        def frame(values: Array, plant: int = 0) -> Frame:
            return Frame(self.run, pair.episode, generation, self.sim_time, values, plant)

        sends = messages_of(self._batch, chunk, frame, self.action_set, self._models_digest)
        pair.started(sends[-1])
        if again and self._models is not None:
            sends.insert(0, Publication(topics.MODEL, self._models))
        return [(pair.number, send) for send in sends]
