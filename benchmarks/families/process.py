# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Plants of process, flow and structure as users write them.

Lumped balances and coarse grids, with bounds on actions (of one side, too), weights as diagonals or
matrices, outputs, products of state and action, cells of different numbers, dead zones and edges. Units
are scaled so that states are of order one. They are the family `process` of `benchmarks.general`.
"""

from __future__ import annotations

from benchmarks.families import process_flow, process_heat, process_reaction
from benchmarks.families.process_base import Process

__all__ = ["PLANTS", "Process"]

PLANTS: dict[str, type[Process]] = {
    name: kind
    for module in (process_heat, process_flow, process_reaction)
    for name, kind in vars(module).items()
    if isinstance(kind, type) and issubclass(kind, Process) and kind is not Process
}
