# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The recorded episodes of a run: each is computed again, then the training that asked for them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Iterable, Mapping, Sequence
from itertools import groupby, pairwise
from typing import Any

import numpy as np

from controller_node.identification import DesignSettings, design_each
from pdeloop.bags.episodes import RecordedEpisode
from pdeloop.bags.headers import Headers
from pdeloop.bags.report import Report
from pdeloop.bags.run_claims import RunClaims, compare_parameters, compare_results
from pdeloop.episode import rollout
from pdeloop.in_process import LocalPair
from pdeloop.messages.arrays import Array
from pdeloop.messages.frames import Frame
from pdeloop.messages.parameters import PLANT, recorded_values, with_budget
from pdeloop.messages.spec import ParameterError
from pdeloop.messages.topics import (
    COMPLETED,
    EPISODES_PER_START,
    CostColumn,
    StartColumn,
    episode_name,
    noise_seeds,
)
from tuner_node.batch import Batch
from tuner_node.budget import PURPOSES
from tuner_node.build import build_training
from tuner_node.training import Training

NAMED = 5
"""Gaps that are named; the others are only counted."""

Gap = tuple[int, int]
"""The first and the last of consecutive numbers that are missing."""


def gaps(numbers: Iterable[int]) -> list[Gap]:
    """The numbers missing before and between these, of each start of the tuner that is among them.

    Numbers that are not our tuner's have none.

    >>> gaps([EPISODES_PER_START + 2, EPISODES_PER_START + 5]) == [
    ...     (EPISODES_PER_START + 1, EPISODES_PER_START + 1),
    ...     (EPISODES_PER_START + 3, EPISODES_PER_START + 4),
    ... ]
    True
    >>> gaps([3, 9])
    []
    """
    found = []
    for start, own in groupby(
        sorted(set(numbers)), key=lambda number: number // EPISODES_PER_START
    ):
        if start:
            for a, b in pairwise([start * EPISODES_PER_START, *own]):
                found += [(a + 1, b - 1)] if b - a > 1 else []
    return found


def gaps_text(found: Sequence[Gap]) -> str:
    """The gaps in words.

    >>> gaps_text([(EPISODES_PER_START + 3, EPISODES_PER_START + 4)])
    'episodes 1.3 to 1.4'
    """
    parts = [
        episode_name(a) if a == b else f"{episode_name(a)} to {episode_name(b)}"
        for a, b in found[:NAMED]
    ]
    more = f" and {len(found) - NAMED} more gaps" if len(found) > NAMED else ""
    several = len(found) > 1 or any(a != b for a, b in found)
    return f"episode{'s' if several else ''} {', '.join(parts)}{more}"


_TUNERS = ("seed", "seeds", "rollouts", "iterations", "start", "optimizer")


