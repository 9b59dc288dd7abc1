# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Least squares on columns of different units, some of which may be zero or the same."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.arrays import Array

Values = NDArray[Any]
"""Real or complex."""


def orthonormal(columns: Array) -> Array:
    """An orthonormal basis of the space of columns, some of which may be zero or the same."""
    scale = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(scale > 0.0, scale, 1.0)
    basis, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    kept: Array = basis[:, sizes > 1e-10 * sizes[0]]
    return kept


def least_squares(columns: Array, values: Values) -> Values:
    """The least coefficients of columns, each in its own unit, that explain values best."""
    scale = np.linalg.norm(columns, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    found: Values = np.linalg.lstsq(columns / scale, values, rcond=1e-10)[0] / scale[:, None]
    return found
