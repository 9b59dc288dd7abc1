# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Messages to send, as returned by the protocols of the three nodes. No ROS import.

A node's protocol is an object without clock, thread or network: an event comes in (a frame, or the
time), messages come out, and the node's only job is to move them. So every fault is a unit test.

Tuner, controller and plant each compute the same signatures, so the plant can recognise whether an
action comes from a controller that has the tuner's policy, model and target:

    D = h(rows, bounds, policy, h(model))          in the header of `episode/start`, as `plant`
    s = -h(D, z_r)                                 in the header of every `action`, as `time`
    s = -h(D, h(the parameters DESIGN))            in that of `model/identified`, as `time`

with h the first 53 bits of BLAKE2b over the numbers as little-endian float64, and bounds the
parameters action_limit, action_bounds, exploration_mean and exploration_scale. Where the controller
explores there is neither policy nor model. A simulated time is never negative, so a controller that
echoes the state's time, or sends 0, differs from one that signs. It does not protect against an
attacker who reads the messages and copies the number.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pdeloop.messages.documents import parse_json
from pdeloop.messages.frames import Frame
from pdeloop.messages.grid import axes_of
from pdeloop.messages.spec import FIELD_MODEL_SETTINGS, IDENTIFICATION_SETTINGS, LAW_SETTINGS
from pdeloop.messages.text import printable
from pdeloop.messages.topics import Topic

STOPPED = 75
"""Exit code of a tuner that an operator stopped (as sysexits' EX_TEMPFAIL)."""
NO_CONTROLLER = 65
"""Exit code of a tuner whose laws diverged (as sysexits' EX_DATAERR); its results are written."""


MAX_REASON = 1000
"""Characters of a reason that are shown."""


@dataclass(slots=True)
class Publication:
    """Publish `frame` on `topic`. Never changed once it is made (see `Frame`)."""

    topic: Topic
    frame: Frame


@dataclass(frozen=True)
class ModelFailure:
    """Why an exploratory episode gave no model, or why an episode cannot be relied on.

    retry: something was incomplete or contradictory, and the same rows can be run again; otherwise
    the data allow no model, or the episode is not to be used, and `reason` says why.
    """

    run: int
    episode: int
    retry: bool
    reason: str

    def to_json(self) -> str:
        return json.dumps(
            {"run": self.run, "episode": self.episode, "retry": self.retry, "reason": self.reason}
        )

    @staticmethod
    def from_json(text: str) -> ModelFailure:
        """Raises ValueError when `text` is not the JSON of a failure."""
        try:
            fields = parse_json(text[:10_000])
            reason = printable(" ".join(str(fields["reason"])[:MAX_REASON].split()))
            return ModelFailure(
                run=int(fields["run"]),
                episode=int(fields["episode"]),
                retry=bool(fields["retry"]),
                reason=reason[:MAX_REASON],
            )
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"expected the JSON of a model failure, got {text[:80]!r}") from error


NOT_SIGNED = 0.0
"""In place of D: the tuner asks for no signature. In place of s: the message carries none."""
DESIGN = (
    "identification", "reduced_order", "dmdc_rank", "dmdc_order", "state_weight", "action_weight",
)  # fmt: skip
"""Parameters that a model depends on in addition to its episode, and the cost where it is not empty.

With sensors their number and delays follow it.
"""


CONSTANTS = (IDENTIFICATION_SETTINGS, LAW_SETTINGS, FIELD_MODEL_SETTINGS)
"""How the names of parameters begin that are constants of the identification, a law or field models."""


def digest_of(*arrays: ArrayLike) -> int:
    """h: a whole number from 1 to 2^53 - 1.

    >>> digest_of([1.0, 2.0], 3.0) == digest_of([1.0], [2.0, 3.0]) != digest_of([1.0, 2.0], 4.0)
    True
    """
    state = blake2b(digest_size=8)
    for array in arrays:
        state.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
    return (int.from_bytes(state.digest(), "big") >> 11) or 1


def design_digest(parameters: Mapping[str, Any]) -> int:
    """h of the parameters DESIGN; text as the numbers of its UTF-8 bytes.

    The name of a law other than the affine one follows, without the file or module that it is in, and
    the horizon; with the identification "field", the noise, where there is any, and the points of each
    axis of a grid of several; then the constants of the identification and of the law, by their names,
    and those of field models with "field".
    """
    values = [parameters[name] for name in DESIGN]
    if parameters.get("cost"):
        seen = [parameters.get("sensors", 0), parameters.get("sensor_delays", 1)]
        values += ["".join(parameters["cost"]), *(seen if seen[0] else [])]
    law = parameters.get("law", "affine").rpartition(":")[2]
    values += [law, parameters["horizon"]] if law != "affine" else []
    noise = parameters.get("measurement_noise")
    values += [noise] if noise and parameters["identification"] == "field" else []
    axes = axes_of(parameters.get("grid", ""))
    values += axes if len(axes) > 1 and parameters["identification"] == "field" else ()
    constants = parameters.get("constants", parameters)
    count = CONSTANTS if parameters["identification"] == "field" else CONSTANTS[:2]
    names = sorted(name for name in constants if name.startswith(count))
    values += [f"{name}={constants[name]}" for name in names]
    return digest_of(*(list(v.encode()) if isinstance(v, str) else v for v in values))


def signature(digest: int, known: ArrayLike) -> float:
    """s for the D that a start carries; NOT_SIGNED where it carries none.

    known: z_r of an action, the design's digest of a model.
    """
    return -float(digest_of(digest, known)) if digest else NOT_SIGNED


def signature_in(time: float) -> float:
    """The signature in a header; NOT_SIGNED if it has an ordinary time there."""
    return min(time, NOT_SIGNED)
