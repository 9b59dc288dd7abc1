# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The state of a search by `gauss_newton`, for checkpoints: its laws, fields and decisions."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.array_files import Arrays, checked_array
from loop_interfaces.arrays import Array
from loop_method.adapt.base import State
from loop_method.adapt.settings import GaussNewtonSettings

Stamps = NDArray[np.int64]
NONE = -1
"""The stamp of a rollout that has not been made."""
STAMPS = ("fields", "incumbents", "trials", "compared")
LATER = ("whole", "from_none", "reason", "ended")
"""What older checkpoints lack."""


@dataclass(eq=False)
class SearchState:
    """State of an optimisation, apart from the rollouts that it remembers.

    policy, candidate (n_a, 2 n_s): the incumbent, and what is tried if `proposed`; fields (M,):
    numbers of the initial fields that judge; incumbents, trials, compared (M,): stamps of the
    rollouts on these fields of the incumbent, of the candidate, and of what the incumbent is
    compared to, the candidate rejected last or the incumbent before, -1: none; fall: what the
    candidate is predicted to gain; damping: lambda; accepted: whether the last candidate was;
    believed: the kind of the model of the whole field, empty for none; whole: whether it predicts
    rollouts as a whole; tried: rollouts, when none was found; from_none: whether the search goes on
    from no control, which the first law did not beat; reason: why it ended early, empty: it did not;
    ended: whether it is decided what is returned.
    """

    policy: Array
    candidate: Array
    fields: Stamps
    incumbents: Stamps
    trials: Stamps
    compared: Stamps
    fall: float = 0.0
    damping: float = 1.0
    accepted: bool = True
    proposed: bool = False
    tells: int = 0
    believed: str = ""
    tried: int = 0
    whole: bool = False
    from_none: bool = False
    reason: str = ""
    ended: bool = False

    @classmethod
    def begin(cls, policy: Array, count: int, first: int, damping: float) -> SearchState:
        """Before the first rollout, with this many fields from number `first` on."""
        incumbents, trials, compared = np.full((3, count), NONE, dtype=np.int64)
        numbers = first + np.arange(count, dtype=np.int64)
        laws = policy.copy(), policy.copy()
        return cls(*laws, numbers, incumbents, trials, compared, damping=damping)

    def arrays(self) -> State:
        """A copy of everything, as a checkpoint holds it."""
        return {field.name: np.array(getattr(self, field.name)) for field in fields(self)}

    def later(self, arrays: Arrays) -> SearchState:
        """From the `arrays` of a later state of this optimisation; a ValueError if they are none."""
        given: dict[str, Any] = {}
        if "compared" not in arrays and "others" in arrays:  # its name in older checkpoints
            arrays = {**arrays, "compared": arrays["others"]}
        for name, own in self.arrays().items():
            if name in LATER and name not in arrays:
                continue
            shape = (None,) if name in STAMPS else own.shape
            array = checked_array(arrays, name, own.dtype.kind, shape)
            given[name] = array.copy() if shape else array.item()
        if len({given[name].size for name in STAMPS}) > 1:
            raise ValueError("the fields of the checkpoint do not add up.")
        return SearchState(**given)

    def damp(self, fall: float, settings: GaussNewtonSettings) -> None:
        """Another damping after a step that gained `fall`."""
        if fall > settings.good_ratio * self.fall:
            self.damping = max(self.damping / settings.damping_fall, settings.least_damping)
        elif fall <= settings.poor_ratio * self.fall:
            self.damping *= settings.damping_rise

    def accept(self) -> None:
        """The candidate becomes the incumbent."""
        self.policy = self.candidate.copy()
        self.compared, self.incumbents = self.incumbents, self.trials.copy()
        self.accepted = True

    def renew_fields(self, left: int, most: int) -> None:
        """A fresh field in place of the oldest, or in addition to it where there are fewer than `most`.

        left: rollouts for the next step, which has to be possible.
        """
        grow = len(self.fields) < most
        if left <= len(self.fields) + grow:
            return
        if grow:
            self.fields = np.append(self.fields, self.fields.max() + 1)
            self.incumbents, self.trials, self.compared = (
                np.append(stamps, NONE) for stamps in (self.incumbents, self.trials, self.compared)
            )
        else:
            oldest = int(np.argmin(self.fields))
            self.fields[oldest] = self.fields.max() + 1
            self.compared[oldest] = self.incumbents[oldest] = NONE

    @property
    def missing(self) -> Stamps:
        """Indices of the fields on which the incumbent has not run."""
        return np.flatnonzero(self.incumbents == NONE)

    @property
    def next_trial(self) -> int:
        """Index of the field on which the candidate runs next."""
        return int(np.argmax(self.trials == NONE))

    @property
    def referred(self) -> set[int]:
        """Stamps of the rollouts that are still needed."""
        return {int(s) for s in (*self.incumbents, *self.trials, *self.compared)} - {NONE}
