# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Viewer status for /diagnostics. Pure."""

from __future__ import annotations

from pdeloop.messages.diagnostics import Level, Rate, Status
from pdeloop.messages.topics import episode_name
from viewer_node.loop_view import SILENT, LoopView


class ViewerDiagnostics:
    """Reports on a view, from one call to the next."""

    def __init__(self, view: LoopView) -> None:
        self._view = view
        self._rate = Rate()

    def report(self, now: float, subscribers: int) -> Status:
        """Level, sentence and values at time `now` (monotonic s)."""
        view, current, quiet = self._view, self._view.current, self._view.quiet(now)
        level, message = Level.OK, "nothing seen yet"
        if current is not None:
            message = f"step {current.last} of episode {episode_name(current.key[1])}"
            if quiet is not None and quiet > SILENT:
                level, message = Level.STALE, f"no messages for {quiet:.0f} s"
        return Status(
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
