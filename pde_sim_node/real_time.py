# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Due times of states on the wall clock, and their delays. Pure: no clock.

State 0 goes out at once and sets the grid; every further one is due a period after the one before.
A state that is not ready at its instant is a missed deadline: it goes out as soon as it is ready and
moves the grid, so that the plant never hurries to make up for lost time.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

REMEMBERED = 10_000
"""States whose lateness `quantile` is about, the last ones."""


@dataclass(frozen=True)
class Timing:
    """Times of messages, never their content; see pdeloop.messages.parameters.PLANT."""

    action_timeout: float
    max_repeats: int
    run_hold: float
    real_time_factor: float = 0.0


class RealTimePacer:
    """The instants of the states of one episode after the other.

    period (s): wall time from one state to the next. `now` is any monotonic time in s.
    """

    def __init__(self, period: float) -> None:
        self.period = period
        self.clear()
        self._due = 0.0
        self._late = False
        self._asked = False

    def clear(self) -> None:
        """Reset the counters."""
        self.count = 0
        self.missed = 0
        self.largest = 0.0
        self._lateness: deque[float] = deque(maxlen=REMEMBERED)

    def begin(self, now: float) -> None:
        """State 0 goes out now."""
        self._due = now

    def next(self, now: float) -> float:
        """The instant at which the next state is due; its step is about to be, or just was, made."""
        self._due += self.period
        self._asked, self._late = False, now > self._due
        return self._due

    def ready(self, now: float) -> bool:
        """True if the state, which is ready now, is to go out; then it is counted."""
        if now < self._due:
            self._asked = True
            return False
        missed = self._late or not self._asked
        lateness = now - self._due
        self.count += 1
        self.missed += missed
        self.largest = max(self.largest, lateness)
        self._lateness.append(lateness)
        if missed:
            self._due = now
        return True

    def quantile(self, share: float) -> float:
        """Lateness in s that this share of the last states did not exceed; 0 before the first."""
        if not self._lateness:
            return 0.0
        return float(np.quantile(self._lateness, share, method="inverted_cdf"))

    def summary(self) -> str:
        """The counts in words, also for `python -m benchmarks realtime`."""
        p50, p99 = (1e6 * self.quantile(share) for share in (0.5, 0.99))
        return (
            f"{self.count} states every {1e3 * self.period:g} ms, {self.missed} missed deadlines, "
            f"jitter p50 {p50:.0f} us, p99 {p99:.0f} us, max {1e6 * self.largest:.0f} us"
        )
