"""A plant from a problem's resolved parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from pde_sim_node.equations import Equation, load_equation
from pde_sim_node.plant import Plant


def build_equation(values: Mapping[str, Any]) -> Equation:
    """The equation named by `equation`, with `length` and `physical.*`. ValueError if none fits."""
    kind = load_equation(str(values["equation"]))
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


def build_plant(values: Mapping[str, Any]) -> Plant:
    """The plant of a problem. ValueError, one sentence, if the parameters do not fit together."""
    return Plant(
        build_equation(values),
        n_z=values["n_z"],
        n_a=values["n_a"],
        width=values["actuator_width"],
        sample_time=values["sample_time"],
        integration_time=values["integration_time"],
        horizon=values["horizon"],
        state_weight=values["state_weight"],
        action_weight=values["action_weight"],
        divergence_bound=values["divergence_bound"],
    )
