# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Calls of an optimiser, possibly a user's: exceptions and results are checked.

Errors that an optimiser of this package raises are passed on unchanged.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from loop_interfaces.arrays import float_array
from loop_interfaces.own_code import OwnCodeError, called
from loop_method.adapt.base import Optimizer, Rollout, RolloutResult, Row, State


def ask(optimizer: Optimizer, size: int) -> list[Rollout]:
    """The rollouts that it asks for, their policies being `size` finite numbers; OwnCodeError."""
    name, asked = type(optimizer).__name__, _called(optimizer, "ask")
    if not isinstance(asked, Sequence) or not all(isinstance(r, Rollout) for r in asked):
        raise OwnCodeError(f"{name}.ask returned {_kinds(asked)}; expected a list of Rollout")
    for rollout in asked:
        try:
            policy = float_array("it", rollout.policy)
        except ValueError:
            got = f"{type(rollout.policy).__name__}, which is not an array of real numbers"
        else:
            if policy.size == size and np.isfinite(policy).all():
                continue
            got = f"an array of shape {policy.shape}" if policy.size != size else "NaN or infinity"
        raise OwnCodeError(f"{name}.ask: a policy is {got}; expected {size} finite numbers")
    return list(asked)


def tell(optimizer: Optimizer, results: list[RolloutResult]) -> Row:
    """Tell it the results of its rollouts, and return its report; OwnCodeError."""
    row = _called(optimizer, "tell", results)
    if not isinstance(row, Mapping):
        raise OwnCodeError(
            f"{type(optimizer).__name__}.tell returned {type(row).__name__}; expected a dict"
        )
    return dict(row)


def state(optimizer: Optimizer) -> State:
    """Everything that `restore` needs; OwnCodeError."""
    kept: State = _called(optimizer, "state")
    return kept


def restore(optimizer: Optimizer, kept: State) -> None:
    """Continue where `kept` was taken; OwnCodeError."""
    _called(optimizer, "restore", kept)


def _called(optimizer: Optimizer, method: str, *given: Any) -> Any:
    function: Callable[..., Any] = getattr(optimizer, method)
    if type(optimizer).__module__.startswith("loop_method."):
        return function(*given)
    kind = type(optimizer)
    return called(f"{kind.__name__}.{method}", function, *given, module=kind.__module__)


def _kinds(asked: Any) -> str:
    if isinstance(asked, Sequence) and not isinstance(asked, str):
        return f"a list with {', '.join(sorted({type(item).__name__ for item in asked}))}"
    return type(asked).__name__
