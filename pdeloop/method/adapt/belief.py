# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The model of the whole field that is selected by measured rollouts, and its prediction error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.array_files import checked_array
from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.base import Context, Record, State, part_of
from pdeloop.method.adapt.closed_loop import ClosedLoop, FeedForwardLoop
from pdeloop.method.adapt.observed_loop import ObservedLoop
from pdeloop.method.adapt.replayed_loop import ReplayedLoop
from pdeloop.method.adapt.sensed_loop import sensed_loop
from pdeloop.method.adapt.settings import BELIEVED_NOISY, ImprovementSettings
from pdeloop.method.adapt.trajectories import within
from pdeloop.method.laws.feedforward import FeedForward
from pdeloop.method.laws.observer import Observer
from pdeloop.method.models import FieldModel, Measured, affine_law, fit_field_model
from pdeloop.method.models.choice import fit_kind, limited
from pdeloop.method.models.files import model_of
from pdeloop.method.models.prediction import errors, pieces
from pdeloop.method.models.readings import ReadingsModel, fit_readings
from pdeloop.method.models.sensed import SensedModel

_PIECES = 8
"""Pieces of a rollout that a model of a chaotic plant must predict."""
_CHAOTIC_GROWTH = 20.0
"""Minimum ratio of the errors on whole rollouts and on pieces."""

_MODEL = "model."
FEWEST = 2
"""Rollouts of a law that say how near to the target it keeps the state."""
LEAST = 1e-6
"""Least unit of a number of the state, relative to the largest."""


@dataclass(frozen=True, eq=False)
class Belief:
    """A model of the plant.

    Attributes
    ----------
    model : FieldModel
    error : float
        E on rollouts that it was not fitted to.
    components : int
        Fields in a state.
    whole : bool
        False: it predicts pieces of rollouts, of a chaotic plant, to E.
    """

    model: FieldModel
    error: float
    components: int
    whole: bool = True

    def state(self) -> State:
        """The model, its error and its components, as the arrays of a checkpoint."""
        arrays = {_MODEL + name: value for name, value in self.model.arrays().items()}
        numbers = {"error": np.array(self.error), "components": np.array(self.components)}
        if not self.whole:
            numbers["whole"] = np.array(self.whole)
        return numbers | arrays

    @classmethod
    def of(cls, state: Mapping[str, NDArray[np.generic]]) -> Belief | None:
        """The belief in a checkpoint, None where it has none; ValueError for arrays of no model."""
        if "error" not in state:
            return None
        model = model_of(part_of(state, _MODEL))
        error = float(checked_array(state, "error", "f", ()))
        components = int(checked_array(state, "components", "i", ()))
        whole = "whole" not in state or bool(checked_array(state, "whole", "b", ()))
        return cls(model, error, components, whole)

    def check(self, context: Context) -> None:
        """ValueError if the model has another plant's size, which compiled code does not check."""
        n_a = context.exploration.actions.shape[1]
        known, expected = (self.model.n_z, self.model.n_a), (len(context.target), n_a)
        own_state = isinstance(self.model, (ReadingsModel, SensedModel))
        if known[1] != n_a or (not own_state and known != expected):
            raise ValueError(f"its model has sizes {known}; expected {expected}")

    def loop(self, context: Context) -> ClosedLoop:
        """The model under laws on the context's basis."""
        problem = (
            context.U,
            context.target,
            context.state_weight,
            context.action_weight,
            context.horizon,
            context.action_set,
        )
        on: dict[str, Any] = {"model": self.model, "noise": context.noise, "cost": context.cost}
        if isinstance(self.model, ReadingsModel):
            assert isinstance(context.law, Observer)
            seen = self.model.U.T
            of_readings = (seen @ context.U, seen @ context.target, *problem[2:])
            return ReplayedLoop(*of_readings, model=self.model, law=context.law)
        if isinstance(self.model, SensedModel):
            return sensed_loop(context, self.model)
        if isinstance(context.law, Observer):
            return ObservedLoop(*problem, **on, law=context.law)
        if isinstance(context.law, FeedForward):
            return FeedForwardLoop(*problem, **on, law=context.law)
        return ClosedLoop(*problem, **on)

    def predicted_costs(self, context: Context, records: Sequence[Record]) -> list[float]:
        """The costs of rollouts that the model predicts from their initial fields."""
        loop = self.loop(context)
        return [
            float(loop.costs(loop.theta(record.policy), loop.beginnings([record]))[0])
            for record in records
        ]


def believe(
    context: Context,
    records: Sequence[Record],
    first: str = "",
    parts: int = 1,
    most: float = np.inf,
) -> Belief | None:
    """The model that predicts the rollouts best, or None where none can be fitted.

    Parameters
    ----------
    context : Context
        The law's basis and target.
    records : sequence of Record
        Explorations, whose policy is zero and whose cost is infinite, and rollouts of laws.
    first : str
        The kind that is tried first, the one selected before; empty: none.
    parts : int
        Pieces of equal length that are predicted in place of a rollout.
    most : float
        Largest E with which a model is used.
    """
    if _reads(context):
        return _of_readings(context, records)
    rollouts = [_measured(context, record) for record in records if len(record.actions)]
    if parts > 1:
        rollouts = [part for rollout in rollouts for part in pieces(rollout, parts)]
    found = fit_field_model(
        rollouts,
        context.target,
        settings=context.field_models,
        noise=context.noise,
        action_set=context.action_set,
        first=first,
        line=context.line,
        shape=context.shape,
        weights=context.weights,
        most=most,
    )
    if found is None:
        return None
    return Belief(found.model, found.error, 2 if found.model.kind.startswith("two-") else 1)


def largest_error(context: Context, settings: ImprovementSettings) -> float:
    """The largest E of a model that laws are improved on."""
    return BELIEVED_NOISY if context.noise else settings.believed


