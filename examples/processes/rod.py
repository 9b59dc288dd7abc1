# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A rod of two lumps, served to `pdeloop train --plant "process:python rod.py"`, without a package."""

import json
import random
import sys

print(
    json.dumps({"n_z": 2, "n_a": 1, "sample_time": 0.1, "horizon": 40, "target": 0.5}), flush=True
)
for line in sys.stdin:
    request = json.loads(line)
    if "reset" in request:
        z = [1.0 + random.Random(request["reset"]).gauss(0.0, 0.5), 1.0]
    else:
        lower = z[1] + 0.1 * (z[0] - z[1])
        z = [z[0] + 0.1 * (request["step"][0] + lower - z[0]), lower]
    print(json.dumps({"z": z}), flush=True)
