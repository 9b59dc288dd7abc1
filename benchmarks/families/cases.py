# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The cases of `python -m benchmarks general`: a base, and what differs from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from benchmarks.families import plants, process
from pde_sim_node.equations import allow

HERE = Path(__file__).parent
FOUR_ACTUATORS = [0.08, 0.31, 0.47, 0.86]
TWELVE_ACTUATORS = [0.02, 0.11, 0.15, 0.27, 0.36, 0.41, 0.52, 0.58, 0.71, 0.77, 0.9, 0.95]


@dataclass(frozen=True)
class Case:
    """A problem of the benchmark.

    Attributes
    ----------
    group : str
        What the case tests.
    base : str
        Shipped problem whose parameters it begins with.
    settings : mapping
        Parameters that replace them.
    physical : mapping
        Parameters of the equation.
    equation : str
        Class in `equations`, instead of the base's.
    plant : str
        Class in `plants`, instead of an equation.
    law_fields : int
        Initial fields that the best affine law is optimised on (`benchmarks.bounds`): more where few
        fields cost far more than the others.
    """

    group: str
    base: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    physical: Mapping[str, float] = field(default_factory=dict)
    equation: str = ""
    plant: str = ""
    law_fields: int = 48

    def parameters(self) -> dict[str, Any]:
        """The parameters that replace those of the base; its code is allowed in this process."""
        given = dict(self.settings)
        if self.plant:
            given["plant"] = getattr(plants, self.plant)()
        given |= {f"physical.{name}": value for name, value in self.physical.items()}
        if self.equation:
            given["equation"] = allow(f"{HERE / 'equations.py'}:{self.equation}")
        return given


def rich(base: str, physical: Mapping[str, float] | None = None, **settings: Any) -> Case:
    """A shipped problem with random modes, varied."""
    return Case("rich initial fields", base, settings, physical or {})


def varied(base: str, physical: Mapping[str, float] | None = None, **settings: Any) -> Case:
    """Another target, weight, horizon, sampling time or set of actuators."""
    return Case("variations", base, settings, physical or {})


def disturbed(base: str, physical: Mapping[str, float] | None = None, **settings: Any) -> Case:
    """With noise or limits."""
    return Case("noise and limits", base, settings, physical or {})


def other(equation: str, **settings: Any) -> Case:
    """A PDE that the project does not ship, with the other settings of kdv."""
    common = {"n_z": 128, "n_a": 10, "reduced_order": 24}
    return Case("other equations", "kdv", {**common, **settings}, {}, equation)


def foreign(
    plant: str, reduced_order: int, variance: float, group: str = "plants of other kinds"
) -> Case:
    """A plant that is not an equation of the compiled solver, explored with this variance."""
    settings = {"reduced_order": reduced_order, "exploration_variance": variance}
    return Case(group, "", settings, {}, "", plant)


VISCOUS = {"viscosity": 1e-2}

