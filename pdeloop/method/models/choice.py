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
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.method.models.base import FieldModel, Measured, Samples, saturated
from pdeloop.method.models.finite_difference import features_of, neighbour_features
from pdeloop.method.models.finite_difference_fit import (
    fit_finite_difference,
    fit_neighbours,
    fit_sparse,
)
from pdeloop.method.models.linear import fit_convolution, fit_linear
from pdeloop.method.models.noise_level import cleaned_states
from pdeloop.method.models.noisy_fit import fit_noisy
from pdeloop.method.models.polynomial import LARGEST_STATE, fit_polynomial
from pdeloop.method.models.prediction import errors, one_step, pieces, predicted, usable
from pdeloop.method.models.projected import fit_coarse, fit_low_rank
from pdeloop.method.models.settings import SPARSE_TERMS, FieldModelSettings
from pdeloop.method.models.spectral_fit import Form, fit_spectral
from pdeloop.method.reduce.reduced_model import turns as held_out

_FEWEST_POINTS = 8
"""Minimum number of points of a field."""
NEAR_NEEDED = 0.05
"""Least E of the other kinds above which models of neighbours are tried."""
DENSE = 512
"""Largest state for the kinds whose cost grows with its square, and for models of neighbours."""
_SPARSE_NUMBERS = 40
"""Largest state for models of few products of any of its numbers."""
_CONVOLUTION_RIDGE = 1e-9
"""Ridge of convolution models."""

FORMS = (
    Form(name="poly2", degree=2),
    Form(name="poly3", degree=3),
    Form(name="front2", degree=2, linear_order=2, shares=(8,)),
    Form(name="fifth2", degree=2, linear_order=5),
    Form(name="nonlocal2", degree=2, hilbert=True),
    Form(name="free2", degree=2, free=True),
    Form(name="poly7", degree=7),
)
POINT_RIDGES = {"x-shared": None, "x1e-5": 1e-5, "x1e-7": 1e-7}
NEAR_RIDGES = {"near-shared": None, "near1e-9": 1e-9}
_POINT_DEGREE = 3
"""Of equations whose coefficients depend on the place."""
LINEAR = "linear"
_LINEAR_RIDGE, _LINEAR_MODES = 1e-6, 64
"""Ridge of a linear model of the whole state; POD modes of one of a large state, at most."""
SPARSE = {"sparse-map": True, "sparse": False}
SQUARES_ENOUGH = 0.01
"""`enough` of an equation with squares alone, as cubes may be small where it was measured."""
SIMPLEST = 3
"""Forms of the fewest unknowns, the first ones."""
ACCURATE, TRIED = 5e-3, "front2"
"""E at which no kind after this form is tried: hardly one is `BETTER` times better."""


Fit = Callable[[Sequence[Measured], float], FieldModel | None]


