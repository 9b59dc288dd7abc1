# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop bag verify`: computes a recorded run again and compares it bit by bit.

The target is the plant's. Every complete episode is run again from its seeds, policies and models (or
the excitation's seed): initial fields, actions, states, costs, and the reduced model after exploration.
The whole training is run again, too: every recorded policy, with its models, must be one that it asks
for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from controller_node.identification import DesignSettings, design
from loop_interfaces import model_rows
from loop_interfaces.arrays import Array
from loop_interfaces.frames import Frame
from loop_interfaces.parameters import PLANT, recorded_values, with_budget
from loop_interfaces.spec import ParameterError, read_yaml
from loop_interfaces.topics import COMPLETED, CostColumn, StartColumn, noise_seeds
from pdeloop.bags.episodes import RecordedEpisode
from pdeloop.bags.reader import bags_of
from pdeloop.episode import rollout
from pdeloop.in_process import LocalPair
from tuner_node.batch import Batch
from tuner_node.build import build_training

_TUNERS = ("seed", "seeds", "rollouts", "iterations", "start", "optimizer")
SHOWN = 5
"""Differences that are described; the others are only counted."""


@dataclass
class Report:
    """What was compared, and what differs."""

    bag: str
    episodes: int = 0
    compared: dict[str, int] = field(default_factory=dict)
    differences: list[str] = field(default_factory=list)
    count: int = 0
    incomplete: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def count_compared(self, what: str, number: int) -> None:
        """Note that so many of something were compared."""
        self.compared[what] = self.compared.get(what, 0) + number

    def differs(self, text: str) -> None:
        """Note a difference."""
        self.count += 1
        if len(self.differences) < SHOWN:
            self.differences.append(text)

    def compare(self, what: str, where: str, recorded: Array, again: Array) -> bool:
        """Count a comparison of two arrays and note the first entry that differs."""
        self.count_compared(what, len(recorded))
        if recorded.shape != again.shape:
            self.differs(f"{where}: recorded shape {recorded.shape}, recomputed {again.shape}")
            return False
        a = np.ascontiguousarray(recorded).view(np.uint64)
        b = np.ascontiguousarray(again).view(np.uint64)
        if np.array_equal(a, b):
            return True
        index = tuple(int(i) for i in np.argwhere(a != b)[0])
        self.differs(
            f"{where}, entry {list(index)}: recorded {float(recorded[index])!r}, "
            f"recomputed {float(again[index])!r}"
        )
        return False

    def text(self) -> str:
        """The report for people."""
        lines = [f"{self.bag}: {self.episodes} episodes"]
        if self.compared:
            parts = ", ".join(f"{n} {what}" for what, n in self.compared.items())
            lines.append(f"  recomputed {parts}")
        lines += [f"  {note}" for note in self.notes]
        lines += [f"  incomplete: {text}" for text in self.incomplete[:SHOWN]]
        if len(self.incomplete) > SHOWN:
            lines.append(f"  and {len(self.incomplete) - SHOWN} more incomplete episodes")
        if self.differences:
            lines.append(f"  {self.count} differences; the first: {self.differences[0]}")
            lines += [f"    {text}" for text in self.differences[1:]]
        elif self.compared:
            lines.append("  no difference, to the bit")
        return "\n".join(lines)


def verify(*paths: Path, parameters: Path | None = None) -> Report:
    """Recompute what was recorded in the folders of bags, or of runs with all their bags.

    Several bags of one run are one. parameters: a file to use instead of what the bags say.
    BagError for a bag that cannot be read, ParameterError for parameters that describe no plant of
    this version.
    """
    bags = [bag for path in paths for bag in bags_of(path)]
    report = Report(", ".join(str(bag.path) for bag in bags))
    given = None if parameters is None else read_yaml(parameters)
    runs: dict[int, _Run] = {}
    for bag in bags:
        known, target = bag.parameters(), bag.target()
        for episode in bag.episodes():
            report.episodes += 1
            number = episode.key[1]
            if number not in runs:
                values = _complete(known.get(number)) if given is None else given
                runs[number] = _Run(number, values, report, target)
            runs[number].episode(episode)
    for run in runs.values():
        run.finish()
    if not report.episodes:
        report.notes.append("no episode of the loop is in this bag")
    return report


def equations(*paths: Path, parameters: Path | None = None) -> list[str]:
    """The equations that `verify` runs with the same arguments, as far as they are known."""
    if parameters is not None:
        known = [read_yaml(parameters)]
    else:
        known = [
            run for path in paths for bag in bags_of(path) for run in bag.parameters().values()
        ]
    return sorted({str(values["equation"]) for values in known if "equation" in values})


