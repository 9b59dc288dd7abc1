"""The limits that `pdeloop bench optimum` computed, and how much of the possible gain a policy has.

share = (J_LQT - J)/(J_LQT - J_opt): 0 is the LQT law of the seed, 1 the optimum of its policy class,
of the same seed on the same fields. A reference counts only for the plant and the identification it
was computed for: all parameters of the problem must agree, and the plant must still do the same
(cost of the mean field without control).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.parameters import PROBLEM
from loop_interfaces.problem import config_folder
from pde_sim_node.build import build_plant
from pde_sim_node.plant import MEAN_FIELD
from tuner_node.results import RunFolderError

__all__ = ["FORMAT", "Reference", "bound_parameters", "find", "no_control_cost"]

Array = NDArray[np.float64]
FORMAT = 1
MAX_BYTES = 10_000_000
IGNORED = ("problem", "learning_rate", "learning_rate_from_zero", "smoothing_radius")
"""Parameters of a problem that neither the plant nor the basis U depends on."""
AGREEMENT = 1e-6
"""Relative, of two plants' costs without control: another compiler rounds differently."""


@dataclass(frozen=True)
class Reference:
    """The limits of one problem on one draw of held-out fields.

    lqt, optimum: by training seed, the costs by field, (fields,); open_loop: (fields,).
    """

    lqt: Mapping[int, Array]
    optimum: Mapping[int, Array]
    open_loop: Array

    def share(self, seed: int, lqt: float, cost: float) -> float:
        """(J_LQT - J)/(J_LQT - J_opt) of mean costs over the fields; NaN for an unknown seed.

        NaN also where the LQT cost is not the reference's, which is then another law.
        """
        if seed not in self.optimum:
            return float("nan")
        if abs(lqt / float(self.lqt[seed].mean()) - 1) > 1e-3:
            return float("nan")
        best = float(self.optimum[seed].mean())
        return (lqt - cost) / (lqt - best)


def bound_parameters(values: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters that a reference holds for."""
    bound = {spec.name: values.get(spec.name, spec.default) for spec in PROBLEM}
    bound |= {name: value for name, value in values.items() if name.startswith("physical.")}
    # A file of an equation may stand elsewhere.
    bound["equation"] = str(values["equation"]).rpartition("/")[2]
    bound["identification_attempts"] = values["identification_attempts"]
    return {name: value for name, value in bound.items() if name not in IGNORED}


def no_control_cost(values: Mapping[str, Any]) -> float:
    """The mean stage cost from the mean initial field without control."""
    plant = build_plant(values)
    plant.reset([MEAN_FIELD])
    for _ in range(plant.horizon):
        plant.step(np.zeros((1, plant.n_a)))
    return float(plant.episode_costs().mean[0])


def find(
    values: Mapping[str, Any], none_cost: float | None = None, folder: Path | None = None
) -> Reference | None:
    """The reference for a run with these parameters; None if there is none.

    Parameters
    ----------
    values
        Resolved parameters of the run, with `evaluation_seed` and `evaluation_fields`.
    none_cost
        What `no_control_cost` gives, if it is known already.
    folder
        Where PROBLEM.json is; the shipped ones if not given.

    Raises
    ------
    RunFolderError
        There is a file, and it cannot be read.
    """
    path = (folder or config_folder() / "optimum") / f"{values['problem']}.json"
    if not path.is_file():
        return None
    try:
        with path.open("rb") as file:
            content = json.loads(file.read(MAX_BYTES + 1))
        if content["format"] != FORMAT or not _fits(content, values, none_cost):
            return None
        for draw in content["evaluations"]:
            count = len(draw["open_loop"])
            if (draw["evaluation_seed"], count) == (
                values["evaluation_seed"],
                values["evaluation_fields"],
            ):
                return Reference(
                    lqt=_costs(draw["lqt"], count),
                    optimum=_costs(draw["optimum"], count),
                    open_loop=np.array(draw["open_loop"], dtype=np.float64),
                )
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RunFolderError(
            f"{path} cannot be used ({error}); write it anew: pdeloop bench optimum --save "
            f"{path.parent}"
        ) from error
    return None


def _costs(rows: Mapping[str, Any], count: int) -> dict[int, Array]:
    costs = {int(seed): np.array(row, dtype=np.float64) for seed, row in rows.items()}
    for row in costs.values():
        if row.shape != (count,):
            raise ValueError(f"expected {count} costs a seed, got shape {row.shape}")
    return costs


def _fits(content: Mapping[str, Any], values: Mapping[str, Any], none_cost: float | None) -> bool:
    known, now = content["parameters"], bound_parameters(values)
    # A parameter that did not exist then has to be at its default now.
    defaults = {spec.name: spec.default for spec in PROBLEM}
    if any(known.get(name, defaults.get(name)) != now.get(name) for name in {*known, *now}):
        return False
    cost = no_control_cost(values) if none_cost is None else none_cost
    return bool(abs(cost / content["no_control_cost"] - 1) <= AGREEMENT)
