# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`model_based` for a law that estimates the state from few readings: short steps from measured laws.

A linear model of the readings describes the plant near the fields of one law, and its innovations
change with the law. So a step stays close to its starting point, the law with the best measured cost,
and replays the innovations of its rollouts. Under its own law a rollout is reproduced exactly. Measured
costs alone decide.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.base import Record, Row
from pdeloop.method.adapt.belief import Belief
from pdeloop.method.adapt.model_based import ModelBased
from pdeloop.method.adapt.replay import best_measured, step
from pdeloop.method.adapt.settings import READINGS_TRUST
from pdeloop.method.laws.extended_kalman import ExtendedKalman


class ModelBasedReadings(ModelBased):
    """`ModelBased` on a model of the readings (`replayed_loop`)."""

    _unpredicted = "no model of the readings predicts the rollouts"
    _model_compares = False
    _about_target = False

    def _scheduled(self, own: int) -> int:
        """A law is rolled out no more often than judges it: steps are short."""
        return self._schedule.often(own)

    def _data(self) -> list[Record]:
        """All rollouts as they were measured: the model's filter knows their noise."""
        return self._measurements()

    def _predicted(self, added: Sequence[Record]) -> list[float]:
        """None: the model gives each rollout its own cost."""
        return []

    def _fields(self) -> Array:
        """Initial states of rollouts, with their innovations."""
        if self._progress.belief is None:
            return super()._fields()
        return self._progress.belief.loop(self._context).beginnings(self._data())

    def _replay(self, model: Belief | None, row: Row, final: bool) -> None:
        """More rollouts may determine a model."""
        row["reason"] = f"{self._unpredicted}; the law is kept"

    def _improve(self, belief: Belief, row: Row, final: bool) -> None:
        """A step from the law that measured best."""
        own = [record for record in self._records.all() if self._is_linear(record.policy)]
        best = best_measured(own, self._first)
        if not self._is_linear(self._progress.policy):
            self._progress.policy = best.copy()
        loop = belief.loop(self._context)
        fields = loop.beginnings(own)
        found = step(loop, fields, best, self._settings, READINGS_TRUST)
        if found is None:
            row["reason"] = "the improved law does not stay finite on the model; the law is kept"
        else:
            self._progress.policy, row["steps"] = found

    def _judge(self, row: Row) -> None:
        """Judge the law that measured best in place of the last one."""
        others = [
            record
            for record in self._records.all()
            if self._is_linear(record.policy) and not np.array_equal(record.policy, self._first)
        ]
        self._progress.policy = best_measured(others, self._progress.policy).copy()
        super()._judge(row)

    def _is_linear(self, policy: Array) -> bool:
        """False of a law on an estimate of the field, which a model of the readings does not have."""
        law = self._context.law
        return not (isinstance(law, ExtendedKalman) and law.estimates(policy))
