# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The topics of the loop: names, axes, quality of service, and why. No ROS import.

Names are relative, so a namespace makes a second loop. docs/protocol.md describes them for
authors of other nodes; this is the same table for the project's nodes.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.frames import ArrayCodec, Frame, FrameError


@dataclass(frozen=True)
class Topic:
    """One topic of arrays: its relative name, and the names of its axes.

    latched: transient local, so that a node that starts late or again receives the last message.
    others: the names of the axes of an array with another number of them.
    """

    name: str
    labels: tuple[str, ...]
    latched: bool
    others: tuple[tuple[str, ...], ...] = ()

    def codec(self) -> ArrayCodec:
        """The codec of its arrays."""
        return ArrayCodec(self.labels, *self.others)


class StartColumn(IntEnum):
    """Columns of `episode/start`, one row per environment."""

    SEED = 0
    """Seed of the initial field (>= 0: drawn from the initial distribution; -1: its mean)."""
    EXCITATION = 1
    """Seed of the exploratory actions (>= 0), or -1: the policy acts."""
    VARIANCE = 2
    """Variance of each exploratory action; 0 where the policy acts."""
    MODEL = 3
    """Index of the reduced model the environment's policy belongs to."""
    NOISE = 4
    """Seed of the environment's noise; only where the plant has noise."""


START_COLUMNS = 4
"""Columns of every `episode/start`; with noise there is one more."""


_WHOLE_NUMBERS = {
    StartColumn.SEED: ("seeds", -1),
    StartColumn.EXCITATION: ("excitation seeds", -1),
    StartColumn.MODEL: ("model indices", 0),
    StartColumn.NOISE: ("noise seeds", 0),
}
"""Meaning and least value of these columns."""


def start_rows(frame: Frame) -> NDArray[np.float64]:
    """The rows of an `episode/start`, (M, 4) or (M, 5); none at the end of a run.

    FrameError where they are not as StartColumn says, or only some environments of the episode
    explore.
    """
    rows = frame.values
    if rows.shape[1] not in (START_COLUMNS, len(StartColumn)):
        raise FrameError(
            f"expected rows of {START_COLUMNS} numbers (seed, excitation, variance, model), "
            f"or one more (noise), got {rows.shape[1]}"
        )
    for column, (what, least) in _WHOLE_NUMBERS.items():
        numbers = rows[:, column : column + 1]  # empty where there is no such column
        if (numbers < least).any() or (numbers != np.floor(numbers)).any():
            raise FrameError(f"expected {what} that are whole numbers of at least {least}")
    if (rows[:, StartColumn.VARIANCE] < 0).any():
        raise FrameError("expected exploration variances of at least 0")
    if len(set(rows[:, StartColumn.EXCITATION] >= 0)) > 1:
        raise FrameError("expected all environments of an episode to explore, or none")
    return rows


def noise_seeds(rows: NDArray[np.float64]) -> NDArray[np.int64] | None:
    """The column NOISE of the rows of a start, or None where there is none."""
    return rows[:, StartColumn.NOISE].astype(np.int64) if rows.shape[1] > START_COLUMNS else None


class CostColumn(IntEnum):
    """Columns of `episode/cost`, one row per environment."""

    MEAN = 0
    """Mean stage cost J = (1/T) sum of l_k."""
    TOTAL = 1
    """Sum of the stage costs."""
    ENDED = 2
    """-1: completed; k >= 0: diverged at step k (J is 1e9); -2: void, not a cost."""


WRITER_DEPTH = 1
"""Only the newest sample has a meaning; the protocol repeats lost ones."""
READER_DEPTH = 8
"""A message of ours must not be pushed out by one of a node that should not be there."""

MAX_GAIN = 1e9
"""Largest gain that is published or accepted: with fields below the divergence bound no action can
overflow, and a law with such gains diverges anyway."""

COMPLETED = -1
VOID = -2

# Latched: a node that restarts in the middle of an episode must learn of it without asking.
START = Topic("episode/start", ("env", "seed_excitation_variance_model"), latched=True)
# Gains of the affine law; theta of any other.
POLICY = Topic("policy", ("env", "actuator", "gain"), latched=True, others=(("env", "parameter"),))
COST = Topic("episode/cost", ("env", "mean_total_ended"), latched=True)
MODEL = Topic("model", ("model", "row", "mode"), latched=True)
MODEL_IDENTIFIED = Topic("model/identified", ("model", "row", "mode"), latched=True)
TARGET = Topic("target", ("x",), latched=True)
PAUSED = Topic("episode/paused", ("paused",), latched=True)
"""One number: 1 while an operator has paused the plant, 0 otherwise. For information only."""

# Volatile, depth 1: in lock-step only the newest sample has a meaning; the plant repeats lost ones.
STATE = Topic("state", ("env", "x"), latched=False)
ACTION = Topic("action", ("env", "actuator"), latched=False)

MODEL_FAILED = "model/failed"
"""std_msgs/String, latched: why an identification gave no model (JSON, see docs/protocol.md)."""

SAMPLES = "samples"
"""std_msgs/UInt8MultiArray: the plant's states and actions, many in one message (samples.py)."""

SAMPLES_THROTTLED = "samples_throttled"
"""The same of some episodes only, for viewers."""

RECORDER_STATUS = "recorder/status"
"""std_msgs/String, latched: a recorder that is matched with the whole loop names its bag here."""

# Not `episode/paused`, which says nothing about an episode's numbers.
ARRAYS = (START, STATE, ACTION, POLICY, COST, MODEL_IDENTIFIED, MODEL, TARGET)

VIEW_NUMBERS = {
    "cost": "mean stage cost of the last adapted policies (neither zero nor the LQT gains)",
    "cost_no_control": "mean stage cost of the last rollouts without control",
    "cost_lqt": "mean stage cost of the last rollouts with the LQT gains",
    "reduction": "100 (1 - cost / cost_lqt), in percent",
    "stage_cost": "l_k = q |z_k - z_r|^2 + r |a_k|^2 of the newest sample",
    "tracking_error": "root of the mean square of z_k - z_r of the newest sample",
    "final_error": "the same at the last step of the last episode",
    "action_norm": "|a_k| of the newest sample",
    "gain_norm": "Frobenius norm of the current gains [K_a K_b], or of another law's parameters",
    "gain_change": "Frobenius norm of their difference from the LQT gains, relative to the latter",
    "step": "k of the newest sample",
}
"""Names and meanings of the numbers that a viewer publishes below `view/`."""

VIEWS = {
    "view/field": "visualization_msgs/msg/Marker",
    "view/target": "visualization_msgs/msg/Marker",
    "view/spacetime": "sensor_msgs/msg/Image",
    **{f"view/{name}": "std_msgs/msg/Float64" for name in VIEW_NUMBERS},
}
"""Topics that a viewer publishes for other tools, with their types."""


EPISODES_PER_START = 2**32
"""Numbers for the episodes between two starts of the tuner, so that a continued run uses none twice."""


def episode_name(number: int) -> str:
    """The number of an episode as text: 2.17 is the 17th after the tuner's second start.

    Another tuner may count from 1 as it likes; such a number is its own name.

    >>> episode_name(2 * EPISODES_PER_START + 17), episode_name(17)
    ('2.17', '17')
    """
    start, index = divmod(number, EPISODES_PER_START)
    return f"{start}.{index}" if start else str(index)


def episode_number(name: str) -> int:
    """The number of the episode with this `episode_name`. ValueError if there is none."""
    start, _, index = name.rpartition(".")
    return int(start or 0) * EPISODES_PER_START + int(index)
