"""How the viewer is, as its /diagnostics show it. Pure."""

from __future__ import annotations

from loop_interfaces.diagnostics import Health, Level, Rate
from viewer_node.loop_view import SILENT, LoopView


class ViewerHealth:
    """Reports on a view, from one call to the next."""

    def __init__(self, view: LoopView) -> None:
        self._view = view
        self._rate = Rate()
        self._seen, self._seen_at = 0, float("-inf")

    def report(self, now: float, subscribers: int) -> Health:
        """Level, sentence and values at time `now` (monotonic s)."""
        view, current = self._view, self._view.current
        if view.samples != self._seen:
            self._seen, self._seen_at = view.samples, now
        level, message = Level.OK, "nothing seen yet"
        if current is not None:
            message = f"step {current.last} of episode {current.key[1]}"
            if now - self._seen_at > SILENT:
                level, message = Level.STALE, f"no sample for {now - self._seen_at:.0f} s"
        return Health(
            level,
            message,
            {
                "run": view.run or None,
                "episode": None if current is None else current.key[1],
                "step": None if current is None else current.last,
                "environment": view.environment,
                "samples": view.samples,
                "samples/s": self._rate.per_second(view.samples, now),
                "subscribers": subscribers,
            },
        )
