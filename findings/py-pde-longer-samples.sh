#!/usr/bin/env bash
# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
# py-pde 0.59.0, SciPy 1.17.1, NumPy 2.4.6. dc/dt = 1 is advanced sample after sample, from 0.25 k to 0.25 (k + 1), with
# dt = 0.1: expected 0.25 more per sample, as t_range is to hold the final time. Seen: whole steps only, and one for any
# rest, so that a sample of 0.25, and also one of 0.21, lasts 0.3: eight samples, in which a law acts eight times, run
# 2.4. The reason for stopping is that the final time was reached; only `t_final` tells. With adaptive steps, with the
# solver `scipy`, or with all samples in one range, the times are right.
set -euo pipefail
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --quiet --disable-pip-version-check install py-pde==0.59.0 scipy==1.17.1 numpy==2.4.6
"$folder/venv/bin/python" -W ignore - <<'PY'
import numpy as np
import pde

grid = pde.CartesianGrid([[0, 1]], 4, periodic=True)
plant = pde.PDE({"c": "1"})


def run(sample, samples=8, **how):
    state = pde.ScalarField(grid, 0.0)
    for k in range(samples):
        between = (k * sample, (k + 1) * sample)
        state, told = plant.solve(state, between, tracker=None, ret_info=True, backend="numpy", **how)
    return state.data[0], told["controller"]["stop_reason"], told["controller"]["t_final"]


for sample, elapsed in ((0.25, 2.4), (0.21, 2.4), (0.2, 1.6)):
    found = run(sample, dt=0.1)
    print(sample, found, "expected", 8 * sample)
    np.testing.assert_allclose(found[0], elapsed)
    assert found[1] == "Reached final time"
np.testing.assert_allclose(run(0.25, dt=0.1)[2], 1.75 + 0.3)
right = run(0.25, dt=0.1, solver="runge-kutta", adaptive=True), run(0.25, solver="scipy"), run(2.0, 1, dt=0.1)
print(right)
np.testing.assert_allclose([value for value, _, _ in right], 2.0)
PY
