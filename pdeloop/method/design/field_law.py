# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A first law from a model of the whole field, linearised near the target.

With e = z - z_r (`linearisation_point`) and the action a of `operating_inputs`,

    e_{k+1} = A e_k + B a_k + d,        d = f(z_r, a) - B a - z_r,

and the law a = K e + b that minimises the cost over the horizon senses only the n_a rows of K. They
are the first columns of U; the others are POD modes of the remainder of simulated states, with that law
and without control. If U has too few columns for both, all are POD modes.

The model and the regression judge both laws, as docs/identification.md says.

References
----------
Anderson, Moore, "Optimal Control: Linear Quadratic Methods", chapter 4.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy import linalg

from pdeloop.messages.action_set import ANY_ACTION, ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.messages.model_rows import ModelRows
from pdeloop.method.design.lqt import LARGEST, regulator, target_gain
from pdeloop.method.models import FieldModel, FieldModelSettings, FittedModel, Measured, affine_law
from pdeloop.method.models.base import DEFAULTS as MODEL_DEFAULTS
from pdeloop.method.models.base import Law, pieces, predicted, samples_of, saturated
from pdeloop.method.models.linear import LinearModel, ProjectedModel
from pdeloop.method.models.noise import smoothed
from pdeloop.method.models.selection import (
    BETTER,
    UNKNOWN,
    Accuracy,
    Kind,
    Selection,
    kinds_of,
    limited,
    scale_of,
    with_clean,
)
from pdeloop.method.models.selection import fitted as fitted_kind
from pdeloop.method.models.spectral import SpectralModel
from pdeloop.method.reduce.reduced_model import (
    DEFAULTS,
    IdentificationSettings,
    ReducedModel,
    Trajectory,
    leading_modes,
    operating_inputs,
)
from pdeloop.method.reduce.regression import fit
from pdeloop.process.one_thread import one_thread

_FIELD_STEPS = 4096
"""Steps of a trajectory by which a model of the whole field is selected, and of the simulations by
which laws are compared, at most."""
_FIELD_THINNING = 5
"""Interval between the simulated states that the basis is computed from."""
_FIELD_ROOM = 2.0
"""Modes per actuator from which on the basis includes the rows of the full-state feedback."""

EQUAL = 1e-4
"""Relative difference up to which costs are the same: the law of the regression is used then."""
EXACT = 1e-6
"""E of a model that counts as exact."""
FAR = 3.0
"""Distance of the target from the mean state, relative to that of the farthest measured state, above
which it is outside of the data."""


@dataclass(frozen=True, eq=False)
class FieldLaw:
    """The outcome of fitting a model of the whole field.

    fitted: the model with its error, and the errors of all kinds; None where none can be fitted. rows:
    its law, with the linearised model on U; None if the model is not accurate enough. cost, other_cost:
    the worst mean stage costs that accepted models predict from the initial fields of the trajectories,
    of its law and of the law to compare with; infinite where there is none, or it diverges. regression:
    its accuracy, to compare with `fitted.own`. judges: the models that were accepted. remark: where the
    model is linearised, if the target is far outside of the data. part: steps that it was fitted to,
    where those are the first ones of trajectories alone; 0: all. doubtful: whether what it saves
    against no control may be the error of a model that was not accepted. linear: the linearised model
    of the whole state, of which `rows` has the part on U, at `inputs`; refit: A, of a model of the same
    kind fitted to other data.

    noise: that which the model was fitted for where another one, or none, was declared; 0: what was
    declared. There is no law then, as the exploration was drawn for the declared noise, and is too weak
    for the effects of the actuators where that is less.
    """

    fitted: FittedModel | None
    rows: ModelRows | None = None
    cost: float = np.inf
    other_cost: float = np.inf
    noise: float = 0.0
    regression: Accuracy = UNKNOWN
    judges: tuple[str, ...] = ()
    remark: str = ""
    part: int = 0
    doubtful: bool = False
    linear: ReducedModel | None = None
    inputs: Array | None = None
    refit: Callable[[Sequence[Trajectory]], Array] | None = None

    @property
    def better(self) -> bool:
        """True if its law is cheaper on the model than the other one, by more than nothing."""
        return self.rows is not None and self.cost < (1.0 - EQUAL) * self.other_cost


