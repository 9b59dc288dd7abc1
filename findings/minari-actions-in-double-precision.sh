#!/usr/bin/env bash
# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
# Minari 0.5.4, Gymnasium 1.4.0, NumPy 2.4.6. Actions of float64 in an environment whose action space is float32:
# expected that the data set has the dtype of the space. Seen: they are stored, and read back, as float64,
# so two data sets of one environment differ in dtype by who acted.
set -euo pipefail
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --quiet --disable-pip-version-check install "minari[hdf5,create]==0.5.4" gymnasium==1.4.0 pillow==13.0.0 numpy==2.4.6
MINARI_DATASETS_PATH="$folder/data" "$folder/venv/bin/python" -W ignore - <<'PY'
import gymnasium as gym
import minari
import numpy as np


class Sum(gym.Env):
    observation_space = gym.spaces.Box(-10, 10, (1,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.x = np.zeros(1)
        return self.x.astype(np.float32), {}

    def step(self, action):
        self.x = self.x + action
        return self.x.astype(np.float32), 0.0, False, False, {}


kinds = []
for kind in (np.float32, np.float64):
    collector = minari.DataCollector(Sum())
    collector.reset(seed=0)
    for _ in range(3):
        collector.step(np.array([0.1], kind))
    name = f"sum/{np.dtype(kind)}-v0"
    collector.create_dataset(dataset_id=name, algorithm_name="constant")
    loaded = minari.load_dataset(name)
    assert loaded.action_space.dtype == np.float32
    kinds.append(next(iter(loaded)).actions.dtype)
print(kinds)
assert kinds == [np.float32, np.float64]
PY
