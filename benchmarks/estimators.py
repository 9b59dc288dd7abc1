# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Laws on an estimate of the state, for `benchmarks.methods`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg

from pde_sim_node.instruments import InstrumentedPlant
from pde_sim_node.plant import Plant
from pde_sim_node.plants import SpectralPlant
from pdeloop.episode import Law
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.method.design.lqt import Gains
from pdeloop.method.reduce.reduced_model import ReducedModel


class Experiment(NamedTuple):
    """A rollout: states that a model is identified from (N + 1, n), actions, and what was measured."""

    states: Array
    actions: Array
    measured: Array


class Identified(NamedTuple):
    """A reduced model with its LQ-tracking gains and reduced target, and the data it is from."""

    model: ReducedModel
    gains: Gains
    s_r: Array
    data: Sequence[Experiment]


class KalmanLaw:
    """LQG: LQ tracking of the reduced state that a Kalman filter estimates from the newest readings.

        s_{k+1} = A s_k + B a_k + w_k,    y_k = C s_k + v_k

    C is the regression of the readings on the reduced states in the data, and the covariances of w, v
    and s_0 are those found there. Anderson, Moore, *Optimal Filtering*, section 3.1.
    """

    def __init__(self, known: Identified, n_y: int, action_set: ActionSet) -> None:
        model, data = known.model, known.data
        self._known, self._n_y, self._action_set = known, n_y, action_set
        s = [each.states @ model.U for each in data]
        w = [
            own[1:] - own[:-1] @ model.A.T - each.actions @ model.B.T
            for own, each in zip(s, data, strict=True)
        ]
        y = np.vstack([each.measured[:, :n_y] for each in data])
        self._C = linalg.lstsq(np.vstack(s), y)[0].T
        v = y - np.vstack(s) @ self._C.T
        self._W, self._V = (e.T @ e / len(e) for e in (np.vstack(w), v))
        self._V += 1e-9 * np.trace(y.T @ y / len(y)) * np.eye(n_y)
        self._first = np.stack([own[0] for own in s])

    def __call__(self, k: int, states: Array) -> Array:
        (A, B), C, n_s = (self._known.model.A, self._known.model.B), self._C, len(self._C.T)
        if k == 0:
            mean = self._first.mean(axis=0)
            spread = self._first - mean
            prior = spread.T @ spread / len(spread) + 1e-3 * (mean @ mean) * np.eye(n_s)
            self._s, self._P = np.tile(mean, (len(states), 1)), prior
        try:
            gain = linalg.solve(C @ self._P @ C.T + self._V, C @ self._P, assume_a="pos").T
        except linalg.LinAlgError as error:
            raise ValueError(f"the Kalman filter's covariance is singular in step {k}") from error
        s = self._s + (states[:, : self._n_y] - self._s @ C.T) @ gain.T
        P = (np.eye(n_s) - gain @ C) @ self._P
        actions: Array = s @ self._known.gains.K_a.T + self._known.gains.K_b @ self._known.s_r
        actions = self._action_set.project(actions)
        self._s, self._P = s @ A.T + actions @ B.T, A @ P @ A.T + self._W
        return actions


class LikeliestField:
    """A law of the whole field, on the likeliest field of the true plant given all readings so far.

    Candidates are drawn from the distribution of initial fields and advanced by the true plant under
    the actions that were taken; the one whose readings fit best, in the sum of squares, is taken for
    the field. Without process noise that is maximum likelihood on the candidates: what is lost against
    the law on the whole field is the price of the sensors, and no model's.
    """

    def __init__(self, sensed: InstrumentedPlant, true: Plant, law: Law, seeds: list[int]) -> None:
        self._sensed, self._true, self._law = sensed, true, law
        assert isinstance(true, SpectralPlant)
        draw = true.equation.initial_field
        self._candidates = np.stack([draw(true.x, np.random.default_rng(s)).ravel() for s in seeds])
        self._scale = np.sqrt(true.n_z / sensed.state_size)

    def __call__(self, k: int, states: Array) -> Array:
        positions, (count, n_z) = self._sensed.positions, self._candidates.shape
        if k == 0:
            self._fields = np.tile(self._candidates, (len(states), 1, 1))
            self._misfit = np.zeros((len(states), count))
        readings = states[:, None, : positions.size] / self._scale
        self._misfit += np.sum((self._fields[:, :, positions] - readings) ** 2, axis=2)
        likeliest = self._fields[np.arange(len(states)), np.argmin(self._misfit, axis=1)]
        actions = self._law(k, likeliest)
        after, _ = self._true.evaluate(
            self._fields.reshape(-1, n_z), np.repeat(actions, count, axis=0)
        )
        self._fields = after.reshape(self._fields.shape)
        return actions
