# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`model_based` for a law that plans from an estimate: `model_based_predictive` with few sensors.

The law `extended_kalman` is trained as ever. Plans start from the estimate of its filter, on the
equation of that, and are simulated with it and with noise on the readings. Where the trained law has no
filter, one is designed as for it. An equation that reproduces the readings may be wrong where no sensor
is: the last rollouts are on fields of the trained law, and these pairs decide.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.base import Record, Rollout, RolloutResult, Row
from pdeloop.method.adapt.belief import Belief
from pdeloop.method.adapt.estimated_loop import estimated_laws, least_trusting
from pdeloop.method.adapt.improve import cheapest
from pdeloop.method.adapt.model_based_predictive import Candidate, ModelBasedPredictive
from pdeloop.method.adapt.sensed_loop import SensedLoop, sensed_loop
from pdeloop.method.adapt.verdict import PREDICTIVE, Evidence, evidence_of_pairs
from pdeloop.method.laws.extended_kalman import ExtendedKalman
from pdeloop.method.laws.plans import Planner
from pdeloop.method.laws.predictive import PredictiveKalman
from pdeloop.method.models.sensed import SensedModel


class ModelBasedPredictiveSensed(ModelBasedPredictive):
    """`ModelBasedPredictive` for the law `predictive_kalman`."""

    @property
    def _kalman(self) -> ExtendedKalman:
        assert isinstance(self._law, PredictiveKalman)
        return self._law.kalman

    def _unplanned(self, belief: Belief) -> str:
        if isinstance(belief.model, SensedModel):
            return ""
        return "no equation of the field reproduces the readings"

    def _compared(self, belief: Belief) -> Array | None:
        """The trained law if it acts on an estimate, else the best one that is designed to."""
        policy = np.ravel(self._affine.policy)
        if self._kalman.estimates(policy):
            return policy
        loop, fields = self._loop(belief), self._affine.fields
        weights = np.full(len(fields), 1.0 / len(fields))
        models = self._context.field_models
        laws, _ = estimated_laws(loop, self._kalman, fields, weights, self._settings, models)
        if not laws:
            return None
        best = cheapest(loop, laws, fields, weights)
        return least_trusting(loop, self._kalman, best, fields, self._settings)

    def _loop(self, belief: Belief) -> SensedLoop:
        assert isinstance(belief.model, SensedModel)
        return sensed_loop(self._context, belief.model)

    def _feedback(self, policy: Array) -> tuple[Array, Array]:
        parts = self._kalman.parts(np.ravel(policy))
        return np.ascontiguousarray(parts["K_e"]), parts["b"]

    def _costs(self, belief: Belief, policy: Array, planner: Planner, fields: Array) -> Array:
        return simulated_from_estimates(self._loop(belief), self._kalman, policy, planner, fields)

    def _seeds(self) -> list[int]:
        """Those of fields of the trained law, and further ones where it has fewer."""
        known = list(dict.fromkeys(own.field_seed for own in self._of_base()))
        return [*known, *super()._seeds()][: self._left]

    def _of_base(self) -> list[Record]:
        """The rollouts of the law to stay with."""
        policy = self._affine.policy
        return [own for own in self._affine.records if np.array_equal(own.policy, policy)]

    def _evidence(
        self,
        candidate: Candidate,
        belief: Belief,
        base: str,
        asked: Sequence[Rollout],
        results: Sequence[RolloutResult],
        row: Row,
    ) -> Mapping[str, Evidence]:
        """Means over pairs from the same initial fields."""
        row["predicted"] = float(np.mean(candidate.costs))
        known = {own.field_seed: own.cost for own in self._of_base()}
        pairs = [
            (result.cost if result.usable else np.inf, known[own.field_seed])
            for own, result in zip(asked, results, strict=True)
            if own.field_seed in known
        ]
        own, others = np.array(pairs).reshape(-1, 2).T
        return evidence_of_pairs({base: others, PREDICTIVE: own}, base)


def simulated_from_estimates(
    loop: SensedLoop, law: ExtendedKalman, theta: Array, planner: Planner, fields: Array
) -> Array:
    """Mean stage costs (F,) of plans from estimates on the model, from initial fields (F, n).

    law, theta: whose filter estimates, from readings with the model's noise.
    """
    model, T, count = loop.model, loop.horizon, len(fields)
    assert isinstance(model, SensedModel)
    known = law.filter(law.parts(theta))
    if known is None:
        return np.full(count, np.inf)
    noise = loop.noise * np.random.default_rng(0).standard_normal((T, count, model.sensors))
    z, a, cost, totals = fields, None, planner.cost, np.zeros(count)
    plan = np.zeros((count, planner.steps, len(planner.b)))
    x, S = (np.repeat(part[None], count, axis=0) for part in known.start)
    with np.errstate(all="ignore"):
        for k in range(T):
            x, S = known.measured(x, S, z[:, model.seen] + noise[k])
            a, plan, _ = planner.step(plan, planner.after(x, a), k)
            plan = planner.shifted(plan)
            cost.add(totals, z, a, k)
            z = model.step(z, a)
            x, S = known.predicted(x, S, a)
            lost = ~(np.isfinite(z).all(axis=1) & np.isfinite(x).all(axis=1) & np.isfinite(totals))
            totals[lost] = np.inf
            for part in (z, x, S, a):
                part[lost] = 0.0
        cost.add_terminal(totals, z)
    totals[~np.isfinite(totals)] = np.inf
    found: Array = totals / T
    return found
