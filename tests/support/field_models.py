# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A small model of the whole state of each form, made of random numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.models import FieldModel
from pdeloop.method.models.finite_difference import (
    FiniteDifferenceModel,
    features_of,
    neighbour_features,
    of_features,
)
from pdeloop.method.models.linear import LinearModel, ProjectedModel, ReadingsModel
from pdeloop.method.models.polynomial import PolynomialModel
from pdeloop.method.models.sensed import TERMS, VARIATIONS, SensedModel, sensed_model, unknowns
from pdeloop.method.models.spectral import SpectralModel
from tests.support.sensed import DECLARED, PLACES

N_A = 2


def spectral(n_z: int = 24, degree: int = 3, clip: float = np.inf) -> SpectralModel:
    rng = np.random.default_rng(degree)
    modes, k = n_z // 2 + 1, 1j * np.arange(n_z // 2 + 1)
    return SpectralModel(
        kind=f"poly{degree}",
        linear=0.1 * k + 0.02 * k**2,
        multipliers=np.array([0.05 * k, 0.1 * np.ones(modes)])[: min(degree - 1, 2)],
        polynomials=rng.normal(size=(min(degree - 1, 2), degree - 1)) * 0.5,
        B=rng.normal(size=(n_z, N_A)),
        constant=rng.normal(size=n_z),
        substeps=3,
        clip=clip,
    )


def differences(
    components: int, shape: tuple[int, ...] = (9,), *, neighbours: bool = False
) -> FiniteDifferenceModel:
    """On a grid of this shape, of differences or of products of neighbours."""
    rng, points = np.random.default_rng(components), int(np.prod(shape))
    features = neighbour_features(components) if neighbours else features_of(components, len(shape))
    C = 0.03 * rng.normal(size=(len(features), components, points))
    B, c = rng.normal(size=(components * points, N_A)), rng.normal(size=components * points)
    kind, axes = "near1e-9" if neighbours else "x1e-5", shape if len(shape) > 1 else ()
    return of_features(kind, features, C, B, 0.1 * c, 3, axes)


def coarse() -> ProjectedModel:
    """Of half of the points of a grid on two axes."""
    inner, rng = differences(1, (6, 8)), np.random.default_rng(0)
    points = np.sort(rng.choice(96, 48, replace=False))
    return ProjectedModel(inner, np.eye(96)[points], rng.standard_normal((96, 48)) / 7)


def linear(n_z: int = 10) -> LinearModel:
    rng = np.random.default_rng(0)
    return LinearModel(
        "linear", rng.normal(size=(n_z, n_z)), rng.normal(size=(n_z, N_A)), rng.normal(size=n_z)
    )


def polynomial(n_z: int = 8) -> PolynomialModel:
    rng = np.random.default_rng(0)
    scale, products = np.linspace(0.5, 1.0, N_A), np.array([[0, 0], [0, 3]])
    parts = (rng.standard_normal((n_z, 3)), rng.standard_normal(n_z), rng.standard_normal(N_A))
    return PolynomialModel(
        "k", *parts, scale, products, 0.3 * rng.standard_normal((1 + 3 + N_A + 2, n_z))
    )


def readings() -> ReadingsModel:
    rng = np.random.default_rng(0)
    shapes = (3, 3), (3, N_A), (3,), (2, 3), (3, 2), (8, 2)
    return ReadingsModel("k", *map(rng.standard_normal, shapes), innovations=np.eye(2))


def sensed(**changed: Any) -> SensedModel:
    """Of three actuators, with coefficients that depend on x."""
    shared = np.zeros(unknowns(3))
    for term, value in {(1, 0): 1.0, (1, 2): 12.0, (2, 1): -2.0, (3, 0): -1.0}.items():
        shared[TERMS.index(term)] = value
    varying = {(1, 0, 2, True): 3.0, (1, 1, 1, True): 0.5, (1, 2, 1, False): 9.0}
    for variation, value in {**varying, (3, 0, 1, False): -0.4}.items():
        shared[len(TERMS) + VARIATIONS.index(variation)] = value
    return replace(sensed_model(shared, PLACES, DECLARED, 4.0), **changed)


MODELS: Mapping[str, Callable[[], FieldModel]] = MappingProxyType(
    {
        "squares": lambda: spectral(degree=2),
        "cubes": spectral,
        "degree 7": lambda: spectral(degree=7, clip=1.1),
        "odd": lambda: spectral(n_z=25),
        "spectral": lambda: replace(spectral(), fewer=np.array([[0.9, 1.0], [1.2, 2.0]])),
        "finite-difference": lambda: differences(1),
        "two components": lambda: differences(2),
        "two axes": lambda: differences(1, (6, 8)),
        "two components on two axes": lambda: differences(2, (6, 8)),
        "projected": coarse,
        "neighbours": lambda: differences(1, (7,), neighbours=True),
        "neighbours of two components": lambda: differences(2, (7,), neighbours=True),
        "linear": linear,
        "polynomial": polynomial,
        "readings": readings,
        "sensed": sensed,
        "sensed, of cut fields": lambda: sensed(clip=0.7),
    }
)
"""By form, or by what is particular to it."""


def points(model: FieldModel, count: int = 3) -> tuple[Array, Array, Array]:
    """States, actions and covectors."""
    rng = np.random.default_rng(1)
    states = 0.5 * rng.normal(size=(count, model.n_z))
    return states, rng.normal(size=(count, model.n_a)), rng.normal(size=(count, model.n_z))
