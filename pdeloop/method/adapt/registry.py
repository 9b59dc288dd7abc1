# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Optimisers by name: an entry point, ours or another package's, or code of the user's.

Which code may be run: `pdeloop.messages.own_code`.
"""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, distribution, entry_points

from pdeloop.messages.own_code import OwnCode
from pdeloop.method.adapt.base import Optimizer

GROUP = "pdeloop.optimizers"
"""The group of entry points by which an installed package offers optimisers."""


_REMOVED = {"gauss_newton": "was removed: use model_based, or two_point"}
"""Optimisers of earlier versions, and what to use in their place."""


def _ours() -> dict[str, type[Optimizer]]:
    try:
        entries = distribution("pdeloop").entry_points.select(group=GROUP)
    except PackageNotFoundError:
        return {}
    return {entry.name: entry.load() for entry in entries if entry.name not in _REMOVED}


OWN_OPTIMIZERS = OwnCode("optimizer", "PDELOOP_OPTIMIZERS", _ours())


def offered() -> list[str]:
    """The names of the installed optimisers, including ours."""
    return sorted({entry.name for entry in entry_points(group=GROUP)} - set(_REMOVED))


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
    return complete(name, OWN_OPTIMIZERS.configured(name))


_MEMBERS = ("ask", "tell", "state", "restore", "policy", "tells", "done", "first_step", "Settings")
_DECLARED = ("name", "needs_trajectories", "iteration_rollouts", "preferences")


def complete(name: str, found: object) -> type[Optimizer]:
    """Return the class that was found if it is a complete optimiser; else a ValueError."""
    called = getattr(found, "__name__", repr(found))
    if not isinstance(found, type):
        raise ValueError(f"optimizer {name!r}: {called} must be a class")
    missing = [item for item in (*_MEMBERS, *_DECLARED) if not hasattr(found, item)]
    missing += sorted(getattr(found, "__abstractmethods__", ()))
    if missing:
        raise ValueError(
            f"optimizer {name!r}: {called} does not define {', '.join(missing)}; see "
            "pdeloop.Optimizer"
        )
    return found
