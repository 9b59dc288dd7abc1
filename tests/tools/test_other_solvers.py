# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Plants of other people's solvers: the examples are trained, and do what their equations say."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest

import pdeloop
from pde_sim_node.plants.loading import OWN_PLANTS
from tests.support.interpreter import ROOT

PLANTS = ROOT / "examples" / "plants"


def needs(module: str, package: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(
        find_spec(module) is None, reason=f"{package} is not installed: extra solvers"
    )


def made(name: str, **given: Any) -> Any:
    file, _, kind = name.partition(":")
    return vars(OWN_PLANTS._load_file(str(PLANTS / file)))[kind](**given)


def test_finite_elements_conduct_heat_as_they_must_and_are_trained() -> None:
    plate = made("plate_skfem.py:Plate", refinements=2, rate=0.0)
    z = plate.initial_state(np.random.default_rng(0))
    heat = [float(plate.M.sum(axis=0) @ z)]
    smaller = [z @ plate.M @ z]
    for _ in range(3):
        # Without the reaction no heat is lost through the edges, and the field is smoothed.
        linear = plate.solve(plate.M @ z)
        heat.append(float(plate.M.sum(axis=0) @ linear))
        smaller.append(linear @ plate.M @ linear)
        z = linear
    np.testing.assert_allclose(heat, heat[0], rtol=1e-10)
    assert (np.diff(smaller) < 0).all()

    name = f"{PLANTS}/plate_skfem.py:Plate"
    how = {
        "rollouts": 9,
        "evaluation_fields": 2,
        "reduced_order": 4,
        "horizon": 20,
        "optimizer": "two_point",
    }
    run = pdeloop.train(plant=name, **how, **{"physical.refinements": 1})
    assert run.costs["adapted"].mean() < run.costs["none"].mean()


@needs("pde", "py-pde")
def test_waves_of_py_pde_grow_at_their_rate() -> None:
    plant = made("swift_hohenberg_pypde.py:SwiftHohenberg", points=8)
    x = plant.grid.axes[1].points
    wave = np.tile(np.cos(np.pi * x / 12.0), (8, 1)).ravel()
    # The second difference of the wave between walls without flux.
    k2 = (2 - 2 * np.cos(np.pi / 8)) / 1.5**2
    growth = (1 + 0.5 / 50 * (0.3 - (1 - k2) ** 2)) ** 50
    after = plant.step(1e-6 * wave, np.zeros(4))
    np.testing.assert_allclose(after.ravel(), 1e-6 * growth * wave, atol=1e-12)


@needs("exponax", "exponax")
def test_gradients_through_jax_are_those_of_differences() -> None:
    plant = made("burgers_exponax.py:Burgers", points=16)
    gradients = pdeloop.Gradients(plant)
    policy = np.zeros((4, 8))
    U = np.linalg.qr(np.random.default_rng(0).standard_normal((16, 4)))[0]
    found = gradients.of_policy(U, policy, [0])
    change, step = np.random.default_rng(1).standard_normal((4, 8)), 1e-5
    costs = [
        pdeloop.rollout(
            plant, pdeloop.projected_law(gradients.plant, U, s * change), [0]
        ).costs.mean[0]
        for s in (step, -step)
    ]
    along = float(np.sum(found.gradient * change))
    assert along == pytest.approx((costs[0] - costs[1]) / (2 * step), rel=1e-5)
