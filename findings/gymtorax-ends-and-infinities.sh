#!/usr/bin/env bash
# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
# Gym-TORAX 1.1.1, TORAX 1.4.3, JAX 0.10.2, Gymnasium 1.4.0, NumPy 2.4.6. Its scenario under its own open-loop agent, and
# under its PID agent with the gains of its documentation: expected finite observations, the return 3.40, an end that is
# `truncated`, as time ends it, and an episode of 150 steps under both. Seen: the first observation has six infinite
# numbers (radii of rational q that are not there yet); the return is 3.263; the end after 150 steps is `terminated`, as a
# failure is, so that only the reward tells them apart; and the PID agent fails in step 105 with the reward -1000, since
# its current is down to 3.2 MA when the heating begins and the core exceeds the observation's bound of 35 keV.
set -euo pipefail
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --quiet --disable-pip-version-check install gymtorax==1.1.1 torax==1.4.3 jax==0.10.2 jaxlib==0.10.2 \
	gymnasium==1.4.0 numpy==2.4.6
"$folder/venv/bin/python" -W ignore - <<'PY'
import gymnasium
import gymtorax
import numpy as np

env = gymnasium.make("gymtorax/IterHybrid-v0")


def episode(agent):
    observation, _ = env.reset(seed=0)
    parts = {**observation["scalars"], **observation["profiles"]}
    infinite = sorted(name for name, value in parts.items() if not np.isfinite(value).all())
    total = steps = 0
    ended = truncated = False
    while not (ended or truncated):
        action = {name: np.array(value, float) for name, value in agent.act(observation).items()}
        observation, reward, ended, truncated, _ = env.step(action)
        total, steps = total + reward, steps + 1
    return infinite, steps, total, ended, truncated, float(observation["profiles"]["T_e"].max())


space = env.unwrapped.action_space
first = episode(gymtorax.IterHybridAgent(space))
print(first)
assert first[0] == [f"rho_q_{q}_{at}" for q in ("2_1", "3_1", "3_2") for at in ("first", "second")]
assert first[1] == 150 and abs(first[2] - 3.263) < 5e-4 and first[3:5] == (True, False)
pid = episode(gymtorax.PIDAgent(space, lambda t: 0.6e6 + 14e3 * min(t, 100), 0.2e6, 0.700, 34.257, 0.0))
print(pid)
assert pid[1] == 105 and pid[2] < -990.0 and pid[3] and 35.0 < pid[5] < 45.0
PY
