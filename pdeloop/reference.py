"""The limits of `python -m benchmarks optimum`, and how much of the possible gain a policy has.

share = (J_LQT - J)/(J_LQT - J_opt): 0 is the LQT law of the seed, 1 the optimum of its policy class,
of the same seed on the same fields. A reference counts only for the plant and the identification it
was computed for: all parameters of the problem must agree, and the plant must still do the same
(cost of the mean field without control).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.files import read_json
from loop_interfaces.parameters import PROBLEM, as_recorded, model_order
from loop_interfaces.problem import config_folder
from pde_sim_node.build import build_equation, build_plant
from pde_sim_node.plant import DIVERGED_COST
from pdeloop.episode import mean_field_cost
from tuner_node.results import RunFolderError

__all__ = ["FORMAT", "Reference", "bound_parameters", "find", "no_control_cost"]

Array = NDArray[np.float64]
FORMAT = 1
IGNORED = ("problem", "learning_rate", "learning_rate_from_zero", "smoothing_radius")
"""Parameters of a problem that neither the plant nor the basis U depends on."""
AGREEMENT = 1e-6
"""Relative, of two plants' costs without control: another compiler rounds differently."""
SAME_LAW = 1e-3
"""Relative, of the costs of two LQT laws of one seed: rounding moves a model a little."""


@dataclass(frozen=True)
class Reference:
    """The limits of one problem on one draw of held-out fields.

    lqt, optimum: by training seed, the costs by field, (fields,); open_loop: (fields,).
    """

    lqt: Mapping[int, Array]
    optimum: Mapping[int, Array]
    open_loop: Array

    def share(self, seeds: Sequence[int], lqt: Array, cost: Array) -> float | None:
        """The share of the possible gain, of the means over seeds and fields.

        Parameters
        ----------
        seeds
            Training seeds; those without a reference, and those whose LQT law is another one than
            the reference's, are left out.
        lqt, cost : (seeds, fields)
            Mean stage costs of the LQT law and of the policy, on the reference's fields.

        Returns
        -------
        None if no seed is left or a rollout of the others diverged.
        """
        known = [
            s
            for s, seed in enumerate(seeds)
            if seed in self.optimum
            and np.allclose(lqt[s].mean(), self.lqt[seed].mean(), rtol=SAME_LAW, atol=0)
        ]
        if not known:
            return None
        best = float(np.mean([self.optimum[seeds[s]].mean() for s in known]))
        start, end = float(lqt[known].mean()), float(cost[known].mean())
        if not (end < DIVERGED_COST / self.open_loop.size and start > best):
            return None
        return (start - end) / (start - best)


def bound_parameters(values: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters that a reference holds for."""
    bound = {spec.name: values.get(spec.name, spec.default) for spec in PROBLEM}
    bound["reduced_order"] = model_order(bound)
    del bound["dmdc_order"]
    equation = asdict(build_equation(values))
    bound |= {f"physical.{name}": number for name, number in equation.items() if name != "length"}
    # A file of an equation may stand elsewhere.
    bound["equation"] = str(values["equation"]).rpartition("/")[2]
    bound["identification_attempts"] = values["identification_attempts"]
    return {name: value for name, value in bound.items() if name not in IGNORED}


def no_control_cost(values: Mapping[str, Any]) -> float:
    """The mean stage cost from the mean initial field without control."""
    return mean_field_cost(build_plant(values))


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
        content = read_json(path)
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
    except _UNREADABLE as error:
        raise RunFolderError(
            f"{path} cannot be used ({error}); write it anew: python -m benchmarks optimum --save "
            f"{path.parent}"
        ) from error
    return None


_UNREADABLE = (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError)


def _costs(rows: Mapping[str, Any], count: int) -> dict[int, Array]:
    costs = {int(seed): np.array(row, dtype=np.float64) for seed, row in rows.items()}
    for row in costs.values():
        if row.shape != (count,):
            raise ValueError(f"expected {count} costs a seed, got shape {row.shape}")
    return costs


def _fits(content: Mapping[str, Any], values: Mapping[str, Any], none_cost: float | None) -> bool:
    known, now = as_recorded(content["parameters"]), bound_parameters(values)
    # A parameter that did not exist then has to be at its default now.
    defaults = {spec.name: spec.default for spec in PROBLEM}
    if any(known.get(name, defaults.get(name)) != now.get(name) for name in {*known, *now}):
        return False
    cost = no_control_cost(values) if none_cost is None else none_cost
    return bool(abs(cost / content["no_control_cost"] - 1) <= AGREEMENT)
