# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The choice of a model of the whole field.

Each kind is fitted to some of the rollouts and judged by the error E of its prediction of the others,
from their initial states, by cross-validation. A single rollout is split into pieces, or, if all points
share their coefficients, used for both. The first kind with E of at most `reproduced`, or with noise of
ten times its share of the states up to REPRODUCED_NOISY, is selected; if there is none, the one with
the fewest unknowns that is not BETTER times worse than the best. Squares alone are selected at a
hundredth of that E, or if cubes as well are not. It is then fitted to all rollouts. `kinds_of`
lists the kinds in the order in which they are tried, with the number of their unknowns.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from pdeloop.messages.action_set import ANY_ACTION, ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.method.models.base import FieldModel, Measured, Samples, saturated
from pdeloop.method.models.finite_difference import features_of, neighbour_features
from pdeloop.method.models.finite_difference_fit import (
    fit_coarse,
    fit_finite_difference,
    fit_neighbours,
    fit_sparse,
)
from pdeloop.method.models.linear import fit_convolution, fit_linear, fit_low_rank
from pdeloop.method.models.noise_level import cleaned_states, share_of_noise
from pdeloop.method.models.noisy_fit import fit_noisy
from pdeloop.method.models.polynomial import LARGEST_STATE, fit_polynomial
from pdeloop.method.models.prediction import errors, one_step, pieces, predicted, usable
from pdeloop.method.models.settings import (
    BETTER,
    DEFAULTS,
    DENSE,
    REPRODUCED_NOISY,
    SPARSE_TERMS,
    FieldModelSettings,
)
from pdeloop.method.models.spectral_fit import Form, fit_spectral
from pdeloop.process.one_thread import one_thread

_FEWEST_POINTS = 8
"""Minimum number of points of a field."""
NEAR_NEEDED = 0.05
"""Least E of the other kinds above which models of neighbours are tried."""
_SPARSE_NUMBERS = 40
"""Largest state for models of few products of any of its numbers."""
_CONVOLUTION_RIDGE = 1e-9
"""Ridge of convolution models."""

FORMS = (
    Form(name="poly2", degree=2),
    Form(name="poly3", degree=3),
    Form(name="front2", degree=2, linear_order=2, shares=(8,)),
    Form(name="poly7", degree=7),
    Form(name="nonlocal2", degree=2, hilbert=True),
    Form(name="nonlocal3", degree=3, hilbert=True),
    Form(name="semi2", degree=2, hilbert=True, free="linear"),
    Form(name="semi3", degree=3, hilbert=True, free="linear"),
    Form(name="free2", degree=2, free="all"),
    Form(name="free3", degree=3, free="all"),
)
POINT_RIDGES = {"x-shared": None, "x1e-3": 1e-3, "x1e-5": 1e-5, "x1e-7": 1e-7}
NEAR_RIDGES = {"near-shared": None, "near1e-9": 1e-9}
LINEAR_RIDGES = {"linear": 1e-6, "linear1e-4": 1e-4}
SPARSE = {"sparse-map": True, "sparse": False}
LOW_RANKS = {"modes8": 8, "modes16": 16, "modes32": 32, "modes64": 64}
SQUARES_ENOUGH = 0.01
"""`enough` of an equation with squares alone, as cubes may be small where it was measured."""
SIMPLEST = 4
"""Forms of the fewest unknowns, the first ones."""
ACCURATE, TRIED = 5e-3, "front2"
"""E at which no kind after this form is tried: hardly one is `BETTER` times better."""


@dataclass(frozen=True, eq=False)
class Kind:
    """A kind of model.

    Attributes
    ----------
    name : str
    fit : callable
        The model of samples, or None.
    unknowns : (float, int)
        Those of each point or wavenumber, by which kinds are compared first, and those that all share.
    fit_noisy : callable, optional
        The model of rollouts whose states have noise of a known standard deviation, or None; without
        it, `fit` is given the denoised states.
    needed : float
        It is tried only where the best E so far is larger.
    enough : float
        Share of `reproduced` at which it is selected before others are tried.
    """

    name: str
    fit: Callable[[Samples], FieldModel | None]
    unknowns: tuple[float, int]
    fit_noisy: Callable[[Sequence[Measured], float], FieldModel | None] | None = None
    needed: float = 0.0
    enough: float = 1.0


