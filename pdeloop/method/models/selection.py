# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The selection of a model by rollouts: whole ones, pieces of them, or what stays near the target.

The model is that which predicts whole rollouts (`choice`), where one is accepted, or else

- one fitted for measurement noise that nobody declared (`fit_undeclared_noise`), which is looked
  for first, as any model that takes noise for the state seems to predict pieces;
- of a chaotic plant, one that predicts pieces of rollouts, where small errors have not grown yet. They
  are then far smaller than those of whole rollouts; those of a plant that is described badly add up;
- of an unstable plant, one that predicts the beginnings of rollouts, near to the target. Explorations,
  and a wrong law, lead to where no model follows, and no good law leads;
- where the plant leaves the target at once, a linear model of short pieces near to it: the beginning
  of a law that keeps it there, of which more is measured.

Any model predicts what rests, as at a stop, and it costs much: a model that does not predict the change
within single steps is not accepted either.

Noise that nobody declared is accepted only where a model says so. It cannot be predicted: unless a
model without noise predicts the rollouts better than noise of the level that their differences allow
(`noise_level`) would let it, an equation is fitted for that noise. The noise is there if this equation
predicts rollouts that it was not fitted to better than any model without noise, and if what it does not
predict of the short waves is measurement noise: its innovations there, along filtered states, have that
level and are white in time and space (`is_white`). Those of a front that is narrower than the grid are
not: they gather around it. Long waves are judged by the prediction, as their innovations hold the
equation's own errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy  # whose transforms, a tenth of a start, load when they are used

from pdeloop.messages.action_set import ANY_ACTION, ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.method.models.base import FieldModel, Measured
from pdeloop.method.models.choice import (
    FittedModel,
    Scale,
    fit_field_model,
    limited,
    scale_of,
    with_clean,
)
from pdeloop.method.models.noise_level import is_white, noise_level, share_of_noise, short_waves
from pdeloop.method.models.noisy_fit import filtered
from pdeloop.method.models.prediction import beginnings, errors, pieces
from pdeloop.method.models.settings import (
    DEFAULTS,
    LEAST_CORRECTION,
    NOISE_MISJUDGED,
    FieldModelSettings,
)
from pdeloop.process.one_thread import one_thread

ACCEPTED_NOISY = 0.3
"""Largest error of a model that is accepted with measurement noise, or is linear and of beginnings:
initial states are uncertain then, and what leaves the target at once says little."""
ONE_STEP = 0.3
"""Largest error of single steps, relative to the change in them."""
PIECES = 8
"""Pieces of a rollout that a model of a chaotic plant predicts."""
CHAOTIC_GROWTH = 20.0
"""Least ratio of the errors on whole rollouts and on pieces of a chaotic plant."""
NEAR = (10.0, 3.0, 1.0)
"""Distances from the target, relative to the largest of initial states, of beginnings."""


@dataclass(frozen=True, eq=False)
class Selected:
    """A model, and what it was selected by.

    Attributes
    ----------
    fitted : FittedModel
    rollouts : list of Measured
        Whole ones, pieces or beginnings.
    most : float
        Largest error at which a model of these is accepted.
    whole : bool
        False: it predicts pieces of rollouts, of a chaotic plant.
    near : float
        Linear, of short pieces up to so many times the distance of initial states from the target;
        infinite: it is not.
    noise : float
        Measurement noise that it was fitted for in place of the declared one; 0: there is none.
    one_step : float
        Error of single steps relative to the change in them; 0 where noise hides it.
    """

    fitted: FittedModel
    rollouts: list[Measured]
    most: float
    whole: bool = True
    near: float = np.inf
    noise: float = 0.0
    one_step: float = 0.0

    @property
    def model(self) -> FieldModel:
        """The model."""
        return self.fitted.model

    @property
    def error(self) -> float:
        """E, or of short pieces that of single steps."""
        return self.one_step if self.near < np.inf else self.fitted.error

    @property
    def predicts(self) -> bool:
        """True if its error is small enough."""
        return self.error <= self.most


