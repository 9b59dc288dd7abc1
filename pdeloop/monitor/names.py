"""How the page names what it shows: the components of a state, the folder of a run. Pure."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pde_sim_node.equations import EQUATIONS


def component_names(values: Mapping[str, Any]) -> list[str]:
    """Names of the components that make up a state, from a plant's parameters."""
    if values.get("sensors"):
        count = int(values.get("sensor_delays") or 1)
        return ["y", *(f"y {k} ago" for k in range(1, count))]
    equation = EQUATIONS.get(str(values.get("equation")))
    return ["u"] if equation is None else list(equation.components)


def short(folder: Path) -> str:
    """The folder as a person in the working directory writes it."""
    with contextlib.suppress(ValueError):
        return str(folder.resolve().relative_to(Path.cwd()))
    return str(folder)
