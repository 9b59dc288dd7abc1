# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The choice of a model of the whole field.

Each kind is fitted to some of the rollouts and judged by the error E of its prediction of the others,
from their initial states, by cross-validation. A single rollout is split into pieces, or, if all points
share their coefficients, used for both. The first kind with E of at most `reproduced`, or with noise of
ten times its share of the states up to REPRODUCED_NOISY, is selected; if there is none, the one with
the fewest unknowns that is not `better` times worse than the best. Squares alone are selected at a
hundredth of that E, or if cubes as well are not `better`. It is then fitted to all rollouts.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pdeloop.messages.action_set import ANY_ACTION, ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.method.models.base import FieldModel, Measured, Samples, saturated
from pdeloop.method.models.denoising import cleaned_states
from pdeloop.method.models.kinds import LINEAR_RIDGES, Kind, kinds_of
from pdeloop.method.models.noise_level import share_of_noise
from pdeloop.method.models.prediction import errors, one_step, pieces, predicted, usable
from pdeloop.method.models.settings import DEFAULTS, REPRODUCED_NOISY, FieldModelSettings
from pdeloop.process.one_thread import one_thread

_HOPELESS = 20.0
"""Multiple of the best E, or of `reproduced`, above which a kind is dropped from further folds."""
_GROWN = 10.0
"""E that the noise of an initial state may lead to, per share of the noise in the states."""

LEAST_UNIT = 1e-6
"""Least unit of a number of the state, relative to the largest: what hardly moves has no say."""
FEWEST_SAMPLES = 4


class Scale(NamedTuple):
    """What errors are relative to: the variation about a state, with its numbers in units of their own.

    reference, units: (n_z,) each.
    """

    reference: Array
    units: Array


def scale_of(states: Sequence[Array]) -> Scale:
    """The mean state, and the standard deviation of every number of the state."""
    every = np.concatenate(states)
    spread = every.std(axis=0)
    units = np.maximum(spread, max(LEAST_UNIT * float(spread.max()), 1e-300))
    return Scale(every.mean(axis=0), units)


class Accuracy(NamedTuple):
    """Errors on data that a model was not fitted to.

    simulated: E from initial states, relative to sum |z - reference|^2; one_step: root of the sum of
    squared errors of single steps, over that of squared changes.
    """

    simulated: float
    one_step: float


UNKNOWN = Accuracy(np.inf, np.inf)


@dataclass(frozen=True, eq=False)
class FittedModel:
    """A model and why it is believed.

    Attributes
    ----------
    model : FieldModel
    error : float
        E of its kind, the mean over rollouts that it was not fitted to.
    candidates : list of (kind, E)
        Those that were tried, in that order.
    own : Accuracy
        The same relative to what the data do, where a scale was given.
    """

    model: FieldModel
    error: float
    candidates: list[tuple[str, float]]
    own: Accuracy = UNKNOWN


def fit_field_model(
    rollouts: Sequence[Measured],
    target: Array,
    *,
    settings: FieldModelSettings = DEFAULTS,
    components: int = 1,
    noise: float = 0.0,
    action_set: ActionSet = ANY_ACTION,
    first: str | None = None,
    line: bool = True,
    shape: tuple[int, ...] = (),
    knows_noise: bool = False,
    scale: Scale | None = None,
    by_scale: bool = False,
    weights: Array | None = None,
    most: float = np.inf,
    linear: bool = False,
) -> FittedModel | None:
    """The model of the whole field that predicts measured rollouts, or None where none can be fitted.

    Parameters
    ----------
    rollouts : sequence of Measured
        Whole or not; values that are not finite are left out.
    target : (n_z,) array
        z_r; the error is measured by the distance to it.
    settings : FieldModelSettings
        Constants of the fits.
    components : int
        Number of fields in a state, stored one after the other.
    noise : float
        Standard deviation of the noise on every number of the states; 0 for none, or unknown. E is then
        the error beyond what it explains, and kinds that know of noise are fitted as `noisy_fit` says.
    action_set : ActionSet
        Admissible actions, the nearest of which is applied.
    first : str, optional
        Kind to be tried first, that of the last choice.
    line : bool
        Whether the states are fields on one axis, or plain vectors.
    shape : tuple of int
        Points of each axis, where the states are fields on several; none: they are not.
    knows_noise : bool
        Try only the kinds that are fitted for noise.
    scale : Scale, optional
        Of the errors `own` of the result, always of rollouts or pieces that it was not fitted to.
    by_scale : bool
        Whether E is relative to this scale instead of the distance to the target.
    weights : (n_z,) or (n, n_z) array, optional
        W of E (`prediction.errors`), in which the numbers of a state count as in the cost.
    most : float
        Largest E with which a model is used: one of fewer unknowns is no better than others above it.
    linear : bool
        Try only linear models.
    """
    rollouts = [limited(rollout, action_set) for rollout in rollouts]
    if len(Samples.of(rollouts)) < FEWEST_SAMPLES:
        return None
    if noise:
        rollouts = with_clean(rollouts, noise, components, line=line)
        enough = _GROWN * share_of_noise(noise, [r.states for r in rollouts], target, weights)
        enough = min(enough, REPRODUCED_NOISY)
        settings = replace(settings, reproduced=max(settings.reproduced, enough))
    kinds = kinds_of(len(target), components, settings, line=line, shape=shape)
    if linear:
        kinds = [kind for kind in kinds if kind.name in LINEAR_RIDGES]
    if knows_noise:
        kinds = [kind for kind in kinds if kind.fit_noisy is not None]
    kinds.sort(key=lambda kind: kind.name != first)
    judged: dict[Kind, float] = {}
    own: dict[Kind, Accuracy] = {}
    with one_thread():  # a rounding must not depend on the machine's load
        for kind in kinds:
            least = min(judged.values(), default=np.inf)
            if not least > kind.needed:
                continue
            found = _error(kind, rollouts, target, settings, least, noise, scale, weights)
            if found is not None:
                error, own[kind] = found
                error = own[kind].simulated if by_scale else error
                judged[kind] = error
                if error <= settings.reproduced * (1.0 if kind.name == first else kind.enough):
                    break
        if not judged:
            return None
        least = min(judged.values())
        near = min(settings.better * least, max(least, most))
        good = [
            kind
            for kind, error in judged.items()
            if error <= max(settings.reproduced * kind.enough, near)
        ]
        for kind in sorted(good, key=lambda kind: kind.unknowns):
            model = _fitted(kind, rollouts, noise)
            if model is not None:
                if scale and len(rollouts) == 1 and not kind.unknowns[0]:
                    cut = pieces(rollouts[0], settings.folds)
                    held = _error(kind, cut, target, settings, np.inf, noise, scale, weights)
                    own[kind] = held[1] if held else UNKNOWN
                seen = [(kind.name, error) for kind, error in judged.items()]
                return FittedModel(model, judged[kind], seen, own[kind])
    return None


