# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""An optimiser of your own in one file: a random change of the policy is kept where it costs less.

pdeloop train burgers --optimizer random_search.py:RandomSearch --set optimizer_settings.size=0.1
"""

from dataclasses import dataclass

import pdeloop


@dataclass(frozen=True, kw_only=True)
class RandomSearchSettings(pdeloop.Settings):
    """The constants of the search."""

    size: float = pdeloop.setting(
        0.05, "size of a change, relative to that of the gains", 1e-6, 10.0
    )


class RandomSearch(pdeloop.StepOptimizer):
    """Compares the policy with a random neighbour of it on one field, and takes the better one."""

    name = "random_search"
    Settings = RandomSearchSettings
    step_rollouts = 2

    def neighbour(self):
        size = self.settings.size * max(abs(self.policy).max(), 0.01)
        return self.policy + size * self.generator.standard_normal(self.policy.shape)

    def rollouts(self):
        return [
            pdeloop.Rollout(policy, self.field_seed) for policy in (self.policy, self.neighbour())
        ]

    def update(self, results):
        before, after = results
        better = after.usable and (not before.usable or after.cost < before.cost)
        if better:
            self.policy = self.neighbour()
        return {"updated": better}
