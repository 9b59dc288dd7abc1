# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The channels of logged data by name, and sentences about those that say nothing of the plant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.arrays import Array

SHOWN = 6
"""Channels that a sentence names at most."""
UNITS = 1e-12
"""Numbers of the state smaller than this, relative to another one, are lost in its rounding."""
_SAME = 1e-12
"""Tolerance of the cosine of two columns that count as multiples of each other."""


@dataclass(frozen=True)
class Channels:
    """Names of the numbers of a state and of the inputs; z1, z2, ... and a1, a2, ... without any."""

    states: Sequence[str] = ()
    inputs: Sequence[str] = ()

    def state(self, i: int) -> str:
        """The name of z_i, from 0 on."""
        return self.states[i] if self.states else f"z{i + 1}"

    def input(self, j: int) -> str:
        """The name of a_j, from 0 on."""
        return self.inputs[j] if self.inputs else f"a{j + 1}"


NUMBERED = Channels()


def constant(columns: Array) -> NDArray[np.int64]:
    """Columns with one value throughout, up to its rounding."""
    eps = float(np.finfo(np.float64).eps)
    still: NDArray[np.int64] = np.flatnonzero(
        np.ptp(columns, axis=0) <= 8.0 * eps * np.abs(columns).max(axis=0)
    )
    return still


def scaled(columns: Array) -> tuple[Array, Array]:
    """Columns of the norm 1, or of zeros, and the norms that they had.

    >>> scaled(np.array([[3.0, 0.0], [4.0, 0.0]]))[0].tolist()
    [[0.6, 0.0], [0.8, 0.0]]
    """
    # In two steps, as the squares of very small and very large numbers have no place in a float64.
    largest = np.abs(columns).max(axis=0)
    parts = columns / np.where(largest > 0.0, largest, 1.0)
    norms = np.linalg.norm(parts, axis=0)
    return parts / np.where(norms > 0.0, norms, 1.0), largest * norms


def listed(names: Sequence[str]) -> str:
    """The first few of them.

    >>> listed(["a1"]), listed(["a1", "a2", "a3"])
    ('a1', 'a1, a2 and a3')
    """
    shown = list(names[:SHOWN])
    if len(names) > SHOWN:
        shown.append(f"{len(names) - SHOWN} others")
    return shown[0] if len(shown) == 1 else f"{', '.join(shown[:-1])} and {shown[-1]}"


def never_moved(names: Sequence[str], values: Sequence[float]) -> str:
    """Message about constant inputs."""
    one, at = len(names) == 1, ", ".join(dict.fromkeys(f"{value:.4g}" for value in values[:SHOWN]))
    return (
        f"the input{'' if one else 's'} {listed(names)} never moved (constant at {at}), which "
        f"shows nothing of {'its effect: excite it' if one else 'their effects: excite them'}, or "
        "add a log in which that was done"
    )


def moved_together(name: str, terms: Mapping[str, float], offset: float) -> str:
    """Message about an input that is the sum of `terms`, factors of other inputs, and `offset`."""
    text = " + ".join(f"{factor:.4g} {other}" for other, factor in terms.items())
    text += f" + {offset:.4g}" if offset else ""
    return (
        f"the inputs {listed([*terms, name])} always moved together ({name} = "
        f"{text.replace('+ -', '- ')}), so their effects cannot be told apart: excite them one by "
        "one or at random, or add a log in which that was done"
    )


def followed_the_state(names: Sequence[str]) -> str:
    """Message about inputs, or a combination of inputs, that are a function of the state."""
    one = len(names) == 1
    what = f"the input {names[0]}" if one else f"a combination of the inputs {listed(names)}"
    return (
        f"{what} always followed from the state (feedback without excitation, or a signal that is "
        "too regular), so its effect cannot be told apart from what the plant does by itself: add "
        f"a test signal to {'it' if one else 'them'}, or move the set points, or add a log with either"
    )


def hardly_independent(names: Sequence[str], shares: Sequence[float]) -> str:
    """Message about inputs that hardly moved by themselves; shares: that part of their variation."""
    own = ", ".join(f"{100 * share:.2g} %" for share in shares[:SHOWN])
    return (
        f"of the variation of {listed(names)} only {own} is independent of the state and the other "
        "inputs, so what was identified of their effects is uncertain: excite each input by "
        "itself, or add a log in which that was done"
    )


def cut_off(names: Sequence[str], shares: Sequence[float], p: int) -> str:
    """Message about inputs cut by a truncation to p directions; shares: the part kept of each."""
    kept = ", ".join(f"{100 * share:.2g} %" for share in shares[:SHOWN])
    return (
        f"the rank p = {p} keeps {kept} of a move of {listed(names)}, and as little of the effect: "
        "raise p, or choose units in which the inputs are as large as the states"
    )


def state_faults(states: Array, channels: Channels = NUMBERED) -> list[str]:
    """Numbers of states (N, n_z) that never moved, are multiples of others, or are lost in rounding."""
    found = []
    still = constant(states)
    if still.size:
        found.append(f"{listed([channels.state(int(i)) for i in still])} never moved")
    moving = np.setdiff1d(np.arange(states.shape[1]), still)
    if not moving.size:
        return found
    names = [channels.state(int(i)) for i in moving]
    if copies := _copies(states[:, moving], names):
        more = f" and {len(copies) - SHOWN} more" if len(copies) > SHOWN else ""
        found.append(f"{', '.join(copies[:SHOWN])}{more}")
    sizes = np.abs(states).max(axis=0)
    small = int(moving[np.argmin(sizes[moving])])
    large = int(moving[np.argmax(sizes[moving])])
    if sizes[small] < UNITS * sizes[large]:
        found.append(
            f"{channels.state(small)} is at most {sizes[small]:.1g} and {channels.state(large)} up "
            f"to {sizes[large]:.1g} (choose units in which they are of similar size)"
        )
    return found


def _copies(states: Array, names: Sequence[str]) -> list[str]:
    """Name the columns that are multiples of earlier ones."""
    first = _first_alike(scaled(states)[0])
    found = []
    for i in np.flatnonzero(first != np.arange(len(first))).tolist():
        one = int(first[i])
        largest = int(np.argmax(np.abs(states[:, one])))
        factor = float(states[largest, i] / states[largest, one])
        times = "" if abs(factor - 1.0) < 1e-6 else f"{factor:.4g} times "
        found.append(f"{names[i]} is always {times}{names[one]}")
    return found


def _first_alike(unit: Array) -> NDArray[np.int64]:
    """For each column of norm 1, the first one that is the same up to its sign and rounding."""
    # Only those of the same weighted sum are compared: all products would be the square of a state.
    first = np.arange(unit.shape[1])
    weights = np.random.default_rng(0).standard_normal(len(unit))
    sums = np.abs(weights @ unit)
    order = np.argsort(sums, kind="stable")
    apart = np.sqrt(2.0 * _SAME) * float(np.linalg.norm(weights))
    for group in np.split(order, np.flatnonzero(np.diff(sums[order]) > apart) + 1):
        left = np.sort(group)
        while len(left) > 1:
            same = np.abs(unit[:, left[0]] @ unit[:, left[1:]]) > 1.0 - _SAME
            first[left[1:][same]] = left[0]
            left = left[1:][~same]
    return first
