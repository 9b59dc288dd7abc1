# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The selection of a model of the whole field, as docs/optimizers.md says.

Kinds are judged by the error E of their prediction of rollouts that they were not fitted to, from the
initial states. A single rollout is split into pieces, or, if all points share their coefficients, used
for both. The first kind with a small E is selected; if there is none, the one with the fewest unknowns
that is not BETTER times worse than the best, and it is fitted again to all rollouts.

Noise that nobody declared is looked for before pieces or beginnings, as any model that takes noise for
the state seems to predict pieces. It cannot be predicted: unless a model without noise predicts the
rollouts better than noise of the level that their differences allow (`noise_level`) would let it, an
equation is fitted for that noise. The noise is there if this equation predicts rollouts that it was not
fitted to better than any model without noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from pdeloop.messages.action_set import ANY_ACTION, ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.method.models.base import (
    DEFAULTS,
    FieldModel,
    FieldModelSettings,
    Measured,
    beginnings,
    errors,
    one_step,
    pieces,
    predicted,
    samples_of,
    saturated,
    usable,
)
from pdeloop.method.models.finite_difference import (
    features_of,
    fit_finite_difference,
    fit_neighbours,
    neighbour_features,
)
from pdeloop.method.models.linear import fit_coarse, fit_linear, fit_low_rank
from pdeloop.method.models.noise import (
    NOISE_MISJUDGED,
    cleaned_states,
    fit_noisy,
    noise_level,
    share_of_noise,
)
from pdeloop.method.models.polynomial import LARGEST_STATE, fit_polynomial
from pdeloop.method.models.spectral import Form, fit_spectral
from pdeloop.method.reduce.reduced_model import turns
from pdeloop.process.one_thread import one_thread

BETTER = 3.0
"""How many times smaller the E of a kind with more unknowns must be for it to be selected."""
_FEWEST_POINTS, _FEWEST_CELLS = 8, 5
"""Minimum number of points of a field, and of cells with neighbours."""
NEAR_NEEDED = 0.05
"""Least E of the other kinds above which models of neighbours are tried."""
DENSE = 512
"""Largest state for the kinds whose cost grows with its square, and for models of neighbours."""

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
FIRST_ENOUGH = 0.01
"""`enough` of a linear model, and of squares alone, as more may be small where it was measured."""
ACCURATE, TRIED = 5e-3, "front2"
"""E at which no kind after this form is tried: hardly one is `BETTER` times better."""

Fit = Callable[[Sequence[Measured], float], FieldModel | None]


@dataclass(frozen=True, eq=False)
class Kind:
    """A kind of model.

    fit (rollouts, noise): their model, or None; unknowns: those of each point or wavenumber, by which
    kinds are compared first, and those that all share; knows_noise: whether it is fitted to noisy
    states, not to denoised ones; needed: it is tried only where the best E so far is larger; enough:
    share of `reproduced` at which it is selected before others are tried.
    """

    name: str
    fit: Fit
    unknowns: tuple[float, int]
    knows_noise: bool = False
    needed: float = 0.0
    enough: float = 1.0


