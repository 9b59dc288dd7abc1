# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""No dead time is found in explorations of plants that have none."""

import pdeloop
from benchmarks.choices import KNOWN
from pdeloop.method.reduce.input_delay import study_delays


def test_earlier_inputs_that_tell_of_unpredicted_modes_are_no_dead_time() -> None:
    """Of this field the eight leading modes are predicted, with half the error by an earlier input."""
    case = KNOWN["benjamin-ono"]
    problem = pdeloop.problem(case.base or None, **case.parameters())
    found = study_delays([problem.explore(seed) for seed in range(2)])
    assert not any(found.best) and found.gain == 1.0
