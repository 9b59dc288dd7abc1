# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The results of a training of two seeds, as narration and warnings read them."""

from __future__ import annotations

from typing import Any


def summary(**changes: Any) -> dict[str, Any]:
    spent = {"exploration": 1, "check": 8, "adaptation": 11, "evaluation": 6, "total": 20}
    return {
        "seed": 0,
        "seeds": 2,
        "costs": {"none": [4.0, 4.0], "lqt": [2.0, 3.0], "adapted": [1.0, 2.0]},
        "reduction": {"ratio_of_means": 0.4, "mean_of_ratios": 0.4167},
        "diverged": {"none": 0, "lqt": 0, "adapted": 0},
        "evaluation_rollouts": 4,
        "changed": [True, True],
        "improved": True,
        "rollouts": [spent, {**spent, "exploration": 2, "check": 16, "total": 29}],
        "seconds": 1.0,
        **changes,
    }
