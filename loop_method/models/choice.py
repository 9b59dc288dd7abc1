# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Which model of the whole field to believe.

Kinds are tried in the order of their unknowns. Each is fitted to every second rollout and judged by the
error E of its prediction of the others, from their initial states. The first one with E of at most
`reproduced` is taken, and else the best one, where a kind of more unknowns has to be `better` times
better. The one that is taken is fitted to all rollouts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from loop_interfaces.arrays import Array
from loop_method.models.base import FieldModel, Measured, Samples
from loop_method.models.finite_difference_fit import fit_finite_difference
from loop_method.models.linear import fit_linear
from loop_method.models.prediction import errors
from loop_method.models.settings import FieldModelSettings
from loop_method.models.spectral_fit import Form, fit_spectral

Fit = Callable[[Samples], FieldModel | None]

FORMS = (
    Form(name="poly3", degree=3),
    Form(name="front2", degree=2, linear_order=2, shares=(8,)),
    Form(name="poly2", degree=2),
    Form(name="poly7", degree=7),
    Form(name="semi2", degree=2, free="linear"),
    Form(name="semi3", degree=3, free="linear"),
    Form(name="free3", degree=3, free="all"),
    Form(name="free2", degree=2, free="all"),
)
POINT_RIDGES = {"x-shared": None, "x1e-5": 1e-5, "x1e-7": 1e-7, "x1e-3": 1e-3}
LINEAR_RIDGES = {"linear": 1e-6, "linear-r": 1e-4}
FEWEST_SAMPLES = 4


@dataclass(frozen=True, eq=False)
class FittedModel:
    """A model and why it is believed.

    Attributes
    ----------
    model : FieldModel
    error : float
        E of its kind, on rollouts that it was not fitted to where `held_out`.
    candidates : list of (kind, E)
        Those that were tried, in that order.
    held_out : bool
    """

    model: FieldModel
    error: float
    candidates: list[tuple[str, float]]
    held_out: bool


def fit_field_model(
    rollouts: Sequence[Measured],
    target: Array,
    *,
    settings: FieldModelSettings | None = None,
    components: int = 1,
    noise: float = 0.0,
    first: str | None = None,
) -> FittedModel | None:
    """The model of the whole field that predicts measured rollouts, or None where none can be fitted.

    Parameters
    ----------
    rollouts : sequence of Measured
        Whole or not; values that are not finite are left out.
    target : (n_z,) array
        z_r; the error is measured by the distance to it.
    settings : FieldModelSettings, optional
        Constants of the fits.
    components : int
        Fields that stand one after the other in a state.
    noise : float
        Standard deviation of the noise on every number of the states; 0 for none, or unknown.
    first : str, optional
        Kind to be tried first, that of the last choice.
    """
    settings = settings or FieldModelSettings()
    few = len(rollouts) < 2
    fitted, judged = (rollouts, rollouts) if few else (rollouts[::2], rollouts[1::2])
    kinds = _kinds(len(target), components, settings, few)
    order = [k for k in kinds if k == first] + [k for k in kinds if k != first]
    some, every = Samples.of(fitted), Samples.of(rollouts)
    if len(every) < FEWEST_SAMPLES:
        return None
    seen: list[tuple[str, float]] = []
    with threadpool_limits(limits=1):  # a rounding must not depend on the machine's load
        for kind in order:
            model = _tried(kinds[kind], some)
            found = errors(model, judged, target, settings.worst) if model else np.empty(0)
            if found.size:
                seen.append((kind, float(found.mean())))
                if seen[-1][1] <= settings.reproduced:
                    break
        if not seen:
            return None
        least = min(error for _, error in seen)
        enough = max(settings.reproduced, settings.better * least)
        kind, error = next(pair for pair in seen if pair[1] <= enough)
        model = _tried(kinds[kind], every)
    return FittedModel(model, error, seen, not few) if model else None


def _tried(fit: Fit, samples: Samples) -> FieldModel | None:
    """A fit, or None where the data overflow it."""
    if len(samples) < FEWEST_SAMPLES:
        return None
    try:
        with np.errstate(all="ignore"):
            return fit(samples)
    except (np.linalg.LinAlgError, ValueError, FloatingPointError):
        return None


def _kinds(n_z: int, components: int, settings: FieldModelSettings, few: bool) -> dict[str, Fit]:
    """The fits by kind, the fewest unknowns first."""
    kinds: dict[str, Fit] = {}
    if components == 1 and n_z >= 8:
        for form in FORMS:
            kinds[form.name] = partial(fit_spectral, form=form, settings=settings)
    if n_z % components == 0 and n_z // components >= 3:
        for kind, ridge in POINT_RIDGES.items():
            own: dict[str, Any] = {
                "kind": kind,
                "settings": settings,
                "components": components,
                "ridge": ridge,
            }
            kinds[kind] = partial(fit_finite_difference, **own)
        own = {"kind": "x5-shared", "settings": settings, "components": components, "degree": 5}
        kinds["x5-shared"] = partial(fit_finite_difference, **own)
    if n_z <= settings.dense:
        for kind, ridge in LINEAR_RIDGES.items():
            kinds[kind] = partial(fit_linear, kind=kind, ridge=ridge)
    if few:  # a model of many unknowns reproduces what it is fitted to, whatever it is worth
        kinds = {k: fit for k, fit in kinds.items() if k[:2] != "x1" and k[:6] != "linear"}
    return kinds
