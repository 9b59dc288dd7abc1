# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The report of `pdeloop bag verify`: comparisons, differences and gaps."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from pdeloop.messages.arrays import Array

SHOWN = 5
"""Differences that are described; the others are only counted."""


@dataclass
class Report:
    """Comparisons, differences and gaps.

    recomputed: episodes that were run again; unverified: runs of which none was; incomplete: episodes
    that lack something, which a training may have repeated; missing: what the bag, its metadata or its
    run says there is, and is not there; count: of the differences, of which the first are in
    `differences`.
    """

    bag: str
    episodes: int = 0
    recomputed: int = 0
    compared: dict[str, int] = field(default_factory=dict)
    differences: list[str] = field(default_factory=list)
    count: int = 0
    incomplete: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    unverified: list[str] = field(default_factory=list)

    @property
    def good(self) -> bool:
        """True if every run was recomputed, nothing is missing, and nothing differs."""
        return bool(self.recomputed) and not (self.count or self.missing or self.unverified)

    def count_compared(self, what: str, number: int) -> None:
        """Count compared items of one kind."""
        self.compared[what] = self.compared.get(what, 0) + number

    def differs(self, text: str) -> None:
        """Note a difference."""
        self.count += 1
        if len(self.differences) < SHOWN:
            self.differences.append(text)

    def differences_of(self, texts: Iterable[str]) -> None:
        """Note several differences."""
        for text in texts:
            self.differs(text)

    def compare(self, what: str, where: str, recorded: Array, again: Array) -> bool:
        """Count a comparison of two arrays and note the first entry that differs."""
        self.count_compared(what, len(recorded))
        if recorded.shape != again.shape:
            self.differs(f"{where}: recorded shape {recorded.shape}, recomputed {again.shape}")
            return False
        a = np.ascontiguousarray(recorded).view(np.uint64)
        b = np.ascontiguousarray(again).view(np.uint64)
        if np.array_equal(a, b):
            return True
        index = tuple(int(i) for i in np.argwhere(a != b)[0])
        self.differs(
            f"{where}, entry {list(index)}: recorded {float(recorded[index])!r}, "
            f"recomputed {float(again[index])!r}"
        )
        return False

    def text(self) -> str:
        """The report for people."""
        lines = [f"{self.bag}: {self.episodes} episodes"]
        if self.compared:
            parts = ", ".join(f"{n} {what}" for what, n in self.compared.items())
            lines.append(f"  recomputed {parts}")
        lines += [f"  {note}" for note in self.notes]
        lines += [f"  incomplete: {text}" for text in self.incomplete[:SHOWN]]
        if len(self.incomplete) > SHOWN:
            lines.append(f"  and {len(self.incomplete) - SHOWN} more incomplete episodes")
        lines += [f"  missing: {text}" for text in self.missing[:SHOWN]]
        if len(self.missing) > SHOWN:
            lines.append(f"  and {len(self.missing) - SHOWN} more things are missing")
        lines += [
            f"  not verified: {name}, no episode of which was run again" for name in self.unverified
        ]
        if self.differences:
            lines.append(f"  {self.count} differences; the first: {self.differences[0]}")
            lines += [f"    {text}" for text in self.differences[1:]]
        elif self.compared and self.missing:
            lines.append(
                "  everything that is there is the same to the bit; missing parts were not compared"
            )
        elif self.recomputed:
            part = f" in the {self.recomputed} of {self.episodes} episodes that were run again"
            whole = self.recomputed == self.episodes
            lines.append(f"  no difference, to the bit{'' if whole else part}")
        return "\n".join(lines)
