#!/usr/bin/env bash
# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
# python-control 0.10.2, Slycot 0.7.1, SciPy 1.17.1, NumPy 2.4.6. A heated rod of six points, sampled with dt = 0.5, is
# reduced to two states by `balred`, whose `alpha` speaks of systems in discrete time: expected two states, dt = 0.5 and
# nearly the same gain, as in continuous time. Seen: six states in continuous time (dt = 0), none of them reduced, as all
# six stable poles in (0, 1) count as unstable; the gain at rest is 5e-5 in place of 0.14, without a warning or an error.
# `model_reduction` with truncated states loses dt too.
set -euo pipefail
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --quiet --disable-pip-version-check install control==0.10.2 slycot==0.7.1 scipy==1.17.1 \
	numpy==2.4.6
"$folder/venv/bin/python" -W error::UserWarning - <<'PY'
import control
import numpy as np

n = 6
laplacian = np.eye(n, k=1) + np.eye(n, k=-1) - 2.0 * np.eye(n)
rod = control.ss(laplacian, np.eye(n)[:, :1], np.eye(n)[-1:], 0.0)
sampled = control.sample_system(rod, 0.5)
assert sampled.dt == 0.5 and abs(sampled.poles()).max() < 1.0
np.testing.assert_allclose([rod.dcgain(), sampled.dcgain()], 1.0 / 7.0)
for method in ("truncate", "matchdc"):
    control_case, found = (control.balred(system, 2, method) for system in (rod, sampled))
    for name, system in (("continuous", control_case), ("sampled", found)):
        print(method, name, system.nstates, system.dt, system.dcgain(), system.poles().real)
    assert control_case.nstates == 2 and control_case.poles().real.max() < 0.0
    assert abs(control_case.dcgain() - 1.0 / 7.0) < 0.01
    assert found.nstates == 6 and found.dt == 0
    np.testing.assert_allclose(np.sort(found.poles().real), np.sort(sampled.poles().real))
    assert found.poles().real.min() > 0.0 and abs(found.dcgain()) < 1e-4
kept = control.model_reduction(sampled, keep_states=[0, 1, 2, 3], method="truncate")
print("truncated", kept.nstates, kept.dt)
assert kept.nstates == 4 and kept.dt == 0
np.testing.assert_array_equal(kept.A, sampled.A[:4, :4])
PY
