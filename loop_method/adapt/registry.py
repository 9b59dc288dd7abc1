# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Which optimiser a name stands for: an entry point of the group `GROUP`, ours or another package's."""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points

from loop_method.adapt.base import Optimizer

GROUP = "pdeloop.optimizers"
"""The group of entry points by which an installed package offers optimisers."""


def offered() -> dict[str, list[EntryPoint]]:
    """The entry points of every name, in the order of the names; more than one if packages disagree.

    No other package takes a name of ours.
    """
    found: dict[str, dict[str, EntryPoint]] = {}
    entries = entry_points(group=GROUP)
    ours = {entry.name for entry in entries if _is_ours(entry)}
    for entry in entries:
        if _is_ours(entry) or entry.name not in ours:
            found.setdefault(entry.name, {})[entry.value] = entry
    return {name: list(found[name].values()) for name in sorted(found)}


def _is_ours(entry: EntryPoint) -> bool:
    return entry.dist is not None and entry.dist.name == "pdeloop"


def optimizer_kind(name: str) -> type[Optimizer]:
    """The class of the optimiser of that name.

    Raises
    ------
    ValueError
        Nothing of that name can be loaded, or it is no complete `Optimizer`.
    """
    known = offered()
    if not known:
        raise ValueError(
            f"optimizer {name!r}: no optimizer is installed, not even ours; install pdeloop again, as "
            "its entry points are out of date"
        )
    if name not in known:
        raise ValueError(f"unknown optimizer {name!r}: give one of {', '.join(known)}")
    if len(known[name]) > 1:
        values = ", ".join(entry.value for entry in known[name])
        raise ValueError(
            f"optimizer {name!r} is offered by several installed packages ({values}): remove one"
        )
    (entry,) = known[name]
    try:
        found = entry.load()
    except Exception as error:
        raise ValueError(f"optimizer {name!r}: {entry.value} cannot be loaded: {error}") from error
    return complete(name, entry.attr, found)


_MEMBERS = ("ask", "tell", "state", "restore", "policy", "tells", "done", "first_step", "Settings")
_DECLARED = ("name", "needs_trajectories", "iteration_rollouts", "preferences")


def complete(name: str, called: str, found: object) -> type[Optimizer]:
    """What was found, if it is a whole optimiser."""
    if not isinstance(found, type):
        raise ValueError(f"optimizer {name!r}: {called} must be a class")
    missing = [item for item in (*_MEMBERS, *_DECLARED) if not hasattr(found, item)]
    missing += sorted(getattr(found, "__abstractmethods__", ()))
    if missing:
        raise ValueError(
            f"optimizer {name!r}: {called} does not define {', '.join(missing)}; see "
            "loop_method.adapt.base.Optimizer"
        )
    return found