def _spread(rollout: Measured, count: int) -> list[Measured]:
    """The rollout, or pieces that are spread over a long one evenly, of `_FIELD_STEPS` steps in all."""
    if len(rollout.actions) <= _FIELD_STEPS:
        return [rollout]
    return [part.part(0, _FIELD_STEPS // count) for part in pieces(rollout, count)]


def regression_kind(n_s: int, constant: bool) -> Kind:
    """The regression of this order as a kind of model, to be judged like the others."""

    def made(rollouts: Sequence[Measured], _: float) -> FieldModel:
        samples = samples_of(rollouts)
        U = leading_modes(samples.after, n_s)[0]
        return _whole(fit(samples, U, constant))

    return Kind("regression", made, (float(n_s), 0))


def _whole(model: ReducedModel | ModelRows) -> ProjectedModel:
    """A reduced model as one of the whole state: what is outside of U is lost in a step."""
    d = np.zeros(len(model.A)) if model.d is None else model.d
    return ProjectedModel(LinearModel("regression", model.A, model.B, d), model.U.T, model.U)


def field_law(
    trajectories: Sequence[Trajectory],
    target: Array,
    other: ModelRows,
    cost: Cost,
    *,
    action_set: ActionSet = ANY_ACTION,
    noise: float = 0.0,
    settings: IdentificationSettings = DEFAULTS,
    models: FieldModelSettings = MODEL_DEFAULTS,
    axes: tuple[int, ...] = (),
    order: int = 0,
) -> FieldLaw:
    """A law from a model of the whole field.

    trajectories: (states (N + 1, n_z), actions (N, n_a)) each, a_k held from z_k to z_{k+1}; target
    (n_z,): z_r; other: the law to compare with, and its model; cost: of the law, and predicted by
    models; action_set: admissible actions, in the data and under both laws; noise: standard deviation
    of that on every number of the states; axes: points of each axis of the fields, which need not be
    known of one; order: modes of the law, 0: as many as `other` has.
    """
    weights, line = cost.state_weights, len(axes) < 2
    selection = Selection(
        target=target,
        accepted=settings.field_error,
        settings=models,
        noise=noise,
        action_set=action_set,
        line=line,
        shape=() if line or len(target) % math.prod(axes) else axes,
        weights=weights,
    )
    # The work grows with the third power of the size of the state, so there is a largest one.
    parts = [part for z, a in trajectories for part in _spread(Measured(z, a), models.folds)]
    fitted = selection.select(parts) if len(target) <= LARGEST else None
    if fitted is None or fitted.noise:
        return FieldLaw(fitted, noise=fitted.noise if fitted else 0.0)
    n_s, scale = other.U.shape[1], scale_of([states for states, _ in trajectories])
    limits = [limited(rollout, action_set) for rollout in fitted.rollouts]
    total = sum(len(actions) for _, actions in trajectories)
    steps = sum(len(rollout.actions) for rollout in fitted.rollouts)
    part = steps if steps < min(total, _FIELD_STEPS) else 0
    kind = regression_kind(n_s, constant=other.d is not None)
    if part:  # there it has to be better than what all of the data gave
        kind = replace(kind, fit=lambda *_: _whole(other))
    with one_thread():
        held = selection.judged(kind, limits, np.inf, models, scale)
    regression = held[1] if held else UNKNOWN
    model, own = fitted.model, fitted.own
    accepted = _accepted([(model, own), (_whole(other), regression)], fitted.most)
    predicts = own.simulated < min(1.0, regression.simulated) and own.one_step < regression.one_step
    # More than nothing, and all of it better than the other one does.
    if alone := not accepted and predicts:
        accepted = [model]
    elif fitted.error > fitted.most or (part and not predicts):
        accepted = [judge for judge in accepted if judge is not model]
    judges = tuple(judge.kind for judge in accepted)
    report = FieldLaw(fitted, regression=regression, judges=judges, part=part)
    if not any(judge is model for judge in accepted):
        return report
    aim = target if weights is None else aim_of(scale.reference, target, weights)
    point, remark = linearisation_point(trajectories, aim, fitted, models.reproduced)
    inputs = operating_inputs(trajectories)
    lqr = regulator(model, cost, point, inputs)
    if lqr is None:  # it grows beyond all bounds within the horizon
        return report
    K, b = lqr.K, lqr.b
    horizon = max(len(actions) for _, actions in trajectories)
    fields = [states[0] for states, _ in trajectories]
    if noise:
        fields = list(smoothed(np.stack(fields), noise))
    best = saturated(affine_law(K, b), action_set)
    none = saturated(affine_law(np.zeros_like(K), np.zeros_like(b)), action_set)
    ahead = min(horizon, _FIELD_STEPS)
    visited = [z for law in (best, none) for z in states_under(model, law, fields, ahead)]
    U = _basis(K, np.concatenate(visited)[::_FIELD_THINNING], target, order or n_s)
    K_a, s_r = K @ U, U.T @ target
    # There is no constant part where the target is outside of U.
    K_b, _ = target_gain(b, s_r)
    drift = point + lqr.drift - lqr.A @ point
    rows = ModelRows(
        A=U.T @ lqr.A @ U, B=U.T @ lqr.B, U=U, K_a=K_a, K_b=K_b, s_r=s_r, d=U.T @ drift
    )

    def predicted_cost(rows: ModelRows, judge: FieldModel) -> float:
        law, total = affine_law(rows.K_a @ rows.U.T, rows.K_b @ rows.s_r), 0.0
        for states in states_under(judge, saturated(law, action_set), fields, ahead):
            if len(states) <= ahead:
                return np.inf
            actions = action_set.applied(law(0, states[:ahead]))
            total += float(cost.along(states[None, :ahead], actions[None], 0)[0][0])
            total += float(cost.at_end(states[-1:])[0][0])
        return total / (ahead * len(fields))

    mine, others = (max(predicted_cost(law, judge) for judge in accepted) for law in (rows, other))
    still = replace(rows, K_a=0.0 * K_a, K_b=0.0 * K_b)
    sure = 1.0 - math.sqrt(fitted.error)
    doubtful = alone and min(mine, others) >= sure * predicted_cost(still, model)
    return replace(
        report,
        rows=rows,
        cost=mine,
        other_cost=others,
        remark=remark,
        doubtful=doubtful,
        linear=ReducedModel(lqr.A, lqr.B, d=drift),
        inputs=inputs,
        refit=partial(_relinearised, selection, model.kind, point, inputs),
    )


def _relinearised(
    selection: Selection,
    name: str,
    point: Array,
    action: Array,
    trajectories: Sequence[Trajectory],
) -> Array:
    """A of the model of this kind of other data, at the same point; ValueError where there is none."""
    known = len(point), selection.settings
    kinds = kinds_of(*known, line=selection.line, shape=selection.shape)
    rollouts = [limited(Measured(*own), selection.action_set) for own in trajectories]
    if selection.noise:
        rollouts = with_clean(rollouts, selection.noise, line=selection.line)
    model = fitted_kind(
        next(kind for kind in kinds if kind.name == name), rollouts, selection.noise
    )
    if model is None:
        raise ValueError(f"no model of the kind {name} can be fitted")
    return model.linearise(point, action)[0]


def _accepted(models: Sequence[tuple[FieldModel, Accuracy]], most: float) -> list[FieldModel]:
    """The models whose errors are small, and not several times as large as those of another one."""
    simulated, once = (
        BETTER * max(min(own[i] for _, own in models), level)
        for i, level in enumerate((EXACT, np.sqrt(EXACT)))
    )
    return [
        model
        for model, own in models
        if own.simulated <= min(most, simulated) and own.one_step <= once
    ]


def aim_of(mean: Array, target: Array, weights: Array) -> Array:
    """The state nearest to the mean one that costs what the target does; weights: as for `errors`."""
    if weights.ndim == 1:
        return np.where(weights > 0.0, target, mean)
    aim: Array = mean + linalg.pinv(weights) @ (weights @ (target - mean))
    return aim


def linearisation_point(
    trajectories: Sequence[Trajectory], target: Array, fitted: FittedModel, exact: float
) -> tuple[Array, str]:
    """Where a model is linearised, and what to say of a target that is far outside of the data.

    At the target, or, if it is outside, at the measured state nearest to it. A linear model is the same
    everywhere. What reproduces the data, or is an equation whose coefficients all points share, says
    something of other states as well.
    """
    states = np.concatenate([states for states, _ in trajectories])
    mean, units = scale_of([states for states, _ in trajectories])
    away = np.linalg.norm((states - mean) / units, axis=1)
    far = float(np.linalg.norm((target - mean) / units) / max(away.max(), 1e-300))
    if far <= FAR or isinstance(getattr(fitted.model, "inner", fitted.model), LinearModel):
        return target, ""
    where = (
        f"the target is {far:.3g} times as far from the mean state as any measured state: the model"
    )
    if fitted.own.simulated <= exact or isinstance(fitted.model, SpectralModel):
        return target, f"{where} is linearised there, where nothing was measured"
    nearest = int(np.argmin(np.linalg.norm((states - target) / units, axis=1)))
    return states[nearest], f"{where} is linearised at the measured state nearest to it"


def states_under(model: FieldModel, law: Law, fields: Sequence[Array], horizon: int) -> list[Array]:
    """z_0 .. z_T of the model under a law from each field, as long as they are finite."""
    nothing = np.zeros((horizon, model.n_a))
    return predicted(model, [Measured(z[None], nothing, law) for z in fields])


def _basis(K: Array, states: Array, target: Array, n_s: int) -> Array:
    """U (n_z, n_s): the rows of K, and POD modes of the states and the target, so that there is a b."""
    n_a, n_z = K.shape
    weighted = np.vstack([states, np.sqrt(len(states)) * target])
    sensed = np.empty((n_z, 0))
    if n_s >= _FIELD_ROOM * n_a:
        _, values, rows = linalg.svd(K, full_matrices=False)
        sensed = rows[values > 1e-12 * max(values[0], 1e-300)].T
    left = weighted - weighted @ sensed @ sensed.T
    modes = linalg.svd(left.T, full_matrices=True)[0][:, : n_s - sensed.shape[1]]
    basis, triangle = linalg.qr(np.hstack([sensed, modes]), mode="economic")
    signed: Array = basis * np.where(np.diag(triangle) < 0.0, -1.0, 1.0)
    return signed
