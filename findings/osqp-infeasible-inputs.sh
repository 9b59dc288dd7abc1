#!/usr/bin/env bash
# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
# OSQP 1.1.3, SciPy 1.17.1, NumPy 2.4.6. One step of a predictive law: the next state 1.2 x + u must not exceed 3, with u
# in [-1, 1]. From x = 3 there is such an input, from x = 5 there is none: expected NaN for it, or an error. Seen: the
# status says so, but the input is the finite number 2143289344, the bits of a NaN in single precision read as an integer
# (OSQP's issue 242 has the constant): it passes a check for finite numbers, and clipped to its bounds it is 1, which
# drives the state further up. Certificates that do not apply are the same number.
set -euo pipefail
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --quiet --disable-pip-version-check install osqp==1.1.3 scipy==1.17.1 numpy==2.4.6
"$folder/venv/bin/python" -W ignore - <<'PY'
import numpy as np
import osqp
from scipy.sparse import csc_matrix

BITS = float(np.array(np.nan, np.float32).view(np.uint32))
law = osqp.OSQP()
rows = csc_matrix([[1.0], [1.0]])
law.setup(csc_matrix([[1.0]]), np.zeros(1), rows, np.array([-1.0, -np.inf]), np.ones(2), verbose=False)


def step(x):
    law.update(l=np.array([-1.0, -np.inf]), u=np.array([1.0, 3.0 - 1.2 * x]))
    return law.solve()


for x in (2.0, 3.0):
    found = step(x)
    print(x, found.info.status, found.x)
    assert found.info.status == "solved" and 1.2 * x + found.x[0] < 3.01
    assert found.prim_inf_cert.tolist() == [BITS, BITS]
found = step(5.0)
print(5.0, found.info.status, found.x, found.y, np.clip(found.x, -1.0, 1.0))
assert found.info.status == "primal infeasible"
assert found.x.tolist() == [BITS] and found.y.tolist() == [BITS, BITS] and BITS == 2143289344.0
assert np.isfinite(found.x).all() and np.clip(found.x, -1.0, 1.0) == 1.0
PY
