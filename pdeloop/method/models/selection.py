# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The selection of a model by rollouts: whole ones, pieces of them, or what stays near the target.

The model is that which predicts whole rollouts (`choice`), where one is accepted, or else

- one fitted for measurement noise that nobody declared (`Selection.undeclared_noise`), which is looked
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
from pdeloop.method.models.base import FieldModel, Measured, Samples
from pdeloop.method.models.choice import (
    ACCURATE,
    FEWEST_SAMPLES,
    LINEAR,
    TRIED,
    UNKNOWN,
    Accuracy,
    FittedModel,
    Kind,
    Scale,
    fitted,
    judged,
    kinds_of,
    limited,
    scale_of,
    with_clean,
)
from pdeloop.method.models.noise_level import is_white, noise_level, share_of_noise, short_waves
from pdeloop.method.models.noisy_fit import filtered
from pdeloop.method.models.prediction import beginnings, errors, pieces
from pdeloop.method.models.settings import (
    BETTER,
    DEFAULTS,
    LEAST_CORRECTION,
    NOISE_MISJUDGED,
    FieldModelSettings,
)
from pdeloop.process.one_thread import one_thread

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
_GROWN = 10.0
"""E that the noise of an initial state may lead to, per share of the noise in the states."""


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
    """How a model is selected.

    Attributes
    ----------
    target : (n_z,) array
        z_r; the error is measured by the distance to it.
    accepted : float
        Largest E of a model that is accepted without noise.
    settings : FieldModelSettings
        Constants of the fits.
    noise : float
        Standard deviation of the noise on every number of the states; 0 for none, or unknown. E is then
        the error beyond what it explains, and kinds that know of noise are fitted as `noisy_fit` says.
    action_set : ActionSet
        Admissible actions, the nearest of which is applied.
    line : bool
        Whether the states are fields on one axis, or plain vectors.
    shape : tuple of int
        Points of each axis, where the states are fields on several; none: they are not.
    weights : (n_z,) or (n, n_z) array, optional
        W of E (`prediction.errors`), in which the numbers of a state count as in the cost.
    undeclared : bool
        Whether noise that was not declared is looked for.
    components : int
        Number of fields in a state, stored one after the other.
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
    components: int = 1

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
        by_scale: bool = False,
        knows_noise: bool = False,
    ) -> FittedModel | None:
        """The model that predicts these rollouts, or None where none can be fitted.

        Parameters
        ----------
        rollouts : sequence of Measured
            Whole or not; values that are not finite are left out.
        scale : Scale, optional
            Of the errors `own` of the result, always of rollouts or pieces that it was not fitted to.
        first : str
            Kind to be tried first, that of the last choice.
        linear, knows_noise : bool
            Try only linear models, or the kinds that are fitted for noise.
        by_scale : bool
            Whether E is relative to this scale instead of the distance to the target.
        """
        target, noise, settings = self.target, self.noise, self.settings
        rollouts = [limited(rollout, self.action_set) for rollout in rollouts]
        if len(Samples.of(rollouts)) < FEWEST_SAMPLES:
            return None
        if noise:
            rollouts = with_clean(rollouts, noise, self.components, line=self.line)
            share = share_of_noise(noise, [r.states for r in rollouts], target, self.weights)
            enough = min(_GROWN * share, REPRODUCED_NOISY)
            settings = replace(settings, reproduced=max(settings.reproduced, enough))
        kinds = kinds_of(len(target), self.components, settings, line=self.line, shape=self.shape)
        if linear:
            kinds = [kind for kind in kinds if kind.name == LINEAR]
        if knows_noise:
            kinds = [kind for kind in kinds if kind.knows_noise]
        kinds.sort(key=lambda kind: kind.name != first)
        tried: dict[Kind, float] = {}
        own: dict[Kind, Accuracy] = {}
        known = target, settings, noise, scale, self.weights
        with one_thread():  # a rounding must not depend on the machine's load
            for kind in kinds:
                least = min(tried.values(), default=np.inf)
                if not least > kind.needed:
                    continue
                found = judged(kind, rollouts, least, *known)
                if found is not None:
                    error, own[kind] = found
                    error = own[kind].simulated if by_scale else error
                    tried[kind] = error
                    if error <= settings.reproduced * (1.0 if kind.name == first else kind.enough):
                        break
                    if kind.name == TRIED and min(tried.values()) <= ACCURATE:
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
                        held = judged(kind, pieces(rollouts[0], settings.folds), np.inf, *known)
                        own[kind] = held[1] if held else UNKNOWN
                    seen = [(kind.name, error) for kind, error in tried.items()]
                    return FittedModel(model, tried[kind], seen, own[kind])
        return None

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
        # E without another noise is no measure for E with it.
        better_than = np.inf if self.noise or whole is None else whole.error
        found = self.undeclared_noise([replace(own, law=None) for own in rollouts], better_than)
        if found is None:
            return None
        return Selected(found[0], rollouts, ACCEPTED_NOISY, noise=found[1])

    def undeclared_noise(
        self, rollouts: Sequence[Measured], better_than: float = np.inf
    ) -> tuple[FittedModel, float] | None:
        """An equation fitted for measurement noise, and the noise; None where there is no such noise.

        Where some is declared another one is looked for only if it is `NOISE_MISJUDGED` times as large,
        or as small.

        rollouts: fields of one component on a periodic axis; better_than: E of the best model without
        noise.
        """
        states = [np.asarray(rollout.states) for rollout in rollouts]
        noise, declared = noise_level(states), self.noise
        misjudged = max(noise, declared) > NOISE_MISJUDGED * min(noise, declared)
        if not noise or not misjudged:
            return None
        if better_than < PREDICTED * share_of_noise(noise, states, self.target, self.weights):
            return None
        found = replace(self, noise=noise).fit(rollouts, knows_noise=True)
        if found is None or found.error > ACCEPTED_NOISY or not found.error < better_than:
            return None
        known = with_clean([limited(rollout, self.action_set) for rollout in rollouts], noise)
        with one_thread():
            left = innovations(found.model, known, noise)
        if left is None:
            return None
        short = [short_waves(own) for own in left]
        if not is_white(short, _WHITE_LEVEL, _WHITE_TOLERANCE):
            return None
        size = float(np.sqrt(np.mean(np.concatenate(short) ** 2)))
        return (found, noise) if size <= _NOISE_EXCESS * noise else None

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