def kinds_of(
    n_z: int, settings: FieldModelSettings, *, line: bool = True, shape: tuple[int, ...] = ()
) -> list[Kind]:
    """The kinds for states of that size; line, shape: as for `Selection`."""
    if n_z > DENSE:
        linear = [_of_samples(LINEAR, fit_low_rank, (_LINEAR_MODES, 0), most=_LINEAR_MODES)]
    else:
        linear = [_of_samples(LINEAR, fit_linear, (n_z, 0), ridge=_LINEAR_RIDGE)]
    if shape:
        return linear + _finite_difference(n_z // math.prod(shape), settings, shape=shape)
    last = list[Kind]()
    if n_z <= LARGEST_STATE:
        needed = settings.reproduced
        last.append(
            Kind("polynomial", lambda own, _: fit_polynomial(own), (n_z + 1.0, 0), needed=needed)
        )
    if not line:
        return linear + last
    # A linear one is soon judged, and tells which others are hopeless.
    linear = [replace(kind, enough=FIRST_ENOUGH) for kind in linear]
    forms = FORMS if n_z >= _FEWEST_POINTS else ()
    spectral = [_spectral(own, settings) for own in forms if own.degree <= settings.largest_degree]
    several, near = list[Kind](), list[Kind]()
    for components, prefix in ((1, ""), (2, "two-")):  # fields that stand one after the other
        n_x, rest = divmod(n_z, components)
        if not rest and n_x >= _FEWEST_POINTS:
            several += _finite_difference(components, settings, prefix)
        if not rest and n_x >= _FEWEST_CELLS and n_z <= DENSE:
            near += _neighbours(components, prefix)
    # Equations of a high degree late, as that takes long.
    late = [kind for kind in spectral if kind.name == FORMS[-1].name]
    early = [kind for kind in spectral if kind.name != FORMS[-1].name]
    return linear + early + several + late + near + last


def _of_samples(
    name: str,
    fit: Callable[..., FieldModel | None],
    unknowns: tuple[float, int],
    needed: float = 0.0,
    **known: Any,
) -> Kind:
    """A kind that is fitted to the steps of rollouts, whatever their order."""

    def fitted(rollouts: Sequence[Measured], _: float) -> FieldModel | None:
        return fit(samples_of(rollouts), kind=name, **known)

    return Kind(name, fitted, unknowns, needed=needed)


def _spectral(form: Form, settings: FieldModelSettings) -> Kind:
    def fit(rollouts: Sequence[Measured], noise: float) -> FieldModel | None:
        if noise and not form.free:
            return fit_noisy(rollouts, form, settings, noise)
        return fit_spectral(samples_of(rollouts), form, settings)

    enough = FIRST_ENOUGH if form is FORMS[0] else 1.0
    return Kind(form.name, fit, form.unknowns, not form.free, enough=enough)


def _neighbours(components: int, prefix: str) -> list[Kind]:
    """Products of neighbours, for states that are no fields; `prefix` is that of their names."""
    count, kinds = components * len(neighbour_features(components)), list[Kind]()
    for name, ridge in NEAR_RIDGES.items():
        if ridge is not None and components > 1:
            continue  # too many unknowns
        unknowns = 0.0 if ridge is None else count, count
        given = {"components": components, "ridge": ridge}
        kinds.append(_of_samples(prefix + name, fit_neighbours, unknowns, NEAR_NEEDED, **given))
    return kinds


def _finite_difference(
    components: int, settings: FieldModelSettings, prefix: str = "", shape: tuple[int, ...] = ()
) -> list[Kind]:
    """Equations whose coefficients depend on the place; shape: as for `kinds_of`."""
    if settings.largest_degree < _POINT_DEGREE:
        return []
    count = components * len(features_of(components, len(shape) or 1))
    fit: Callable[..., FieldModel | None] = fit_coarse if shape else fit_finite_difference
    given: dict[str, Any] = {"shape": shape} if shape else {"components": components}
    return [
        _of_samples(
            prefix + name, fit, (0.0 if ridge is None else count, count), ridge=ridge, **given
        )
        for name, ridge in POINT_RIDGES.items()
    ]


_HOPELESS = 20.0
"""Multiple of the best E, or of `reproduced`, above which a kind is dropped from further folds."""

LEAST_UNIT = 1e-6
"""Least unit of a number of the state, relative to the largest: what hardly moves has no say."""
FEWEST_SAMPLES = 4


class Scale(NamedTuple):
    """What errors are relative to: the variation about a state (n_z,), in units (n_z,)."""

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

    simulated: E, relative to sum |z - reference|^2; one_step: root of the sum of squared errors of
    single steps, over that of squared changes.
    """

    simulated: float
    one_step: float


UNKNOWN = Accuracy(np.inf, np.inf)


def with_clean(rollouts: Sequence[Measured], noise: float, *, line: bool = True) -> list[Measured]:
    """The rollouts with denoised states."""
    rollouts = usable(rollouts)
    clean = cleaned_states([r.states for r in rollouts], noise, line=line)
    return [replace(r, clean=own) for r, own in zip(rollouts, clean, strict=True)]


def fitted(kind: Kind, rollouts: Sequence[Measured], noise: float = 0.0) -> FieldModel | None:
    """A fit, or None where the data overflow it."""
    if len(samples_of(rollouts)) < FEWEST_SAMPLES:
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


ACCEPTED_NOISY = 0.3
"""Largest error of a model that is accepted with measurement noise, or is linear and of beginnings:
initial states are uncertain then, and what leaves the target at once says little."""
REPRODUCED_NOISY = 0.05
"""Largest E at which a kind is selected with measurement noise: initial states are uncertain then."""
ONE_STEP = 0.3
"""Largest error of single steps, relative to the change in them."""
PIECES = 8
"""Pieces of a rollout that a model of a chaotic plant predicts."""
CHAOTIC_GROWTH = 20.0
"""Least ratio of the errors on whole rollouts and on pieces of a chaotic plant."""
NEAR = (10.0, 3.0, 1.0)
"""Distances from the target, relative to the largest of initial states, of beginnings."""

PREDICTED = 0.5
"""E of a model without noise, relative to the share of the noise, below which there is no noise."""
_GROWN = 10.0
"""E that the noise of an initial state may lead to, per share of the noise in the states."""


@dataclass(frozen=True, eq=False)
class FittedModel:
    """A model, and what it was selected by.

    error: E of its kind, the mean over rollouts that it was not fitted to; candidates: kinds that were
    tried, in that order, and their E; own: relative to what the data do, where a scale was given;
    rollouts: whole ones, pieces or beginnings; most: largest error at which a model of these is
    accepted; whole: False of one that predicts pieces of rollouts, of a chaotic plant; noise: that
    which it was fitted for in place of the declared one, or 0; near: of a linear one, of short pieces
    up to some distance from the target, the error of single steps (0 where noise hides it), which
    counts in place of E.
    """

    model: FieldModel
    error: float
    candidates: list[tuple[str, float]]
    own: Accuracy = UNKNOWN
    rollouts: Sequence[Measured] = ()
    most: float = np.inf
    whole: bool = True
    noise: float = 0.0
    near: float | None = None

    @property
    def judged(self) -> float:
        """The error that counts."""
        return self.error if self.near is None else self.near

    @property
    def predicts(self) -> bool:
        """True if its error is small enough."""
        return self.judged <= self.most


@dataclass(frozen=True, eq=False, kw_only=True)
class Selection:
    """How a model is selected.

    target (n_z,): z_r, to which the distance is what E is relative to; accepted: largest E of a model
    that is accepted without noise; action_set: admissible actions, the nearest of which is applied;
    line: whether the states are fields on one axis, or plain vectors; shape: points of each axis,
    where the states are fields on several; weights: W of E (`errors`), in which the numbers of a state
    count as in the cost; undeclared: whether noise that was not declared is looked for.

    noise: standard deviation of that on every number of the states, 0 for none, or unknown. E is then
    the error beyond what it explains, and kinds that know of noise are fitted as `fit_noisy` does.
    """

    target: Array
    accepted: float = np.inf
    settings: FieldModelSettings = DEFAULTS
    noise: float = 0.0
    action_set: ActionSet = ANY_ACTION
    line: bool = True
    shape: tuple[int, ...] = ()
    weights: Array | None = None
    undeclared: bool = True

    @cached_property
    def most(self) -> float:
        """Largest E of a model that is accepted."""
        return max(self.accepted, ACCEPTED_NOISY) if self.noise else self.accepted

    def fit(
        self,
        rollouts: Sequence[Measured],
        scale: Scale | None = None,
        first: str = "",
        *,
        linear: bool = False,
        knows_noise: bool = False,
    ) -> FittedModel | None:
        """The model that predicts these rollouts, or None where none can be fitted.

        scale: of the errors `own` of the result, always of rollouts or pieces that it was not fitted
        to; first: kind to be tried first, that of the last choice; linear, knows_noise: only linear
        models, or kinds that are fitted for noise.
        """
        target, noise, settings, given = self.target, self.noise, self.settings, rollouts
        rollouts = [limited(rollout, self.action_set) for rollout in rollouts]
        if len(samples_of(rollouts)) < FEWEST_SAMPLES:
            return None
        if noise:
            rollouts = with_clean(rollouts, noise, line=self.line)
            share = share_of_noise(noise, [r.states for r in rollouts], target, self.weights)
            enough = min(_GROWN * share, REPRODUCED_NOISY)
            settings = replace(settings, reproduced=max(settings.reproduced, enough))
        kinds = kinds_of(len(target), settings, line=self.line, shape=self.shape)
        if linear:
            kinds = [kind for kind in kinds if kind.name == LINEAR]
        if knows_noise:
            kinds = [kind for kind in kinds if kind.knows_noise]
        kinds.sort(key=lambda kind: kind.name != first)
        tried: dict[Kind, float] = {}
        own: dict[Kind, Accuracy] = {}
        with one_thread():  # a rounding must not depend on the machine's load
            for kind in kinds:
                least = min(tried.values(), default=np.inf)
                if not least > kind.needed:
                    continue
                found = self.judged(kind, rollouts, least, settings, scale)
                if found is not None:
                    error, own[kind] = found
                    tried[kind] = error
                    if error <= settings.reproduced * (1.0 if kind.name == first else kind.enough):
                        break
                    forms = [own for kind, own in tried.items() if kind.name != LINEAR]
                    if kind.name == TRIED and min(forms) <= ACCURATE:
                        break
            least = min(tried.values(), default=np.inf)
            # One of fewer unknowns is no better than others where it is not accepted.
            near = min(BETTER * least, max(least, self.most))
            good = [
                kind
                for kind, error in tried.items()
                if error <= max(settings.reproduced * kind.enough, near)
            ]
            for kind in sorted(good, key=lambda kind: kind.unknowns):
                model = fitted(kind, rollouts, noise)
                if model is not None:
                    if scale and len(rollouts) == 1 and not kind.unknowns[0]:
                        parts = pieces(rollouts[0], settings.folds)
                        held = self.judged(kind, parts, np.inf, settings, scale)
                        own[kind] = held[1] if held else UNKNOWN
                    seen = [(kind.name, error) for kind, error in tried.items()]
                    return FittedModel(model, tried[kind], seen, own[kind], given, self.most)
        return None

    def judged(
        self,
        kind: Kind,
        rollouts: Sequence[Measured],
        least: float,
        settings: FieldModelSettings,
        scale: Scale | None,
    ) -> tuple[float, Accuracy] | None:
        """E of a kind, its mean over the rollouts, and its accuracy on a scale, or None.

        least: that of the best kind so far. One that is far from it after the first turn gets no other.
        """
        # Coefficients that all points share are hardly fitted to a single rollout's accidents.
        if len(rollouts) == 1 and kind.unknowns[0] > 0:
            rollouts = pieces(rollouts[0], settings.folds)
        # A single one that is no piece is fitted to and judged by.
        whole = [(list(rollouts), list(rollouts))]
        found, relative, sums = list[float](), list[float](), np.zeros(2)
        for others, own in whole if len(rollouts) == 1 else turns(rollouts, settings.folds):
            model = fitted(kind, others, self.noise)
            if model is None:
                return None
            own = usable(own)
            known, simulated = (settings.worst, self.noise), predicted(model, own)
            found += errors(model, own, self.target, *known, self.weights, simulated).tolist()
            if scale is not None:
                units = scale.units
                missed = errors(model, own, scale.reference, *known, 1.0 / units, simulated)
                relative, sums = relative + missed.tolist(), sums + one_step(model, own, units)
            if found and np.mean(found) > _HOPELESS * max(least, settings.reproduced):
                break
        if not found:
            return None
        if scale is None:
            return float(np.mean(found)), UNKNOWN
        with np.errstate(all="ignore"):
            one = float(np.sqrt(sums[0] / sums[1]))
        return float(np.mean(found)), Accuracy(float(np.mean(relative)), one)

    def select(self, rollouts: Sequence[Measured], first: str = "") -> FittedModel | None:
        """The model, which need not be accepted, or None; first: kind that is tried first."""
        rollouts = [own for own in rollouts if len(own.actions)]
        if not rollouts:
            return None
        scale = scale_of([own.states for own in rollouts])
        whole = self.fit(rollouts, scale, first)
        if self.undeclared and self.line and not self.shape:  # fields on one axis
            # E without another noise is no measure for E with it.
            better_than = np.inf if self.noise or whole is None else whole.error
            if noisy := self.undeclared_noise(rollouts, better_than):
                return noisy
        if whole is not None and whole.predicts and self._one_step(whole) <= ONE_STEP:
            return whole
        found = [self._near(rollouts, scale, linear=False)]
        if whole is not None and not whole.predicts:
            found.append(self._of_pieces(rollouts, scale, whole))
        best = min((own for own in found if own), key=lambda own: own.judged, default=None)
        return best or self._near(rollouts, scale, linear=True) or whole

    def _one_step(self, fitted: FittedModel) -> float:
        return 0.0 if self.noise else fitted.own.one_step

    def undeclared_noise(
        self, rollouts: Sequence[Measured], better_than: float = np.inf
    ) -> FittedModel | None:
        """An equation fitted for measurement noise; None where there is no such noise.

        Another one than was declared must be `NOISE_MISJUDGED` times as large, or as small.
        better_than: E of the best model without noise.
        """
        states = [np.asarray(rollout.states) for rollout in rollouts]
        noise, declared = noise_level(states), self.noise
        misjudged = max(noise, declared) > NOISE_MISJUDGED * min(noise, declared)
        if not noise or not misjudged:
            return None
        if better_than < PREDICTED * share_of_noise(noise, states, self.target, self.weights):
            return None
        known = [replace(rollout, law=None) for rollout in rollouts]
        found = replace(self, noise=noise).fit(known, knows_noise=True)
        if found is None or found.error > ACCEPTED_NOISY or not found.error < better_than:
            return None
        return replace(found, rollouts=rollouts, most=ACCEPTED_NOISY, noise=noise)

    def _of_pieces(
        self, rollouts: list[Measured], scale: Scale, whole: FittedModel
    ) -> FittedModel | None:
        """A model that predicts pieces of rollouts of a chaotic plant."""
        most = min(self.most, whole.error / CHAOTIC_GROWTH)
        parts = [part for rollout in rollouts for part in pieces(rollout, PIECES)]
        # Of whole rollouts that none predicts the best kind is so by accident: any may predict pieces.
        worst = self.settings.worst
        known = errors(whole.model, parts, self.target, worst, self.noise, self.weights)
        kind = whole.model.kind if len(known) and known.mean() <= most else ""
        found = self.fit(parts, scale, kind)
        return replace(found, whole=False) if found and found.error <= most else None

    def _near(self, rollouts: list[Measured], scale: Scale, *, linear: bool) -> FittedModel | None:
        """The best model of beginnings near to the target, of regions of several sizes."""
        regions: dict[int, float] = {}
        for near in (np.inf, *NEAR):  # of several in which the same is measured the largest
            parts = beginnings(rollouts, self.target, near, self.weights)
            if _moved(parts) == _moved(rollouts):  # what stood still there shows no effect
                regions.setdefault(sum(len(own.actions) for own in parts), near)
        found = []
        for near in regions.values():
            if near < np.inf:
                parts = beginnings(rollouts, self.target, near, self.weights, short=linear)
                fitted = self.fit(parts, scale, linear=linear)
                if fitted and linear:
                    own = self._one_step(fitted)
                    fitted = replace(fitted, most=ACCEPTED_NOISY, near=own)
                found.append(fitted)
        good = [own for own in found if own and own.predicts and self._one_step(own) <= ONE_STEP]
        return min(good, key=lambda own: own.judged, default=None)


def _moved(rollouts: Sequence[Measured]) -> list[bool]:
    """Which inputs moved."""
    every = zip(*(own.actions.T for own in rollouts), strict=True)
    return [bool(np.ptp(np.concatenate(own)) > 0.0) for own in every]
