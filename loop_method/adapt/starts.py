# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Fields that a law is improved from on a model: those in which episodes began, or any measured ones.

A chaotic plant forgets where it began, and what a law costs depends on the initial field as if by
chance: a law that is better from a few of them is not from others. There any measured state serves as
well, of which one rollout has many.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from loop_interfaces.arrays import Array
from loop_method.adapt.base import Record
from loop_method.adapt.closed_loop import ClosedLoop

# A field is moved by this share of its distance to another one; without control the costs of a chaotic
# plant then change by more than the other share.
_MOVED, _CHANGED = 1e-2, 3e-2


def initial_fields(records: Sequence[Record]) -> Array:
    """The measured initial fields, each once, (n, n_z)."""
    fields = [record.states[0] for record in records]
    return np.stack(list({field.tobytes(): field for field in fields}.values()))


def measured_states(records: Sequence[Record], count: int) -> Array:
    """So many of the measured states, at equal distances; all where there are fewer."""
    states = np.concatenate([record.states for record in records])
    chosen: Array = states[np.linspace(0, len(states) - 1, min(count, len(states))).astype(int)]
    return chosen


def forgets(loop: ClosedLoop, fields: Array) -> bool:
    """Whether the plant is chaotic, as far as a model of it says: whether small changes grow."""
    if len(fields) < 2:
        return False
    none = np.zeros((loop.model.n_a, loop.U.shape[1] + 1))
    still = replace(loop, noise=0.0)
    before = still.costs(none, fields)
    after = still.costs(none, fields + _MOVED * (np.roll(fields, 1, axis=0) - fields))
    known = np.isfinite(before) & np.isfinite(after)
    change = float(np.sum(np.abs(after - before)[known]))
    return change > _CHANGED * float(np.sum(before[known]))