CASES: dict[str, Case] = {
    "burgers": Case("as shipped", "burgers"),
    "allen-cahn": Case("as shipped", "allen-cahn"),
    "kdv": Case("as shipped", "kdv"),
    "fisher": Case("as shipped", "fisher"),
    "cahn-hilliard": Case("as shipped", "cahn-hilliard"),
    "ginzburg-landau-20": Case("as shipped", "ginzburg-landau-20"),
    "kuramoto-sivashinsky-22": Case("as shipped", "kuramoto-sivashinsky-22", law_fields=192),
    "convection-diffusion-reaction": Case("as shipped", "convection-diffusion-reaction"),
    "wave": Case("as shipped", "wave"),
    "schrodinger": Case("as shipped", "schrodinger"),
    "burgers-modes": rich("burgers-modes"),
    "burgers-modes, viscosity 1e-2": rich("burgers-modes", VISCOUS),
    "allen-cahn-modes": rich("allen-cahn-modes"),
    "allen-cahn-modes, 8 modes": rich("allen-cahn-modes", {"modes": 8.0}),
    "kdv-modes": rich("kdv-modes"),
    "kdv-modes, 8 modes": rich("kdv-modes", {"modes": 8.0}),
    "allen-cahn-modes, noise 0.05": disturbed("allen-cahn-modes", measurement_noise=0.05),
    "kdv-modes, noise 0.05": disturbed("kdv-modes", measurement_noise=0.05),
    "burgers-modes, viscosity 1e-2, noise 0.03": disturbed(
        "burgers-modes", VISCOUS, measurement_noise=0.03
    ),
    "allen-cahn-modes, limit 3": disturbed("allen-cahn-modes", action_limit=3.0),
    "kdv-modes, limit 1": disturbed("kdv-modes", action_limit=1.0),
    "allen-cahn-modes, twice the horizon": varied("allen-cahn-modes", horizon=160),
    "allen-cahn-modes, sampled at half the rate": varied(
        "allen-cahn-modes", sample_time=0.02, horizon=40
    ),
    "allen-cahn-modes, unequal actuators": varied(
        "allen-cahn-modes", actuator_positions=TWELVE_ACTUATORS
    ),
    "allen-cahn-modes, target 0": varied("allen-cahn-modes", {"target_amplitude": 0.0}),
    "kdv, sampled every 0.1": varied("kdv", sample_time=0.1, horizon=60),
    "kdv-modes, action weight 0.1": replace(varied("kdv-modes", action_weight=0.1), law_fields=192),
    "kdv-modes, four unequal actuators": varied(
        "kdv-modes", n_a=4, actuator_positions=FOUR_ACTUATORS, actuator_width=0.1
    ),
    "kdv-modes, Gaussian actuators": varied(
        "kdv-modes", actuator_shape="gaussian", actuator_width=0.03
    ),
    "burgers-modes, viscosity 1e-2, target 0.4": varied(
        "burgers-modes", {**VISCOUS, "target_amplitude": 0.4}
    ),
    "burgers to fronts": Case("variations", "burgers-modes", {}, VISCOUS, "SteepTarget"),
    "benjamin-ono": other(
        "BenjaminOno",
        sample_time=0.05,
        integration_time=0.01,
        horizon=100,
        exploration_variance=0.1,
    ),
    "kawahara": other("Kawahara", sample_time=0.02, integration_time=0.002, horizon=100),
    "benjamin-bona-mahony": other(
        "BenjaminBonaMahony",
        sample_time=0.1,
        integration_time=0.05,
        horizon=100,
        exploration_variance=0.1,
    ),
    "sine-reaction": other(
        "SineReaction", length=2.0, integration_time=0.01, horizon=100, exploration_variance=0.1
    ),
    "fractional-burgers": other(
        "FractionalBurgers",
        length=1.0,
        n_a=6,
        actuator_width=0.1,
        sample_time=0.05,
        integration_time=0.005,
        horizon=100,
        exploration_variance=0.1,
    ),
    "swift-hohenberg-modes": other(
        "SwiftHohenberg",
        length=25.132741228718345,
        sample_time=0.1,
        integration_time=0.05,
        horizon=100,
        exploration_variance=0.1,
    ),
    "allen-cahn with V(x)": foreign("AllenCahnInhomogeneous", 24, 0.1, "coefficients of x"),
    "reaction-diffusion with D(x), r(x)": foreign(
        "ReactionDiffusionInhomogeneous", 24, 0.1, "coefficients of x"
    ),
    "burgers between walls": foreign("BurgersBetweenWalls", 16, 0.1, "coefficients of x"),
    "fitzhugh-nagumo": foreign("FitzHughNagumo", 16, 0.1, "two components"),
    "gray-scott": foreign("GrayScott", 16, 1e-5, "two components"),
    "sine-gordon": foreign("SineGordon", 16, 0.3, "two components"),
    "lorenz-96": foreign("Lorenz96", 24, 4.0),
    "coupled pendulums": foreign("CoupledPendulums", 24, 1.0),
    "random linear": foreign("RandomLinear", 16, 0.01),
}
"""By name; nobody may choose a constant of the method on the seeds of `general.TABLE_SEEDS`."""

OF_FEW_SENSORS: dict[str, Case] = {
    "allen-cahn-modes, unequal strengths": Case(
        "unequal actuators", "allen-cahn-modes", {}, {}, "AllenCahnUnequal"
    ),
    "allen-cahn with V(x), declared": foreign(
        "AllenCahnInhomogeneousCircle", 24, 0.1, "coefficients of x"
    ),
    "reaction-diffusion with D(x), r(x), declared": foreign(
        "ReactionDiffusionInhomogeneousCircle", 24, 0.1, "coefficients of x"
    ),
}
"""Further ones, where only readings of the field make the difference hard to tell."""


def case_of(problem: str) -> Case:
    """The case of this name, else that of a shipped problem or of a file, as it is."""
    return {**CASES, **OF_FEW_SENSORS}.get(problem) or Case("", problem)


@dataclass(frozen=True)
class ProcessCase(Case):
    """A plant of `process`, with a training's defaults."""

    def parameters(self) -> dict[str, Any]:
        return {"plant": process.PLANTS[self.plant]()}


PROCESS_CASES: dict[str, Case] = {
    name: ProcessCase("process", "", plant=name) for name in process.PLANTS
}
"""The cases of `python -m benchmarks general --family process`."""
