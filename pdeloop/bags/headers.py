# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Compares the times, signatures and fingerprints in the headers of a run's messages, and /clock.

With the sample time dt, states and costs have the times of docs/protocol.md:

    t_0 = max(the plant's time before, the start's time) + dt,    t_{k+1} = t_k + dt

and a start has the newest time that its tuner knew. See pdeloop.messages.protocol for signatures.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from itertools import accumulate, repeat

import numpy as np
from numpy.typing import ArrayLike

from controller_node.identification import DesignSettings
from pde_sim_node.plant import Plant
from pdeloop.bags.episodes import RecordedEpisode
from pdeloop.bags.report import Report
from pdeloop.messages.arrays import Array
from pdeloop.messages.frames import Frame
from pdeloop.messages.protocol import design_digest, digest_of, signature
from pdeloop.messages.samples import MAX_TIME
from pdeloop.messages.topics import EPISODES_PER_START, episode_name

NANOSECONDS = 1e9


@dataclass(frozen=True)
class _Span:
    """The times of an episode: those of its starts, its first state and its end; NaN where unknown."""

    number: int
    namespace: str
    starts: frozenset[float]
    first: float
    end: float


class Headers:
    """The headers of one run's messages.

    plant, settings: of the run.
    """

    def __init__(self, name: str, plant: Plant, settings: DesignSettings, report: Report) -> None:
        self._name, self._plant, self._settings, self._report = name, plant, settings, report
        self._design = design_digest(asdict(settings))
        self._spans: list[_Span] = []
        self._signed: dict[bool, str] = {}
        """An episode with signed actions, and one without."""
        self._starts: list[str] = []
        """Episodes with another signature than that of their rows, policies and models."""

    def note(self, episode: RecordedEpisode) -> None:
        """Take the times of any episode of the run."""
        first = episode.states.get(0)
        self._spans.append(
            _Span(
                episode.number,
                episode.key[0],
                frozenset(episode.asked),
                np.nan if first is None or episode.missing else first.time,
                np.nan if episode.cost is None else episode.cost.time,
            )
        )

    def check(self, episode: RecordedEpisode, where: str) -> None:
        """Compare the headers of a complete episode."""
        assert episode.start is not None and episode.cost is not None
        self._check_plants(episode, where)
        whole = list(times_of(episode, self._plant.sample_time))
        states = [episode.states[k].time for k in sorted(episode.states)]
        due = [whole[k] for k in sorted(episode.states)]
        self._report.compare(
            "times",
            f"times of the states and the cost of {where}",
            np.array([*states, episode.cost.time]),
            np.array([*due, whole[-1]]),
        )
        if episode.start.plant:
            self._check_signatures(episode, episode.start, episode.cost, where)

    def finish(self) -> None:
        """Compare what only several episodes show together."""
        if self._starts:
            others = len(self._starts) - 1
            self._report.differs(
                f"signature of the start of {self._starts[0]}"
                + (f" and of {others} more" if others else "")
                + ": it is not that of the recorded rows, policies and models"
            )
        if len(self._signed) == 2:
            self._report.differs(
                f"{self._name}: the actions of {self._signed[True]} are signed, those of "
                f"{self._signed[False]} are not"
            )
        self._spans.sort(key=lambda span: span.number)
        known: dict[int, list[_Span]] = {}
        for span in self._spans:
            before = known.setdefault(span.number // EPISODES_PER_START, [])
            self._check_begin(span, before)
            before.append(span)

    def _check_plants(self, episode: RecordedEpisode, where: str) -> None:
        assert episode.cost is not None
        others = [*episode.states.values(), *episode.actions.values(), episode.model]
        if any(frame is not None and frame.plant != episode.cost.plant for frame in others):
            self._report.differs(f"{where}: its messages have the fingerprints of several plants")

    def _check_signatures(
        self, episode: RecordedEpisode, start: Frame, cost: Frame, where: str
    ) -> None:
        report = self._report
        signed: list[ArrayLike] = [start.values, self._settings.action_set.signed]
        explores = digest_of(*signed)
        if episode.exploratory or (episode.policy is not None and episode.bases is not None):
            parts = signed
            if not episode.exploratory:
                assert episode.policy is not None and episode.bases is not None
                parts = [*signed, episode.policy.values, digest_of(episode.bases.values)]
            report.count_compared("signatures", 1)
            if digest_of(*parts) != start.plant:
                self._starts.append(where)
        times = np.array([episode.actions[k].time for k in sorted(episode.actions)])
        signs = bool((times < 0.0).any())
        self._signed.setdefault(signs, where)
        if signs:
            due = np.full(len(times), signature(start.plant, self._plant.target))
            report.compare("signatures", f"signatures of the actions of {where}", times, due)
        if episode.model is not None:
            due = _one(signature(explores, self._design) if signs else cost.time)
            time = _one(episode.model.time)
            report.compare("signatures", f"signature of the model of {where}", time, due)

    def _check_begin(self, span: _Span, before: Sequence[_Span]) -> None:
        """Hold the times of a start and of the first state against those of the episodes before.

        before: those of the same beginning of the tuner.
        """
        report, dt = self._report, self._plant.sample_time
        where = f"episode {episode_name(span.number)}"
        number = span.number % EPISODES_PER_START
        whole = span.number >= EPISODES_PER_START and len(before) == number - 1
        ends = {other.end for other in before}
        if whole and not any(map(np.isnan, ends)):
            known = ends | {0.0, span.end}  # it is asked for again until its model is there
            if unknown := sorted(span.starts - known):
                report.differs(
                    f"the start of {where} has the time {unknown[0]!r}, which no cost up to then has"
                )
        if np.isnan(span.first) or not span.starts:
            return
        own = [other.end for other in before if other.namespace == span.namespace]
        due = {time + dt for time in span.starts}
        if whole and own and not np.isnan(own[-1]):
            due.add(own[-1] + dt)
            right = span.first in due
        else:
            right = span.first >= min(due)
        if not right:
            report.differs(
                f"z_0 of {where} has the time {span.first!r}, expected {max(due)!r}, a sample time "
                "after the last one"
            )


def times_of(episode: RecordedEpisode, sample_time: float) -> Iterable[float]:
    """The times of all states of an episode, recorded or not, from that of its first one on."""
    if 0 not in episode.states:
        return [frame.time for frame in episode.states.values()]
    steps = max([*episode.states, episode.horizon])
    return accumulate(repeat(sample_time, steps), initial=episode.states[0].time)


class ClockTimes:
    """The times of states, for comparison with the messages on /clock."""

    def __init__(self) -> None:
        self._times = array("d")
        self._due = array("d")
        self._parts: list[tuple[float, float]] = []
        """The first and last known times of episodes that lack something."""

    def note(self, episode: RecordedEpisode, sample_time: float | None) -> None:
        """Take those of an episode; all of a complete one must be on /clock."""
        some = episode.state_every > 1 and sample_time is not None
        times = times_of(episode, sample_time or 0.0) if some else ()
        self._times.extend([*episode.stamps, *times])
        if not episode.missing:
            self._due.extend(frame.time for frame in episode.states.values())
        elif known := sorted({*episode.asked, *episode.stamps}):
            self._parts.append((known[0], known[-1]))

    def compare(self, recorded: Sequence[int], report: Report, *, published: bool) -> None:
        """Compare with the recorded ones (ns); published: whether every state must have had one."""
        if not len(recorded):
            return
        clock, known = np.unique(np.asarray(recorded, dtype=np.int64)), _nanoseconds(self._times)
        report.count_compared("times of /clock", len(clock))
        for time in (np.setdiff1d(clock, known) / NANOSECONDS).tolist():
            if not any(first <= time <= last for first, last in self._parts):
                report.differs(f"/clock has the time {time!r} s, which no state has")
        if published and (lost := np.setdiff1d(_nanoseconds(self._due), clock)).size:
            report.missing.append(
                f"{lost.size} of the times on /clock, the first at {int(lost[0]) / NANOSECONDS!r} s"
            )


def _nanoseconds(times: array[float]) -> np.ndarray:
    """As pdeloop.messages.samples.clock_message rounds them."""
    values = np.unique(np.asarray(times, dtype=np.float64))
    values = values[(values >= 0.0) & (values < MAX_TIME)]
    return np.rint(values * NANOSECONDS).astype(np.int64)


def _one(value: float) -> Array:
    return np.array([float(value)])
