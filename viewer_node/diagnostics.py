"""How the viewer is, as its /diagnostics show it. Pure."""

from __future__ import annotations

from loop_interfaces.diagnostics import Health, Level, Rate
from viewer_node.view import LoopView

SILENT = 5.0
"""Seconds without a sample after which what is shown is old."""


class ViewerHealth:
    """Reports on a view, from one call to the next."""

    def __init__(self, view: LoopView) -> None:
        self._view = view
        self._rate = Rate()
        self._seen, self._seen_at = 0, float("-inf")

    def report(self, now: float, subscribers: int) -> Health:
        """Level, sentence and values at time `now` (monotonic s)."""
        view = self._view
        if view.samples != self._seen:
            self._seen, self._seen_at = view.samples, now
        level, message = Level.OK, f"step {view.step} of episode {view.episode}"
        if not view.samples:
            message = "nothing seen yet"
        elif now - self._seen_at > SILENT:
            level, message = Level.STALE, f"no sample for {now - self._seen_at:.0f} s"
        return Health(
            level,
            message,
            {
                "run": view.run or None,
                "episode": view.episode if view.episode >= 0 else None,
                "step": view.step if view.step >= 0 else None,
                "environment": view.environment,
                "samples": view.samples,
                "samples/s": self._rate.per_second(view.samples, now),
                "subscribers": subscribers,
            },
        )