@dataclass(frozen=True, eq=False, kw_only=True)
class Selection:
    """How a model is selected; the arguments of `fit_field_model` are as there.

    Attributes
    ----------
    accepted : float
        Largest E of a model that is accepted without noise.
    undeclared : bool
        Whether noise that was not declared is looked for.
    """

    target: Array
    accepted: float
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
        scale: Scale,
        first: str = "",
        *,
        linear: bool = False,
        by_scale: bool = False,
    ) -> FittedModel | None:
        """`fit_field_model` of these rollouts."""
        return fit_field_model(
            rollouts,
            self.target,
            settings=self.settings,
            noise=self.noise,
            action_set=self.action_set,
            first=first,
            line=self.line,
            shape=self.shape,
            scale=scale,
            by_scale=by_scale,
            weights=self.weights,
            most=self.most,
            linear=linear,
        )

    def select(self, rollouts: Sequence[Measured], first: str = "") -> Selected | None:
        """The model, which need not be accepted; None where none can be fitted.

        rollouts: measured ones; first: kind that is tried first, that of the last selection.
        """
        rollouts = [own for own in rollouts if len(own.actions)]
        if not rollouts:
            return None
        scale = scale_of([own.states for own in rollouts])
        whole = self._selected(self.fit(rollouts, scale, first), rollouts)
        if (noisy := self._of_noise(rollouts, whole)) is not None:
            return noisy
        if whole is not None and whole.predicts and whole.one_step <= ONE_STEP:
            return whole
        found = [self._near(rollouts, scale, linear=False)]
        if whole is not None and not whole.predicts:
            found.append(self._of_pieces(rollouts, scale, whole))
        best = min((own for own in found if own), key=lambda own: own.error, default=None)
        return best or self._near(rollouts, scale, linear=True) or whole

    def _selected(
        self, fitted: FittedModel | None, rollouts: list[Measured], near: float = np.inf
    ) -> Selected | None:
        if fitted is None:
            return None
        most = ACCEPTED_NOISY if near < np.inf else self.most
        one_step = 0.0 if self.noise else fitted.own.one_step
        return Selected(fitted, rollouts, most, near=near, one_step=one_step)

    def _of_noise(self, rollouts: list[Measured], whole: Selected | None) -> Selected | None:
        """An equation for noise that was not declared, of fields on one axis."""
        if not (self.undeclared and self.line) or self.shape:
            return None
        found = fit_undeclared_noise(
            [replace(own, law=None) for own in rollouts],
            self.target,
            settings=self.settings,
            most=ACCEPTED_NOISY,
            # E without another noise is no measure for E with it.
            better_than=np.inf if self.noise or whole is None else whole.error,
            declared=self.noise,
            action_set=self.action_set,
            weights=self.weights,
        )
        if found is None:
            return None
        return Selected(found[0], rollouts, ACCEPTED_NOISY, noise=found[1])

    def _of_pieces(
        self, rollouts: list[Measured], scale: Scale, whole: Selected
    ) -> Selected | None:
        """A model that predicts pieces of rollouts of a chaotic plant."""
        most = min(self.most, whole.error / CHAOTIC_GROWTH)
        parts = [part for rollout in rollouts for part in pieces(rollout, PIECES)]
        # Of whole rollouts that none predicts the best kind is so by accident: any may predict pieces.
        worst = self.settings.worst
        known = errors(whole.model, parts, self.target, worst, self.noise, self.weights)
        kind = whole.model.kind if len(known) and known.mean() <= most else ""
        found = self._selected(self.fit(parts, scale, kind), parts)
        return replace(found, whole=False) if found and found.error <= most else None

    def _near(self, rollouts: list[Measured], scale: Scale, *, linear: bool) -> Selected | None:
        """The best model of beginnings near to the target, of regions of several sizes."""
        regions: dict[int, float] = {}
        for near in (np.inf, *NEAR):  # of several in which the same is measured the largest
            parts = beginnings(rollouts, self.target, near, self.weights)
            regions.setdefault(sum(len(own.actions) for own in parts), near)
        found = []
        for near in regions.values():
            if near < np.inf:
                parts = beginnings(rollouts, self.target, near, self.weights, short=linear)
                fitted = self.fit(parts, scale, linear=linear)
                found.append(self._selected(fitted, parts, near if linear else np.inf))
        good = [own for own in found if own and own.predicts and own.one_step <= ONE_STEP]
        return min(good, key=lambda own: own.error, default=None)


