# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The training without ROS: the same plant, controller and training code, called directly.

It gives the bit-identical policy of the loop over topics, because every number is made by the same
pure functions from the same float64 arrays; only the transport is missing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from controller_node.identification import DesignSettings, design_each
from controller_node.law_batch import LawBatch
from controller_node.policy import excitations
from pde_sim_node.build import build_plant
from pde_sim_node.plant import Plant
from pdeloop.episode import EpisodeRecord, Law, rollout
from pdeloop.messages import model_rows
from pdeloop.messages.arrays import Array
from pdeloop.messages.topics import CostColumn, StartColumn, noise_seeds
from pdeloop.method.laws.registry import law_kind, laws_of
from tuner_node.batch import Batch, BatchResult, NoModelError, most_environments
from tuner_node.chunk import Chunk, ChunkQueue, gathered
from tuner_node.pair import cut
from tuner_node.training import Training

Report = Callable[[Mapping[str, Any]], None]


class LocalPair:
    """A plant, of this fingerprint, and a controller in this process."""

    def __init__(self, values: Mapping[str, Any], plant: Plant | None = None) -> None:
        self.plant = plant or build_plant(values)
        self.fingerprint = self.plant.definition.fingerprint
        self._settings = DesignSettings.of(values)
        self._kind = law_kind(self._settings.law, self._settings.constants)
        self._law: LawBatch | None = None
        self._generation = 0

    def follow(self, training: Training) -> None:
        """Use the models of a training, if they are others than before."""
        if training.ready and self._generation != training.generation:
            assert training.models is not None
            self._generation = training.generation
            self.use_models(training.models)

    def use_models(self, models: Array) -> None:
        """Take the reduced models (S, rows, n_s) that policies refer to."""
        unpacked = [
            model_rows.unpack(rows, self._settings.n_a, self._kind.filtered) for rows in models
        ]
        laws = laws_of(self._kind, unpacked, self._settings.horizon, self._settings.measured_cost)
        self._law = LawBatch(laws, self.plant.target, self._settings.action_set)

    def run(self, batch: Batch, max_batch: int = 1024) -> BatchResult:
        """Roll the batch out. NoModelError if exploration gives no model though no rollout diverged."""
        plant, batch = self.plant, batch.within(max_batch)
        largest = most_environments(max_batch, plant.state_size, plant.horizon)
        chunks = ChunkQueue(batch, largest, pairs=1).waiting
        for chunk in chunks:
            self._carry_out(chunk, batch)
        return gathered(chunks, batch, self.fingerprint, plant.target)

    def roll_out(self, batch: Batch) -> EpisodeRecord:
        """The episode of a batch; states and actions of one that is exploratory or asks for them."""
        seeds = batch.rows[:, StartColumn.SEED].astype(np.int64)
        keep = batch.exploratory or batch.trajectories
        return rollout(self.plant, self.law(batch), seeds, noise_seeds(batch.rows), keep=keep)

    def _carry_out(self, chunk: Chunk, batch: Batch) -> None:
        policies = None if batch.policies is None else batch.policies[chunk.rows]
        episode = self.roll_out(replace(batch, rows=batch.rows[chunk.rows], policies=policies))
        chunk.costs, chunk.steps = episode.costs.rows(), self.plant.horizon
        if batch.trajectories:
            ended = chunk.costs[:, CostColumn.ENDED]
            chunk.trajectories = cut(episode.states, episode.actions, ended)
        if not (batch.exploratory and chunk.completed):
            return
        numbers = batch.rows[chunk.rows, StartColumn.MODEL].astype(int).tolist()
        try:
            chunk.models = design_each(
                episode.states, episode.actions, numbers, self.plant.target, self._settings
            )
        except np.linalg.LinAlgError:
            raise
        except ValueError as error:
            raise NoModelError(f"no reduced model: {error}") from error

    def law(self, batch: Batch) -> Law:
        """Every environment's policy on the model that it belongs to, or its excitation."""
        if batch.policies is not None:
            law = self._law
            assert law is not None
            law.set(batch.policies, batch.rows[:, StartColumn.MODEL].astype(np.int64))
            return law.actions
        n_a, admissible = self._settings.n_a, self._settings.action_set
        return lambda k, states: excitations(batch.rows, k, n_a, admissible)


def train(
    training: Training,
    pair: LocalPair,
    report: Report,
    *,
    max_batch: int = 1024,
    after_batch: Callable[[], None] = lambda: None,
) -> None:
    """Run `training` to its end on `pair`."""
    for _ in batches(training, pair, report, max_batch=max_batch):
        after_batch()


def batches(
    training: Training, pair: LocalPair, report: Report, *, max_batch: int = 1024
) -> Iterator[None]:
    """The same, batch by batch."""
    pair.follow(training)
    phase = ""
    while True:
        batch = training.next_batch()
        if training.phase != phase:
            phase = training.phase
            report({"event": "phase", "phase": phase, **training.progress})
        if batch is None:
            return
        result = pair.run(batch, max_batch)
        for row in training.batch_costs(result):
            report(row)
        for row in training.finish(result):
            report(row)
        pair.follow(training)
        yield


def episodes(training: Training, values: Mapping[str, Any]) -> Iterator[EpisodeRecord]:
    """The episodes of a training, which is run to its end on the way."""
    pair = _KeepingPair(values)
    for _ in batches(training, pair, lambda row: None, max_batch=values["max_batch"]):
        yield from pair.kept
        pair.kept.clear()


class _KeepingPair(LocalPair):
    """Keeps the states and actions of every episode."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        super().__init__(values)
        self.kept: list[EpisodeRecord] = []

    def roll_out(self, batch: Batch) -> EpisodeRecord:
        seeds = batch.rows[:, StartColumn.SEED].astype(np.int64)
        self.kept.append(rollout(self.plant, self.law(batch), seeds, noise_seeds(batch.rows)))
        return self.kept[-1]
