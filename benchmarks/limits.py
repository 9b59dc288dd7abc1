# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The costs of inputs that `python -m benchmarks optimum --save` keeps, to compare others with.

A cost counts only for the plant it was computed for: all of the plant's parameters must agree, and
it must still do the same (cost of the mean field without control).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pde_sim_node.build import build_equation, build_plant
from pde_sim_node.plant import MEAN_FIELD
from pdeloop.episode import rollout
from pdeloop.messages.files import read_json
from pdeloop.messages.parameters import PROBLEM
from pdeloop.messages.spec import Spec

__all__ = ["FOLDER", "content", "find"]

FOLDER = Path(__file__).parent / "open_loop_limits"
AGREEMENT = 1e-6
"""Relative, of two plants' costs without control: another compiler rounds differently."""


def content(values: Mapping[str, Any], open_loop: Mapping[str, list[float]]) -> dict[str, Any]:
    """What is kept of the costs for a problem, by evaluation seed."""
    return {
        "parameters": _parameters(values),
        "no_control_cost": _without_control(values),
        "open_loop": dict(open_loop),
    }


def find(values: Mapping[str, Any], folder: Path = FOLDER) -> NDArray[np.float64] | None:
    """The cost on each field (fields,) of a closing evaluation; None if it is not known.

    Parameters
    ----------
    values
        Resolved parameters, with `evaluation_seed` and `evaluation_fields`.
    folder
        Where PROBLEM.json is.
    """
    path = folder / f"{values['problem']}.json"
    if not path.is_file():
        return None
    known = read_json(path)
    costs = known["open_loop"].get(str(values["evaluation_seed"]), ())
    # A parameter that was not known when the cost was kept has its default.
    kept = {spec.name: spec.default for spec in _plant_parameters()} | known["parameters"]
    if len(costs) != values["evaluation_fields"] or kept != _parameters(values):
        return None
    now = _without_control(values)
    same = abs(now / known["no_control_cost"] - 1) <= AGREEMENT
    return np.array(costs, dtype=np.float64) if same else None


def _without_control(values: Mapping[str, Any]) -> float:
    """The mean stage cost from the mean initial field."""
    plant = build_plant(values)
    none = np.zeros((1, plant.n_a))
    episode = rollout(plant, lambda k, z: none, [MEAN_FIELD], np.arange(1), keep=False)
    return float(episode.costs.mean[0])


def _plant_parameters() -> list[Spec]:
    return [spec for spec in PROBLEM if "P" in spec.nodes and spec.name != "problem"]


def _parameters(values: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters of the plant."""
    own = {spec.name: values[spec.name] for spec in _plant_parameters()}
    own["equation"] = str(values["equation"]).rpartition("/")[2]  # a file may stand elsewhere
    physical = asdict(build_equation(values))
    del physical["length"]
    return {**own, **{f"physical.{name}": number for name, number in physical.items()}}