_NOISE_EXCESS = 1.3
"""Largest root mean square of the innovations of an equation, relative to the noise."""
_WHITE_LEVEL = 0.01
"""Rate at which the test for white innovations rejects independent noise."""
_WHITE_TOLERANCE = 0.5
"""Root sum of squares of the correlations of innovations that counts as white."""

PREDICTED = 0.5
"""E of a model without noise, relative to the share of the noise, below which there is no noise."""
_BEGINNING = 8
"""Innovations of a rollout that are left out, as those of its uncertain initial state."""
_TURNS = 4
"""Times that the filter's shares are computed from its innovations."""


def fit_undeclared_noise(
    rollouts: Sequence[Measured],
    target: Array,
    *,
    settings: FieldModelSettings,
    most: float,
    better_than: float = np.inf,
    declared: float = 0.0,
    action_set: ActionSet = ANY_ACTION,
    weights: Array | None = None,
) -> tuple[FittedModel, float] | None:
    """An equation fitted for measurement noise, and the noise; None where there is no such noise.

    Parameters
    ----------
    rollouts : sequence of Measured
        Of fields of one component on a periodic axis.
    target : (n_z,) array
        z_r.
    settings : FieldModelSettings
        Constants.
    most : float
        Largest error E of the equation.
    better_than : float
        E of the best model without noise.
    declared : float
        Noise that was declared; another one is looked for only if it is `noise_misjudged` times as
        large, or as small.
    action_set : ActionSet
        Admissible actions, the nearest of which is applied.
    weights : array, optional
        As for `fit_field_model`.
    """
    states = [np.asarray(rollout.states) for rollout in rollouts]
    noise = noise_level(states)
    misjudged = max(noise, declared) > NOISE_MISJUDGED * min(noise, declared)
    if (
        not noise
        or not misjudged
        or better_than < PREDICTED * share_of_noise(noise, states, target, weights)
    ):
        return None
    found = fit_field_model(
        rollouts,
        target,
        settings=settings,
        noise=noise,
        action_set=action_set,
        knows_noise=True,
        weights=weights,
    )
    if found is None or found.error > most or not found.error < better_than:
        return None
    known = with_clean([limited(rollout, action_set) for rollout in rollouts], noise)
    with one_thread():
        left = innovations(found.model, known, noise)
    if left is None:
        return None
    short = [short_waves(own) for own in left]
    if not is_white(short, _WHITE_LEVEL, _WHITE_TOLERANCE):
        return None
    size = float(np.sqrt(np.mean(np.concatenate(short) ** 2)))
    return (found, noise) if size <= _NOISE_EXCESS * noise else None


def innovations(
    model: FieldModel, rollouts: Sequence[Measured], noise: float
) -> list[Array] | None:
    """Measured minus predicted states of each rollout, along its filtered states, but for the first.

    rollouts: with `clean`, where the filter begins; None where the model runs away.
    """
    power = noise**2 / model.n_z
    shares = np.full(model.n_z // 2 + 1, 0.5)
    for _ in range(_TURNS):
        first = [rollout.known[0] for rollout in rollouts]
        along = filtered(model, rollouts, first, shares, settling=True)
        if along.lost:
            return None
        left = [own[_BEGINNING:] for own in along.innovations]
        spectra = np.concatenate([scipy.fft.rfft(own) / model.n_z for own in left])
        error = np.maximum(np.mean(np.abs(spectra) ** 2, axis=0) - power, 0.0)
        shares = np.clip(error / (error + power), LEAST_CORRECTION, 1.0)
    return left