@dataclass(frozen=True, eq=False)
class Kind:
    """A kind of model.

    Attributes
    ----------
    name : str
    fit : callable
        The model of rollouts, whose states have noise of a standard deviation that is known or 0; or
        None.
    unknowns : (float, int)
        Those of each point or wavenumber, by which kinds are compared first, and those that all share.
    knows_noise : bool
        Whether it is fitted to noisy states, not to denoised ones.
    needed : float
        It is tried only where the best E so far is larger.
    enough : float
        Share of `reproduced` at which it is selected before others are tried.
    """

    name: str
    fit: Fit
    unknowns: tuple[float, int]
    knows_noise: bool = False
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
    if shape:
        return _linear(n_z) + _finite_difference(n_z // math.prod(shape), settings, "", shape)
    if not line:
        return _linear(n_z) + _sparse(n_z) + _polynomial(n_z)
    forms = FORMS if components == 1 and n_z >= _FEWEST_POINTS else ()
    spectral = [_spectral(own, settings) for own in forms if own.degree <= settings.largest_degree]
    several, near = _several_fields(n_z, components, settings), _neighbours(n_z, components)
    if components == 1:  # two fields that were not declared
        two = _several_fields(n_z, 2, settings, "two-")
        # Linear ones are tried early, as that is quick.
        spectral[SIMPLEST:SIMPLEST] = [kind for kind in two if kind.name == "two-convolution"]
        several += [kind for kind in two if kind.name != "two-convolution"]
        near += _neighbours(n_z, 2, "two-")
    # And equations of a high degree late, as that takes long.
    late = [kind for kind in spectral if kind.name == FORMS[-1].name]
    early = [kind for kind in spectral if kind.name != FORMS[-1].name]
    return early + several + late + _linear(n_z) + near + _sparse(n_z) + _polynomial(n_z)


def _of_samples(fit: Callable[..., FieldModel | None], **known: Any) -> Fit:
    """A fit to the steps of rollouts, whatever their order."""
    return lambda rollouts, _: fit(Samples.of(rollouts), **known)


def _spectral(form: Form, settings: FieldModelSettings) -> Kind:
    def fit(rollouts: Sequence[Measured], noise: float) -> FieldModel | None:
        if noise and not form.free:
            return fit_noisy(rollouts, form, settings, noise)
        return fit_spectral(Samples.of(rollouts), form, settings)

    enough = SQUARES_ENOUGH if form is FORMS[0] else 1.0
    return Kind(form.name, fit, form.unknowns, not form.free, enough=enough)


def _linear(n_z: int) -> list[Kind]:
    if n_z > DENSE:
        fit = _of_samples(fit_low_rank, kind=LINEAR, most=_LINEAR_MODES)
        return [Kind(LINEAR, fit, (_LINEAR_MODES, 0))]
    return [Kind(LINEAR, _of_samples(fit_linear, kind=LINEAR, ridge=_LINEAR_RIDGE), (n_z, 0))]


def _several_fields(
    n_z: int, components: int, settings: FieldModelSettings, prefix: str = ""
) -> list[Kind]:
    """Kinds of fields that stand one after the other; `prefix` is that of their names."""
    if n_z % components or n_z // components < _FEWEST_POINTS:
        return []
    kinds: list[Kind] = []
    if components > 1 and n_z <= DENSE:
        name = f"{prefix}convolution"
        convolution = _of_samples(
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
        if ridge is not None and components > 1:
            continue  # too many unknowns
        fit = _of_samples(
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
            _of_samples(fit_sparse, kind=name, is_map=is_map),
            (n_z + SPARSE_TERMS, 0),
            needed=NEAR_NEEDED,
        )
        for name, is_map in SPARSE.items()
    ]


def _polynomial(n_z: int) -> list[Kind]:
    """Products of the leading modes and of actions, where nothing simpler describes the plant."""
    if n_z > LARGEST_STATE:
        return []
    return [Kind("polynomial", lambda rollouts, _: fit_polynomial(rollouts), (n_z + 1.0, 0))]


def _finite_difference(
    components: int, settings: FieldModelSettings, prefix: str = "", shape: tuple[int, ...] = ()
) -> list[Kind]:
    """Equations whose coefficients depend on the place; shape: as for `kinds_of`."""
    if settings.largest_degree < _POINT_DEGREE:
        return []
    kinds, count = list[Kind](), components * len(features_of(components, len(shape) or 1))
    for name, ridge in POINT_RIDGES.items():
        known: dict[str, Any] = {"kind": prefix + name, "ridge": ridge}
        if shape:
            fit = _of_samples(fit_coarse, shape=shape, **known)
        else:
            fit = _of_samples(fit_finite_difference, components=components, **known)
        kinds.append(Kind(prefix + name, fit, (0.0 if ridge is None else count, count)))
    return kinds


_HOPELESS = 20.0
"""Multiple of the best E, or of `reproduced`, above which a kind is dropped from further folds."""

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


def with_clean(
    rollouts: Sequence[Measured], noise: float, components: int = 1, *, line: bool = True
) -> list[Measured]:
    """The rollouts with denoised states."""
    rollouts = usable(rollouts)
    clean = cleaned_states([r.states for r in rollouts], noise, components, line=line)
    return [replace(r, clean=own) for r, own in zip(rollouts, clean, strict=True)]


def judged(
    kind: Kind,
    rollouts: Sequence[Measured],
    least: float,
    target: Array,
    settings: FieldModelSettings,
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
        model = fitted(kind, others, noise)
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
) -> Iterable[tuple[list[Measured], list[Measured]]]:
    """Rollouts to fit to and others to judge by, so that each is judged once; a single one is both."""
    if len(rollouts) == 1:
        return [(list(rollouts), list(rollouts))]
    return held_out(rollouts, folds)


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


def fitted(kind: Kind, rollouts: Sequence[Measured], noise: float = 0.0) -> FieldModel | None:
    """A fit, or None where the data overflow it."""
    if len(Samples.of(rollouts)) < FEWEST_SAMPLES:
        return None
    try:
        with np.errstate(all="ignore"):
            return kind.fit(rollouts, noise)
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
