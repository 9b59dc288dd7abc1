# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The user's measurements in files (docs/identification.md), as trajectories."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdeloop.column_files import read_mat, read_parquet
from pdeloop.data_table import Columns, read_table
from pdeloop.log import Log, Remedies, in_seconds, trajectories_of
from pdeloop.messages.array_files import MAX_ARRAY_BYTES, read_arrays
from pdeloop.messages.arrays import Array, float_array
from pdeloop.messages.files import FileError, read_bounded
from pdeloop.method.reduce.channels import NUMBERED, Channels, listed

MAX_TEXT_BYTES = 2**28
"""Most bytes of a .csv file."""
MAX_TRAJECTORIES = 100_000
LARGEST = 1e100
"""Magnitude of a number, so that squares and their sums stay finite."""
SAME_STEP = 1e-3
"""Relative tolerance between the sampling times of several files."""
TABLES = (".csv", ".tsv", ".txt", ".dat")
READERS = {".mat": read_mat, ".parquet": read_parquet}


@dataclass(frozen=True, eq=False)
class Measurements:
    """Trajectories of one plant.

    Attributes
    ----------
    trajectories : list of (states (N + 1, n_z), actions (N, n_a))
        a_k was held from z_k to z_{k+1}.
    target : (n_z,) array or None
        z_r, the target state; None if no file has one.
    sample_time : float
        Seconds between two states.
    channels : Channels
        Names of the numbers of the state and of the inputs; empty if they have none.
    sources : list of dict
        For each trajectory, its number in its file, and the file if there are several.
    remarks : tuple of str
        What was left out.
    """

    trajectories: list[tuple[Array, Array]]
    target: Array | None
    sample_time: float
    channels: Channels = NUMBERED
    sources: Sequence[dict[str, int | str]] = ()
    remarks: tuple[str, ...] = ()


def read_measurements(
    *paths: str | Path,
    time: str = "",
    states: str = "",
    inputs: str = "",
    sample_time: float | None = None,
    target: ArrayLike | None = None,
    time_unit: str = "",
    missing: Sequence[float] | None = None,
    cut: bool = False,
    resample: float | None = None,
) -> Measurements:
    """The measurements of one plant, in one or several files.

    A .npz file has the arrays `states` (N + 1, n_z), `actions` (N, n_a), `target` (n_z,), which may
    be missing, and `sample_time` (s); for several trajectories, states and actions have one more
    axis in front.

    A .csv file has a line of names, t, z..., a..., then a line for each instant, t in s or an instant
    like 2026-01-31 12:00:00.5. A time that does not increase starts a new trajectory, and the actions
    of a trajectory's last line are not used. The line whose t is the word target has z_r. Columns are
    separated by commas, semicolons, tabs or spaces; except with commas, the decimal mark may be a
    comma.

    A .mat file of any version has either the arrays of a .npz file or a vector or matrix for each group
    of columns, and a .parquet file has columns; otherwise they are as a .csv file.

    Parameters
    ----------
    paths
        The files, which end in .npz, .csv, .tsv, .txt, .dat, .mat or .parquet.
    time, states, inputs
        Names of columns, or of arrays, separated by commas; patterns such as "T*" for columns. If one
        is given, other columns are ignored.
    sample_time
        Seconds between two states, where the files do not have it.
    target : (n_z,)
        z_r, instead of the one in the files.
    time_unit
        Unit of the times, such as "ms", instead of the one in the column's name.
    missing
        Values that stand for missing readings, such as -9999.
    cut
        Leave out rows with missing readings, spikes, frozen or saturated sensors, and begin a new
        trajectory after them and after gaps, instead of refusing the file or warning.
    resample
        Seconds of equal steps to interpolate to; 0 for the log's own step.

    Returns
    -------
    Measurements

    Raises
    ------
    FileError
        A file cannot be read, is too large, or has another content; one sentence.
    """
    if not paths:
        raise FileError("no file given; expected a .npz or a .csv file")
    columns = Columns(time, states, inputs)
    try:
        remedies = Remedies(time_unit, missing, cut, resample)
    except ValueError as error:
        raise FileError(str(error)) from error
    found = []
    for path in map(Path, paths):
        try:
            found.append(_read(path, columns, sample_time, remedies))
        except FileError:
            raise
        except ValueError as error:
            raise FileError(f"{path}: {error}") from error
    whole = _together(found, [str(path) for path in paths])
    if target is None:
        return whole
    wanted, n_z = float_array("target", target), whole.trajectories[0][0].shape[1]
    if wanted.shape != (n_z,) or not np.isfinite(wanted).all():
        raise FileError(
            f"expected a target of {n_z} finite numbers, one for each of the state, got "
            f"{wanted.size if wanted.ndim == 1 else f'shape {wanted.shape}'}"
        )
    return replace(whole, target=wanted)


