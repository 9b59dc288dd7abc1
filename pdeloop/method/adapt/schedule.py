# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The numbers of rollouts after which `model_based` renews its law and judges the final one."""

from __future__ import annotations

from dataclasses import dataclass

from pdeloop.method.adapt.settings import FIRST_RENEWAL, ModelBasedSettings


@dataclass(frozen=True)
class Schedule:
    """When a law is renewed, in rollouts of the optimiser itself.

    Attributes
    ----------
    known : int
        Rollouts that were measured before.
    budget : int
        Rollouts in all, without those.
    settings : ModelBasedSettings
        `enough_fields` and `judging`.
    """

    known: int
    budget: int
    settings: ModelBasedSettings

    @property
    def judging(self) -> int:
        """Rollouts that judge the final law."""
        return max(1, min(self.settings.judging, self.budget // 2))

    @property
    def last(self) -> int:
        """Rollouts after which the law is renewed for the last time."""
        enough = max(self.settings.enough_fields - self.known, 1)
        return min(self.budget - self.judging, enough)

    def doubled(self, own: int) -> int:
        """The next renewal where each one comes after twice as many rollouts, known ones included."""
        at = FIRST_RENEWAL
        while at - self.known <= own:
            at *= 2
        # One is only worth it if as many rollouts again come before the last one.
        return at - self.known if 2 * at - self.known <= self.last else self.last

    def often(self, own: int) -> int:
        """The next renewal where a law is rolled out no more often than judges it."""
        first = max(FIRST_RENEWAL - self.known, 1)
        every = range(first, max(self.last, first) + 1, self.settings.judging)
        return next((n for n in every if own < n <= self.last), self.last)