class RecordedRun:
    """The episodes of one run, compared with their recomputation."""

    def __init__(
        self, number: int, values: Mapping[str, Any] | None, report: Report, target: Array | None
    ) -> None:
        self._name, self._report = f"run {number}", report
        self._recomputed = 0
        self._rollouts: dict[bytes, list[str]] = {}
        """The recorded rollouts in words, by their keys (`_keys`)."""
        self._answered: Counter[bytes] = Counter()
        """Number of those with costs."""
        self._complete: Counter[bytes] = Counter()
        """Those of complete episodes."""
        self._numbers: set[int] = set()
        """Numbers of all episodes, whatever was recorded of them."""
        self._models: dict[int, Frame] = {}
        """The models that policies are about, by their number."""
        self._values: dict[str, Any] | None = None
        if values is None:
            self._note(
                "its parameters are not in the bag, so nothing is recomputed (give them with "
                "--parameters FILE: the parameters.yaml of the run, or the parameters.json that the "
                "recorder wrote next to its bag)"
            )
            return
        if not any(spec.name in values for spec in PLANT):
            self._note(
                "its plant gave no parameters, as a node of your own may, so nothing is recomputed"
            )
            return
        self._given = set(values)
        try:
            self._values = with_budget(recorded_values(values))
        except ParameterError as error:
            raise ParameterError(f"{self._name}: {error}") from error
        self._pair = LocalPair(self._values)
        self._fingerprint = self._pair.fingerprint
        self._headers = Headers(
            self._name, self._pair.plant, DesignSettings.of(self._values), report
        )
        self._same_plant = True
        if target is not None:
            own = self._pair.plant.target[np.newaxis]
            report.compare("targets", f"target of {self._name}", target[np.newaxis], own)

    def episode(self, episode: RecordedEpisode) -> None:
        """Check one episode."""
        report, where = self._report, f"episode {episode.name}"
        self._numbers.add(episode.number)
        for text in episode.contradictions:
            report.differs(f"{where}: {text}")
        if self._values is not None:
            self._headers.note(episode)
        if episode.void:
            return
        if episode.missing:
            report.incomplete.append(f"{where} lacks {', '.join(episode.missing)}")
        self._keep(episode)
        if self._values is None or episode.start is None or episode.cost is None:
            return
        if self._same_plant and episode.cost.plant != self._fingerprint:
            self._same_plant = False
            self._note(
                f"recorded with another fingerprint of the plant ({episode.cost.plant}; here it is "
                f"{self._fingerprint}): its parameters or the source of its equation differ. The "
                "states that it computes are compared all the same"
            )
        if not episode.missing:
            self._run_again(episode, where)

    @property
    def sample_time(self) -> float | None:
        """The plant's, in s; None where nothing of the run can be recomputed."""
        return None if self._values is None else self._pair.plant.sample_time

    @property
    def publishes_clock(self) -> bool:
        """True if every state of the plant's went with a time on /clock."""
        return self._values is not None and bool(self._values.get("publish_clock", False))

    def finish(self, claims: RunClaims | None) -> None:
        """Run the training again, until it has asked for all that was recorded.

        claims: what the run's folder says, if it is known; the training is then run as far as that.
        """
        if not self._recomputed:
            self._report.unverified.append(self._name)
        if self._values is not None:
            self._headers.finish()
        if claims is not None and self._values is not None:
            compare_parameters(claims, self._values, self._report)
        if not self._follow(claims):
            self._miss_unfollowed()

    def _follow(self, claims: RunClaims | None) -> bool:
        """Run the training again; whether it could be followed to its recorded end."""
        if self._values is None or not (self._rollouts or claims):
            return False
        if unknown := [name for name in _TUNERS if name not in self._given]:
            self._note(f"the tuner's policies cannot be followed without its {', '.join(unknown)}")
            return False
        training = build_training({**self._values, "plant_fingerprint": self._fingerprint})
        pair = LocalPair(self._values, self._pair.plant)
        pair.follow(training)
        unseen = dict(self._rollouts)
        first = min(self._numbers, default=0)
        # A bag that begins with a later start of the tuner: another one has the rest.
        continues = claims is None and first // EPISODES_PER_START > 1 and not gaps({first})
        lost = _Lost(self._rollouts, self._complete, everything=not continues)
        while unseen or (claims is not None and not claims.reached(training)):
            if (batch := training.next_batch()) is None:
                break
            keys = _keys(batch.rows, batch.policies, training.generation)
            again = _repeated(keys, batch.rows, training)
            for key in keys:
                lost.look(key, training.phase, again=key in again)
                if unseen.pop(key, None) and not batch.exploratory:
                    self._report.count_compared("policies", self._answered[key])
            if batch.policies is not None and (
                known := self._models.pop(training.generation, None)
            ):
                assert training.models is not None
                where = f"models number {known.step} of {self._name}"
                self._report.compare("models", where, known.values, training.models)
            try:
                training.finish(pair.run(batch, self._values["max_batch"]))
            except ValueError as error:  # an exploration without a model, as it was then
                self._note(f"the training ends there: {error}")
                return False
            pair.follow(training)
        for places in unseen.values():
            for place in places:
                self._report.differs(f"policy of {place}: the training never asks for it")
        if claims is not None:
            lost.reach_end()
            compare_results(claims, training, self._report)
        if missing := lost.text():
            between = gaps(self._numbers)
            told = f"; the bag has nothing of {gaps_text(between)}" if between else ""
            self._report.missing.append(f"{self._name}: {missing}{told}")
        return True

    def _miss_unfollowed(self) -> None:
        """Name what is missing where no training shows what was asked for."""
        if between := gaps(self._numbers):
            self._report.missing.append(f"{self._name}: {gaps_text(between)}")
        if lost := [place for key, place in self._rollouts.items() if not self._complete[key]]:
            count = sum(map(len, lost))
            self._report.missing.append(
                f"{self._name}: {count} rollouts that are in no complete episode, the first of "
                f"{lost[0][0]}"
            )

    def _note(self, text: str) -> None:
        self._report.notes.append(f"{self._name}: {text}")

    def _keep(self, episode: RecordedEpisode) -> None:
        """Note the rollouts of an episode, to be found in the training."""
        if episode.start is None or (episode.policy is None and not episode.exploratory):
            return
        policies = None if episode.policy is None else episode.policy.values
        for i, key in enumerate(_keys(episode.start.values, policies, episode.start.step)):
            place = f"episode {episode.name}, environment {i}"
            self._rollouts.setdefault(key, []).append(place)
            self._answered[key] += episode.cost is not None
            if not episode.missing:
                self._complete[key] += 1
        if episode.bases is not None:
            self._models[episode.bases.step] = episode.bases

    def _run_again(self, episode: RecordedEpisode, where: str) -> None:
        """The whole episode from its seeds, under its policies or its excitation."""
        assert episode.start is not None and episode.cost is not None
        self._recomputed += 1
        self._report.recomputed += 1
        report, plant, rows = self._report, self._pair.plant, episode.start.values
        states, actions = episode.trajectory()
        if states.shape[1:] != (len(rows), plant.state_size) or actions.shape[2] != plant.n_a:
            report.differs(f"{where}: states and actions do not have the plant's shape")
            return
        self._headers.check(episode, where)
        policies = None if episode.policy is None else episode.policy.values
        if episode.bases is not None:
            self._pair.use_models(episode.bases.values)
        if episode.exploratory or episode.bases is not None:
            law = self._pair.law(Batch(rows, None if episode.exploratory else policies))
        else:  # the models that the policies are about are in another bag
            law = lambda k, z: actions[k]  # noqa: E731
        seeds = rows[:, StartColumn.SEED].astype(np.int64)
        again = rollout(plant, law, seeds, noise_seeds(rows))
        report.compare("initial fields", f"z_0 of {where}", states[0], again.states[0])
        every = episode.state_every
        for what, name, step, recorded, computed in (
            ("actions", "a", range(len(actions)), actions, again.actions),
            (
                "steps",
                "z",
                range(every, len(again.states), every),
                states[1:],
                again.states[::every][1:],
            ),
        ):
            for k, own, other in zip(step, recorded, computed, strict=True):
                if not report.compare(what, f"{name}_{k} of {where}", own, other):
                    break
        costs = again.costs.rows()
        report.compare("costs", f"cost of {where}", episode.cost.values, costs)
        if episode.model is not None and (costs[:, CostColumn.ENDED] == COMPLETED).all():
            assert self._values is not None
            settings = DesignSettings.of(self._values)
            numbers = rows[:, StartColumn.MODEL].astype(int).tolist()
            # Where not all states were recorded, those between them are what was computed again.
            whole = states if every == 1 else again.states
            designed = design_each(whole, actions, numbers, plant.target, settings)
            for env, (model, own) in enumerate(zip(episode.model.values, designed, strict=True)):
                text = f"model of {where}, environment {env}"
                report.compare("rows of models", text, model, own)


