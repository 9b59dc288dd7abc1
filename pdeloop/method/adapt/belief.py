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
from pdeloop.method.laws.feedforward import FeedForward
from pdeloop.method.laws.observer import Observer
from pdeloop.method.models import FieldModel, Measured, affine_law, fit_field_model
from pdeloop.method.models.choice import scale_of
from pdeloop.method.models.files import model_of
from pdeloop.method.models.prediction import NEAR, beginnings, errors, pieces
from pdeloop.method.models.readings import ReadingsModel, fit_readings
from pdeloop.method.models.sensed import SensedModel
from pdeloop.method.models.settings import FAR

_PIECES = 8
"""Pieces of a rollout that a model of a chaotic plant must predict."""
_CHAOTIC_GROWTH = 20.0
"""Minimum ratio of the errors on whole rollouts and on pieces."""

MOST_ONCE = 0.3
"""Largest error of single steps of a model: what rests is predicted by any model, and costs much."""

_MODEL = "model."


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
    near : float
        A linear model up to so many times the distance of initial states from the target; infinite: of
        all that was measured, or of beginnings that it predicts as well.
    once : float
        Error of single steps relative to the change in them, on rollouts that it was not fitted to; 0
        where noise hides it, or it is not known.
    """

    model: FieldModel
    error: float
    components: int
    whole: bool = True
    near: float = np.inf
    once: float = 0.0

    def state(self) -> State:
        """The model, its error and its components, as the arrays of a checkpoint."""
        arrays = {_MODEL + name: value for name, value in self.model.arrays().items()}
        numbers = {"error": np.array(self.error), "components": np.array(self.components)}
        if not self.whole:
            numbers["whole"] = np.array(self.whole)
        if self.near < np.inf:
            numbers["near"] = np.array(self.near)
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
        near = float(checked_array(state, "near", "f", ())) if "near" in state else np.inf
        return cls(model, error, components, whole, near)

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
        on["reach"] = FAR * context.largest
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
    near: float = np.inf,
    linear: bool = False,
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
    near : float
        Rollouts end where they are so many times as far from the target as any at its first state.
    linear : bool
        Only linear models, of short pieces.
    """
    if _reads(context):
        return _of_readings(context, records)
    rollouts = [_measured(context, record) for record in records if len(record.actions)]
    if parts > 1:
        rollouts = [part for rollout in rollouts for part in pieces(rollout, parts)]
    if near < np.inf:
        rollouts = beginnings(rollouts, context.target, near, context.weights, short=linear)
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
        linear=linear,
        scale=None if context.noise or not rollouts else scale_of([own.states for own in rollouts]),
    )
    if found is None:
        return None
    components = 2 if found.model.kind.startswith("two-") else 1
    once = 0.0 if context.noise else found.own.one_step
    near, error = (near, once) if linear else (np.inf, found.error)
    return Belief(found.model, error, components, near=near, once=once)


def is_believed(context: Context, belief: Belief | None, settings: ImprovementSettings) -> bool:
    """True if laws are improved on a model."""
    return belief is not None and belief.error <= largest_error(context, settings, belief.near)


def largest_error(context: Context, settings: ImprovementSettings, near: float = np.inf) -> float:
    """The largest E of a model that laws are improved on; near: as for `believe`.

    What leaves the target at once says little of the plant, which a law that keeps it there does.
    """
    return BELIEVED_NOISY if context.noise or near < np.inf else settings.believed


def also_in_parts(
    context: Context,
    records: Sequence[Record],
    whole: Belief | None,
    settings: ImprovementSettings,
) -> Belief | None:
    """A model of parts of rollouts where the best one of whole rollouts, `whole`, predicts too little.

    Else `whole` itself. Explorations of an unstable plant, and a wrong first law, lead to where no
    model follows, and no good law leads: their beginnings near to the target are predicted. Those of a
    chaotic plant are predicted in pieces; the better of both is taken. Where the plant leaves the
    target at once, a linear model of short pieces near to it is the beginning of a law that keeps it
    there, of which more is measured.
    """
    believed = whole and is_believed(context, whole, settings)
    if _reads(context) or (whole and believed and whole.once <= MOST_ONCE):
        return whole
    found = [_near(context, records, settings, linear=False)]
    if whole and not believed:
        found.append(_in_pieces(context, records, whole, settings))
    best = min((own for own in found if own), key=lambda own: own.error, default=None)
    return best or _near(context, records, settings, linear=True) or whole


def _in_pieces(
    context: Context, records: Sequence[Record], whole: Belief, settings: ImprovementSettings
) -> Belief | None:
    """A model that predicts pieces of rollouts of a chaotic plant, where small errors grow.

    They are far smaller than those of whole rollouts; those of a plant that is described badly add up.
    """
    most = min(largest_error(context, settings), whole.error / _CHAOTIC_GROWTH)
    rollouts = [_measured(context, record) for record in records if len(record.actions)]
    parts = [part for rollout in rollouts for part in pieces(rollout, _PIECES)]
    # What it was fitted to is predicted better than what it was not, and takes no other fit.
    known = _errors(context, whole.model, parts)
    if not (len(known) and known.mean() <= most):
        return None
    found = believe(context, records, whole.model.kind, _PIECES, most)
    return replace(found, whole=False) if found and found.error <= most else None


def _near(
    context: Context, records: Sequence[Record], settings: ImprovementSettings, *, linear: bool
) -> Belief | None:
    """The best model of beginnings near to the target, of regions of several sizes."""
    most = BELIEVED_NOISY if linear else largest_error(context, settings)
    rollouts = [_measured(context, own) for own in records if len(own.actions)]
    sizes: dict[int, float] = {}
    for near in (np.inf, *NEAR):  # of several in which the same is measured the largest
        parts = beginnings(rollouts, context.target, near, context.weights)
        sizes.setdefault(sum(len(own.actions) for own in parts), near)
    regions = [near for near in sizes.values() if near < np.inf]
    found = [believe(context, records, near=near, linear=linear) for near in regions]
    good = [own for own in found if own and own.error <= most and own.once <= MOST_ONCE]
    return min(good, key=lambda own: own.error, default=None)


def _errors(context: Context, model: FieldModel, rollouts: Sequence[Measured]) -> Array:
    """E of each rollout."""
    worst = context.field_models.worst
    return errors(model, rollouts, context.target, worst, context.noise, context.weights)


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
