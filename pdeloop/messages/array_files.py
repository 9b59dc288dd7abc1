# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""NumPy's .npz files, read without trusting them. No ROS import."""

import zipfile
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.files import FileError, open_ordinary

MAX_ARRAY_BYTES = 2**30
"""Most bytes of all arrays in a file of policies or models."""
Arrays = Mapping[str, NDArray[Any]]
_TYPES: Mapping[str, type] = {"f": np.float64, "c": np.complex128, "i": np.int64, "b": np.bool_}
"""The type in which each NumPy kind is stored; others would change results or cannot be stored."""


def packed_arrays(arrays: Mapping[str, Any]) -> bytes:
    """The content of an npz file with these arrays."""
    content = BytesIO()
    np.savez(content, **arrays)
    return content.getvalue()


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of an npz file. FileError for none, objects, or more than MAX_ARRAY_BYTES."""
    try:
        with open_ordinary(path) as file:
            return unpack_arrays(file, MAX_ARRAY_BYTES)
    except OSError as error:
        raise FileError(f"{path} cannot be read: {error.strerror or error}") from error
    except FileError as error:
        raise FileError(f"{path} {error}") from error


def unpack_arrays(file: BinaryIO, most: int) -> dict[str, NDArray[Any]]:
    """The arrays of an npz archive that begins where `file` stands, of at most `most` bytes together.

    The archive's directory gives their sizes before anything is unpacked: no member can unpack to more
    than is written there.
    """
    try:
        start = file.tell()
        with zipfile.ZipFile(file) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > most:
            raise FileError(f"holds {size} bytes of arrays; expected at most {most}")
        file.seek(start)
        with np.load(file, allow_pickle=False) as arrays:
            return {name: np.asarray(arrays[name]) for name in arrays.files}
    except FileError:
        raise
    except Exception as error:  # zipfile and NumPy raise some twenty kinds on damaged files
        raise FileError(f"holds no arrays ({type(error).__name__}: {error})") from error


def checked_array(
    arrays: Arrays, name: str, kind: str, shape: tuple[int | None, ...], *, finite: bool = True
) -> NDArray[Any]:
    """The array of this name, of this NumPy kind and shape (None: of any length), or a FileError.

    Numbers have the type with which they are written: 8 bytes, in this machine's order.
    finite: whether infinity is refused as well as NaN in floating-point numbers.
    """
    if name not in arrays:
        raise FileError(f"it has no array '{name}'")
    array = arrays[name]
    fits = array.ndim == len(shape) and all(
        expected in (None, length) for expected, length in zip(shape, array.shape, strict=True)
    )
    typed = array.dtype.kind == kind and array.dtype == _TYPES.get(kind, array.dtype)
    if not (typed and fits):
        expected_type = np.dtype(_TYPES[kind]).name if kind in _TYPES else "text"
        raise FileError(
            f"expected '{name}' of type {expected_type} and shape {shape}, "
            f"got {array.dtype} and {array.shape}"
        )
    if kind in "fc" and (not np.isfinite(array).all() if finite else np.isnan(array).any()):
        raise FileError(f"'{name}' is not finite")
    return array


def packed(arrays: Arrays) -> NDArray[np.float64]:
    """Arrays as whole numbers below 2^24, three bytes of an npz file in each after its length.

    >>> unpacked(np.append(packed({"a": np.array([1.0, np.inf])}), np.zeros(3)))
    {'a': array([ 1., inf])}
    """
    content = packed_arrays(arrays)
    parts = np.frombuffer(content + bytes(-len(content) % 3), np.uint8).reshape(-1, 3)
    return np.append(float(len(content)), parts @ np.array([1.0, 2.0**8, 2.0**16]))


def unpacked(numbers: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
    """The arrays of a vector that begins as `packed` made it; ValueError for anything else."""
    try:
        length = int(numbers[0])
        words = numbers[1 : 2 + length // 3].astype("<u4")
        content = words.view(np.uint8).reshape(-1, 4)[:, :3].tobytes()[:length]
        return unpack_arrays(BytesIO(content), MAX_ARRAY_BYTES)
    except (IndexError, OverflowError, ValueError) as error:
        raise ValueError(f"the numbers are those of no arrays ({error})") from error
