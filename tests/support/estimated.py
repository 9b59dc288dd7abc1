# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Small equations of a field between eight sensors, their filters, and laws on the estimate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pdeloop.messages.model_rows import ModelRows
from pdeloop.method.adapt import Context, Trajectory
from pdeloop.method.adapt.sensed_loop import SensedLoop, sensed_loop
from pdeloop.method.laws import ExtendedKalman, Law
from pdeloop.method.models.sensed import (
    COEFFICIENTS,
    TERMS,
    WAVES,
    Actuators,
    SensedFilter,
    SensedModel,
    field_of,
    sensed_model,
    unknowns,
)
from tests.support.sensed import PLACES, SENSORS

Array = np.ndarray
N_A, T, N_S = 3, 24, 6
ACTUATORS = Actuators((np.arange(N_A) + 0.5) / N_A, np.full(N_A, 0.1))
SPREAD = np.concatenate([[0.3], *2 * [np.r_[1.0, 0.7, 0.4, np.full(WAVES - 3, 1e-3)]]])
FACTOR = np.diag(SPREAD)
SEEN = slice(4, None, 8)
"""The sensors among the 64 points of the grid."""
SIGMA = 0.2


def model_of(**terms: float) -> SensedModel:
    """The equation with these terms, like z1_x2 for the second derivative of z."""
    shared = np.zeros(unknowns(N_A))
    for name, value in terms.items():
        p, j = (int(part) for part in name[1:].split("_x"))
        shared[TERMS.index((p, j))] = value
    shared[COEFFICIENTS] = 5.0
    model = sensed_model(shared, PLACES, ACTUATORS, 4.0, noise=SIGMA)
    return replace(model, spread=SPREAD)


LINEAR = model_of(z1_x0=1.5, z1_x1=20.0, z1_x2=0.5)
CUBIC = model_of(z1_x0=8.0, z1_x2=0.5, z3_x0=-1.0)


def filter_of(model: SensedModel, sigma: float = SIGMA, factor: Array = FACTOR) -> SensedFilter:
    return SensedFilter(model, np.zeros(SPREAD.size), factor, sigma)


def rows_of(gain: float = 0.0) -> ModelRows:
    rng = np.random.default_rng(2)
    A, B, K = (0.3 * rng.standard_normal(shape) for shape in ((N_S, N_S), (N_S, N_A), (N_A, N_S)))
    U = np.linalg.qr(rng.standard_normal((SENSORS, N_S)))[0]
    return ModelRows(A=A, B=B, U=U, K_a=gain * K, K_b=gain * K, s_r=np.zeros(N_S))


def context_of(law: Law) -> Context:
    target, none = np.zeros(SENSORS), np.zeros((T, N_A))
    seen = Trajectory(np.ones((T + 1, SENSORS)), none)
    return Context(law.model.U, target, 1.0, 0.1, T, seen, sensors=SENSORS, law=law)


def loop_of(model: SensedModel) -> tuple[SensedLoop, ExtendedKalman]:
    law = ExtendedKalman(rows_of(), T)
    return sensed_loop(context_of(law), model), law


def fields(count: int, seed: int = 0) -> Array:
    rng = np.random.default_rng(seed)
    return field_of(SPREAD * rng.standard_normal((count, SPREAD.size)), 64)
