# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The model of the whole field that measured rollouts speak for, and how well it predicts them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from loop_method.adapt.base import Context, Record
from loop_method.adapt.closed_loop import ClosedLoop
from loop_method.models import FieldModel, FittedModel, Measured, affine_law, fit_field_model

MOST_COMPONENTS = 2
"""Fields one after the other in a state, as many as are tried."""


@dataclass(frozen=True, eq=False)
class Belief:
    """A model, its error E on rollouts that it was not fitted to, and its components."""

    model: FieldModel
    error: float
    components: int

    def loop(self, context: Context) -> ClosedLoop:
        """The model under laws on the context's basis."""
        return ClosedLoop(
            self.model,
            context.U,
            context.target,
            context.state_weight,
            context.action_weight,
            context.horizon,
            context.action_limit,
            context.noise,
            context.cost,
        )


def believe(
    context: Context, records: Sequence[Record], last: Belief | None, enough: float
) -> Belief | None:
    """The model that predicts the rollouts best, or None where none can be fitted.

    Parameters
    ----------
    context : Context
        The law's basis and target.
    records : sequence of Record
        Explorations, whose policy is zero and whose cost is infinite, and rollouts of laws.
    last : Belief or None
        What was believed before, of whose kind the first model is.
    enough : float
        E above which a state of several components is tried.
    """
    rollouts = [_measured(context, record) for record in records if len(record.actions)]

    def fitted(components: int) -> FittedModel | None:
        return fit_field_model(
            rollouts,
            context.target,
            components=components,
            noise=context.noise,
            action_limit=context.action_limit,
            first=last.model.kind if last else None,
            line=context.line,
        )

    counts = list(range(1, MOST_COMPONENTS + 1))
    if last is not None:
        counts.sort(key=lambda count: count != last.components)
    best: Belief | None = None
    for components in counts:
        if context.target.size % components:
            continue
        found = fitted(components)
        if found is not None and (best is None or found.error < best.error):
            two = found.model.kind.startswith("two-")
            best = Belief(found.model, found.error, 2 if two else components)
        if best is not None and best.error <= enough:
            break
    return best


def _measured(context: Context, record: Record) -> Measured:
    """With the law, where the rollout was under one whose states are known without noise."""
    explored = not record.policy.any()  # of no control too the actions say everything
    if explored or context.noise:
        return Measured(record.states, record.actions)
    n_s = context.U.shape[1]
    K = record.policy[:, :n_s] @ context.U.T
    b = record.policy[:, n_s:] @ (context.U.T @ context.target)
    return Measured(record.states, record.actions, affine_law(K, b))
