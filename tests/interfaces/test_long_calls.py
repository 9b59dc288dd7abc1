# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Own code that takes long is named with its line, and a call that returns is forgotten."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pdeloop.messages import long_calls, own_code
from pdeloop.messages.own_code import OwnCodeError, called
from tests.support.loop_harness import until

LIMIT = 60.0


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is said of calls that take 0.1 s or longer."""
    said: list[str] = []
    watch = long_calls.LongCalls()
    watch.tell = said.append  # type: ignore[method-assign]
    monkeypatch.setattr(long_calls, "PATIENCE", 0.1)
    monkeypatch.setattr("pdeloop.messages.own_code.LONG_CALLS", watch)
    return said


def hangs(until_then: Callable[[], object]) -> None:
    until(until_then, LIMIT, "word")


def line_of(mark: str) -> int:
    lines = Path(__file__).read_text().splitlines()
    return next(i for i, text in enumerate(lines, 1) if mark in text)


def test_a_call_that_hangs_is_named_with_the_line_of_the_own_file(told: list[str]) -> None:
    called("Own.step", hangs, lambda: len(told) >= 2)
    for text in told:
        assert text.startswith("Own.step has been running for ")
        assert text.endswith(f", at {__file__}, line {line_of('until(until_then, LIMIT')}")


def test_a_call_within_another_is_named_instead_and_afterwards_the_outer_one(
    told: list[str],
) -> None:
    def outer() -> None:
        called("Own.inner", hangs, lambda: told)
        hangs(lambda: told[-1].startswith("Own.outer"))

    called("Own.outer", outer)
    assert told[0].startswith("Own.inner")


class Clock:
    """A time that passes only where a test lets it, however busy the machine is."""

    def __init__(self) -> None:
        self.now = 0.0
        self.looks: Counter[int | None] = Counter()

    def monotonic(self) -> float:
        return self.now

    def sleep(self, _: float) -> None:
        """The watch of a thread looks all the time."""
        self.looks[threading.get_ident()] += 1
        time.sleep(0.001)


def test_what_returns_or_fails_is_forgotten(
    told: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock()
    monkeypatch.setattr(long_calls, "time", clock)

    def takes(seconds: float) -> None:
        """Let the time pass, and the watch look at what is running then."""
        clock.now += seconds
        watch = own_code.LONG_CALLS._thread
        assert watch is not None
        seen = clock.looks[watch.ident]
        until(lambda: clock.looks[watch.ident] >= seen + 2, LIMIT, "look")

    def fails() -> Any:
        raise ValueError("no")

    for _ in range(20):
        called("Own.step", takes, 0.02)
        with pytest.raises(OwnCodeError, match=r"Own\.step fails: .*, line \d+: ValueError: no"):
            called("Own.step", fails)
    takes(1.0)
    assert told == []
    called("Own.step", takes, 0.2)
    assert [text.split()[0] for text in told] == ["Own.step"]


def test_two_threads_are_looked_after(told: list[str]) -> None:
    names = {"Own.a", "Own.b"}
    heard: Callable[[], bool] = lambda: {text.split()[0] for text in told} == names  # noqa: E731
    threads = [threading.Thread(target=called, args=(name, hangs, heard)) for name in names]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(LIMIT)
    assert heard()
