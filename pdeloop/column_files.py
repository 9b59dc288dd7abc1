# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Columns of numbers from other programs' files: .mat of any version, and Parquet."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdeloop.data_table import Columns, places_of
from pdeloop.log import Log, in_seconds
from pdeloop.messages.array_files import MAX_ARRAY_BYTES
from pdeloop.messages.arrays import Array
from pdeloop.messages.files import FileError, open_ordinary
from pdeloop.method.reduce.channels import Channels

HDF5 = b"\x89HDF\r\n\x1a\n"
TARGET = "target"


def read_mat(
    path: Path, columns: Columns, *, timed: bool, time_unit: str
) -> Log | dict[str, NDArray[Any]]:
    """A MATLAB file of version 4 to 7.3: its arrays if they are those of a .npz, or its columns.

    Vectors of one length are columns of that name, and a matrix has columns NAME1, NAME2, ...; those of
    a structure have its name in front, as in log.T1. Other variables are left out.
    """
    _refuse_large(path)
    with open_ordinary(path) as file:
        begin = file.read(1024)
    arrays = dict(_hdf5(path) if HDF5 in begin else _mat(path))
    if {columns.states or "states", columns.inputs or "actions"} <= {*arrays}:
        own = {columns.time or "sample_time", "target"}
        return {name: a.reshape(-1) if name in own else a for name, a in arrays.items()}
    return _log_of(_columns(arrays, columns), columns, timed, time_unit, arrays.get(TARGET))


def read_parquet(path: Path, columns: Columns, *, timed: bool, time_unit: str) -> Log:
    """The columns of a Parquet file; instants are seconds since the first one."""
    _refuse_large(path)
    try:
        from pyarrow import ArrowException, parquet, types
    except ImportError as error:
        raise FileError(
            f"{path} is a Parquet file, which needs pyarrow: pip install 'pdeloop[logs]'"
        ) from error
    found: dict[str, NDArray[Any]] = {}
    try:
        # One file: no table of several files, no other file system.
        table = parquet.ParquetFile(path).read()
    except (ArrowException, OSError) as error:
        raise ValueError(
            f"it cannot be read as Parquet ({' '.join(str(error).split())})"
        ) from error
    for name, column in zip(table.column_names, table.columns, strict=True):
        if types.is_timestamp(column.type) or types.is_duration(column.type):
            ticks = column.cast("int64")
            seconds = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[column.type.unit]
            known = [tick for tick in ticks.to_pylist() if tick is not None]
            since = known[0] if known and types.is_timestamp(column.type) else 0
            found[name] = np.array(
                [np.nan if t is None else (t - since) / seconds for t in ticks.to_pylist()],
                dtype=_INSTANTS,
            )
        elif types.is_integer(column.type) or types.is_floating(column.type):
            found[name] = column.to_numpy().astype(np.float64)
        elif types.is_decimal(column.type) or types.is_boolean(column.type):
            found[name] = np.array(
                [math.nan if v is None else float(v) for v in column.to_pylist()], dtype=np.float64
            )
        else:
            found[name] = np.array(column.to_pylist(), dtype=object)
    return _log_of(found, columns, timed, time_unit, None)


_INSTANTS = np.dtype(np.longdouble)
"""The type in which seconds of instants are marked, which have no unit to look for."""


def _refuse_large(path: Path) -> None:
    try:
        with open_ordinary(path) as file:
            size = file.seek(0, 2)
    except OSError as error:
        raise FileError(f"{path} cannot be read: {error.strerror or error}") from error
    if size > MAX_ARRAY_BYTES:
        raise ValueError(f"it has {size} bytes; expected at most {MAX_ARRAY_BYTES}")


