# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law on an extended Kalman filter's estimate of the field between few sensors."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from threading import get_ident

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.laws.base import Law, Parts
from pdeloop.method.laws.linear import Observer
from pdeloop.method.models.base import DEFAULTS, FieldModelSettings
from pdeloop.method.models.sensed import (
    SENSED_MOST,
    WAVES,
    Actuators,
    SensedFilter,
    grid_points,
    sensed_model,
    unknowns,
)

FIELD_COEFFICIENTS = 1 + 2 * WAVES
"""Fourier coefficients of an initial field."""


class ExtendedKalman(Observer):
    """The law `observer`, and feedback of the field that an extended Kalman filter estimates:

        a_k = K_e x_k + K p_k + D s_k + b

    with x_k the estimate of the field given all readings so far (`SensedFilter`), on a grid of n
    points. It begins as the law `observer`, with K_e = 0, where no filter is computed; `model_based`
    writes the equation, the distribution of initial fields and the filter's constants into theta. Its
    memory is p_k, the prediction of x_k and the columns S_k of the square root of its covariance.

    Source: Anderson, Moore, *Optimal Filtering*, 1979, section 8.2.
    """

    name = "extended_kalman"
    needs_model = True
    # It has no derivative: an estimate is not linear in the readings.
    pull_back = Law.pull_back
    pull_back_memory = Law.pull_back_memory

    @property
    def points(self) -> int:
        """n; 0 of a law of more readings than a field is estimated from."""
        readings = len(self.model.U)
        return grid_points(readings) if readings <= SENSED_MOST else 0

    @property
    def memory_size(self) -> int:  # type: ignore[override]
        return super().memory_size + self.points * (1 + FIELD_COEFFICIENTS)

    def start(self) -> Parts:
        """The parts of `Observer`, and of the filter:

        K_e (n_a, n); equation (44 + n_a,), places (n_y,), centres (n_a,) and widths (n_a,), as for
        `SensedModel`; integration (4,), its largest field, internal steps, their reach and its fastest
        growth; mean (33,) and factor (33, 33) of initial fields; noise (1,), sigma.
        """
        n_a = self.n_a
        own = {
            "K_e": np.zeros((n_a, self.points)),
            "equation": np.zeros(unknowns(n_a)),
            "places": np.zeros(len(self.model.U)),
            "centres": np.zeros(n_a),
            "widths": np.zeros(n_a),
            "integration": np.zeros(4),
            "mean": np.zeros(FIELD_COEFFICIENTS),
            "factor": np.zeros((FIELD_COEFFICIENTS, FIELD_COEFFICIENTS)),
            "noise": np.zeros(1),
        }
        return {**super().start(), **own}

    def estimates(self, theta: Array) -> bool:
        """True if actions depend on the filter's estimate."""
        return bool(self.parts(np.ravel(theta))["K_e"].any())

    def filter(self, theta: Parts) -> SensedFilter | None:
        """The filter in theta; None where its equation cannot be integrated."""
        names = "equation", "places", "centres", "widths", "integration", "mean", "factor", "noise"
        return _filter(get_ident(), *(theta[name].tobytes() for name in names))

    def theta_of(
        self, K: Array, b: Array, known: SensedFilter, settings: FieldModelSettings
    ) -> Array:
        """Theta of a_k = K x_k + b on the estimates of this filter.

        settings: those that its model was made with.
        """
        model = known.model
        parts = dict(self.parts(np.zeros(self.size)))
        parts |= {
            "K_e": K,
            "b": b,
            "equation": model.shared,
            "places": model.places,
            "centres": model.actuators.centres,
            "widths": model.actuators.widths,
            "integration": np.array(
                [model.largest, settings.substeps, settings.reach, settings.sensed_growth]
            ),
            "mean": known.mean,
            "factor": known.factor,
            "noise": np.array([known.noise]),
        }
        return self.vector(parts)

    def action(self, theta: Parts, z: Array, memory: Array, k: int) -> Array:
        p, _ = self._split(memory)
        a = super().action(theta, z, p, k)
        if theta["K_e"].any():
            found = self.estimate(theta, z, memory, k)
            a = a + theta["K_e"] @ (np.full(self.points, np.nan) if found is None else found[0][0])
        return a

    def memory_update(self, theta: Parts, z: Array, memory: Array, action: Array, k: int) -> Array:
        p, rest = self._split(memory)
        p = super().memory_update(theta, z, p, action, k)
        found = self.estimate(theta, z, memory, k) if theta["K_e"].any() else None
        if found is None:
            return np.concatenate([p, np.zeros_like(rest)])
        known = self.filter(theta)
        assert known is not None
        x, S = known.predicted(*found, action[None])
        return np.concatenate([p, x[0], S[0].ravel()])

    def _split(self, memory: Array) -> tuple[Array, Array]:
        n_s = len(self.model.A)
        return memory[:n_s], memory[n_s:]

    def prediction(self, memory: Array) -> Array:
        """The field (n,) that a memory after step 0 predicts for the next reading."""
        return self._split(memory)[1][: self.points]

    def estimate(self, theta: Parts, z: Array, memory: Array, k: int) -> tuple[Array, Array] | None:
        """x and S of one environment after its newest reading."""
        known = self.filter(theta)
        if known is None:
            return None
        n, rest = self.points, self._split(memory)[1]
        x, S = (rest[:n], rest[n:].reshape(-1, n)) if k else known.start
        return known.measured(x[None], S[None], z[None])


# Every step of an episode asks for it. One thread at a time may use a model.
@lru_cache(maxsize=64)
def _filter(thread: int, *parts: bytes) -> SensedFilter | None:
    shared, places, centres, widths, integration, mean, factor, noise = map(np.frombuffer, parts)
    largest, substeps, reach, growth = integration.tolist()
    actuators, first = Actuators(centres, np.abs(widths)), factor.reshape(FIELD_COEFFICIENTS, -1)
    try:
        settings = replace(
            DEFAULTS,
            substeps=max(int(np.clip(substeps, 1, 1000)), 1),
            reach=reach,
            sensed_growth=growth,
        )
        with np.errstate(all="ignore"):
            model = sensed_model(shared, places, actuators, largest, settings)
            model.step(np.zeros((1, model.n_z)), np.zeros((1, model.n_a)))
    except (ValueError, ZeroDivisionError, OverflowError):
        return None
    return SensedFilter(model, mean, first, *np.abs(noise).tolist())
