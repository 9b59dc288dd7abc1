# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Own measurements in a file, .npz or .csv (docs/identification.md), as trajectories."""

from __future__ import annotations

import csv
import io
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from math import isfinite, nan
from pathlib import Path

import numpy as np

from loop_interfaces.array_files import MAX_ARRAY_BYTES, read_arrays
from loop_interfaces.arrays import Array
from loop_interfaces.files import FileError, read_bounded

__all__ = ["Measurements", "read_measurements"]

MAX_TEXT_BYTES = 2**28
"""Of a .csv file."""
MAX_TRAJECTORIES = 100_000
LARGEST = 1e100
"""Magnitude of a number, so that squares and their sums stay finite."""
NAMES = ("states", "actions", "target", "sample_time")


@dataclass(frozen=True, eq=False)
class Measurements:
    """Trajectories of one plant.

    Attributes
    ----------
    trajectories : list of (states (N + 1, n_z), actions (N, n_a))
        a_k was held from z_k to z_{k+1}.
    target : (n_z,) array
        z_r, the state that is to be reached.
    sample_time : float
        Seconds between two states.
    """

    trajectories: list[tuple[Array, Array]]
    target: Array
    sample_time: float


def read_measurements(path: str | Path) -> Measurements:
    """The measurements in a file.

    In a .npz file are the arrays `states` (N + 1, n_z), `actions` (N, n_a), `target` (n_z,) and
    `sample_time` (s), with one axis more in front of states and actions where there are several
    trajectories.

    A .csv file has a line of names, t, z..., a..., then a line for each instant, t in s. A time that
    does not grow begins another trajectory, and the actions of a trajectory's last line are not used.
    The line whose t is the word target has z_r.

    Parameters
    ----------
    path
        Of the file, which ends in .npz or .csv.

    Returns
    -------
    Measurements

    Raises
    ------
    FileError
        It cannot be read, is too large, or is not that; one sentence.
    """
    path = Path(path)
    read = {".npz": _npz, ".csv": _csv}.get(path.suffix.lower())
    if read is None:
        raise FileError(f"{path} must be a .npz or a .csv file (docs/identification.md)")
    try:
        found = read(path)
        _check(found)
    except FileError:
        raise
    except ValueError as error:
        raise FileError(f"{path}: {error}") from error
    return found


def _check(found: Measurements) -> None:
    """Raises ValueError, one sentence, unless everything fits together."""
    target = found.target
    for number, (states, actions) in enumerate(found.trajectories):
        if states.ndim != 2 or actions.ndim != 2 or len(states) != len(actions) + 1:
            raise ValueError(
                "expected states (N + 1, n_z) and actions (N, n_a), got shapes "
                f"{states.shape} and {actions.shape} in trajectory {number}"
            )
        if states.shape[1:] != target.shape or not (actions.size and target.size):
            raise ValueError(
                f"expected states and a target of the same n_z numbers, got shapes {states.shape} and "
                f"{target.shape} in trajectory {number}"
            )
        if not (np.isfinite(states).all() and np.isfinite(actions).all()):
            raise ValueError(f"expected finite numbers, got NaN or infinity in trajectory {number}")
        largest = max(np.abs(states).max(), np.abs(actions).max())
        if largest > LARGEST:
            raise ValueError(
                f"expected numbers of magnitude {LARGEST:g} at most, got {largest:g} in trajectory "
                f"{number}"
            )
    if not found.trajectories:
        raise ValueError("it holds no trajectory of two states or more")
    if not np.isfinite(target).all():
        raise ValueError("expected a target of finite numbers, got NaN or infinity")
    if not 0 < found.sample_time < np.inf:
        raise ValueError(f"expected a sample_time above 0, got {found.sample_time:g}")


