# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""With few point sensors: a law that is improved on a model of the field between them.

Applies where every sensor is read once and a model of the field reproduces the last rollouts' readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from loop_interfaces.field_models.sensed import SensedModel, fit_sensed, interpolated
from tuner_node.optimizers.base import Array, Record
from tuner_node.optimizers.fit import extended_basis
from tuner_node.optimizers.proposals.proposal import COMPARED, TRUST, Proposal, spread
from tuner_node.optimizers.selection import LOCAL
from tuner_node.optimizers.simulation import Loop, improve

# More point sensors than this are taken for a field.
MOST_SENSORS = 32


class SensedProposals:
    """Proposals from a model of the field between the sensors.

    Parameters
    ----------
    loop : Loop
        Its states are one reading of each sensor.
    before : sequence of Record
        What is known before the first rollout, the exploratory trajectory first.
    reproduced : float
        The relative error of the readings up to which the model is used.
    """

    def __init__(self, loop: Loop, before: Sequence[Record], reproduced: float) -> None:
        self._loop, self._before, self._reproduced = loop, before, reproduced

    def propose(self, data: Sequence[Record], policy: Array, damping: float) -> Proposal | None:
        """A law improved on the model, or None if the model does not reproduce the readings."""
        rollouts = self._chosen(data)
        model, fields, error = _fit(rollouts, self._first_model)
        if not error <= self._reproduced:
            return None
        loop, (sensors, n_s) = self._loop, self._loop.U.shape
        n = fields.shape[1]
        U = np.zeros((n, n_s))
        U[n // (2 * sensors) :: n // sensors] = loop.U
        between = replace(
            loop,
            U=U,
            target=interpolated(loop.target),
            state_weight=loop.state_weight * sensors / n,
        )
        own = dict(zip((record.states[0].tobytes() for record in rollouts), fields, strict=True))
        improved = improve(
            between,
            model,
            loop.theta(policy),
            spread(np.stack(list(own.values()))),
            extended_basis(U, [np.eye(n)], n),
            TRUST * damping,
        )
        candidate = loop.moved(policy, improved.theta - loop.theta(policy))
        return Proposal(candidate, improved.fall, 1, 0.0, error, model.name)

    @cached_property
    def _first_model(self) -> SensedModel:
        """From what is known before the first rollout, so that it is the same in a resumed training."""
        return _fit(self._chosen(self._before), None)[0]

    def _chosen(self, records: Sequence[Record]) -> list[Record]:
        """Whole rollouts, the newest, each once, and none that went far away."""
        loop, most = self._loop, LOCAL * self._loop.cost_of(self._before[0])
        whole = {
            record.states.tobytes(): record
            for record in records
            if len(record.actions) == loop.horizon and loop.cost_of(record) <= most
        }
        return list(whole.values())[-COMPARED:]


def _fit(rollouts: Sequence[Record], start: SensedModel | None) -> tuple[SensedModel, Array, float]:
    """The model, the initial fields, and the relative error of the readings."""
    readings = [record.acted_from for record in rollouts]
    return fit_sensed(readings, [record.actions for record in rollouts], start)
