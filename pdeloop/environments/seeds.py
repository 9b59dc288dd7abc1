# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Initial fields of an environment's episodes: by seeds, or as given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Integral
from typing import Any

import numpy as np

from pdeloop.messages.arrays import Array, float_array


def field_seed(generator: np.random.Generator) -> int:
    """The seed of the next initial field."""
    return int(generator.integers(2**53))


def seed_of_each(seed: int | Sequence[int | None] | None, num_envs: int) -> list[int | None]:
    """s, s + 1, ..., or those of a list; None: to be drawn. ValueError unless there are M."""
    if seed is None:
        return [None] * num_envs
    if isinstance(seed, Integral):
        return [int(seed) + m for m in range(num_envs)]
    given: list[int | None] = np.asarray(seed, dtype=object).ravel().tolist()
    if len(given) != num_envs:
        raise ValueError(f"expected {num_envs} seeds, one per environment, got {len(given)}")
    return given


def first_fields(options: Mapping[str, Any] | None, shape: tuple[int, ...]) -> Array | None:
    """The initial fields that the options of a reset give. ValueError for other options or shapes."""
    others = sorted(set(options or {}) - {"field"})
    if others:
        raise ValueError(f"unknown option {others[0]!r} of reset; expected 'field'")
    if not options:
        return None
    field = float_array("options['field']", options["field"])
    if field.shape != shape:
        raise ValueError(f"options['field'] must have shape {shape}, got {field.shape}")
    return field
