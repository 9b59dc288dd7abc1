# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A plant from a problem's resolved parameters."""

import hashlib
import inspect
import json
from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any

from loop_interfaces.frames import MAX_ID
from loop_interfaces.parameters import ACTUATORS, INSTRUMENTS
from pde_sim_node.equations import Equation, configured_equation
from pde_sim_node.measurement import InstrumentedPlant
from pde_sim_node.plant import Instruments, Plant


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


def fingerprint(values: Mapping[str, Any]) -> int:
    """A number in [1, 2^53) that two plants share only if they are the same plant.

    It covers everything the plant's states and costs depend on, the equation's source included.
    """
    equation = build_equation(values)
    content = {spec: values[spec] for spec in _PLANT_VALUES} | asdict(equation)
    instruments = Instruments(**{spec.name: values[spec.name] for spec in INSTRUMENTS})
    # What a plant has not is left out: it is the same plant as before that was known.
    if not instruments.ideal:
        content |= asdict(instruments)
    content |= {
        spec.name: values[spec.name] for spec in ACTUATORS if values[spec.name] != spec.default
    }
    digest = hashlib.sha256(json.dumps([content, sources(equation)], sort_keys=True).encode())
    return 1 + int.from_bytes(digest.digest()[:8], "big") % (MAX_ID - 1)


def sources(equation: Equation) -> list[str]:
    """The source of the equation's class and of the classes it is derived from.

    Each with its whole module: constants and functions beside the class are part of the equation.
    """
    kinds = [kind for kind in type(equation).__mro__ if issubclass(kind, Equation)]
    return [inspect.getsource(inspect.getmodule(kind) or kind) for kind in kinds]


_PLANT_VALUES = (
    "n_z",
    "n_a",
    "actuator_width",
    "sample_time",
    "integration_time",
    "horizon",
    "state_weight",
    "action_weight",
    "divergence_bound",
)


def build_plant(values: Mapping[str, Any]) -> Plant:
    """The plant of a problem. ValueError, one sentence, if the parameters do not fit together."""
    equation = build_equation(values)
    grid = {name: values[name] for name in _PLANT_VALUES if name != "actuator_width"}
    grid |= {name: values[f"actuator_{name}"] for name in ("width", "shape", "positions")}
    instruments = Instruments(**{spec.name: values[spec.name] for spec in INSTRUMENTS})
    if instruments.ideal:
        return Plant(equation, **grid)
    return InstrumentedPlant(equation, instruments=instruments, **grid)
