# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Optimisers by name: an entry point, ours or another package's, or code of the user's.

Which code may be run: `pdeloop.messages.own_code`.

Of calls of an optimiser's methods return values are checked, and exceptions become one sentence; those
that an optimiser of this package raises are passed on unchanged.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, distribution
from typing import Any

import numpy as np

from pdeloop.messages.arrays import float_array
from pdeloop.messages.own_code import OwnCode, OwnCodeError, called
from pdeloop.method.adapt.base import Optimizer, Rollout, RolloutResult, Row, State

GROUP = "pdeloop.optimizers"
"""The group of entry points by which an installed package offers optimisers."""


_MEMBERS = (
    *("ask", "tell", "state", "restore", "policy", "tells", "done", "first_step", "Settings"),
    *("name", "needs_trajectories", "iteration_rollouts", "preferences"),
)
"""What a class has to define."""
_REMOVED = {"gauss_newton": "was removed: use model_based, or two_point"}
"""Optimisers of earlier versions, and what to use in their place."""


def _ours() -> dict[str, type[Optimizer]]:
    try:
        entries = distribution("pdeloop").entry_points.select(group=GROUP)
    except PackageNotFoundError:
        return {}
    return {entry.name: entry.load() for entry in entries if entry.name not in _REMOVED}


OWN_OPTIMIZERS = OwnCode("optimizer", "PDELOOP_OPTIMIZERS", _ours())


def optimizer_kind(name: str) -> type[Optimizer]:
    """The class of the optimiser of that name.

    Raises
    ------
    ValueError
        Nothing of that name can be loaded, it is code that is not allowed, or no complete `Optimizer`.
    """
    if name in _REMOVED:
        raise ValueError(f"optimizer {name!r} {_REMOVED[name]}")
    if not OWN_OPTIMIZERS.shipped:
        raise ValueError(
            f"optimizer {name!r}: the entry points of pdeloop are out of date, as not even its own "
            "optimizers are found; install pdeloop again"
        )
    found = OWN_OPTIMIZERS.configured(name)
    return OWN_OPTIMIZERS.complete(name, found, members=_MEMBERS)


_COUNTED = ("cost", "rollouts", "diverged")
"""Keys of a report that others read as numbers."""


def ask(optimizer: Optimizer, size: int, *, extends: bool = False) -> list[Rollout]:
    """The rollouts that it asks for, their policies being `size` finite numbers; OwnCodeError.

    extends: or more numbers (`Law.extends`).
    """
    name, asked = type(optimizer).__name__, _called(optimizer, "ask")
    if not isinstance(asked, Sequence) or not all(isinstance(r, Rollout) for r in asked):
        raise OwnCodeError(f"{name}.ask returned {_kinds(asked)}; expected a list of Rollout")
    for rollout in asked:
        try:
            policy = float_array("it", rollout.policy)
        except ValueError:
            got = f"{type(rollout.policy).__name__}, which is not an array of real numbers"
        else:
            fits = policy.size == size or (extends and policy.size > size)
            if fits and np.isfinite(policy).all():
                continue
            got = "NaN or infinity" if fits else f"an array of shape {policy.shape}"
        raise OwnCodeError(f"{name}.ask: a policy is {got}; expected {size} finite numbers")
    return list(asked)


def tell(optimizer: Optimizer, results: list[RolloutResult]) -> Row:
    """Tell it the results of its rollouts, and return its report as JSON takes it; OwnCodeError.

    JSON has neither NaN nor infinity, so a user's are left out.
    """
    name, row = type(optimizer).__name__, _called(optimizer, "tell", results)
    if not isinstance(row, Mapping):
        raise OwnCodeError(f"{name}.tell returned {type(row).__name__}; expected a dict")
    told: Row = {}
    for key, given in row.items():
        value = given.tolist() if isinstance(given, np.generic | np.ndarray) else given
        if isinstance(value, float) and not np.isfinite(value) and not _shipped(optimizer):
            continue
        number = key in _COUNTED
        if not (isinstance(key, str) and (_is_number(value) if number else _is_json(value))):
            expected = "a number" if number else "a text as key, and numbers, texts or lists"
            raise OwnCodeError(
                f"{name}.tell returned {type(given).__name__} as {key!r}; expected {expected}"
            )
        told[key] = value
    return told


def state(optimizer: Optimizer) -> State:
    """Everything that `restore` needs; OwnCodeError."""
    kept: State = _called(optimizer, "state")
    return kept


def restore(optimizer: Optimizer, kept: State) -> None:
    """Continue where `kept` was taken; OwnCodeError."""
    _called(optimizer, "restore", kept)


def _called(optimizer: Optimizer, method: str, *given: Any) -> Any:
    function: Callable[..., Any] = getattr(optimizer, method)
    if _shipped(optimizer):
        return function(*given)
    kind = type(optimizer)
    return called(f"{kind.__name__}.{method}", function, *given, module=kind.__module__)


def _shipped(optimizer: Optimizer) -> bool:
    return type(optimizer).__module__.startswith("pdeloop.method.")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_json(value: Any) -> bool:
    try:
        json.dumps(value)
    except (TypeError, ValueError):
        return False
    return True


def _kinds(asked: Any) -> str:
    if isinstance(asked, Sequence) and not isinstance(asked, str):
        return f"a list with {', '.join(sorted({type(item).__name__ for item in asked}))}"
    return type(asked).__name__
