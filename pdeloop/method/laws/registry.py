# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Laws by name: ours, an entry point of another package, or code of the user's.

Which code may be run: `pdeloop.messages.own_code`.

Of calls of a law's methods return values are checked, and exceptions become one sentence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from types import MappingProxyType
from typing import Any

import numpy as np

from pdeloop.messages.arrays import Array, float_array
from pdeloop.messages.cost import Cost
from pdeloop.messages.model_rows import ModelRows
from pdeloop.messages.own_code import OwnCode, OwnCodeError, called
from pdeloop.messages.spec import LAW_SETTINGS
from pdeloop.method.laws.base import Law, Parts
from pdeloop.method.laws.extended_kalman import ExtendedKalman
from pdeloop.method.laws.linear import Affine, FeedForward, Observer
from pdeloop.method.laws.neural import Neural
from pdeloop.method.laws.predictive import Auto, AutoKalman, Predictive, PredictiveKalman
from pdeloop.method.settings import settings_from
from pdeloop.process.one_thread import one_thread

_OURS = Affine, FeedForward, Observer, ExtendedKalman, Predictive, Auto, Neural
_OURS_OF_SENSORS = PredictiveKalman, AutoKalman
OWN_LAWS = OwnCode(
    "law",
    "PDELOOP_LAWS",
    MappingProxyType({kind.name: kind for kind in (*_OURS, *_OURS_OF_SENSORS)}),
)


def law_kind(name: str, values: Mapping[str, Any] = MappingProxyType({})) -> type[Law]:
    """The class of the law of that name, with the settings that parameters give it.

    values: parameters, of which those that begin with "law_settings." are taken.

    Raises
    ------
    ValueError
        Nothing of that name can be loaded, it is code that is not allowed, or no complete `Law`.
    ParameterError
        A setting that it does not have, or out of its range.
    """
    OWN_LAWS.require(name)
    kind: type[Law] = OWN_LAWS.complete(name, OWN_LAWS.load(name), Law)
    chosen = settings_from(LAW_SETTINGS, kind.Settings, values, f"law '{name}'")
    if chosen == kind.settings:
        return kind
    own = {"settings": chosen, "name": kind.name, "__module__": kind.__module__}
    return type(kind.__name__, (kind,), own)


MAX_NUMBER = 1e9
"""Largest magnitude of an action or a memory; what exceeds it, or is not finite, counts as this."""


@contextmanager
def arithmetic_of_laws() -> Iterator[None]:
    """One thread of linear algebra, and no warning of numbers that are too large."""
    with one_thread(), np.errstate(over="ignore", invalid="ignore"):
        yield


def laws_of(
    kind: type[Law], models: Sequence[ModelRows], horizon: int, cost: Sequence[str] = ()
) -> list[Law]:
    """The law of each model, whose start was looked at.

    cost: as the parameter has it (`pdeloop.messages.cost.Cost.texts`).
    A model from a message may lie at any address and in any order, for which products round otherwise:
    each law has a copy of its own.

    Raises
    ------
    OwnCodeError
        A law cannot be made, its start is not usable, or theta = 0 is not no control.
    """
    known = Cost.parse(cost)
    return [_checked(kind, _copied(model), horizon, known) for model in models]


def _copied(model: ModelRows) -> ModelRows:
    parts = {item.name: getattr(model, item.name) for item in fields(ModelRows)}
    return ModelRows(
        **{name: np.array(part, order="C") for name, part in parts.items() if part is not None}
    )


def _checked(kind: type[Law], model: ModelRows, horizon: int, cost: Cost | None) -> Law:
    with arithmetic_of_laws():
        law: Law = _called(kind.name, "__init__", kind, model, horizon)
        law.cost = cost
        _called(kind.name, "start", law.start)  # by itself, so that an error names its line
        start = _called(kind.name, "start", lambda: law.theta_start)
        if not start.size or not np.isfinite(start).all():
            raise OwnCodeError(f"{kind.name}.start must return finite numbers, at least one")
        if kind is not Affine:
            _check_actions(law)
    return law


def _check_actions(law: Law) -> None:
    """OwnCodeError where theta = 0 is not no control, or a compiled form is another law."""
    z, first = np.ones(len(law.model.U)), _called(law.name, "memory_start", law.memory_start)
    for theta in (np.zeros_like(law.theta_start), law.theta_start):
        acted = action(law, law.parts(theta), z, first, 0)
        if acted.any() and not theta.any():
            raise OwnCodeError(
                f"{law.name}.action returns a non-zero action for theta = 0, which must mean no "
                "control: every law is compared with it"
            )
        if law.compiled and not np.allclose(_by_gains(law, theta, z), acted):
            raise OwnCodeError(
                f"{law.name}.gains must be [K_a K_b] of the law that {law.name}.action computes, "
                "but they give a different action"
            )


def _by_gains(law: Law, theta: Array, z: Array) -> Array:
    """The action of the compiled form."""
    gains = _called(law.name, "gains", law.gains, theta)
    expected = law.model.policy.shape
    if np.shape(gains) != expected:
        raise OwnCodeError(
            f"{law.name}.gains returned an array of shape {np.shape(gains)}; expected {expected}"
        )
    K_a, K_b = np.hsplit(np.asarray(gains), 2)
    a: Array = K_a @ law.reduced(z) + K_b @ law.model.s_r
    return a


def action(law: Law, theta: Parts, z: Array, memory: Array, k: int) -> Array:
    """`Law.action`; OwnCodeError unless that is n_a numbers."""
    return _numbers(law, "action", law.n_a, law.action, theta, z, memory, k)


def updated(law: Law, theta: Parts, z: Array, memory: Array, a: Array, k: int) -> Array:
    """`Law.memory_update`; OwnCodeError unless that is a memory."""
    if not law.memory_size:
        return memory
    return _numbers(
        law, "memory_update", law.memory_size, law.memory_update, theta, z, memory, a, k
    )


def along(law: Law, theta: Array, states: Array, actions: Array) -> Array:
    """The law's actions along a trajectory: states (L, n_z) and actions (L, n_a) that were seen."""
    parts, found = law.parts(theta), np.empty_like(actions)
    with arithmetic_of_laws():
        memory = law.memory_start()
        for k, (z, a) in enumerate(zip(states, actions, strict=True)):
            found[k] = action(law, parts, z, memory, k)
            memory = updated(law, parts, z, memory, a, k)
    return found


def _numbers(law: Law, method: str, size: int, function: Callable[..., Any], *given: Any) -> Array:
    returned = _called(law.name, method, function, *given)
    try:
        numbers = float_array("it", returned)
    except ValueError:
        got = f"{type(returned).__name__}, which is not an array of real numbers"
    else:
        if numbers.shape == (size,):
            whole = np.nan_to_num(numbers, nan=MAX_NUMBER, posinf=MAX_NUMBER, neginf=-MAX_NUMBER)
            bounded: Array = np.clip(whole, -MAX_NUMBER, MAX_NUMBER)
            return bounded
        got = f"an array of shape {numbers.shape}"
    raise OwnCodeError(f"{law.name}.{method} returned {got}; expected {size} numbers")


def _called(name: str, method: str, function: Callable[..., Any], *given: Any) -> Any:
    return called(f"{name}.{method}", function, *given)
