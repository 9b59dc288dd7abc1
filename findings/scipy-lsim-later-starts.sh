#!/usr/bin/env bash
# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
# SciPy 1.17.1, NumPy 2.4.6. A simulation by `lsim` is continued from its state at t = 2 with the inputs and times of the
# second half: expected what a simulation in one piece has there, as X0 is called the initial state, and the times may be
# any that are not negative and evenly spaced. Seen: the state counts as that of t = 0 and decays
# without an input until t = 2, so that the first row already is another state, 0.117 in place of 0.865, without a
# warning. With the times shifted to start at 0 the second half is right.
set -euo pipefail
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --quiet --disable-pip-version-check install scipy==1.17.1 numpy==2.4.6
"$folder/venv/bin/python" -W error - <<'PY'
import numpy as np
from scipy.signal import StateSpace, lsim

plant = StateSpace([[-1.0]], [[1.0]], [[1.0]], [[0.0]])
t, u = 0.1 * np.arange(41), np.ones(41)
whole = lsim(plant, u, t, interp=False)[2]
np.testing.assert_allclose(whole, 1.0 - np.exp(-t))
there = whole[20]
times, _, later = lsim(plant, u[20:], t[20:], X0=[there], interp=False)
print("whole:", whole[20], whole[-1], "from t = 2:", later[0], later[-1])
np.testing.assert_array_equal(times, t[20:])
np.testing.assert_allclose(later[0], there * np.exp(-2.0))
np.testing.assert_allclose(later[-1], 1.0 + (later[0] - 1.0) * np.exp(-2.0))
shifted = lsim(plant, u[20:], t[20:] - t[20], X0=[there], interp=False)[2]
print("from t = 0:", shifted[0], shifted[-1])
np.testing.assert_allclose(shifted, whole[20:])
PY
