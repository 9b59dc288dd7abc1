# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The numeric type of all computations, float64."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def read_only(values: ArrayLike) -> Array:
    """The values as compiled functions take what they only read: a view in C order, not writable.

    To Numba the orders and permissions of arrays are types, for each of which it compiles a function.
    """
    view: Array = np.ascontiguousarray(values, dtype=np.float64).view()
    view.setflags(write=False)
    return view


def float_array(name: str, values: ArrayLike) -> Array:
    """The values as float64; a ValueError unless they are an array of real numbers."""
    if type(values).__name__ == "MaskedArray" and np.any(getattr(values, "mask", False)):
        raise ValueError(f"{name} has masked entries, which have no value: fill or drop them")
    try:
        array = np.asarray(values)
        what = str(array.dtype)
    except ValueError:  # NumPy's word for rows of different lengths
        array, what = np.asarray(None), "rows of different lengths"
    what = "None" if values is None else what
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{name} must be an array of real numbers, got {what}")
    return array.astype(np.float64, copy=False)
