#!/usr/bin/env bash
# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
# Gymnasium 1.4.0, NumPy 2.4.6. RescaleAction to [-1, 1] around an action space of float32: expected that the action 1
# arrives as the upper bound, and anyhow within the space. Seen: for more than a fifth of the pairs of bounds with one
# decimal it arrives a rounding or a few above, where `contains` of the space says no; -1 arrives below for a twelfth.
set -euo pipefail
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --quiet --disable-pip-version-check install gymnasium==1.4.0 numpy==2.4.6
"$folder/venv/bin/python" -W ignore - <<'PY'
import gymnasium as gym
import numpy as np
from gymnasium.wrappers import RescaleAction


class Env(gym.Env):
    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, low, high):
        self.action_space = gym.spaces.Box(low, high, (1,), np.float32)

    def step(self, action):
        self.arrived = action
        return np.zeros(1, np.float32), 0.0, False, False, {}


def arrives(low, high, action):
    inner = Env(np.float32(low), np.float32(high))
    env = RescaleAction(inner, np.float32(-1.0), np.float32(1.0))
    assert env.action_space.contains(action)
    env.step(action)
    return inner.arrived, inner.action_space


one = np.ones(1, np.float32)
action, space = arrives(0.0, 3.9, one)
print(repr(action), space)
assert action.dtype == np.float32 and action > space.high and not space.contains(action)
pairs = [(low / 10, high / 10) for low in range(-50, 0) for high in range(1, 51)]
for action in (one, -one):
    found = [arrives(*pair, action) for pair in pairs]
    outside = sum(not space.contains(arrived) for arrived, space in found)
    print(action, outside, "of", len(pairs))
    assert outside > len(pairs) / 20
PY
