# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Derivatives of nonlinearities that call `math`, against closed forms."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from dataclasses import dataclass
from math import exp, tanh

import numba
import numpy as np
import pytest

from pde_sim_node.equations import AllenCahn
from pdeloop.gradients import Gradients
from pdeloop.solver.adjoint import derivative_loop
from pdeloop.solver.dual_math import PAIRS, on_duals
from tests.support.plants import plant_of

POINTS = np.array([0.2, 0.35, 0.8])


def slopes(function: Callable[[float], float]) -> np.ndarray:
    values = POINTS.copy()
    address = values.ctypes.data_as(ctypes.POINTER(ctypes.c_double))
    derivative_loop(function).ctypes(address, values.size)
    return values


@pytest.mark.parametrize("name", PAIRS)
def test_each_derivative_is_that_of_its_function(name: str) -> None:
    value, slope = PAIRS[name]
    points, h = POINTS + 1.0 if name == "acosh" else POINTS, 1e-4
    for u in points.tolist():
        finite = (8 * (value(u + h) - value(u - h)) - (value(u + 2 * h) - value(u - 2 * h))) / (
            12 * h
        )
        assert slope(u) == pytest.approx(finite, rel=1e-9)


@numba.njit
def helper(u: float) -> float:
    return math.sin(0.5 * u)


@pytest.mark.parametrize(
    ("function", "exact"),
    [
        (lambda u: u * math.sin(u), lambda u: np.sin(u) + u * np.cos(u)),
        (
            lambda u: tanh(u) * exp(-u) + math.pi,
            lambda u: np.exp(-u) * (1 / np.cosh(u) ** 2 - np.tanh(u)),
        ),
        (lambda u: helper(u) * u, lambda u: np.sin(0.5 * u) + 0.5 * u * np.cos(0.5 * u)),
        (lambda u: math.log(u) + math.sqrt(2.0) * u, lambda u: 1 / u + np.sqrt(2)),
        (lambda u: math.pow(u, 3), lambda u: 3 * u**2),
        (lambda u: 1e-9 * np.sin(u), lambda u: 1e-9 * np.cos(u)),
    ],
)
def test_a_nonlinearity_may_call_math(
    function: Callable[[float], float], exact: Callable[[np.ndarray], np.ndarray]
) -> None:
    np.testing.assert_allclose(slopes(function), exact(POINTS), rtol=1e-13)


def test_what_has_no_derivative_is_refused_however_small_it_is() -> None:
    for function in (lambda u: 1e-9 * abs(u), lambda u: max(u, 0.0), lambda u: math.fabs(u)):
        with pytest.raises(ValueError, match="complex"):
            derivative_loop(function)


def test_a_function_without_math_is_left_as_it_is() -> None:
    def cubic(u: float) -> float:
        return u * u * u

    assert on_duals(cubic) is cubic


def test_gradients_of_a_plant_whose_nonlinearity_calls_math_agree_with_finite_differences() -> None:
    @dataclass(frozen=True, kw_only=True)
    class Driven(AllenCahn):
        name = "driven"

        @staticmethod
        def nonlinearity(u: float) -> float:
            return math.sin(2.0 * u)

    plant = plant_of(
        Driven(), n_z=32, n_a=2, width=0.2, horizon=4, sample_time=0.02, integration_time=0.01
    )
    gradients, rng = Gradients(plant), np.random.default_rng(0)
    actions, move = rng.normal(size=(2, 4, 1, 2))
    found = gradients.of_actions(actions, [3])
    plus, minus = (gradients.of_actions(actions + h * move, [3]).cost for h in (1e-5, -1e-5))
    assert float(np.sum(found.gradient * move)) == pytest.approx((plus - minus) / 2e-5, rel=1e-7)
