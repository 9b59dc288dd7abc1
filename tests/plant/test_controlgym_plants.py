# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The PDEs of controlgym: its trajectories, initial fields, supports and default sizes."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pde_sim_node.build import build_plant
from pde_sim_node.plants import SpectralPlant
from pdeloop.messages.problem import load_parameters

DATA = Path(__file__).parents[1] / "data"
SEMILINEAR = ("kuramoto-sivashinsky", "fisher", "cahn-hilliard", "ginzburg-landau")
LINEAR = ("convection-diffusion-reaction", "wave", "schrodinger")


def golden_and_plant(name: str, eighths: bool) -> tuple[Any, SpectralPlant]:
    golden = np.load(DATA / f"controlgym_{name.replace('-', '_')}.npz")
    values = load_parameters(name, {})
    if eighths:  # a step of which controlgym's rounding loses none
        values["integration_time"] = values["sample_time"] / 8
    return golden, build_plant(values)


@pytest.mark.parametrize("name", SEMILINEAR)
def test_a_forced_trajectory_and_its_costs_are_controlgyms(name: str) -> None:
    golden, plant = golden_and_plant(name, eighths=True)
    z = golden["states"][:1]
    for k, action in enumerate(golden["actions"]):
        z, cost = plant.evaluate(z, action[None])
        np.testing.assert_allclose(z[0], golden["states"][k + 1], rtol=0, atol=1e-9)
        np.testing.assert_allclose(cost[0], golden["stage_costs"][k], rtol=1e-9)


@pytest.mark.parametrize("name", LINEAR)
def test_a_linear_plant_moves_as_controlgyms_does_between_its_actions(name: str) -> None:
    """controlgym adds Phi a at the end of a sample instead of holding a over it."""
    golden, plant = golden_and_plant(name, eighths=False)
    n_x = len(plant.x)
    kick = np.zeros(plant.n_z)
    for k, action in enumerate(golden["actions"]):
        z = golden["states"][k : k + 1]
        free, _ = plant.evaluate(z, np.zeros((1, plant.n_a)))
        kick[plant.equation.actuated * n_x :][:n_x] = plant.supports @ action
        np.testing.assert_allclose(free[0] + kick, golden["states"][k + 1], rtol=0, atol=1e-11)
        _, cost = plant.evaluate(z, action[None])
        action_part = (1 - plant.action_weight) * action @ action
        np.testing.assert_allclose(cost[0] + action_part, golden["stage_costs"][k], rtol=1e-12)


@pytest.mark.parametrize("name", SEMILINEAR + LINEAR)
def test_supports_and_the_mean_initial_field_are_controlgyms(name: str) -> None:
    golden, plant = golden_and_plant(name, eighths=False)
    supports = np.zeros((plant.n_z, plant.n_a))
    first = plant.equation.actuated * len(plant.x)
    supports[first : first + len(plant.x)] = plant.supports
    assert np.array_equal(supports, golden["supports"])
    np.testing.assert_allclose(plant.reset([-1])[0], golden["states"][0], rtol=0, atol=1e-13)
    assert not plant.target.any()


@pytest.mark.parametrize(
    ("name", "length", "sample_time", "horizon", "n_z"),
    [
        ("kuramoto-sivashinsky", 32 * np.pi, 0.5, 500, 256),
        ("fisher", 10.0, 0.05, 100, 256),
        ("cahn-hilliard", 2.0, 0.01, 50, 256),
        ("ginzburg-landau", 100.0, 0.1, 100, 256),
        ("convection-diffusion-reaction", 1.0, 0.1, 100, 200),
        ("wave", 1.0, 0.1, 200, 200),
        ("schrodinger", 1.0, 0.001, 500, 256),
    ],
)
def test_the_shipped_problems_have_controlgyms_sizes(
    name: str, length: float, sample_time: float, horizon: int, n_z: int
) -> None:
    values = load_parameters(name, {})
    assert values["length"] == length
    assert (values["sample_time"], values["horizon"], values["n_z"]) == (sample_time, horizon, n_z)
    assert (values["n_a"], values["actuator_width"]) == (8, 0.1)
    # controlgym's linear plants take an action as an impulse, which is sample_time times a held one.
    impulses = ("convection-diffusion-reaction", "schrodinger")
    weight = sample_time**2 if name in impulses else 1.0
    assert (values["state_weight"], values["action_weight"]) == (1.0, pytest.approx(weight))
    assert not [key for key in values if key.startswith("physical.")], "the equation's defaults"


@pytest.mark.parametrize("name", ["kuramoto-sivashinsky", "ginzburg-landau"])
def test_eight_equal_actuators_cannot_reach_some_growing_waves(name: str) -> None:
    """Symmetric supports at (j + 1/2) L/8 push cos and sin of 4, 8 and 12 waves alike, or one not.

    So no law with controlgym's actuators stabilises u = 0; twenty narrower ones reach every wave, and
    so do eight at unequal distances.
    """

    def unreached(**changes: Any) -> list[int]:
        plant = build_plant({**load_parameters(name, {}), **changes})
        found = []
        for waves in range(1, 41):
            k = 2 * np.pi * waves / plant.equation.length
            (growth,) = plant.equation.linear_operator(np.array([k]))
            pair = np.stack([np.cos(k * plant.x), np.sin(k * plant.x)]) @ plant.supports
            if growth > 0 and np.linalg.svd(pair, compute_uv=False)[-1] < 1e-9:
                found.append(waves)
        return found

    assert unreached() == [4, 8, 12]
    assert unreached(n_a=20, actuator_width=0.05) == []
    assert unreached(actuator_positions=[0.05, 0.17, 0.31, 0.44, 0.55, 0.68, 0.83, 0.93]) == []
