# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A plant from a problem's resolved parameters."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from loop_interfaces.parameters import INSTRUMENTS
from pde_sim_node.equations import Equation, configured_equation
from pde_sim_node.instruments import InstrumentedPlant
from pde_sim_node.plant import Instruments, Plant
from pde_sim_node.plants import SpectralPlant


def build_equation(values: Mapping[str, Any]) -> Equation:
    """The equation named by `equation`, with `length` and `physical.*`. ValueError if none fits."""
    kind = configured_equation(str(values["equation"]))
    known = [item.name for item in fields(kind) if item.name != "length"]
    physical = {
        name.removeprefix("physical."): value
        for name, value in values.items()
        if name.startswith("physical.")
    }
    for name in physical:
        if name not in known:
            raise ValueError(
                f"unknown parameter 'physical.{name}' of {kind.name}; known: {', '.join(known)}"
            )
    return kind(length=values["length"], **physical)


def build_plant(values: Mapping[str, Any], *, compiled: bool = True) -> Plant:
    """The plant of a problem. ValueError, one sentence, if the parameters do not fit together.

    compiled: its step is compiled now, which can take long; otherwise with the first step.
    """
    equation = build_equation(values)
    grid = {name: values[name] for name in _GRID}
    grid |= {name: values[f"actuator_{name}"] for name in ("width", "shape", "positions")}
    plant = SpectralPlant(equation, **grid, compiled=compiled)
    instruments = Instruments(**{spec.name: values[spec.name] for spec in INSTRUMENTS})
    return plant if instruments.ideal else InstrumentedPlant(plant, instruments)


def fingerprint(values: Mapping[str, Any]) -> int:
    """The fingerprint of a problem's plant; see `definition.Definition`."""
    return build_plant(values, compiled=False).definition.fingerprint


_GRID = (
    "n_z",
    "n_a",
    "sample_time",
    "integration_time",
    "horizon",
    "state_weight",
    "action_weight",
    "divergence_bound",
)
