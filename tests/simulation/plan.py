# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What goes wrong in a simulated training, drawn from a seed."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass, replace

MAIN = ("plant", "controller", "tuner")
"""The processes of a loop; those of a second pair have its number behind their name."""
KINDS = {
    "crash": 30,  # of one process, at any moment, also within a write to its disk
    "power cut": 6,  # of all of them; what was not synced is lost
    "bit rot": 4,  # a power cut after which a bit of a file of the tuner has changed
    "cut": 15,  # a line from one process to another, one way
    "stall": 8,  # a process stands still, and goes on later
    "pause plant": 6,
    "step plant": 4,  # a pause in which the operator lets single steps happen
    "pause tuner": 5,
    "stop tuner": 5,  # and the training is continued later
    "replay": 6,  # a message from before is delivered again
    "second controller": 14,  # that was told something else, or answers anything and does not sign
    "second tuner": 5,  # of a training of its own, on the same plant and controller
    "early cost": 6,  # a completed one in the middle of an episode, with the ids and the plant's time
    "episode ahead": 6,  # policy and start of the next one, signed, from somebody else
    "forgery": 8,  # beside each message on a topic comes one with the same header and other values
}
"""Faults, and how often each is drawn."""
FORGED = (
    "policy",
    "target",
    "model",
    "episode/start",
    "state",
    "action",
    "episode/cost",
    "model/identified",
    "samples",
)
"""Topics on which messages are forged."""
AIMED = {
    "stale": (
        "episode/start",
        "policy",
        "model",
        "state",
        "action",
        "episode/cost",
        "model/identified",
    ),
    "another run": ("policy", "model", "state", "action", "episode/cost", "model/identified"),
    "another plant": ("state", "action", "episode/cost", "model/identified"),
    "late action": ("",),
    "late start": ("",),
    "forgery": ("episode/cost", "model/identified"),
}
"""Faults of `aimed`, and the topics that each is on: beside each message comes one of an earlier
episode, of another run or of another plant, with the same step; an action or a start of an episode
that has ended comes once more, with its header and other values; or each answer comes with another."""
OTHERS = ("another plant", "late action", "late start")
"""Those of them that somebody else causes who takes part in the run."""
HOSTILE = ("second controller", "second tuner", "early cost", "episode ahead", "forgery", *OTHERS)
"""Faults after which a training may also end with an error that names the cause."""
HIDING = ("crash", "power cut", "bit rot", "cut", "stop tuner", "second controller")
"""Faults by which plant, controller or tuner may miss what contradicts a cost that came too early."""


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

    loss, duplicates, damage: probabilities that a message on a topic that is not reliable is lost,
    comes twice, or has a bit changed in what is in front of its values; delay: mean (s); rates: of
    the clocks of the processes; iterations: of the two-point method, 0 for model_based, for which
    the tuner reads states and actions; pairs: of plant and controller; own_plant: instead of the small
    problem's one of a user's own; law: which the controller has, with the two-point method any; signs:
    whether it signs its actions.
    """

    seed: int
    loss: float = 0.0
    duplicates: float = 0.0
    damage: float = 0.0
    delay: float = 1e-3
    rates: tuple[float, ...] = (1.0, 1.0, 1.0)
    iterations: int = 1
    pairs: int = 1
    own_plant: bool = False
    law: str = "affine"
    signs: bool = True
    faults: tuple[Fault, ...] = ()

    @property
    def hostile(self) -> bool:
        return self.damage > 0.0 or any(fault.kind in HOSTILE for fault in self.faults)

    @property
    def harmless(self) -> bool:
        """True if nothing happens but that messages come which are for nobody there."""
        return bool(self.faults) and all(
            fault.kind in ("stale", "another run") for fault in self.faults
        )

    @property
    def hides(self) -> bool:
        return self.damage > 0.0 or any(fault.kind in HIDING for fault in self.faults)

    @property
    def names(self) -> tuple[str, ...]:
        """The processes."""
        return MAIN if self.pairs == 1 else (*MAIN, "plant 1", "controller 1")

    def smaller(self) -> Iterator[Plan]:
        """Plans with one thing less, to find the smallest that still fails."""
        for i in range(len(self.faults)):
            yield replace(self, faults=self.faults[:i] + self.faults[i + 1 :])
        quiet = Plan(self.seed)
        names = (
            "loss",
            "duplicates",
            "damage",
            "delay",
            "rates",
            "iterations",
            "pairs",
            "own_plant",
            "law",
        )
        for name in names:
            if getattr(self, name) != getattr(quiet, name):
                yield replace(self, **{name: getattr(quiet, name)})


def draw(seed: int) -> Plan:
    """The plan of a seed."""
    rng = random.Random(seed)
    delay = rng.choice([1e-4, 1e-3, 2e-2])
    iterations = rng.choice([0, 0, 0, 1, 1, 1, 4])
    pairs = rng.choice([1, 1, 1, 2])
    names = Plan(seed, pairs=pairs).names
    length = 0.1 + (70 + 20 * iterations) * delay  # of the training, if nothing happens
    faults = []
    for _ in range(rng.randrange(6)):
        (kind,) = rng.choices(list(KINDS), KINDS.values())
        who = ""
        if kind in ("crash", "stall"):
            who = rng.choice(names)
        elif kind == "cut":
            who = ">".join(rng.sample(names, 2))
        elif kind in ("pause plant", "step plant"):
            who = rng.choice([name for name in names if name.startswith("plant")])
        elif kind == "forgery":
            who = rng.choice(FORGED)
        elif kind == "second controller":
            who = rng.choice(["signs", "does not sign"])
        duration = rng.expovariate(1.0 / rng.choice([length / 4, 2.0]))
        faults.append(Fault(rng.uniform(0.0, length), kind, who, duration))
    return Plan(
        seed,
        loss=rng.choice([0.0, 0.0, 0.01, 0.05]),
        duplicates=rng.choice([0.0, 0.02]),
        damage=rng.choice([0.0, 0.0, 0.0, 0.01]),
        delay=delay,
        rates=tuple(rng.choices([1.0, 0.5, 2.0], k=len(MAIN))),
        iterations=iterations,
        pairs=pairs,
        own_plant=seed % 5 == 4,
        law="observer" if iterations and seed % 3 == 0 else "affine",
        faults=tuple(sorted(faults, key=lambda fault: fault.time)),
    )


def aimed(seed: int) -> Plan:
    """A plan with one of the faults that a check of a header is there for, on a good network.

    Those of `draw` seldom come at the moment at which a check that was removed would be missed.
    """
    rng = random.Random(seed)
    delay, iterations = rng.choice([1e-3, 1e-2]), rng.choice([0, 1])
    length = 0.1 + (70 + 20 * iterations) * delay
    kind = rng.choice(list(AIMED))
    late = kind.startswith("late")
    begin = rng.uniform(0.2, 1.0) * length if late else 0.0
    faults = [Fault(begin, kind, rng.choice(AIMED[kind]), 0.0 if late else 100.0)]
    if not late and rng.random() < 0.3:
        who = rng.choice(MAIN[:2])
        faults.append(Fault(rng.uniform(0.0, length), "crash", who, 0.1))
    law = "observer" if iterations and seed % 3 == 0 else "affine"
    if law != "affine" and rng.random() < 0.5:  # its memory is lost in the middle of an episode
        faults = [Fault(rng.uniform(0.1, 1.0) * length, "crash", "controller", 5 * delay)]
    return Plan(
        seed,
        delay=delay,
        iterations=iterations,
        law=law,
        signs=rng.random() < 0.5,
        faults=tuple(sorted(faults, key=lambda fault: fault.time)),
    )