def also_in_pieces(
    context: Context, records: Sequence[Record], whole: Belief, settings: ImprovementSettings
) -> Belief:
    """A model that predicts pieces of rollouts where the best one of whole rollouts, `whole`, does not.

    Else `whole` itself. Of a chaotic plant small errors grow, so that those of pieces are far smaller;
    those of a plant that is described badly add up.
    """
    most = largest_error(context, settings)
    if whole.error <= most or _reads(context):
        return whole
    most = min(most, whole.error / _CHAOTIC_GROWTH)
    rollouts = [_measured(context, record) for record in records if len(record.actions)]
    parts = [part for rollout in rollouts for part in pieces(rollout, _PIECES)]
    # What it was fitted to is predicted better than what it was not, and takes no other fit.
    known = _errors(context, whole.model, parts)
    if not (len(known) and known.mean() <= most):
        return whole
    found = believe(context, records, whole.model.kind, _PIECES, most)
    return replace(found, whole=False) if found and found.error <= most else whole


def also_near(
    context: Context,
    records: Sequence[Record],
    belief: Belief | None,
    settings: ImprovementSettings,
    limit: float,
) -> Belief | None:
    """A model of rollouts up to where a state exceeds this magnitude, where none predicts whole ones.

    Else `belief` itself. A first law may drive the plant to where no model follows, and no good law
    leads.
    """
    if _reads(context):
        return belief
    return _of_parts(context, [within(own, limit) for own in records], records, belief, settings)


def also_around(
    context: Context,
    records: Sequence[Record],
    belief: Belief | None,
    settings: ImprovementSettings,
    law: Array,
) -> Belief | None:
    """A model of what stays as near to the target as a law's rollouts, where none predicts the rest.

    Else `belief` itself. Explorations of an unstable plant lead far from the target, and are then most
    of what a model is judged by. Near to it there may be little excitation left, and a model then knows
    the plant under its laws alone: rollouts of each law must be predicted by those of the others.
    """
    own = [record for record in records if record.usable and np.array_equal(record.policy, law)]
    if len(own) < FEWEST or _reads(context):
        return belief
    away = np.concatenate([record.states for record in own]) - context.target
    if not away.any():
        return belief
    units = np.sqrt(np.mean(away**2, axis=0))
    units = np.maximum(units, LEAST * max(float(units.max()), 1e-300))
    limit = float(np.abs(away / units).max())
    near = [within(record, limit, context.target, units) for record in records]
    found = _of_parts(context, near, records, None, settings)
    return found if found and _predicts_others(context, near, found, settings) else belief


def _errors(context: Context, model: FieldModel, rollouts: Sequence[Measured]) -> Array:
    """E of each rollout."""
    worst = context.field_models.worst
    return errors(model, rollouts, context.target, worst, context.noise, context.weights)


def _predicts_others(
    context: Context, records: Sequence[Record], belief: Belief, settings: ImprovementSettings
) -> bool:
    """True if a model of this kind predicts rollouts of laws that it was not fitted to."""
    groups: dict[bytes, list[Measured]] = {}
    for record in records:
        if len(record.actions):
            rollout = limited(_measured(context, record), context.action_set)
            groups.setdefault(record.policy.tobytes(), []).append(rollout)
    found = []
    for group in groups:
        others = [rollout for name in groups if name != group for rollout in groups[name]]
        model = others and fit_kind(
            belief.model.kind,
            others,
            settings=context.field_models,
            noise=context.noise,
            line=context.line,
            shape=context.shape,
        )
        if not model:
            return False
        found.append(_errors(context, model, groups[group]).mean())
    return bool(np.mean(found) <= largest_error(context, settings))


def _of_parts(
    context: Context,
    near: Sequence[Record],
    records: Sequence[Record],
    belief: Belief | None,
    settings: ImprovementSettings,
) -> Belief | None:
    """The model of the beginnings `near` of rollouts, if it predicts them; else `belief`."""
    if sum(len(record.states) for record in records) == sum(len(own.states) for own in near):
        return belief
    most = largest_error(context, settings)
    found = believe(context, [own for own in near if len(own.actions)], most=most)
    return found if found and found.error <= most else belief


def _reads(context: Context) -> bool:
    """True if the law estimates the state from few readings."""
    return bool(context.sensors) and isinstance(context.law, Observer)


def _of_readings(context: Context, records: Sequence[Record]) -> Belief | None:
    """The belief in a model in innovation form, with as many states as the law's filter has."""
    rollouts = []
    for record in records:
        steps = min(len(record.actions), len(record.states) - 1)
        if steps > 1 and np.isfinite(record.states).all():
            rollouts.append((record.states[: steps + 1], record.actions[:steps]))
    try:
        model, error = fit_readings(rollouts, context.target, context.U.shape[1])
    except ValueError:
        return None
    return Belief(model, error, 1)


def _measured(context: Context, record: Record) -> Measured:
    """With the law, where the rollout was under one without memory and noise."""
    explored = not record.policy.any()  # of no control too the actions say everything
    if explored or context.noise or isinstance(context.law, Observer):
        return Measured(record.states, record.actions)
    n_s = context.U.shape[1]
    if isinstance(context.law, FeedForward):
        parts = context.law.parts(record.policy)
        gains, every = parts["K"] @ context.U.T, parts["b"]

        def law(k: int, states: Array) -> Array:
            return affine_law(gains, every[min(k, len(every) - 1)])(k, states)

        return Measured(record.states, record.actions, law)
    K = record.policy[:, :n_s] @ context.U.T
    b = record.policy[:, n_s:] @ (context.U.T @ context.target)
    return Measured(record.states, record.actions, affine_law(K, b))
