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