class _Lost:
    """Counts the rollouts that a training asks for and that are in no complete episode.

    recorded: those of which something was recorded, complete: of which all was; everything: count from
    the training's beginning on, and not only from the first one that was recorded.
    """

    def __init__(
        self, recorded: Container[bytes], complete: Counter[bytes], *, everything: bool
    ) -> None:
        self._recorded, self._complete, self._begun = recorded, complete.copy(), everything
        self._lost: Counter[str] = Counter()
        self._since: Counter[str] = Counter()
        """Those since the last one that was recorded: they may come after the end of the recording."""

    def look(self, key: bytes, phase: str, *, again: bool) -> None:
        """Take the next rollout that the training asks for, in a phase of it.

        again: it asks for that one once more at its end, so that a recording which begins later can
        have it, too.
        """
        if again and not self._begun and self._complete[key] < 2:
            return
        if key in self._recorded:
            self._begun = True
            self.reach_end()
        if self._complete[key]:
            self._complete[key] -= 1
        elif self._begun:
            (self._lost if key in self._recorded else self._since)[phase] += 1

    def reach_end(self) -> None:
        """Count rollouts that should have been recorded by now."""
        self._lost += self._since
        self._since.clear()

    def text(self) -> str:
        """The missing rollouts in words; empty if there are none."""
        if not (total := self._lost.total()):
            return ""
        parts = ", ".join(f"{PURPOSES[phase]} {count}" for phase, count in self._lost.items())
        many = "1 rollout" if total == 1 else f"{total} rollouts"
        return f"{many} that the training asked for ({parts}), in no complete episode"


def _repeated(keys: Sequence[bytes], rows: Array, training: Training) -> set[bytes]:
    """The keys of a batch that the evaluation repeats: of the first rollout of every adaptation."""
    if training.phase != "adapt" or any(optimizer.tells for optimizer in training.optimizers):
        return set()
    firsts: dict[float, bytes] = {}
    for row, key in zip(rows, keys, strict=True):
        firsts.setdefault(float(row[StartColumn.MODEL]), key)
    return set(firsts.values())


def _keys(rows: Array, policies: Array | None, models: int) -> list[bytes]:
    """A key of each rollout, bit by bit: its seeds, and the policy if there is one.

    A policy stands with the number of the models it is about, as each exploration repeats the
    rollouts without control.
    """
    rows = np.ascontiguousarray(rows)
    if policies is None:
        return [row.tobytes() for row in rows]
    return [
        models.to_bytes(8, "little") + row.tobytes() + np.ascontiguousarray(policy).tobytes()
        for row, policy in zip(rows, policies, strict=True)
    ]