def kinds_of(
    n_z: int,
    components: int,
    settings: FieldModelSettings,
    *,
    line: bool = True,
    shape: tuple[int, ...] = (),
) -> list[Kind]:
    """The kinds for states of that size.

    line: whether a point has one neighbour at each side, which is not so on several axes; shape: points
    of each axis, where there are several and the states are fields on them.
    """
    kinds: list[Kind] = []
    if not line or n_z > DENSE:
        kinds = [
            Kind(
                name,
                partial(fit_low_rank, kind=name, most=most),
                (float(most), 0),
            )
            for name, most in LOW_RANKS.items()
        ]
    if shape:
        several = _finite_difference(n_z // math.prod(shape), settings, "", shape)
        return kinds + _linear(n_z) + several
    if not line:
        return kinds + _linear(n_z) + _sparse(n_z) + _polynomial(n_z)
    if components == 1 and n_z >= _FEWEST_POINTS:
        kinds += [
            _spectral(form, settings) for form in FORMS if form.degree <= settings.largest_degree
        ]
    kinds += _several_fields(n_z, components, settings)
    near = _neighbours(n_z, components)
    if components == 1:  # two fields that were not declared
        two = _several_fields(n_z, 2, settings, "two-")
        # Linear ones are tried early, as that is quick.
        kinds[SIMPLEST:SIMPLEST] = [kind for kind in two if kind.name == "two-convolution"]
        kinds += [kind for kind in two if kind.name != "two-convolution"]
        near += _neighbours(n_z, 2, "two-")
    kinds += _linear(n_z) + near + _sparse(n_z)
    return kinds + _polynomial(n_z)


def _spectral(form: Form, settings: FieldModelSettings) -> Kind:
    fit = partial(fit_spectral, form=form, settings=settings)
    enough = SQUARES_ENOUGH if form is FORMS[0] else 1.0
    if form.free != "none":
        return Kind(form.name, fit, form.unknowns)

    def noisy(rollouts: Sequence[Measured], noise: float) -> FieldModel | None:
        return fit_noisy(rollouts, form, settings, noise)

    return Kind(form.name, fit, form.unknowns, noisy, enough=enough)


def _linear(n_z: int) -> list[Kind]:
    if n_z > DENSE:
        return []
    return [
        Kind(name, partial(fit_linear, kind=name, ridge=ridge), (n_z, 0))
        for name, ridge in LINEAR_RIDGES.items()
    ]


def _several_fields(
    n_z: int, components: int, settings: FieldModelSettings, prefix: str = ""
) -> list[Kind]:
    """Kinds of fields that stand one after the other; `prefix` is that of their names."""
    if n_z % components or n_z // components < _FEWEST_POINTS:
        return []
    kinds: list[Kind] = []
    if components > 1 and n_z <= DENSE:
        name = f"{prefix}convolution"
        convolution = partial(
            fit_convolution, kind=name, ridge=_CONVOLUTION_RIDGE, components=components
        )
        kinds.append(Kind(name, convolution, (float(components), 0)))
    return kinds + _finite_difference(components, settings, prefix)


def _neighbours(n_z: int, components: int, prefix: str = "") -> list[Kind]:
    """Products of neighbours, for states that are no fields; arguments: as for `_several_fields`."""
    count = components * len(neighbour_features(components))
    if n_z % components or n_z // components < 5 or n_z > DENSE:
        return []
    kinds = []
    for name, ridge in NEAR_RIDGES.items():
        fit = partial(
            fit_neighbours,
            components=components,
            kind=prefix + name,
            ridge=ridge,
        )
        own = 0.0 if ridge is None else count
        kinds.append(Kind(prefix + name, fit, (own, count), needed=NEAR_NEEDED))
    return kinds


def _sparse(n_z: int) -> list[Kind]:
    """Few products of any numbers of a small state."""
    if n_z > _SPARSE_NUMBERS:
        return []
    return [
        Kind(
            name,
            partial(fit_sparse, kind=name, is_map=is_map),
            (n_z + SPARSE_TERMS, 0),
            needed=NEAR_NEEDED,
        )
        for name, is_map in SPARSE.items()
    ]


def _polynomial(n_z: int) -> list[Kind]:
    """Products of the leading modes and of actions, where nothing simpler describes the plant."""
    if n_z > LARGEST_STATE:
        return []
    fit = partial(fit_polynomial, kind="polynomial")
    return [Kind("polynomial", fit, (n_z + 1.0, 0))]


def _finite_difference(
    components: int, settings: FieldModelSettings, prefix: str, shape: tuple[int, ...] = ()
) -> list[Kind]:
    """Equations whose coefficients depend on the place; shape: as for `kinds_of`."""
    kinds: list[Kind] = []
    for degree, ridges in ((3, POINT_RIDGES), (5, {"x5-shared": None})):
        if degree > settings.largest_degree:
            continue
        count = components * len(features_of(components, degree, len(shape) or 1))
        for name, ridge in ridges.items():
            known: dict[str, Any] = {
                "kind": prefix + name,
                "ridge": ridge,
                "degree": degree,
            }
            fit: Callable[[Samples], FieldModel | None] = partial(
                fit_finite_difference, components=components, **known
            )
            if shape:
                fit = partial(fit_coarse, shape=shape, **known)
            # An unknown that a ridge holds at zero counts as part of one; only the order matters.
            own = 0.0 if ridge is None else count * (0.5 if ridge > 1e-4 else 1.0)
            kinds.append(Kind(prefix + name, fit, (own, count)))
    return kinds


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
    units = np.maximum(spread, max(LEAST_UNIT * float(spread.max()), 1e-150))
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
                if kind.name == TRIED and min(judged.values()) <= ACCURATE:
                    break
        if not judged:
            return None
        least = min(judged.values())
        near = min(BETTER * least, max(least, most))
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
