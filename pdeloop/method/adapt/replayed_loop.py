# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law with an observer on a model of the readings, which replays measured innovations.

An initial field is a row [x_0, e_0, .., e_{T-1}] (`pdeloop.method.models.readings`): where a rollout
began, and what in it no model foresaw. Under its own law it is the rollout again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.method.adapt.base import Record
from pdeloop.method.adapt.observed_loop import ObservedLoop
from pdeloop.method.design.lqt import DesignError, track_outputs
from pdeloop.method.models.readings import ReadingsModel


@dataclass(frozen=True, eq=False)
class ReplayedLoop(ObservedLoop):
    """Laws with an observer on a `ReadingsModel`; U and target are those of U^T y."""

    replays: ClassVar[bool] = True

    def beginnings(self, records: Sequence[Record]) -> Array:
        """[x_0, e] of each rollout; a shorter one continues without innovations."""
        model, found = self._readings, []
        for record in records:
            first, e = model.replay(record.states, record.actions)
            whole = np.zeros((self.horizon, e.shape[1]))
            whole[: len(e)] = e[: self.horizon]
            found.append(np.concatenate([first, whole.ravel()]))
        return np.stack(found)

    def curvature(self, own: Array) -> Array:
        """With R + B^T P B of the cost of the readings."""
        model = self._readings
        cost = Cost(
            len(model.C),
            model.n_a,
            1,
            state_weight=self.state_weight,
            action_weight=self.action_weight,
        )
        try:
            P = track_outputs(model.A, model.B, model.C, cost).P
            own = self.action_weight * np.eye(model.n_a) + model.B.T @ P @ model.B
        except DesignError:
            pass
        return super().curvature(own)

    @property
    def _readings(self) -> ReadingsModel:
        assert isinstance(self.model, ReadingsModel)
        return self.model

    def _start(self, fields: Array) -> Array:
        return fields[:, : self.model.n_z]

    def _innovations(self, fields: Array) -> Array:
        """e of each step."""
        return fields[:, self.model.n_z :].reshape(len(fields), -1, len(self._readings.C))

    def _disturbances(self, fields: Array) -> Array:
        moved: Array = self._innovations(fields) @ self._readings.G.T
        return moved

    def _outputs(self, z: Array) -> Array:
        v: Array = z @ self._readings.C.T
        return v

    def _pull_outputs(self, by_outputs: Array) -> Array:
        by_z: Array = by_outputs @ self._readings.C
        return by_z
