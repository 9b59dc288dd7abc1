# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A model from the arrays that it was written as, and arrays as numbers of a law's parameters."""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO

import numpy as np

from pdeloop.messages.array_files import MAX_ARRAY_BYTES, packed_arrays, unpack_arrays
from pdeloop.messages.arrays import Array
from pdeloop.method.models.base import Arrays, FieldModel, text_of
from pdeloop.method.models.finite_difference import FiniteDifferenceModel
from pdeloop.method.models.linear import LinearModel, ProjectedModel, ReadingsModel
from pdeloop.method.models.polynomial import PolynomialModel
from pdeloop.method.models.sensed import SensedModel
from pdeloop.method.models.spectral import SpectralModel

FORMS: dict[str, Callable[[Arrays], FieldModel]] = {
    "spectral": SpectralModel.from_arrays,
    "finite-difference": FiniteDifferenceModel.from_arrays,
    "linear": LinearModel.from_arrays,
    "projected": lambda arrays: ProjectedModel.from_arrays(arrays, model_of),
    "polynomial": PolynomialModel.from_arrays,
    "readings": ReadingsModel.from_arrays,
    "sensed": SensedModel.from_arrays,
}


def model_of(arrays: Arrays) -> FieldModel:
    """The model whose `arrays` these are, the same to the bit; ValueError for no such form."""
    form = text_of(arrays, "form")
    if form not in FORMS:
        raise ValueError(f"a field model is of the form {form!r}; expected one of {list(FORMS)}")
    return FORMS[form](arrays)


def packed(arrays: Arrays) -> Array:
    """Arrays as whole numbers below 2^24, three bytes of an npz file in each after its length.

    >>> unpacked(np.append(packed({"a": np.array([1.0, np.inf])}), np.zeros(3)))
    {'a': array([ 1., inf])}
    """
    content = packed_arrays(arrays)
    parts = np.frombuffer(content + bytes(-len(content) % 3), np.uint8).reshape(-1, 3)
    return np.append(float(len(content)), parts @ np.array([1.0, 2.0**8, 2.0**16]))


def unpacked(numbers: Array) -> Arrays:
    """The arrays of a vector that begins as `packed` made it; ValueError for anything else."""
    try:
        length = int(numbers[0])
        words = numbers[1 : 2 + length // 3].astype("<u4")
        content = words.view(np.uint8).reshape(-1, 4)[:, :3].tobytes()[:length]
        return unpack_arrays(BytesIO(content), MAX_ARRAY_BYTES)
    except (IndexError, OverflowError, ValueError) as error:
        raise ValueError(f"the numbers are those of no arrays ({error})") from error
