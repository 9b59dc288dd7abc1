"""The cost of every policy that a training of one seed had, on the evaluation fields. Pure.

policies (N, n_a, 2 n_s)    at the start, and after every batch of the adaptation
costs (N, fields)           theirs
rollouts (N,)               paid until then
"""

from __future__ import annotations

from collections.abc import Mapping
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdeloop.evaluation import mean_costs
from pdeloop.in_process import LocalPair
from tuner_node.training import Training

Array = NDArray[np.float64]


class Curve:
    """Grows with a training of one seed that runs on `pair`.

    Parameters
    ----------
    training : Training
    pair : LocalPair
        It rolls the policies out besides; these rollouts belong to no budget.
    values : dict
        Resolved parameters of the training.
    """

    def __init__(self, training: Training, pair: LocalPair, values: Mapping[str, Any]) -> None:
        self._training, self._pair, self._values = training, pair, values
        self._policies: list[Array] = []
        self._costs: list[Array] = []
        self._rollouts: list[int] = []

    def update(self) -> None:
        """Add the present policy; its cost is measured where it is another one than before."""
        if not self._training.optimizers or self._training.phase == "done":
            return
        (policy,) = self._training.policies()
        same = bool(self._policies) and np.array_equal(policy, self._policies[-1])
        self._costs.append(self._costs[-1] if same else self._measured(policy))
        self._policies.append(policy)
        self._rollouts.append(int(self._training.budget.paid[0]))

    def archive(self) -> bytes:
        """The arrays as an .npz file."""
        content = BytesIO()
        np.savez(
            content,
            policies=np.stack(self._policies),
            costs=np.stack(self._costs),
            rollouts=np.array(self._rollouts, dtype=np.float64),
        )
        return content.getvalue()

    def _measured(self, policy: Array) -> Array:
        """Mean stage costs (fields,) of a policy, as in the closing evaluation."""
        fields, seed = self._values["evaluation_fields"], self._values["evaluation_seed"]
        laws = policy[np.newaxis]
        (costs,) = mean_costs(self._pair, self._values, laws, [0], fields=fields, seed=seed)
        return np.asarray(costs)