def _npz(path: Path) -> Measurements:
    arrays = read_arrays(path)
    if missing := [name for name in NAMES if name not in arrays]:
        raise ValueError(
            f"expected the arrays {', '.join(NAMES)}, but {', '.join(missing)} is missing"
        )
    for name in NAMES:
        if arrays[name].dtype.kind not in "fiu":
            raise ValueError(f"expected real numbers in {name}, got {arrays[name].dtype}")
    if (size := 8 * sum(arrays[name].size for name in NAMES)) > MAX_ARRAY_BYTES:
        raise ValueError(f"expected at most {MAX_ARRAY_BYTES // 8} numbers, got {size // 8}")
    states, actions, target, times = (arrays[name].astype(np.float64) for name in NAMES)
    if times.size != 1:
        raise ValueError(f"expected one number as sample_time, got shape {times.shape}")
    several = states.ndim == 3
    if several and (actions.ndim != 3 or len(actions) != len(states)):
        raise ValueError(
            "expected states (K, N + 1, n_z) and actions (K, N, n_a) of K trajectories, got shapes "
            f"{states.shape} and {actions.shape}"
        )
    if several:
        _check_count(len(states))
    pairs = zip(states, actions, strict=True) if several else [(states, actions)]
    return Measurements(list(pairs), target, float(times.reshape(())))


def _csv(path: Path) -> Measurements:
    raw = read_bounded(path, MAX_TEXT_BYTES, "give the same as .npz (docs/identification.md)")
    text = io.TextIOWrapper(io.BytesIO(raw), "utf-8-sig", errors="replace", newline="")
    lines = csv.reader(text)
    try:
        return _table(line for line in lines if line)
    except csv.Error as error:
        raise ValueError(f"it is no table of commas: {error}") from error


def _table(lines: Iterator[list[str]]) -> Measurements:
    head = [name.strip() for name in next(lines, [])]
    kinds = "".join(name[:1] for name in head)
    n_z, n_a = kinds.count("z"), kinds.count("a")
    if head[:1] != ["t"] or not (n_z and n_a) or kinds != "t" + "z" * n_z + "a" * n_a:
        raise ValueError(
            f"expected the names t, z..., a... in the first line, got '{','.join(head)[:60]}'"
        )
    numbers, target = array("d"), None
    for number, line in enumerate(lines, 2):
        if len(line) != len(head):
            raise ValueError(f"expected {len(head)} values in row {number}, got {len(line)}")
        if line[0].strip() == "target":
            if target is not None:
                raise ValueError(
                    f"expected one row whose t is the word target, got another, {number}"
                )
            target = np.array(_numbers(line[1 : 1 + n_z], number))
            continue
        row = _numbers(line, number)
        if not isfinite(row[0]):
            raise ValueError(f"expected a time t in row {number}, got '{line[0]}'")
        numbers.extend(row)
    if target is None:
        raise ValueError("expected a row whose t is the word target")
    table = np.array(numbers).reshape(-1, len(head))
    starts = 1 + np.flatnonzero(~(np.diff(table[:, 0]) > 0))
    _check_count(len(starts))
    parts = [part for part in np.split(table, starts) if len(part) > 1]
    steps = np.concatenate([np.diff(part[:, 0]) for part in parts] or [np.ones(1)])
    if not np.allclose(steps, steps[0], rtol=1e-3):
        raise ValueError(f"expected equal steps of t, got {steps.min():g} to {steps.max():g}")
    states = slice(1, 1 + n_z)
    return Measurements(
        [(part[:, states], part[:-1, 1 + n_z :]) for part in parts], target, float(np.median(steps))
    )


def _check_count(trajectories: int) -> None:
    """ValueError for so many that each takes more memory than its numbers."""
    if trajectories > MAX_TRAJECTORIES:
        raise ValueError(f"expected at most {MAX_TRAJECTORIES} trajectories, got {trajectories}")


def _numbers(texts: list[str], row: int) -> list[float]:
    """The numbers of a row; an empty place is NaN."""
    try:
        return [float(text) if text.strip() else nan for text in texts]
    except ValueError as error:
        raise ValueError(f"expected numbers in row {row}: {error}") from None
