#!/usr/bin/env bash
# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
# PyBaMM 26.10.1.1 (pybammsolvers 0.11.1, CasADi 3.8.1), NumPy 2.4.6. `Simulation.step` a second time with
# `starting_solution=None`, its default, and `save=False`: expected a step from the initial state. Seen: it goes on
# from the last step; `pybamm.EmptySolution()` begins anew, to the bit.
set -euo pipefail
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --quiet --disable-pip-version-check install pybamm==26.10.1.1 pybammsolvers==0.11.1 \
	casadi==3.8.1 numpy==2.4.6
PYBAMM_DISABLE_TELEMETRY=true "$folder/venv/bin/python" - <<'PY'
import pybamm

model = pybamm.lithium_ion.SPM()
values = model.default_parameter_values
values["Current function [A]"] = "[input]"
sim = pybamm.Simulation(model, parameter_values=values)


def step(start):
    s = sim.step(60.0, starting_solution=start, save=False, inputs={"Current function [A]": 0.5})
    return float(s.t[-1]), float(s["Terminal voltage [V]"].entries[-1])


first, second, anew = step(None), step(None), step(pybamm.EmptySolution())
print(first, second, anew)
assert first[0] == 60.0 and second[0] == 120.0 and second[1] < first[1]
assert anew == first
PY
