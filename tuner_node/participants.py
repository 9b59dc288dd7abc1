# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Other participants on the network, and their effect on a session. Pure."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pdeloop.messages.diagnostics import ConditionTimer
from tuner_node.batch import DispatchError
from tuner_node.pair import PairPublication
from tuner_node.session import Session

SECOND_TUNER_GRACE = 6.0
"""Seconds a second tuner may be seen before it counts as one: a killed one is seen for 4 s."""


@dataclass(frozen=True)
class Publishers:
    """Numbers of publishers of the topics that show the participants.

    plants, controllers: of `episode/cost` and `model/identified`, by pair; tuners: of each
    `episode/start`, this tuner's own among them; recorders: of `recorder/status`; unmatched: those of
    them that do not yet read every `episode/start` of this tuner, as long as one is awaited.
    """

    plants: Sequence[int]
    controllers: Sequence[int]
    tuners: Mapping[str, int]
    recorders: int
    unmatched: int = 0


class Participants:
    """Reports to a session's dispatcher who is missing, and refuses who should not be there.

    recorder: the tuner's parameter of this name.
    """

    def __init__(self, session: Session, recorder: str) -> None:
        self._session, self._recorder = session, recorder
        self._recorder_seen = False
        self._second_tuner = ConditionTimer()
        self._paused: list[int] = []

    @property
    def awaits_recorder(self) -> bool:
        """True until a recorder was there from which no start of an episode can be lost."""
        return self._recorder != "none" and not self._recorder_seen

    def update(self, there: Publishers, now: float) -> list[PairPublication]:
        """The messages to send now that these publishers are present (now: monotonic s).

        DispatchError where a required recorder has gone, or another tuner publishes.
        """
        self._refuse_second_tuner(there.tuners, now)
        self._look_for_recorder(there)
        absent = ["recorder"] if self.awaits_recorder else []
        publications = []
        for pair, counts in enumerate(zip(there.plants, there.controllers, strict=True)):
            roles = zip(("plant", "controller"), counts, strict=True)
            missing = [role for role, count in roles if not count] + absent
            publications += self._session.dispatcher.presence(pair, missing, now)
        return publications + self._session.dispatcher.tick(now)

    def newly_paused(self, now: float) -> str:
        """Plants that were paused or resumed since the last call, in words; may be empty."""
        dispatcher = self._session.dispatcher
        paused, before = dispatcher.paused_pairs(now), self._paused
        if paused == before:
            return ""
        self._paused = paused
        if not paused:
            return "no plant is paused"
        which = f" of pair {', '.join(map(str, paused))}" if len(dispatcher.pairs) > 1 else ""
        return f"the plant{which} is paused"

    def _look_for_recorder(self, there: Publishers) -> None:
        """Note a recorder that misses nothing; DispatchError where a required one has gone.

        One may be discovered before its subscriptions are.
        """
        if self._recorder == "required" and self._recorder_seen and not there.recorders:
            raise DispatchError(
                "the recorder has gone, but this training has to be recorded; continue it from "
                "its folder with resume:=true"
            )
        self._recorder_seen |= there.recorders > there.unmatched

    def _refuse_second_tuner(self, tuners: Mapping[str, int], now: float) -> None:
        """DispatchError if another tuner publishes, unless a pair serves this one and refuses it."""
        shared = [topic for topic, count in tuners.items() if count > 1]
        unserved = bool(shared) and not self._session.established
        if self._second_tuner.seconds(unserved, now) > SECOND_TUNER_GRACE:
            raise DispatchError(
                f"another tuner publishes {shared[0]}; "
                "stop it, or start this one in another namespace or ROS domain"
            )
