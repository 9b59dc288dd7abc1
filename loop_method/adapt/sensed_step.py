# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""With few point sensors: a law that is improved on a model of the field between them.

Applies where every sensor is read once and a model of the field reproduces the last rollouts' readings.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loop_interfaces.arrays import Array
from loop_method.adapt.base import Record
from loop_method.adapt.closed_loop import ClosedLoop, ClosedLoopProblem
from loop_method.adapt.field_step import COMPARED, EXTRAPOLATION, extrapolated_fields, improved
from loop_method.adapt.proposal import Proposal
from loop_method.models.sensed import KIND, SHARED, interpolated, sensed_model
from loop_method.models.sensed_fit import fit_sensed
from loop_method.models.settings import DEFAULTS, FieldModelSettings

# The readings are reproduced up to this share of their sum of squares.
_REPRODUCED = 0.05
# More point sensors than this are taken for a field.
MOST_SENSORS = 32


class SensedProposals:
    """Proposals from a model of the field between the sensors.

    Parameters
    ----------
    loop : ClosedLoopProblem
        Its states are one reading of each sensor.
    centres : (n_a,) array
        Of the actuators, as shares of the domain.
    noise : float
        Standard deviation of the noise on every reading.
    largest_cost : float
        Mean stage cost of a rollout above which it is not fitted.
    settings : FieldModelSettings
        Constants of the model's internal steps.

    Attributes
    ----------
    equation : (12,) array
        The unknowns that the rollouts share, as they were fitted last; zero before.
    """

    def __init__(
        self,
        loop: ClosedLoopProblem,
        centres: Array,
        noise: float,
        largest_cost: float,
        settings: FieldModelSettings = DEFAULTS,
    ) -> None:
        self._loop, self._centres, self._noise = loop, centres, noise
        self._largest_cost, self._settings = largest_cost, settings
        self.equation: Array = np.zeros(SHARED)

    def propose(self, data: Sequence[Record], policy: Array, damping: float) -> Proposal | None:
        """A law improved on the model, or None if the model does not reproduce the readings."""
        rollouts = self._chosen(data)
        starts = (self.equation, None) if self.equation.any() else (None,)
        for start in starts:
            shared, fields, error = self._fit(rollouts, start)
            if error <= _REPRODUCED:
                break
        else:
            return None
        self.equation = shared
        loop, (sensors, n_s) = self._loop, self._loop.U.shape
        n, largest = fields.shape[1], float(np.abs(fields).max())
        U = np.zeros((n, n_s))
        U[n // (2 * sensors) :: n // sensors] = loop.U
        between = ClosedLoop(
            U,
            interpolated(loop.target),
            loop.state_weight * sensors / n,
            loop.action_weight,
            loop.horizon,
            loop.action_limit,
            model=sensed_model(
                shared, sensors, self._centres, EXTRAPOLATION * largest, self._settings
            ),
            noise=self._noise,
        )
        own = dict(zip((record.states[0].tobytes() for record in rollouts), fields, strict=True))
        theta = between.theta(policy)
        found = improved(between, theta, extrapolated_fields(np.stack(list(own.values()))), damping)
        if found is None:
            return None
        candidate = between.policy(found[0], policy)
        return Proposal(candidate, found[1], 1, 0.0, error, KIND)

    def _chosen(self, records: Sequence[Record]) -> list[Record]:
        """Whole rollouts, the newest, each once, and none that went far away."""
        loop = self._loop
        whole = {
            record.states.tobytes(): record
            for record in records
            if len(record.actions) == loop.horizon and loop.cost_of(record) <= self._largest_cost
        }
        return list(whole.values())[-COMPARED:]

    def _fit(self, rollouts: Sequence[Record], start: Array | None) -> tuple[Array, Array, float]:
        """The shared unknowns, the initial fields, and the relative error of the readings."""
        readings = [record.acted_from for record in rollouts]
        actions = [record.actions for record in rollouts]
        return fit_sensed(
            *(readings, actions, self._centres, self._noise, start),
            self._loop.target,
            np.array([self._distance(record) for record in rollouts]),
        )

    def _distance(self, record: Record) -> float:
        """Mean of (z - z_r)^2, from the cost; NaN where it tells none, as after the exploration."""
        loop = self._loop
        acting = loop.action_weight * float(np.sum(record.actions**2)) / len(record.actions)
        distance = (record.cost - acting) / (loop.state_weight * len(loop.target))
        return distance if record.usable and distance > 0.0 else np.nan
