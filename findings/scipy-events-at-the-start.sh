#!/usr/bin/env bash
# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
# SciPy 1.17.1, NumPy 2.4.6. A relay that is solved from switch to switch: the function of a terminal event of
# `solve_ivp` is zero at the start and moves away: expected no event, as no sign changes. Seen: the solution ends at
# its start, t = 0, with the event found there, whichever side it leaves to. With a direction it does not where
# the function leaves to the other side.
set -euo pipefail
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --quiet --disable-pip-version-check install scipy==1.17.1 numpy==2.4.6
"$folder/venv/bin/python" - <<'PY'
import numpy as np
from scipy.integrate import solve_ivp


def switch(t, x):
    return x[0] - 1.0


switch.terminal = True
for method in ("RK45", "DOP853", "Radau", "BDF", "LSODA"):
    for slope in (1.0, -1.0):
        switch.direction = 0
        found = solve_ivp(lambda t, x: [slope], (0.0, 2.0), [1.0], method, events=switch)
        print(method, slope, found.status, found.t[-1], found.t_events)
        assert found.status == 1 and found.t[-1] == 0.0
        switch.direction = -slope
        found = solve_ivp(lambda t, x: [slope], (0.0, 2.0), [1.0], method, events=switch)
        assert found.status == 0 and found.t[-1] == 2.0 and found.t_events[0].size == 0
        np.testing.assert_allclose(found.y[0, -1], 1.0 + 2.0 * slope)
PY
