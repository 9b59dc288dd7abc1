# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Which law is adapted where none is given, and why.

With few sensors and measurement noise a law that estimates the state costs less than one of the newest
readings, where the optimiser can improve it (`docs/robustness.md`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from loop_method.adapt import Optimizer
from loop_method.laws import Affine, Observer
from loop_method.models.settings import DEFAULTS

# Each says how the first law is found, so that it is made for one law.
_BY_HAND = ("model", "start", "identification")


def default_law(given: Mapping[str, Any], kind: type[Optimizer]) -> str:
    """The name of the law for parameters without one, which need not be checked yet."""
    sensors, noise, delays, points = (
        _number(given.get(name, default))
        for name, default in (
            ("sensors", 0),
            ("measurement_noise", 0),
            ("sensor_delays", 1),
            ("n_z", float("inf")),
        )
    )
    few = 0 < sensors <= DEFAULTS.sensed_most and sensors < points and delays == 1
    estimates = few and noise > 0 and Observer.name in kind.also_improves
    return Observer.name if estimates else Affine.name


def preferred_law(given: Mapping[str, Any], kind: type[Optimizer]) -> dict[str, str]:
    """The law as a preference; none where what is given is made for another one."""
    if any(name in given for name in _BY_HAND):
        return {}
    return {"law": default_law(given, kind)}


def law_reason(values: Mapping[str, Any], kind: type[Optimizer]) -> str:
    """Why a training with these parameters has its law."""
    if values["law"] != default_law(values, kind):
        return "as given"
    if values["law"] == Observer.name:
        return "the default for few sensors with measurement noise: it estimates the state"
    if not 0 < values["sensors"] < values["n_z"]:
        return "the default where every point is measured"
    if values["measurement_noise"]:
        return "the default of this optimizer"
    return "the default without measurement noise: the newest readings suffice"


def _number(value: Any) -> float:
    """Zero for what is no number: it is refused later, with its name."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return 0.0
