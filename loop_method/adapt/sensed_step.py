# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""With few point sensors: a law that is improved on a model of the field between them.

Applies where every sensor is read once and a model of the field reproduces the last rollouts' readings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.arrays import Array
from loop_method.adapt.base import Record
from loop_method.adapt.closed_loop import ClosedLoop, ClosedLoopProblem
from loop_method.adapt.field_step import extrapolated_fields, improved
from loop_method.adapt.proposal import Proposal
from loop_method.adapt.sensed_loop import fit_rollouts, whole_rollouts
from loop_method.adapt.settings import GaussNewtonSettings
from loop_method.models.sensed import KIND, Actuators, interpolated, sensed_model
from loop_method.models.sensed_unknowns import unknowns, unknowns_of
from loop_method.models.settings import DEFAULTS, FieldModelSettings


class SensedProposals:
    """Proposals from a model of the field between the sensors.

    Parameters
    ----------
    loop : ClosedLoopProblem
        Its states are one reading of each sensor.
    actuators : Actuators
        What is declared of them.
    noise : float
        Standard deviation of the noise on every reading.
    largest_cost : float
        Mean stage cost of a rollout above which it is not fitted.
    settings : FieldModelSettings
        Constants of the fit and of the model's internal steps.
    own : GaussNewtonSettings, optional
        Constants of a step.

    Attributes
    ----------
    equation : (44 + n_a,) array
        The unknowns that the rollouts share, as they were fitted last; zero before.
    """

    def __init__(
        self,
        loop: ClosedLoopProblem,
        actuators: Actuators,
        noise: float,
        largest_cost: float,
        settings: FieldModelSettings = DEFAULTS,
        own: GaussNewtonSettings | None = None,
    ) -> None:
        self._loop, self._actuators, self._noise = loop, actuators, noise
        self._largest_cost, self._settings = largest_cost, settings
        self._own = own or GaussNewtonSettings()
        self.equation: Array = np.zeros(unknowns(len(actuators.centres)))

    def restore(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Continue from the `equation` of a checkpoint."""
        self.equation = unknowns_of(state, "equation", len(self._actuators.centres)).copy()

    def propose(self, data: Sequence[Record], policy: Array, damping: float) -> Proposal | None:
        """A law improved on the model, or None if the model does not reproduce the readings."""
        settings = self._settings
        newest = settings.sensed_newest
        rollouts = whole_rollouts(self._loop, data, self._largest_cost, newest)
        start = self.equation if self.equation.any() else None
        fitted = fit_rollouts(self._loop, rollouts, self._actuators, self._noise, start, settings)
        if fitted is None:
            return None
        shared, fields, error = fitted
        self.equation = shared
        reach = self._own.extrapolation
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
            loop.action_set,
            model=sensed_model(shared, sensors, self._actuators, reach * largest, settings),
            noise=self._noise,
        )
        own = dict(zip((record.states[0].tobytes() for record in rollouts), fields, strict=True))
        theta = between.theta(policy)
        wide = extrapolated_fields(np.stack(list(own.values())), reach)
        found = improved(between, theta, wide, damping, self._own)
        if found is None:
            return None
        candidate = between.policy(found[0], policy)
        return Proposal(candidate, found[1], 1, 0.0, error, KIND)
