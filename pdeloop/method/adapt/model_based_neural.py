# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`model_based` for the law `neural`: first the affine law, then a network beside it, and rollouts.

The plans that the law `predictive` would use on the same model are what the network imitates first
(`network`). The last rollouts are of the law with the network, from fresh fields, and replace the
affine law only if it is better by more than chance (`verdict`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.base import Context, Row
from pdeloop.method.adapt.belief import Belief
from pdeloop.method.adapt.improve import curvature_of
from pdeloop.method.adapt.model_based_predictive import Candidate, ModelBasedPredictive, share_saved
from pdeloop.method.adapt.network import HELD_OUT, Network, NetworkTraining, acting
from pdeloop.method.adapt.verdict import NEURAL
from pdeloop.method.laws.neural import Neural
from pdeloop.method.laws.plans import Act, Planner, simulated
from pdeloop.method.laws.predictive import Predictive

_STREAM = 0x4E4554  # "NET"


class ModelBasedNeural(ModelBasedPredictive):
    """`ModelBased`, and then the law `neural` on its model; parameters as there."""

    candidate = NEURAL

    def __init__(
        self, policy0: ArrayLike, *, context: Context | None = None, **others: Any
    ) -> None:
        if context is None or not isinstance(context.law, Neural):
            raise ValueError("this optimiser needs a context with the law neural")
        self._neural = context.law
        plans = Predictive(self._neural.model, self._neural.horizon)
        plans.cost = self._neural.cost
        super().__init__(policy0, context=replace(context, law=plans), **others)

    def _made(self, belief: Belief, row: Row) -> Candidate | str:
        """The law with the network of this model; or why there is none."""
        policy, context, own = self._affine.policy, self._context, self._neural
        fields, _ = self._simulated(belief, policy)
        planner, _ = self._planner(belief, policy, fields)
        K, b = own.feedback(own.without.parts(np.ravel(policy)))
        loop, every = belief.loop(context), self._affine.fields
        costs, states, _ = simulated(planner, every, self._acts(planner, policy, loop.noise))
        known = np.isfinite(costs)
        if not (known.any() and costs[known].any()):
            return f"the law {own.without.name} does not stay finite on the model, or costs nothing"
        network = Network.of(
            context.U,
            K,
            b,
            states[known].reshape(-1, states.shape[2]),
            curvature_of(loop),
            float(costs[known].mean()),
            own.settings.neurons,
        )
        training = NetworkTraining(
            network,
            planner,
            every,
            [self._seed, _STREAM, self._count],
            belief.components,
            periodic=context.periodic,
            noise=loop.noise,
        )
        numbers = training.trained(own.settings.iterations)
        every = np.concatenate([every, training.drawn(HELD_OUT)])
        before = simulated(planner, every, self._acts(planner, policy, loop.noise))[0]
        after = training.costs(numbers, every)
        row["network_saves"] = share_saved(after, before)
        if not np.sum(after) < np.sum(before):
            return "on the model no network is better"
        return Candidate(own.theta_of(policy, *network.folded(numbers)), after, before)

    def _acts(self, planner: Planner, theta: Array, noise: float) -> Act:
        """The law of a theta in simulations."""
        own, parts = self._neural, self._neural.parts(np.ravel(theta))

        def law(z: Array, k: int) -> Array:
            return np.stack([own.action(parts, row, np.zeros(0), k) for row in z])

        return acting(planner, law, noise)

    def _check(self, theta: Array) -> None:
        self._neural.layers(self._neural.parts(theta)["network"])

    def _costs_of(self, theta: Array, belief: Belief, fields: Array) -> Array:
        planner = self._plain(belief, self._affine.policy, self._affine.fields)
        noise = belief.loop(self._context).noise
        return simulated(planner, fields, self._acts(planner, theta, noise))[0]
