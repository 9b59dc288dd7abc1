#!/usr/bin/env bash
# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
# CasADi 3.8.2, NumPy 2.4.6. x' = -x + u over a grid of three intervals with inputs 1, 2, 4: expected that
# tighter tolerances give smaller errors. Seen: `cvodes` is right at 1e-6 and raises CV_ERR_FAILURE at the
# first jump of the input from 1e-7 on; `idas` on the same problem is right at 1e-10.
set -euo pipefail
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --quiet --disable-pip-version-check install casadi==3.8.2 numpy==2.4.6
"$folder/venv/bin/python" - 2>/dev/null <<'PY'
import casadi
import numpy as np

x, u = casadi.SX.sym("x"), casadi.SX.sym("u")
exact, now = [], 0.0
for value in (1.0, 2.0, 4.0):
    now = np.exp(-0.1) * now + (1.0 - np.exp(-0.1)) * value
    exact.append(now)


def error(method, tolerance):
    options = {"reltol": tolerance, "abstol": tolerance / 100}
    ode = {"x": x, "u": u, "ode": -x + u}
    step = casadi.integrator("step", method, ode, 0.0, [0.1, 0.2, 0.3], options)
    try:
        found = step(x0=0.0, u=casadi.DM([[1.0, 2.0, 4.0]]))["xf"]
    except RuntimeError as raised:
        assert "CV_ERR_FAILURE" in str(raised)
        return np.inf
    return np.abs(np.array(found).ravel() - exact).max()


errors = {(m, e): error(m, e) for m in ("cvodes", "idas") for e in (1e-6, 1e-7, 1e-10)}
print(errors)
assert errors["cvodes", 1e-6] < 1e-5
assert np.isinf(errors["cvodes", 1e-7]) and np.isinf(errors["cvodes", 1e-10])
assert errors["idas", 1e-7] < 1e-6 and errors["idas", 1e-10] < 1e-9
PY
