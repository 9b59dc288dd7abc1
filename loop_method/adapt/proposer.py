# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Proposes the next policy of Gauss-Newton, a function of the remembered trajectories.

A proposal is of the first of three kinds that applies:

1. `sensed_step`: there are few point sensors, and a model of the field between them reproduces their
   readings. It also depends on the equation that was fitted before, with which the next fit begins.
2. `field_step`: a model of the whole field predicts the rollouts or, if the plant is chaotic, pieces of
   them.
3. `local_step`: always; local models of the plant agree on a direction.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.arrays import Array
from loop_method.adapt import field_step, local_step
from loop_method.adapt.base import Context, Record, State
from loop_method.adapt.belief import Belief
from loop_method.adapt.closed_loop import ClosedLoopProblem
from loop_method.adapt.final_comparison import Comparison, Laws, on_model
from loop_method.adapt.progress import noise_of
from loop_method.adapt.proposal import Proposal
from loop_method.adapt.sensed_loop import can_be_sensed
from loop_method.adapt.sensed_step import SensedProposals
from loop_method.adapt.settings import GaussNewtonSettings
from loop_method.adapt.trajectories import cleaned
from loop_method.adapt.verdict import Verdict
from loop_method.models.denoising import denoised


class Proposer:
    """Proposes policies for one problem.

    Parameters
    ----------
    context : Context
    policy : (n_a, 2 n_s) array
        Any policy of the training, for its shape.
    settings : GaussNewtonSettings, optional
        Constants.

    Attributes
    ----------
    loop : ClosedLoopProblem
        The closed loop and its cost.
    sensed : SensedProposals or None
        None where the states are not one reading of each of a few sensors.
    found : float
        Measurement noise that a model showed, and was not declared; 0: none.
    """

    found = 0.0

    def __init__(
        self, context: Context, policy: Array, settings: GaussNewtonSettings | None = None
    ) -> None:
        self._settings = settings = settings or GaussNewtonSettings()
        U = np.array(context.U, dtype=np.float64)
        target = np.array(context.target, dtype=np.float64)
        n_a, columns = policy.shape
        if U.ndim != 2 or columns != 2 * U.shape[1]:
            raise ValueError(
                f"a policy of shape {policy.shape} does not match a basis U of shape {U.shape}."
            )
        if target.shape != U.shape[:1]:
            raise ValueError(
                f"the target must have shape {U.shape[:1]}, but it has {target.shape}."
            )
        states, actions = context.exploration.states, context.exploration.actions
        if states.shape[1:] != target.shape or actions.shape[1:] != (n_a,):
            raise ValueError(
                f"the exploratory trajectory must have states of {target.size} and actions of "
                f"{n_a} numbers, but the shapes are {states.shape} and {actions.shape}."
            )
        self.loop = ClosedLoopProblem(
            U,
            target,
            context.state_weight,
            context.action_weight,
            context.horizon,
            context.action_set,
        )
        # Few readings cannot be denoised; the fits to them account for the noise.
        self._noise = 0.0 if context.sensors else context.noise
        self._context = replace(context, noise=self._noise)
        self._declared = self._noise
        self._cleaned: WeakKeyDictionary[Record, Record] = WeakKeyDictionary()
        exploration = Record(np.zeros_like(policy), np.inf, states, actions)
        self._measured = [exploration, *context.measured]
        self._before = [self._clean(record) for record in self._measured]
        self.sensed: SensedProposals | None = None
        # One component, of which each sensor's last reading is the state.
        if can_be_sensed(context):
            actuators = context.actuators(n_a)
            largest_cost = context.field_models.sensed_largest_cost
            largest_cost *= self.loop.cost_of(self._before[0])
            self.sensed = SensedProposals(
                self.loop,
                actuators,
                context.noise,
                largest_cost,
                context.field_models,
                settings,
            )

    def state(self) -> State:
        """What proposals depend on besides rollouts: the noise, and the equation between sensors."""
        noise = {"noise": np.array(self.found)} if self.found else {}
        return noise | ({"equation": self.sensed.equation.copy()} if self.sensed else {})

    def restore(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Continue from a checkpoint; ValueError if it is not one."""
        found = noise_of(state) if "noise" in state else 0.0
        if self.sensed:
            self.sensed.restore(state)
        self._take_noise(found)

    def _take_noise(self, noise: float) -> None:
        """Go on as if this measurement noise had been declared; 0: it was as declared."""
        if noise == self.found:
            return
        self.found, self._noise = noise, noise or self._declared
        self._context = replace(self._context, noise=self._noise)
        self._cleaned.clear()
        self._before = [self._clean(record) for record in self._measured]

    def propose(
        self,
        records: Sequence[Record],
        incumbents: Sequence[Record],
        compared: Sequence[Record | None],
        *,
        damping: float,
        accepted: bool,
        first: str | None = "",
    ) -> Proposal | None:
        """The next policy to try, or None if no model gives a finite step.

        Parameters
        ----------
        records : sequence of Record
            All remembered rollouts.
        incumbents : sequence of Record
            The rollouts of the incumbent on the current fields.
        compared : sequence of Record or None
            On the same fields: the candidate that was rejected last, or the previous incumbent.
        damping : float
            lambda.
        accepted : bool
            Whether the last candidate was accepted.
        first : str or None
            Kind of the model of the whole field to try first; None: try none.
        """
        measured, policy = self._measurements(records), incumbents[0].policy
        if self.sensed is not None:
            proposal = self.sensed.propose(self._data(records), policy, damping)
            if proposal is not None:
                return proposal
        believed, whole = "", False
        if first is not None:
            belief, whole = self._field_model(measured, first)
            if belief is not None:
                believed = belief.model.kind
                pairs = [] if accepted else zip(incumbents, compared, strict=True)
                rejected = [(self._clean(i), self._clean(o)) for i, o in pairs if o]
                if (
                    not rejected
                    or not whole
                    or field_step.agrees_with_rejections(self._context, belief, rejected)
                ):
                    known = self._without_noise(measured)
                    return field_step.propose(
                        self._context, belief, whole, known, policy, damping, self._settings
                    )
        # What was measured is denoised once it is known how noisy it is.
        data, loop = self._data(records), self.loop
        incumbents = [self._clean(record) for record in incumbents]
        compared = [other and self._clean(other) for other in compared]
        # A rollout counts less in a fit, the more it costs above the incumbent's.
        level = loop.mean_cost_of(incumbents)
        shares = [min(1.0, level / max(loop.cost_of(record), 1e-300)) ** 2 for record in data]
        proposal = local_step.propose(
            loop,
            data,
            shares,
            incumbents,
            compared,
            damping=damping,
            accepted=accepted,
            settings=self._settings,
        )
        return proposal and replace(proposal, believed=believed, whole=bool(believed) and whole)

    def comparison(
        self,
        laws: Laws,
        records: Sequence[Record],
        believed: str,
        numbers: Sequence[int],
        rng: np.random.Generator,
    ) -> Comparison | None:
        """The last rollouts on a model (`on_model`), or None if no model predicts rollouts as a whole.

        records : as for `propose`; believed : kind of the model to try first.
        """
        measured = self._measurements(records)
        belief, whole = self._field_model(measured, believed)
        if belief is None or not whole:
            return None
        known = self._without_noise(measured)
        return on_model(self._context, belief, laws, known, numbers, rng, self._settings)

    def verdict(
        self, last: Comparison, laws: Laws, before: Sequence[Record], fresh: Sequence[Record]
    ) -> Verdict:
        """The law to return, after the rollouts of a comparison.

        before, fresh : the remembered rollouts before, and those.
        """
        measured = self._measurements(before)
        every = self._without_noise([*measured, *fresh])
        known, new = every[: len(measured)], every[len(measured) :]
        return last.verdict(self._context, laws, known, new, self._settings.confidence)

    def _field_model(self, measured: Sequence[Record], first: str) -> tuple[Belief | None, bool]:
        """As `field_step.field_model`, whose noise counts from now on."""
        known = self._context, measured, first, self._settings
        belief, whole, noise = field_step.field_model(*known)
        if noise:
            self._take_noise(noise)
        return belief, whole

    def _data(self, records: Sequence[Record]) -> list[Record]:
        """All rollouts of more than a state, denoised."""
        every = (*self._before, *map(self._clean, records))
        return [record for record in every if len(record.states) > 1]

    def _measurements(self, records: Sequence[Record]) -> list[Record]:
        """All rollouts of more than a state, as they were measured."""
        return [r for r in (*self._measured, *records) if len(r.states) > 1]

    def _without_noise(self, measured: Sequence[Record]) -> list[Record]:
        if not self._noise:
            return list(measured)
        return cleaned(measured, self._noise, line=self._context.line)

    def _clean(self, record: Record) -> Record:
        """The denoised rollout."""
        if not self._noise:
            return record
        if record not in self._cleaned:  # every proposal asks for all remembered rollouts
            states = denoised(record.states, self._noise)
            self._cleaned[record] = replace(record, states=states)
        return self._cleaned[record]
