#!/usr/bin/env bash
# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
# Minari 0.5.4, Gymnasium 1.4.0, NumPy 2.4.6. An environment that returns its state, which each step changes in place,
# and a policy that fills one array: expected that the collector copies what passes through it. Seen: all rows of an
# episode, that of the reset among them, have the numbers of the last one, for observations and for actions; rewards
# are right.
set -euo pipefail
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --quiet --disable-pip-version-check install "minari[hdf5,create]==0.5.4" gymnasium==1.4.0 pillow==13.0.0 numpy==2.4.6
MINARI_DATASETS_PATH="$folder/data" "$folder/venv/bin/python" -W ignore - <<'PY'
import gymnasium as gym
import minari
import numpy as np


class Sum(gym.Env):
    observation_space = gym.spaces.Box(-10, 10, (1,), np.float64)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float64)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.x = np.zeros(1)
        return self.x, {}

    def step(self, action):
        self.x += action
        return self.x, float(self.x[0]), False, False, {}


collector, action = minari.DataCollector(Sum()), np.zeros(1)
seen = [collector.reset(seed=0)[0].tolist()]
for value in (0.5, 0.25, 0.125):
    action[:] = value
    seen.append(collector.step(action)[0].tolist())
episode = next(iter(collector.create_dataset(dataset_id="sum/inplace-v0", algorithm_name="constant")))
print(seen, episode.observations.ravel(), episode.actions.ravel(), episode.rewards)
assert seen == [[0.0], [0.5], [0.75], [0.875]]
assert episode.rewards.tolist() == [0.5, 0.75, 0.875]
assert episode.observations.ravel().tolist() == [0.875] * 4
assert episode.actions.ravel().tolist() == [0.125] * 3
PY
