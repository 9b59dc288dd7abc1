"""What goes wrong in a simulated training, drawn from a seed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

PROCESSES = ("plant", "controller", "tuner")
HOSTILE = ("second controller", "second tuner")
"""Faults after which a training may also end with an error that names the cause."""

ROUNDS = 250
"""Steps of the simulated training, about."""


@dataclass(frozen=True)
class Fault:
    """At `time` (s) what `kind` says happens to `who`, for `duration` (s) where it passes."""

    time: float
    kind: str
    who: str = ""
    duration: float = 0.0


@dataclass(frozen=True)
class Plan:
    """A history is a function of its plan.

    loss, duplicates: probabilities of a message on a topic that is not reliable; delay: mean (s);
    rates: of the clocks of the processes; saved: probability that a checkpoint reaches the disk;
    trajectories: whether the tuner reads states and actions (Gauss-Newton), or costs alone.
    """

    seed: int
    loss: float
    duplicates: float
    delay: float
    rates: tuple[float, ...]
    saved: float
    trajectories: bool
    faults: tuple[Fault, ...]

    @property
    def hostile(self) -> bool:
        return any(fault.kind in HOSTILE for fault in self.faults)

    def without(self, index: int) -> Plan:
        """The plan with one fault less, to find the smallest that still fails."""
        return replace(self, faults=self.faults[:index] + self.faults[index + 1 :])


def draw(seed: int) -> Plan:
    """The plan of a seed."""
    rng = np.random.default_rng(seed)
    delay = float(rng.choice([1e-4, 1e-3, 2e-2]))
    length = 0.1 + ROUNDS * 2 * delay  # of the training, if nothing happens
    faults = []
    for _ in range(rng.integers(0, 6)):
        time, duration = float(rng.uniform(0.0, length)), float(rng.exponential(length / 4))
        kind = str(
            rng.choice(
                ["crash", "cut", "pause plant", "hold tuner", *HOSTILE],
                p=[0.4, 0.2, 0.1, 0.1, 0.15, 0.05],
            )
        )
        if kind == "crash":
            who = str(rng.choice(PROCESSES))
        elif kind == "cut":  # one way
            who = ">".join(rng.choice(PROCESSES, 2, replace=False))
        elif kind == "second controller":
            who = str(rng.choice(["signs", "does not sign"]))
        else:
            who = ""
        faults.append(Fault(time, kind, who, duration))
    return Plan(
        seed,
        loss=float(rng.choice([0.0, 0.01, 0.05])),
        duplicates=float(rng.choice([0.0, 0.02])),
        delay=delay,
        rates=tuple(rng.choice([1.0, 1.0, 0.5, 2.0], len(PROCESSES)).tolist()),
        saved=float(rng.choice([0.0, 0.3, 1.0])),
        trajectories=bool(rng.integers(2)),
        faults=tuple(sorted(faults, key=lambda fault: fault.time)),
    )
