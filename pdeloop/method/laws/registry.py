# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Laws by name: ours, an entry point of another package, or code of the user's.

Which code may be run: `pdeloop.messages.own_code`.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import entry_points
from types import MappingProxyType
from typing import Any

from pdeloop.messages.own_code import OwnCode
from pdeloop.messages.spec import LAW_SETTINGS
from pdeloop.method.laws.affine import Affine
from pdeloop.method.laws.base import Law
from pdeloop.method.laws.extended_kalman import ExtendedKalman
from pdeloop.method.laws.feedforward import FeedForward
from pdeloop.method.laws.observer import Observer
from pdeloop.method.laws.predictive import Auto, AutoKalman, Predictive, PredictiveKalman
from pdeloop.method.settings import settings_from

OWN_LAWS = OwnCode(
    "law",
    "PDELOOP_LAWS",
    MappingProxyType(
        {
            kind.name: kind
            for kind in (
                Affine,
                FeedForward,
                Observer,
                ExtendedKalman,
                Predictive,
                Auto,
                PredictiveKalman,
                AutoKalman,
            )
        }
    ),
)


def offered() -> list[str]:
    """The names of the installed laws, ours first."""
    others = {entry.name for entry in entry_points(group=OWN_LAWS.group)} - set(OWN_LAWS.shipped)
    return [*OWN_LAWS.shipped, *sorted(others)]


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
    kind = complete(name, OWN_LAWS.load(name))
    chosen = settings_from(LAW_SETTINGS, kind.Settings, values, f"law '{name}'")
    if chosen == kind.settings:
        return kind
    own = {"settings": chosen, "name": kind.name, "__module__": kind.__module__}
    return type(kind.__name__, (kind,), own)


def complete(name: str, found: object) -> type[Law]:
    """Return the class that was found if it is a complete law; else a ValueError."""
    called = getattr(found, "__name__", repr(found))
    if not (isinstance(found, type) and issubclass(found, Law)):
        raise ValueError(f"law {name!r}: {called} must be a class derived from pdeloop.Law")
    missing = sorted(getattr(found, "__abstractmethods__", ()))
    if missing:
        raise ValueError(
            f"law {name!r}: {called} does not define {', '.join(missing)}; see pdeloop.Law"
        )
    return found
