#!/usr/bin/env bash
# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
# SciPy 1.17.1, NumPy 2.4.6. dlsim of a system with dt = 0.1 at the times 0, 0.1, 0.2, 0.3, with an input
# for each: expected four states, one a step. Seen: three, said to be at 0, 0.15 and 0.3, each still one
# step of 0.1 after the other, the inputs interpolated to those times, since 0.3 / 0.1 is below 3.
# Without the times there are four, and right.
set -euo pipefail
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --quiet --disable-pip-version-check install scipy==1.17.1 numpy==2.4.6
"$folder/venv/bin/python" - <<'PY'
import numpy as np
from scipy.signal import dlsim, dlti

system = dlti([[1.0]], [[1.0]], [[1.0]], [[0.0]], dt=0.1)
u = np.array([[1.0], [2.0], [4.0], [8.0]])
t, _, x = dlsim(system, u, t=[0.0, 0.1, 0.2, 0.3])
print("with t:   ", t, x.ravel())
np.testing.assert_allclose(t, [0.0, 0.15, 0.3])
np.testing.assert_allclose(x.ravel(), [0.0, 1.0, 4.0])  # 4 = 1 + 3, an input that was never given
t, _, x = dlsim(system, u)
print("without t:", t, x.ravel())
np.testing.assert_allclose(x.ravel(), [0.0, 1.0, 3.0, 7.0])
PY
