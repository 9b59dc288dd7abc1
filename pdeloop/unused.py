# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Refuses parameters that are given but would have no effect, rather than ignoring them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pdeloop.messages.parameters import EXECUTION, PLANT, PROBLEM, RECORDER, VIEWER
from pdeloop.messages.spec import ParameterError

OF_A_METHOD = {
    "learning_rate": ("optimizer", "two_point"),
    "learning_rate_from_zero": ("optimizer", "two_point"),
    "smoothing_radius": ("optimizer", "two_point"),
    "dmdc_rank": ("identification", "dmdc"),
    "dmdc_order": ("identification", "dmdc"),
}
"""Parameters of one method: which parameter chooses it, and by which word."""
OF_THE_COMMAND = ("out", "resume", "recorder", "pairs", "plant_fingerprint")
"""Parameters of the tuner that follow from where and how a training runs."""
OF_NODES = {*(spec.name for spec in (*PLANT, *EXECUTION)), "episode_timeout", "max_attempts"}
"""Parameters of processes and messages, which a training in this process does not have."""
ELSEWHERE = {spec.name for spec in (*RECORDER, *VIEWER)} - {spec.name for spec in PROBLEM}


def refuse_unused(
    given: Mapping[str, Any],
    values: Mapping[str, Any],
    *,
    in_process: bool = False,
    viewed: bool = False,
) -> None:
    """ParameterError for a parameter that was given for a training and has no effect on it.

    given: those that the user named, not those of a problem's file; values: all of them, resolved;
    viewed: whether a viewer runs as well.
    """
    for name in given:
        reason = _reason(name, values, in_process=in_process, viewed=viewed)
        if reason:
            raise ParameterError(f"parameter '{name}' has no effect here: {reason}")


def _reason(name: str, values: Mapping[str, Any], *, in_process: bool, viewed: bool) -> str:
    if name in OF_A_METHOD:
        chooser, word = OF_A_METHOD[name]
        if values[chooser] != word:
            return f"it applies to the {chooser} {word}, but this one is {values[chooser]}"
    if name == "sensor_delays" and not values["sensors"]:
        return "there are no sensors; give sensors as well"
    if name in OF_THE_COMMAND:
        return "it follows from how the training is started; see pdeloop train --help"
    if name in OF_NODES and in_process:
        return "it applies to nodes; train over topics, without --in-process"
    if name in ELSEWHERE and not (viewed and name.startswith("view_")):
        return "it belongs to a node that the training does not start" + (
            "; add --view" if name.startswith("view_") else ""
        )
    return ""
