# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A model from the arrays that it was written as, and arrays as numbers of a law's parameters."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.arrays import Array
from pdeloop.messages.documents import parse_json
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


LARGEST = 1e9
"""Largest magnitude of a packed number: messages clip those of laws there."""
_KINDS = {"f": np.float64, "c": np.complex128, "i": np.int64, "b": np.bool_}
_BITS = 22


def packed(arrays: Arrays) -> Array:
    """Arrays as a vector of finite numbers of at most `LARGEST`, from which `unpacked` makes them.

    A directory, with all texts, comes first, as character codes. Arrays of numbers that are infinite,
    or larger, are written as bits.

    >>> found = unpacked(np.append(packed({"a": np.array([1.0, np.inf])}), np.zeros(3)))
    >>> found["a"]
    array([ 1., inf])
    """
    directory, numbers = list[list[object]](), list[Array]()
    for name, array in arrays.items():
        kind, values = str(array.dtype.kind), np.ascontiguousarray(array).ravel()
        if kind == "U":
            directory.append([name, kind, array.item()])
            continue
        own = values.view(np.float64) if kind in "cf" else values.astype(np.float64)
        if own.size and not np.abs(own).max() <= LARGEST:
            kind, own = kind.upper(), _bits_of(values.astype(_KINDS[kind]))
        directory.append([name, kind, list(array.shape)])
        numbers.append(own)
    text = np.frombuffer(json.dumps(directory).encode(), dtype=np.uint8).astype(np.float64)
    return np.concatenate([[float(len(text))], text, *numbers])


def unpacked(numbers: Array) -> Arrays:
    """The arrays of a vector that begins as `packed` made it; ValueError for anything else."""
    try:
        length = int(numbers[0])
        text, at = bytes(numbers[1 : 1 + length].astype(np.uint8)), 1 + length
        arrays: Arrays = {}
        for name, kind, shape in parse_json(text.decode()):
            if kind == "U":
                arrays[name] = np.array(str(shape))
                continue
            dtype: type[Any] = _KINDS[kind.lower()]
            count = math.prod(shape)
            words = count * np.dtype(dtype).itemsize // 8 if kind.lower() in "cf" else count
            size = words if kind.islower() else 3 * words
            own = numbers[at : at + size]
            at += size
            as_stored = _of_bits(own) if kind.isupper() else own
            values: NDArray[Any] = as_stored.view(dtype)[:count]
            if kind in "ib":
                values = own.astype(dtype)
            arrays[name] = values.reshape(shape).copy()
        return arrays
    except (LookupError, TypeError, ValueError, OverflowError, AttributeError) as error:
        raise ValueError(f"the numbers are those of no arrays ({error})") from error


def _bits_of(values: Array) -> Array:
    words = values.view(np.uint64)
    mask = np.uint64((1 << _BITS) - 1)
    parts = [(words >> np.uint64(_BITS * i)) & mask for i in range(3)]
    return np.concatenate(parts).astype(np.float64)


def _of_bits(numbers: Array) -> Array:
    parts = numbers.astype(np.uint64).reshape(3, -1)
    words = parts[0] | parts[1] << np.uint64(_BITS) | parts[2] << np.uint64(2 * _BITS)
    found: Array = words.view(np.float64)
    return found
