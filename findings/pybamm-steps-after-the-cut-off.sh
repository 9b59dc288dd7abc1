#!/usr/bin/env bash
# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
# PyBaMM 26.10.1.1 (pybammsolvers 0.11.1, CasADi 3.8.1), NumPy 2.4.6. A cell is discharged by `step` until a step
# ends early at the lowest voltage, and then charged: expected an error, or a voltage that rises. Seen: this step and
# all others return at once without a word, with time and state where they were and the current of the discharge. A
# new simulation of a model that was given the state by `set_initial_conditions_from` does charge it.
set -euo pipefail
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --quiet --disable-pip-version-check install pybamm==26.10.1.1 pybammsolvers==0.11.1 \
	casadi==3.8.1 numpy==2.4.6
PYBAMM_DISABLE_TELEMETRY=true "$folder/venv/bin/python" - <<'PY'
import warnings

import pybamm

warnings.simplefilter("error", UserWarning)
model = pybamm.lithium_ion.SPM()
values = model.default_parameter_values
values["Current function [A]"] = "[input]"
C = values["Nominal cell capacity [A.h]"]
sim = pybamm.Simulation(model, parameter_values=values)


def step(current):
    s = sim.step(3000.0, inputs={"Current function [A]": current})
    return s.t[-1], s["Current [A]"].entries[-1], s["Terminal voltage [V]"].entries[-1]


whole, cut, charged, again = step(C), step(C), step(-C), step(-C)
print(whole, cut, charged, again, sim.solution.termination)
assert whole[0] == 3000.0 and 3600.0 < cut[0] < 3650.0
assert charged == again == cut and charged[1] == C
sim = pybamm.Simulation(model.set_initial_conditions_from(sim.solution), parameter_values=values)
charged = step(-C)
print(charged)
assert charged[:2] == (3000.0, -C) and charged[2] > cut[2] + 0.3
PY
