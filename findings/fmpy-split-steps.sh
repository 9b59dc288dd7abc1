#!/usr/bin/env bash
# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
# FMPy 0.3.32, pythonfmu 0.7.0. A co-simulation FMU that records the length of its steps, with
# output_interval = 0.1 and an input that jumps at 0.25: expected five steps of 0.1. Seen: six calls, of
# which two have 0.05, split at the jump: a law with a memory of one row per step counts one too many.
set -euo pipefail
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --quiet --disable-pip-version-check install fmpy==0.3.32 pythonfmu==0.7.0 numpy==2.4.6
cd "$folder"
cat >counter.py <<'PY'
from pythonfmu import Fmi2Causality, Fmi2Slave, Real


class Counter(Fmi2Slave):
    def __init__(self, **given):
        super().__init__(**given)
        self.u = self.calls = self.length = 0.0
        self.register_variable(Real("u", causality=Fmi2Causality.input))
        self.register_variable(Real("calls", causality=Fmi2Causality.output))
        self.register_variable(Real("length", causality=Fmi2Causality.output))

    def do_step(self, time, step):
        self.calls += 1
        self.length = step
        return True
PY
venv/bin/python -m pythonfmu build -f counter.py >/dev/null
venv/bin/python - <<'PY'
import numpy as np
from fmpy import simulate_fmu

jump = [(0.0, 0.0), (0.25, 0.0), (0.25, 1.0), (0.5, 1.0)]
table = np.array(jump, dtype=[("time", float), ("u", float)])
how = {"stop_time": 0.5, "output_interval": 0.1, "output": ["calls", "length"]}
rows = simulate_fmu("Counter.fmu", input=table, **how)
print(rows)
assert rows["calls"][-1] == 6.0
at = np.argmin(np.abs(rows["time"] - 0.3))
np.testing.assert_allclose(rows["length"][at], 0.05)
assert simulate_fmu("Counter.fmu", **how)["calls"][-1] == 5.0
PY
