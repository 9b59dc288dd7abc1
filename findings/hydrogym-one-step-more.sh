#!/usr/bin/env bash
# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
# HydroGym 1.0.0, Gymnasium 1.4.0, NumPy 2.4.6. An environment with `max_steps` = 10: expected that the tenth step is
# truncated, as by Gymnasium's own limit. Seen: the eleventh is. With four substeps per step `max_steps` counts
# substeps: the third step ends the episode, at 12.
set -euo pipefail
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --quiet --disable-pip-version-check install hydrogym==1.0.0 gymnasium==1.4.0 numpy==2.4.6
"$folder/venv/bin/python" - <<'PY'
import numpy as np
from hydrogym import FlowEnv, PDEBase, TransientSolver


class Decay(PDEBase):
    """x' = -x + u."""

    num_inputs = num_outputs = 1
    MAX_CONTROL, DEFAULT_MESH = 1.0, "point"

    def initialize_state(self):
        self.q = np.ones(1)

    def copy_state(self, deepcopy=True):
        return self.q.copy()

    def get_observations(self):
        return self.q

    def evaluate_objective(self, q=None):
        return float(self.q[0] ** 2)

    def nothing(self, *args, **kwargs):
        pass

    load_mesh = init_bcs = save_checkpoint = load_checkpoint = render = reset_controls = nothing


class Euler(TransientSolver):
    def step(self, iteration, control=None, **kwargs):
        self.flow.q = self.flow.q + self.dt * (np.ravel(control) - self.flow.q)
        return self.flow


def steps(**how):
    env = FlowEnv({"flow": Decay, "solver": Euler, "solver_config": {"dt": 0.1}, "max_steps": 10, **how})
    env.reset(seed=0)
    for number in range(1, 100):
        _, _, terminated, truncated, _ = env.step(np.zeros(1))
        if terminated or truncated:
            return number, terminated, truncated


found = steps(), steps(actuation_config={"num_substeps": 4})
print(found)
assert found == ((11, False, True), (3, False, True))
PY
