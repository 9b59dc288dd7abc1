# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Environment steps per second of controlgym, in Gymnasium's vector environments; prints them as JSON.

`benchmarks.environments` runs it with an interpreter that has controlgym, which needs a NumPy below 2.
"""

import json
import sys
import time
from functools import partial

import controlgym  # type: ignore[import-not-found, unused-ignore]
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv


def rate(envs: SyncVectorEnv | AsyncVectorEnv, seconds: float) -> float:
    envs.reset(seed=0)
    actions = 0.1 * envs.action_space.sample()
    envs.step(actions)
    steps, start = 0, time.perf_counter()
    while (passed := time.perf_counter() - start) < seconds:
        envs.step(actions)
        steps += 1
    return float(steps * envs.num_envs / passed)


def main(name: str, parameters: str, count: str, seconds: str) -> None:
    make = [partial(controlgym.make, name, **json.loads(parameters))] * int(count)
    found = {}
    for mode, vector in (("sync", SyncVectorEnv), ("async", AsyncVectorEnv)):
        envs = vector(make)
        found[mode] = rate(envs, float(seconds))
        envs.close()
    print(json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