def _read(
    path: Path, columns: Columns, sample_time: float | None, remedies: Remedies
) -> Measurements:
    """One file; ValueError, one sentence, without its name."""
    kind = path.suffix.lower()
    unit = remedies.time_unit
    if kind in READERS:
        found = READERS[kind](path, columns, timed=sample_time is None, time_unit=unit)
        if isinstance(found, Log):
            return _checked(_of_log(found, sample_time, remedies))
        return _checked(_of_arrays(found, columns, sample_time, remedies))
    if kind == ".npz":
        return _checked(_of_arrays(read_arrays(path), columns, sample_time, remedies))
    if kind in TABLES:
        raw = read_bounded(path, MAX_TEXT_BYTES, "give the same as .npz (docs/identification.md)")
        log = read_table(raw, columns, timed=sample_time is None, time_unit=unit)
        return _checked(_of_log(log, sample_time, remedies))
    raise FileError(f"{path} must be a .npz, .csv, .mat or .parquet file (docs/identification.md)")


def _together(found: Sequence[Measurements], names: Sequence[str]) -> Measurements:
    """The measurements of several files. FileError if they are not of one plant."""
    first = found[0]
    if len(found) == 1:
        return first
    sources: list[dict[str, int | str]] = []
    for one, name in zip(found, names, strict=True):
        for what, own, other in (
            ("the states", one.channels.states, first.channels.states),
            ("the inputs", one.channels.inputs, first.channels.inputs),
            ("the sizes", *([len(a[0]) for a in m.trajectories[0]] for m in (one, first))),
        ):
            if list(own) != list(other):
                raise FileError(
                    f"{name}: expected the same channels as in {names[0]}, got {what} "
                    f"{listed([str(x) for x in own] or ['without names'])} after "
                    f"{listed([str(x) for x in other] or ['without names'])}"
                )
        if abs(one.sample_time - first.sample_time) > SAME_STEP * first.sample_time:
            raise FileError(
                f"{name}: expected the sampling time of {names[0]}, {first.sample_time:g} s, got "
                f"{one.sample_time:g} s"
            )
        sources += [{"file": name, **source} for source in one.sources]
    targets = [
        (name, m.target) for name, m in zip(names, found, strict=True) if m.target is not None
    ]
    for name, target in targets[1:]:
        if not np.array_equal(target, targets[0][1]):
            raise FileError(f"{name}: expected the target of {targets[0][0]}, or none, got another")
    return Measurements(
        [trajectory for one in found for trajectory in one.trajectories],
        targets[0][1] if targets else None,
        first.sample_time,
        first.channels,
        sources,
        tuple(f"{n}: {text}" for n, m in zip(names, found, strict=True) for text in m.remarks),
    )


def _checked(found: Measurements) -> Measurements:
    """The same; ValueError, one sentence, unless everything fits together."""
    target = found.target
    for number, (states, actions) in enumerate(found.trajectories):
        if states.ndim != 2 or actions.ndim != 2 or len(states) != len(actions) + 1:
            raise ValueError(
                "expected states (N + 1, n_z) and actions (N, n_a), got shapes "
                f"{states.shape} and {actions.shape} in trajectory {number}"
            )
        if not (actions.size and states.size):
            raise ValueError(
                f"expected states and actions of one number or more, got shapes {states.shape} and "
                f"{actions.shape} in trajectory {number}"
            )
        if target is not None and states.shape[1:] != target.shape:
            raise ValueError(
                f"expected states and a target of the same n_z numbers, got shapes {states.shape} and "
                f"{target.shape} in trajectory {number}"
            )
        for name, values in (("states", states), ("actions", actions)):
            if not np.isfinite(values).all():
                row = int(np.argmin(np.isfinite(values).all(axis=1)))
                raise ValueError(
                    f"expected finite numbers, got NaN or infinity in row {row} of {name} in "
                    f"trajectory {number}: fill the gap, or cut the trajectory in two there"
                )
        largest = max(np.abs(states).max(), np.abs(actions).max())
        if largest > LARGEST:
            raise ValueError(
                f"expected numbers of magnitude {LARGEST:g} at most, got {largest:g} in trajectory "
                f"{number}"
            )
    if not found.trajectories:
        raise ValueError("it holds no trajectory of two states or more")
    if target is not None and not np.isfinite(target).all():
        raise ValueError("expected a target of finite numbers, got NaN or infinity")
    if not 0 < found.sample_time < np.inf:
        raise ValueError(f"expected a sample_time above 0, got {found.sample_time:g}")
    return found