def _complete(values: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    """The parameters of a run, None without those that only its plant can tell."""
    told = values is not None and any(spec.name in values for spec in PLANT)
    return values if told else None


class _Run:
    """The episodes of one run, and what they must be."""

    def __init__(
        self,
        number: int,
        values: Mapping[str, Any] | None,
        report: Report,
        target: Array | None,
    ) -> None:
        self._name, self._report = f"run {number}", report
        self._rollouts: dict[bytes, list[str]] = {}
        """What was recorded, in words, by what identifies a rollout (`_keys`)."""
        self._models: dict[int, Frame] = {}
        """The models that policies are about, by their number."""
        self._values: dict[str, Any] | None = None
        if values is None:
            self._note(
                "its parameters are not in the bag, so nothing is recomputed "
                "(give them with --parameters FILE)"
            )
            return
        self._given = set(values)
        try:
            self._values = with_budget(recorded_values(values))
        except ParameterError as error:
            raise ParameterError(f"{self._name}: {error}") from error
        self._pair = LocalPair(self._values)
        self._fingerprint = self._pair.fingerprint
        self._same_plant = True
        if target is not None:
            own = self._pair.plant.target[np.newaxis]
            report.compare("targets", f"target of {self._name}", target[np.newaxis], own)

    def episode(self, episode: RecordedEpisode) -> None:
        """Check one episode."""
        report, where = self._report, f"episode {episode.name}"
        for text in episode.contradictions:
            report.differs(f"{where}: {text}")
        if episode.void:
            return
        if episode.missing:
            report.incomplete.append(f"{where} lacks {', '.join(episode.missing)}")
        if self._values is None or episode.start is None or episode.cost is None:
            return
        if self._same_plant and episode.cost.plant != self._fingerprint:
            self._same_plant = False
            self._note(
                f"recorded with another fingerprint of the plant ({episode.cost.plant}; here it is "
                f"{self._fingerprint}): its parameters or the source of its equation are others. "
                "What it computes is compared all the same"
            )
        self._keep(episode)
        if not episode.missing:
            self._run_again(episode, where)

    def finish(self) -> None:
        """Run the training again, until it has asked for all that was recorded."""
        if self._values is None or not self._rollouts:
            return
        if unknown := [name for name in _TUNERS if name not in self._given]:
            self._note(
                f"the tuner's {', '.join(unknown)} not known, so its policies cannot be followed"
            )
            return
        training = build_training({**self._values, "plant": self._fingerprint})
        pair = LocalPair(self._values, self._pair.plant)
        pair.follow(training)
        unseen = dict(self._rollouts)
        while unseen and (batch := training.next_batch()) is not None:
            for key in _keys(batch.rows, batch.policies, training.generation):
                found = len(unseen.pop(key, ()))
                if not batch.exploratory:
                    self._report.count_compared("policies", found)
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
                return
            pair.follow(training)
        for places in unseen.values():
            for place in places:
                self._report.differs(f"policy of {place}: the training asks for none like it")

    def _note(self, text: str) -> None:
        self._report.notes.append(f"{self._name}: {text}")

    def _keep(self, episode: RecordedEpisode) -> None:
        """Note what the rollouts of an episode were, to be looked for in the training."""
        assert episode.start is not None
        if episode.policy is None and not episode.exploratory:
            return
        policies = None if episode.policy is None else episode.policy.values
        for i, key in enumerate(_keys(episode.start.values, policies, episode.start.step)):
            place = f"episode {episode.name}, environment {i}"
            self._rollouts.setdefault(key, []).append(place)
        if episode.bases is not None:
            self._models[episode.bases.step] = episode.bases

    def _run_again(self, episode: RecordedEpisode, where: str) -> None:
        """The whole episode from its seeds, under its policies or its excitation."""
        assert episode.start is not None and episode.cost is not None
        report, plant, rows = self._report, self._pair.plant, episode.start.values
        states, actions = episode.trajectory()
        if states.shape[1:] != (len(rows), plant.state_size) or actions.shape[2] != plant.n_a:
            report.differs(f"{where}: states and actions do not have the plant's shape")
            return
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
        for what, name, first, recorded, computed in (
            ("actions", "a", 0, actions, again.actions),
            ("steps", "z", 1, states[1:], again.states[1:]),
        ):
            for k in range(len(recorded)):
                text = f"{name}_{k + first} of {where}"
                if not report.compare(what, text, recorded[k], computed[k]):
                    break
        costs = again.costs.rows()
        report.compare("costs", f"cost of {where}", episode.cost.values, costs)
        if episode.model is not None and (costs[:, CostColumn.ENDED] == COMPLETED).all():
            assert self._values is not None
            settings = DesignSettings.of(self._values)
            for env, model in enumerate(episode.model.values):
                own = design([(states[:, env], actions[:, env])], plant.target, settings)
                text = f"model of {where}, environment {env}"
                report.compare("rows of models", text, model, model_rows.pack(own))


def _keys(rows: Array, policies: Array | None, models: int) -> list[bytes]:
    """What identifies each rollout, bit by bit: its seeds, and the policy if there is one.

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
