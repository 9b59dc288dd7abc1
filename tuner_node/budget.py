# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The budget of a training: the rollouts of every seed, by purpose.

A rollout counts once, when its result is used: what a fault makes a plant repeat is not counted again.
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

PURPOSES = {
    "identify": "exploration",
    "check": "check",
    "adapt": "adaptation",
    "evaluate": "evaluation",
}
"""The purpose of the rollouts of each phase. Those of the closing evaluation are not in the budget."""

Counts = NDArray[np.int64]


class Budget:
    """Rollouts of several seeds.

    rollouts: what each seed may pay before the closing evaluation; 0: `adaptation` besides what its
    explorations and checks take.

    >>> budget = Budget(seeds=2, rollouts=80)
    >>> budget.count("identify", [0, 1])
    >>> budget.count("identify", [1])
    >>> budget.adaptation.tolist()
    [79, 78]
    """

    def __init__(self, seeds: int, rollouts: int, adaptation: int = 0) -> None:
        self._rollouts, self._adaptation = rollouts, adaptation
        self._counts: Counts = np.zeros((len(PURPOSES), seeds), dtype=np.int64)

    def count(self, phase: str, owners: Iterable[int]) -> None:
        """Count rollouts of a phase; owners: the index of the seed of each."""
        row = self._counts[list(PURPOSES).index(phase)]
        np.add.at(row, np.fromiter(owners, dtype=np.int64), 1)

    @property
    def paid(self) -> Counts:
        """Rollouts of each seed so far, without those of the evaluation, (S,)."""
        return self._sum("identify", "check", "adapt")

    @property
    def total(self) -> Counts:
        """The budget of each seed, where known, (S,)."""
        return self._sum("identify", "check") + self.adaptation

    @property
    def adaptation(self) -> Counts:
        """The budget for the adaptation of each seed, (S,)."""
        if not self._rollouts:
            return np.full(self._counts.shape[1], self._adaptation)
        return self._rollouts - self._sum("identify", "check")

    def allows(self, seed: int, rollouts: int) -> bool:
        """True if a seed can pay for this many more."""
        return not self._rollouts or bool(self.paid[seed] + rollouts <= self._rollouts)

    def by_purpose(self) -> list[dict[str, int]]:
        """The rollouts of each seed by purpose; the evaluation is not in `total`."""
        return [
            dict(zip(PURPOSES.values(), counts, strict=True)) | {"total": total}
            for counts, total in zip(self._counts.T.tolist(), self.paid.tolist(), strict=True)
        ]

    def state(self) -> Counts:
        """All counts, for a checkpoint."""
        return self._counts.copy()

    def restore(self, counts: NDArray[np.generic]) -> None:
        """Go on from `state`."""
        if counts.shape != self._counts.shape:
            raise ValueError(f"a budget of shape {self._counts.shape}, but got {counts.shape}")
        self._counts = counts.astype(np.int64)

    def _sum(self, *phases: str) -> Counts:
        rows = [list(PURPOSES).index(phase) for phase in phases]
        total: Counts = self._counts[rows].sum(axis=0)
        return total