def _mat(path: Path) -> Iterator[tuple[str, NDArray[Any]]]:
    """The numbers of a file of version 4 to 7."""
    from scipy.io import loadmat

    try:
        content = loadmat(str(path), struct_as_record=True, appendmat=False)
    except Exception as error:  # a dozen kinds on damaged files
        raise ValueError(f"it is no MATLAB file ({type(error).__name__}: {error})") from error
    for name, value in content.items():
        if name.startswith("__") or not isinstance(value, np.ndarray):
            continue
        if value.dtype.names and value.size == 1:
            for part in value.dtype.names:
                yield from _numeric(f"{name}.{part}", value[part].reshape(-1)[0])
        else:
            yield from _numeric(name, value)


def _hdf5(path: Path) -> Iterator[tuple[str, NDArray[Any]]]:
    """The numbers of a file of version 7.3, in which matrices are transposed."""
    try:
        import h5py
    except ImportError as error:
        raise FileError(
            f"{path} is a MATLAB file of version 7.3, which needs h5py: pip install 'pdeloop[logs]', "
            "or save it with -v7"
        ) from error
    try:
        with h5py.File(path, "r") as file:
            for name, item in file.items():
                if name.startswith("#"):
                    continue
                inside = item.items() if isinstance(item, h5py.Group) else ()
                for part, value in inside:
                    if isinstance(value, h5py.Dataset):
                        yield from _numeric(f"{name}.{part}", value[()].T)
                if isinstance(item, h5py.Dataset) and item.attrs.get("MATLAB_class") != b"char":
                    yield from _numeric(name, item[()].T)
    except OSError as error:
        raise ValueError(f"it is no MATLAB file of version 7.3 ({error})") from error


def _numeric(name: str, value: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    """The item, if it is an array of real numbers."""
    array = np.asarray(value)
    if array.dtype.kind in "biuf" and array.size:
        yield name, array.astype(np.float64)


def _columns(arrays: Mapping[str, NDArray[Any]], columns: Columns) -> dict[str, NDArray[Any]]:
    """Vectors and the columns of matrices, as long as the times or the most numbers are."""
    sizes = [max(a.shape) for a in arrays.values() if a.ndim <= 2]
    rows = max(sizes, default=0)
    if columns.time in arrays:
        rows = arrays[columns.time].size
    found: dict[str, NDArray[Any]] = {}
    for name, array in arrays.items():
        if array.ndim > 2 or rows not in array.shape or rows < 2:
            continue
        matrix = array.reshape(rows, -1) if array.shape[0] == rows else array.T
        if matrix.shape[1] == 1:
            found[name] = matrix[:, 0]
        else:
            found |= {f"{name}{i + 1}": column for i, column in enumerate(matrix.T)}
    return found


def _log_of(
    found: Mapping[str, NDArray[Any]],
    columns: Columns,
    timed: bool,
    time_unit: str,
    target: NDArray[Any] | None,
) -> Log:
    """The log that the chosen columns are; rows are numbered from 1 on."""
    head = [*found]
    if not head:
        raise ValueError("it has no columns of numbers")
    places = places_of(head, columns, timed)
    chosen = [head[i] for i in (*places.states, *places.inputs)]
    for name in chosen:
        if found[name].dtype.kind not in "biuf":
            text = str(found[name][0])[:40]
            raise ValueError(f"expected numbers in column {name}, got '{text}' in row 1")
    values = np.stack([found[name].astype(np.float64) for name in chosen], axis=1)
    channels = Channels([head[i] for i in places.states], [head[i] for i in places.inputs])
    rows = np.arange(1, len(values) + 1)
    own = None if target is None else target.reshape(-1).astype(np.float64)
    if own is not None and own.shape != (len(places.states),):
        raise ValueError(
            f"expected a target of {len(places.states)} numbers, as of the state, got {own.size}"
        )
    if places.time < 0:
        return Log(channels, values, np.arange(len(values), dtype=np.float64), rows, own, 1.0)
    times: Array = found[head[places.time]]
    if times.dtype == object or not np.isfinite(times).all():
        raise ValueError(f"expected a time in every row of {head[places.time]}")
    if times.dtype == _INSTANTS:
        return Log(channels, values, times.astype(np.float64), rows, own)
    seconds, remarks = in_seconds(head[places.time], times, time_unit)
    return Log(channels, values, seconds, rows, own, None, remarks)
