# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What many tests compile, in parts for several workers; forked processes inherit it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from pdeloop.method.models.finite_difference import features_of, of_features
from pdeloop.method.models.linear import LinearModel
from pdeloop.method.models.spectral import SpectralModel
from pdeloop.training_run import load_compiled, resolve
from tests.support.small import SMALL


def load_nodes() -> None:
    """The step, the law and the fast path of the small problem."""
    load_compiled(resolve(str(SMALL), {}))


def load_field_models() -> None:
    """The models of fields that the optimisers fit: a tiny one of each form."""
    n = 16  # has a compiled transform
    B, constant = np.zeros((n, 1)), np.zeros(n)
    none = np.zeros(n // 2 + 1, dtype=np.complex128)
    spectral = SpectralModel("poly2", none, none[None], np.ones((1, 1)), B, constant, 2)
    features = features_of(1)
    C = np.zeros((len(features), 1, n))
    differences = of_features("tiny", features, C, B, constant, 1)
    states, actions = np.zeros((2, n)), np.zeros((2, 1))
    spectral.compiled.integrals(states, actions, states)
    differences.means(states, actions, states)
    for model in (spectral, differences, LinearModel("tiny", np.zeros((n, n)), B, constant)):
        model.step(states, actions)
        model.pull_back(states, actions, states)


COMPILED: Mapping[str, Callable[[], None]] = MappingProxyType(
    {"nodes": load_nodes, "field-models": load_field_models}
)
"""The parts by name."""
