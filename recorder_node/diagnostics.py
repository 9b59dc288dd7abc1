"""How the recording is, as the recorder's /diagnostics show it. Pure."""

from __future__ import annotations

from loop_interfaces.diagnostics import Level, Rate, Status
from recorder_node.recording import Recording


class RecorderDiagnostics:
    """Reports on a recording, from one call to the next."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._messages = Rate()
        self._incomplete = 0

    def report(self, now: float, matched: bool) -> Status:
        """Level, sentence and values at time `now` (monotonic s).

        matched: whether every publisher of the loop knows of the recorder, so that nothing is missed.
        """
        recording = self._recording
        level, message = Level.OK, "recording"
        if not matched:
            level, message = Level.WARN, "not yet matched with all publishers of the loop"
        elif recording.incomplete > self._incomplete:
            new = recording.incomplete - self._incomplete
            level, message = Level.WARN, f"recording; {new} more episode(s) are incomplete"
        self._incomplete = recording.incomplete
        return Status(
            level,
            message,
            {
                "run": recording.run or None,
                "bag": str(recording.path.resolve()),
                "matched": matched,
                "messages": recording.messages,
                "messages/s": self._messages.per_second(recording.messages, now),
                "episodes": recording.episodes,
                "episodes incomplete": recording.incomplete,
            },
        )
