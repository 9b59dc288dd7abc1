#!/usr/bin/env bash
# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
# controlgym 1.0.0, Gymnasium 0.29.1, PyTorch 2.14.1, SciPy 1.17.1, NumPy 1.26.4. The PDE of convection, diffusion and
# reaction without noise: expected the observation of the state after the step, and `truncated` at the time limit, as
# Gymnasium has them. Seen: the first step observes what `reset` did, to the bit, so that a model from actions and
# observations has a dead time of one step; and at the limit `terminated` is true and `truncated` is not.
set -euo pipefail
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --quiet --disable-pip-version-check install controlgym==1.0.0 gymnasium==0.29.1 \
	torch==2.14.1 scipy==1.17.1 numpy==1.26.4
"$folder/venv/bin/python" -W ignore - <<'PY'
import controlgym
import numpy as np

env = controlgym.make("convection_diffusion_reaction", sensor_noise_cov=0.0, n_steps=20)
seen = [env.reset(seed=0)[0]]
while True:
    observation, _, terminated, truncated, _ = env.step(np.ones(env.n_action))
    seen.append(observation)
    if len(seen) == 3:
        following = env.state.copy()
    if terminated or truncated:
        break
print(len(seen) - 1, np.abs(seen[1] - seen[0]).max(), np.abs(seen[2] - seen[1]).max(), terminated, truncated)
assert np.array_equal(seen[0], seen[1]) and not np.array_equal(seen[1], seen[2])
assert len(seen) == 21 and terminated and not truncated
# The third observation is that of the state which the second step left.
np.testing.assert_array_equal(seen[3], env.C @ following)
PY
