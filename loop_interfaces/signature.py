"""Signatures: with which policy, model and target an action was computed.

Tuner, controller and plant compute the same numbers from what each of them knows, so the plant can
tell whether an action comes from a controller that was told what the tuner published:

    D = h(rows, action_limit, policy, h(model))    in the header of `episode/start`, as `plant`
    s = -h(D, z_r)                                 in the header of every `action`, as `time`

with h the first 53 bits of BLAKE2b over the numbers as little-endian float64. Where the controller
explores there is neither policy nor model. A simulated time is never negative, so a controller that
echoes the state's time, or sends 0, is told from one that signs. It is no protection from somebody
who reads the wire and copies the number.
"""

from __future__ import annotations

from hashlib import blake2b

import numpy as np
from numpy.typing import ArrayLike

NOT_SIGNED = 0.0
"""In place of D: the tuner asks for no signature. In place of s: the action carries none."""


def digest_of(*arrays: ArrayLike) -> int:
    """h: a whole number from 1 to 2^53 - 1.

    >>> digest_of([1.0, 2.0], 3.0) == digest_of([1.0], [2.0, 3.0]) != digest_of([1.0, 2.0], 4.0)
    True
    """
    state = blake2b(digest_size=8)
    for array in arrays:
        state.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
    return (int.from_bytes(state.digest(), "big") >> 11) or 1


def signature(told: int, target: ArrayLike) -> float:
    """s for the D that a start carries; NOT_SIGNED where it carries none."""
    return -float(digest_of(told, target)) if told else NOT_SIGNED


def signature_in(time: float) -> float:
    """The signature in an action's header; NOT_SIGNED if it has an ordinary time there."""
    return min(time, NOT_SIGNED)
