#!/usr/bin/env bash
# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
# python-control 0.10.2. Markov parameters of the response of a sampled system with dt = 0.1: expected D,
# C B, C A B. Seen: `markov` returns all of them divided by dt; `eigensys_realization(..., dt=0.1)`
# multiplies B by dt again but not D, which is ten times too large: neither scaling is right for both.
set -euo pipefail
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --quiet --disable-pip-version-check install control==0.10.2 scipy==1.17.1 numpy==2.4.6
"$folder/venv/bin/python" -W ignore - <<'PY'
import control
import numpy as np

A, B, C, D = [[0.5, 0.2], [0.0, 0.3]], [[1.0], [2.0]], [[1.0, 1.0]], [[0.7]]
system = control.ss(A, B, C, D, 0.1)
u = np.random.default_rng(0).standard_normal(400)
response = control.forced_response(system, inputs=u, timepts=0.1 * np.arange(400))
H = control.markov(response, 40)
right = [0.7, 3.0, (np.array(C) @ A @ B).item()]
print("markov:", np.ravel(H)[:3], "expected", right)
np.testing.assert_allclose(0.1 * np.ravel(H)[:3], right, rtol=1e-6)
found, _ = control.eigensys_realization(H.reshape(1, 1, -1), 2, dt=0.1)
print("realization: D", found.D.item(), "C B", (found.C @ found.B).item())
np.testing.assert_allclose([found.D.item(), (found.C @ found.B).item()], [7.0, 3.0], rtol=1e-6)
PY