def with_clean(
    rollouts: Sequence[Measured], noise: float, components: int = 1, *, line: bool = True
) -> list[Measured]:
    """The rollouts with denoised states."""
    rollouts = usable(rollouts)
    clean = cleaned_states([r.states for r in rollouts], noise, components, line=line)
    return [replace(r, clean=own) for r, own in zip(rollouts, clean, strict=True)]


def _error(
    kind: Kind,
    rollouts: Sequence[Measured],
    target: Array,
    settings: FieldModelSettings,
    least: float,
    noise: float,
    scale: Scale | None,
    weights: Array | None,
) -> tuple[float, Accuracy] | None:
    """E of a kind, its mean over the rollouts, and its accuracy on a scale if there is one.

    None where there is nothing to fit or to judge.

    least: that of the best kind so far. One that is far from it after the first turn gets no other.
    """
    # Coefficients that all points share are hardly fitted to a single rollout's accidents.
    if len(rollouts) == 1 and kind.unknowns[0] > 0:
        rollouts = pieces(rollouts[0], settings.folds)
    found: list[float] = []
    parts: list[tuple[FieldModel, list[Measured], list[Array]]] = []
    for others, own in turns(rollouts, settings.folds):
        model = _fitted(kind, others, noise)
        if model is None:
            return None
        own = usable(own)
        parts.append((model, own, predicted(model, own)))
        found += errors(model, own, target, settings.worst, noise, weights, parts[-1][2]).tolist()
        if found and np.mean(found) > _HOPELESS * max(least, settings.reproduced):
            break
    if not found:
        return None
    known = UNKNOWN if scale is None else accuracy_of(parts, scale, settings.worst, noise)
    return float(np.mean(found)), known


def turns(
    rollouts: Sequence[Measured], folds: int
) -> Iterator[tuple[list[Measured], list[Measured]]]:
    """Rollouts to fit to and others to judge by, so that each is judged once; a single one is both."""
    folds = min(len(rollouts), folds)
    for fold in range(folds):
        others = [rollout for i, rollout in enumerate(rollouts) if i % folds != fold]
        yield others or list(rollouts), list(rollouts[fold::folds])


def accuracy_of(
    parts: Sequence[tuple[FieldModel, Sequence[Measured], Sequence[Array]]],
    scale: Scale,
    worst: float,
    noise: float = 0.0,
) -> Accuracy:
    """The accuracy of models, each with rollouts to judge it by and what it predicts of them."""
    found, sums = list[float](), np.zeros(2)
    for model, own, simulated in parts:
        own_weights = 1.0 / scale.units
        found += errors(model, own, scale.reference, worst, noise, own_weights, simulated).tolist()
        sums += one_step(model, own, scale.units)
    with np.errstate(all="ignore"):
        return Accuracy(float(np.mean(found)), float(np.sqrt(sums[0] / sums[1])))


def _fitted(kind: Kind, rollouts: Sequence[Measured], noise: float = 0.0) -> FieldModel | None:
    """A fit, or None where the data overflow it."""
    samples = Samples.of(rollouts)
    if len(samples) < FEWEST_SAMPLES:
        return None
    try:
        with np.errstate(all="ignore"):
            if noise and kind.fit_noisy is not None:
                return kind.fit_noisy(rollouts, noise)
            return kind.fit(samples)
    except (np.linalg.LinAlgError, ValueError, FloatingPointError):
        return None


def limited(rollout: Measured, action_set: ActionSet) -> Measured:
    """With the actions that are applied."""
    if not action_set.bounded:
        return rollout
    law = rollout.law
    return replace(
        rollout,
        actions=action_set.applied(rollout.actions),
        law=None if law is None else saturated(law, action_set),
    )
