# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The model of the whole field that is selected by measured rollouts, and its prediction error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdeloop.method.adapt.base import Context, Record, State, numbers_of, part_of
from pdeloop.method.adapt.closed_loop import ClosedLoop, LinearLoop, ReplayedLoop
from pdeloop.method.adapt.sensed_loop import sensed_loop
from pdeloop.method.laws.linear import Observer, at_step
from pdeloop.method.models import FieldModel, Measured, affine_law
from pdeloop.method.models.base import FAR, model_of
from pdeloop.method.models.linear import ReadingsModel, fit_readings
from pdeloop.method.models.selection import Selection
from pdeloop.method.models.sensed import SensedModel

_MODEL = "model."
_NUMBERS = {"error": "f", "whole": "b"}
"""What is one number of a checkpoint, and its NumPy kind."""


@dataclass(frozen=True, eq=False)
class Belief:
    """A model of the plant, and its E on rollouts that it was not fitted to.

    whole: False where it predicts only pieces of rollouts, of a chaotic plant; noise: that it was
    fitted for in place of the declared one, or 0; accepted: whether laws are improved on it.
    """

    model: FieldModel
    error: float
    whole: bool = True
    noise: float = 0.0
    accepted: bool = True

    def state(self) -> State:
        """The model and its error, as the arrays of a checkpoint."""
        arrays = {_MODEL + name: value for name, value in self.model.arrays().items()}
        return arrays | {name: np.array(getattr(self, name)) for name in _NUMBERS}

    @classmethod
    def of(cls, state: Mapping[str, NDArray[np.generic]]) -> Belief | None:
        """The belief in a checkpoint, None where it has none; ValueError for arrays of no model."""
        if "error" not in state:
            return None
        return cls(model_of(part_of(state, _MODEL)), **numbers_of(state, _NUMBERS, finite=False))

    @property
    def components(self) -> int:
        """Fields in a state."""
        return 2 if self.model.kind.startswith("two-") else 1

    def check(self, context: Context) -> None:
        """ValueError if the model has another plant's size, which compiled code does not check."""
        n_a = context.exploration.actions.shape[1]
        known, expected = (self.model.n_z, self.model.n_a), (len(context.target), n_a)
        own_state = isinstance(self.model, (ReadingsModel, SensedModel))
        if known[1] != n_a or (not own_state and known != expected):
            raise ValueError(f"its model has sizes {known}; expected {expected}")

    def loop(self, context: Context) -> ClosedLoop:
        """The model under laws on the context's basis."""
        allowed, model = context.action_set, self.model
        if isinstance(model, ReadingsModel):
            assert isinstance(context.law, Observer)
            cost = context.cost and context.cost.through(model.U)
            cost = cost or context.plain(model.U.T @ context.target)
            return ReplayedLoop(model.U.T @ context.U, cost, allowed, model=model, law=context.law)
        if isinstance(model, SensedModel):
            return sensed_loop(context, model)
        on: dict[str, Any] = {"model": model, "noise": context.noise}
        on["reach"] = FAR * context.largest
        law, problem = context.with_constants, (context.U, context.stage, allowed)
        return LinearLoop(*problem, **on, law=law) if law else ClosedLoop(*problem, **on)


def believe(
    context: Context, records: Sequence[Record], accepted: float, first: str = ""
) -> Belief | None:
    """The model that predicts explorations and rollouts, as `Selection` says; None: none can be fitted.

    accepted: largest E without noise; first: the kind that is tried first, if any.
    """
    if context.of_readings:
        return _of_readings(context, records)
    selection = Selection(
        target=context.target,
        accepted=accepted,
        settings=context.field_models,
        noise=context.noise,
        action_set=context.action_set,
        line=context.line,
        shape=context.shape,
        weights=context.weights,
        undeclared=not context.sensors,
    )
    found = selection.select([_measured(context, own) for own in records], first)
    if found is None:
        return None
    return Belief(found.model, found.judged, found.whole, found.noise, accepted=found.predicts)


def _of_readings(context: Context, records: Sequence[Record]) -> Belief | None:
    """The belief in a model in innovation form, with as many states as the law's filter has."""
    rollouts, free = [], context.action_set.free(context.exploration.actions.shape[1])
    for record in records:
        steps = min(len(record.actions), len(record.states) - 1)
        if steps > 1 and np.isfinite(record.states).all():
            rollouts.append((record.states[: steps + 1], record.actions[:steps] @ free))
    try:
        model, error = fit_readings(rollouts, context.target, context.U.shape[1])
    except ValueError:
        return None
    return Belief(replace(model, B=model.B @ free.T), error)


def _measured(context: Context, record: Record) -> Measured:
    """With the law, where the rollout was under one without memory and noise."""
    explored = not record.policy.any()  # of no control too the actions say everything
    if explored or context.noise or isinstance(context.law, Observer):
        return Measured(record.states, record.actions)
    n_s = context.U.shape[1]
    if context.with_constants is not None:
        parts = context.with_constants.parts(record.policy)
        K, b = parts["K"] @ context.U.T, parts["b"]
    else:
        K = record.policy[:, :n_s] @ context.U.T
        b = record.policy[:, n_s:] @ (context.U.T @ context.target)
    return Measured(record.states, record.actions, lambda k, z: affine_law(K, at_step(b, k))(k, z))
