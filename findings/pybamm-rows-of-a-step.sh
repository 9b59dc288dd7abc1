#!/usr/bin/env bash
# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
# PyBaMM 26.10.1.1 (pybammsolvers 0.11.1, CasADi 3.8.1), NumPy 2.4.6. Three steps of 10 s with held currents:
# expected a solution with a row per sample, or two at a change. Seen: more than ten rows per step, where the solver
# went, the first 0.01 s after its start and the next ones ever farther apart; with `t_interp=[0, dt]` two per step,
# at its ends, with the current of this step in both.
set -euo pipefail
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --quiet --disable-pip-version-check install pybamm==26.10.1.1 pybammsolvers==0.11.1 \
	casadi==3.8.1 numpy==2.4.6
PYBAMM_DISABLE_TELEMETRY=true "$folder/venv/bin/python" - <<'PY'
import numpy as np
import pybamm

model = pybamm.lithium_ion.SPM()
values = model.default_parameter_values
values["Current function [A]"] = "[input]"


def rows(**how):
    sim = pybamm.Simulation(model, parameter_values=values)
    for current in (0.5, 0.1, 0.3):
        sim.step(10.0, inputs={"Current function [A]": current}, **how)
    return sim.solution.t, sim.solution["Current [A]"].entries


t, _ = rows()
print(t)
first = t[: np.searchsorted(t, 9.999) + 1]
assert len(t) > 30 and first[1] < 0.02 and np.diff(first).max() > 100.0 * first[1]
t, current = rows(t_interp=[0.0, 10.0])
print(t, current)
np.testing.assert_allclose(t, [0.0, 10.0, 10.0, 20.0, 20.0, 30.0])
np.testing.assert_allclose(current, [0.5, 0.5, 0.1, 0.1, 0.3, 0.3])
PY