def _of_arrays(
    arrays: Mapping[str, NDArray[Any]],
    columns: Columns,
    sample_time: float | None,
    remedies: Remedies,
) -> Measurements:
    """From the arrays states, actions and sample_time, under the names that were chosen."""
    names = {
        "states": columns.states or "states",
        "actions": columns.inputs or "actions",
        "sample_time": columns.time or "sample_time",
        "target": "target",
    }
    needed = [names["states"], names["actions"], names["sample_time"]]
    if sample_time is not None:
        needed.pop()
        if names["sample_time"] in arrays:
            raise ValueError(f"leave out --sample-time: it has the array {names['sample_time']}")
    if missing := [name for name in needed if name not in arrays]:
        raise ValueError(
            f"expected the arrays {', '.join(needed)}, but {', '.join(missing)} is missing; there are "
            f"{', '.join(arrays) or 'none'}"
        )
    own = {what: arrays[name] for what, name in names.items() if name in arrays}
    for what, array in own.items():
        if array.dtype.kind not in "fiu":
            raise ValueError(f"expected real numbers in {names[what]}, got {array.dtype}")
    if (size := 8 * sum(array.size for array in own.values())) > MAX_ARRAY_BYTES:
        raise ValueError(f"expected at most {MAX_ARRAY_BYTES // 8} numbers, got {size // 8}")
    own = {what: array.astype(np.float64) for what, array in own.items()}
    states, actions, target = own["states"], own["actions"], own.get("target")
    if sample_time is None:
        times = own["sample_time"]
        if times.size != 1:
            raise ValueError(
                f"expected one number as {names['sample_time']}, got shape {times.shape}"
            )
        seconds, _ = in_seconds(names["sample_time"], times.reshape(1), remedies.time_unit)
        sample_time = float(seconds[0])
    several = states.ndim == 3
    if several and (actions.ndim != 3 or len(actions) != len(states)):
        raise ValueError(
            "expected states (K, N + 1, n_z) and actions (K, N, n_a) of K trajectories, got shapes "
            f"{states.shape} and {actions.shape}"
        )
    if several:
        _check_count(len(states))
    pairs = list(zip(states, actions, strict=True) if several else [(states, actions)])
    plain = Measurements(pairs, target, sample_time, sources=_numbered(len(pairs)))
    if not 0 < sample_time < np.inf or not all(_fit(*pair) for pair in pairs):
        return plain  # and refused
    if not remedies.cut and not all(np.isfinite(a).all() for pair in pairs for a in pair):
        return plain
    log = _log(pairs, target, sample_time)
    found = _of_log(log, sample_time, remedies, named=False)
    if remedies.cut or remedies.missing is not None or remedies.resample is not None:
        return found
    return replace(plain, remarks=found.remarks)


def _fit(states: Array, actions: Array) -> bool:
    """Whether they are of the shapes of a trajectory."""
    shaped = states.ndim == actions.ndim == 2 and len(states) == len(actions) + 1
    return shaped and bool(states.size and actions.size)


def _log(pairs: Sequence[tuple[Array, Array]], target: Array | None, step: float) -> Log:
    """Trajectories as a log, whose rows are numbered from 0 in each of them."""
    n_z, n_a = (part.shape[1] for part in pairs[0])
    channels = Channels([f"z{i + 1}" for i in range(n_z)], [f"a{j + 1}" for j in range(n_a)])
    last = np.full((1, n_a), np.nan)
    values = np.vstack([np.hstack([z, np.vstack([a, last])]) for z, a in pairs])
    rows = np.concatenate([np.arange(len(z)) for z, _ in pairs])
    return Log(channels, values, step * rows, rows, target, step)


def _of_log(
    log: Log, sample_time: float | None, remedies: Remedies, *, named: bool = True
) -> Measurements:
    """The trajectories of a log; named: whether its channels have names of their own."""
    if named and sample_time is not None:
        if log.step is None:
            raise ValueError("leave out --sample-time: it has a column of times")
        log = replace(log, step=sample_time, times=log.times * sample_time)
    found = trajectories_of(log, remedies, timed=log.step is None, most=MAX_TRAJECTORIES)
    return Measurements(
        found.trajectories,
        found.target,
        1.0 if found.sample_time is None else found.sample_time,  # without one, refused
        found.channels if named else NUMBERED,
        _numbered(len(found.trajectories)),
        tuple(found.remarks),
    )


def _numbered(count: int) -> list[dict[str, int | str]]:
    return [{"trajectory": number} for number in range(count)]


def _check_count(trajectories: int) -> None:
    """ValueError for more trajectories than MAX_TRAJECTORIES."""
    if trajectories > MAX_TRAJECTORIES:
        raise ValueError(f"expected at most {MAX_TRAJECTORIES} trajectories, got {trajectories}")
