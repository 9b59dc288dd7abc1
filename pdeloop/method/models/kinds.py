# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The kinds of models that are tried, in this order, and how many unknowns each has."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from pdeloop.method.models.base import FieldModel, Measured, Samples
from pdeloop.method.models.coarse import fit_coarse
from pdeloop.method.models.finite_difference import features_of, neighbour_features
from pdeloop.method.models.finite_difference_fit import fit_finite_difference
from pdeloop.method.models.linear import fit_convolution, fit_linear
from pdeloop.method.models.low_rank import fit_low_rank
from pdeloop.method.models.neighbour_fit import fit_neighbours
from pdeloop.method.models.noisy_fit import fit_noisy
from pdeloop.method.models.polynomial import LARGEST_STATE, fit_polynomial
from pdeloop.method.models.settings import DENSE, SPARSE_TERMS, FieldModelSettings
from pdeloop.method.models.sparse_fit import fit_sparse
from pdeloop.method.models.spectral_fit import fit_spectral
from pdeloop.method.models.symbols import Form

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
        return kinds + _linear(n_z, settings) + several
    if not line:
        return kinds + _linear(n_z, settings) + _sparse(n_z, settings) + _polynomial(n_z)
    if components == 1 and n_z >= _FEWEST_POINTS:
        kinds += [
            _spectral(form, settings) for form in FORMS if form.degree <= settings.largest_degree
        ]
    kinds += _several_fields(n_z, components, settings)
    near = _neighbours(n_z, components, settings)
    if components == 1:  # two fields that were not declared
        two = _several_fields(n_z, 2, settings, "two-")
        # Linear ones are tried early, as that is quick.
        kinds[SIMPLEST:SIMPLEST] = [kind for kind in two if kind.name == "two-convolution"]
        kinds += [kind for kind in two if kind.name != "two-convolution"]
        near += _neighbours(n_z, 2, settings, "two-")
    kinds += _linear(n_z, settings) + near + _sparse(n_z, settings)
    return kinds + _polynomial(n_z)


def _spectral(form: Form, settings: FieldModelSettings) -> Kind:
    fit = partial(fit_spectral, form=form, settings=settings)
    enough = SQUARES_ENOUGH if form is FORMS[0] else 1.0
    if form.free != "none":
        return Kind(form.name, fit, form.unknowns)

    def noisy(rollouts: Sequence[Measured], noise: float) -> FieldModel | None:
        return fit_noisy(rollouts, form, settings, noise)

    return Kind(form.name, fit, form.unknowns, noisy, enough=enough)


def _linear(n_z: int, settings: FieldModelSettings) -> list[Kind]:
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


def _neighbours(
    n_z: int, components: int, settings: FieldModelSettings, prefix: str = ""
) -> list[Kind]:
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
            settings=settings,
            ridge=ridge,
        )
        own = 0.0 if ridge is None else count
        kinds.append(Kind(prefix + name, fit, (own, count), needed=NEAR_NEEDED))
    return kinds


def _sparse(n_z: int, settings: FieldModelSettings) -> list[Kind]:
    """Few products of any numbers of a small state."""
    if n_z > _SPARSE_NUMBERS:
        return []
    return [
        Kind(
            name,
            partial(fit_sparse, kind=name, settings=settings, is_map=is_map),
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
                "settings": settings,
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
