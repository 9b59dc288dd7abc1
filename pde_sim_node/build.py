# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A plant from a problem's resolved parameters."""

from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any

import numpy as np

from pde_sim_node.equations import Equation, configured_equation
from pde_sim_node.instruments import InstrumentedPlant
from pde_sim_node.plant import Instruments, Plant
from pde_sim_node.plants.dynamics_plant import SETTABLE
from pde_sim_node.plants.loading import PHYSICAL, Made, make, physical_of
from pde_sim_node.plants.spectral import NUMBERS, SpectralPlant
from pde_sim_node.plants.stateful_plant import plant_of
from pdeloop.messages.actuators import extents
from pdeloop.messages.cost import Cost
from pdeloop.messages.parameters import INSTRUMENTS, table
from pdeloop.messages.spec import ParameterError

_FIXED = ("n_z", "n_a", "sample_time")
"""Parameters that a user's own plant supplies and a problem cannot change."""
EXTENTS, BOUNDS = "actuator_extents", "action_bounds"
SUPPLIED = (*_FIXED, "grid", "length", "cost", BOUNDS, EXTENTS)
"""Those and the other parameters that such a plant fills in."""


def build_equation(values: Mapping[str, Any]) -> Equation:
    """The equation named by `equation`, with `length` and `physical.*`. ValueError if none fits."""
    kind = configured_equation(str(values["equation"]))
    known = [item.name for item in fields(kind) if item.name != "length"]
    physical = physical_of(values)
    for name in physical:
        if name not in known:
            raise ParameterError(
                f"unknown parameter 'physical.{name}' of {kind.name}; known: {', '.join(known)}"
            )
    return kind(length=values["length"], **physical)


def build_plant(values: Mapping[str, Any], *, compiled: bool = True) -> Plant:
    """The plant of a problem. ValueError, one sentence, if the parameters do not fit together.

    compiled: its step is compiled now, which can take long; otherwise with the first step.
    """
    return _build(values, compiled)[0]


def fingerprint(values: Mapping[str, Any]) -> int:
    """The fingerprint of a problem's plant; see `definition.Definition`."""
    return build_plant(values, compiled=False).definition.fingerprint


def complete(values: Mapping[str, Any], *, compiled: bool = True) -> tuple[Plant, dict[str, Any]]:
    """The plant of a problem, and the parameters with those that the plant defines itself."""
    plant, physical = _build(values, compiled)
    own = {name: getattr(plant, name) for name in (*_FIXED, *SETTABLE)}
    axes = plant.grid.axes
    own |= {"grid": plant.grid.text, "length": axes[-1].length if axes else 1.0, "reduced_order": 0}
    own["cost"] = plant.cost.texts if values["plant"] else list(values.get("cost", ()))
    own[BOUNDS] = plant.action_set.bounds
    own[EXTENTS] = _declared_actuators(plant, values)
    given = {**values, **{f"{PHYSICAL}{name}": value for name, value in physical.items()}}
    if values["plant"]:
        for spec in table():
            if spec.name in own:
                spec.check(own[spec.name], f"{spec.name} of {values['plant']}")
        return plant, {**own, **given}
    names = ["grid", "cost"]
    names += [] if values.get(EXTENTS) else [EXTENTS]
    names += ["state_weight", "action_weight"] if own["cost"] else []
    return plant, {**given, **{name: own[name] for name in names}}


def _declared_actuators(plant: Plant, values: Mapping[str, Any]) -> list[float]:
    """Centres and widths of the actuators that an equation or a plant places itself, else none."""
    placed = values["plant"] or (
        values["actuator_shape"] == "equation"
        and not values["actuator_positions"]
        and configured_equation(str(values["equation"])).supports is not Equation.supports
    )
    grid, supports = plant.grid, plant.supports
    if not placed or supports is None or not grid.is_circle or len(grid.components) > 1:
        return []
    return [float(number) for number in np.concatenate(extents(supports))]


def _build(values: Mapping[str, Any], compiled: bool) -> tuple[Plant, Mapping[str, Any]]:
    """A plant, and the parameters of the equation or plant itself, the defaults among them."""
    plant, physical = _own_plant(values) if values["plant"] else _spectral_plant(values, compiled)
    given = {spec.name: values.get(spec.name, spec.default) for spec in INSTRUMENTS}
    if values["plant"]:
        del given[BOUNDS]  # it applies its own
    instruments = Instruments(**given)
    return plant if instruments.ideal else InstrumentedPlant(plant, instruments), physical


def _spectral_plant(values: Mapping[str, Any], compiled: bool) -> tuple[Plant, Mapping[str, Any]]:
    equation = build_equation(values)
    grid = {name: values[name] for name in NUMBERS}
    grid |= {name: values[f"actuator_{name}"] for name in ("width", "shape", "positions")}
    physical = asdict(equation)
    del physical["length"]
    try:
        cost = Cost.parse(values.get("cost", ()))
    except ValueError as error:
        raise ParameterError(f"parameter 'cost': {error}") from error
    return SpectralPlant(equation, **grid, cost=cost, compiled=compiled), physical


def _own_plant(values: Mapping[str, Any]) -> tuple[Plant, Mapping[str, Any]]:
    made: Made = make(values)
    plant, given = made.plant, {name: values[name] for name in SETTABLE if name in values}
    if not isinstance(plant, Plant):
        plant = plant_of(plant, **given)
    for name in (*_FIXED, *SETTABLE):
        if name in values and values[name] != getattr(plant, name):
            raise ParameterError(
                f"parameter '{name}' is {values[name]!r}, but the plant {values['plant']} has "
                f"{getattr(plant, name)!r}; leave it out"
            )
    if values.get("cost") and "".join(values["cost"]) != "".join(plant.cost.texts):
        raise ParameterError(
            f"parameter 'cost' differs from that of the plant {values['plant']}; leave it out"
        )
    if values.get(BOUNDS) and list(values[BOUNDS]) != plant.action_set.bounds:
        raise ParameterError(
            f"parameter '{BOUNDS}' differs from that of the plant {values['plant']}; leave it out"
        )
    return plant, made.parameters
