# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The rollouts of a run as a data set of other programs: Minari, and Parquet.

An episode has the measurements y_0 .. y_T, the actions that were applied, rewards r_k = -l_k of the
stage cost, and its end: terminated where the plant diverged, truncated at the horizon.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import numpy as np

from pdeloop.finished_run import FinishedRun
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.messages.grid import Grid
from pdeloop.messages.spec import ParameterError


@dataclass(frozen=True, eq=False)
class DataEpisode:
    """One rollout of N steps.

    y: (N + 1, n_y); a: (N, n_a); rewards: (N,); seed: of the initial field, -1 for the mean field;
    diverged: whether it ended so.
    """

    y: Array
    a: Array
    rewards: Array
    seed: int
    diverged: bool


def data_episodes(run: FinishedRun) -> Iterator[DataEpisode]:
    """The rollouts of the training in order, carried out again with the same bits."""
    for record in run._repeated():
        assert record.seeds is not None and record.stage_costs is not None
        for m, lost in enumerate(record.costs.diverged_step):
            N = len(record.actions) if lost < 0 else int(lost)
            yield DataEpisode(
                record.states[: N + 1, m],
                record.applied[:N, m],
                -record.stage_costs[:N, m],
                int(record.seeds[m]),
                bool(lost >= 0),
            )


def parquet(run: FinishedRun) -> bytes:
    """A table with a row per measurement; that of an episode's last one has no action and no reward.

    run: a run whose training can be repeated. Returns columns episode, seed, k, t (s), the
    measurements, a1 .. and reward, terminated, truncated. The unit of a column is in its field's
    metadata, problem and sample time in the schema's. ValueError if pyarrow is not installed, or the
    run cannot be repeated.
    """
    try:
        import pyarrow as pa
        from pyarrow import parquet as files
    except ImportError as error:
        raise ParameterError("a Parquet file needs pyarrow: pip install 'pdeloop[logs]'") from error
    dt, found = float(run.values["sample_time"]), list(data_episodes(run))
    lengths = [len(own.y) for own in found]
    last = np.cumsum(lengths) - 1
    k = np.concatenate([np.arange(n) for n in lengths])

    def to_the_end(rows: list[Array]) -> Array:
        return np.concatenate(
            [np.concatenate([own, np.full_like(own[:1], np.nan)]) for own in rows]
        )

    y, unit = np.concatenate([own.y for own in found]), Grid.parse(run.values["grid"]).unit
    actions, rewards = (
        to_the_end([own.a for own in found]),
        to_the_end([own.rewards for own in found]),
    )
    missing = np.zeros(len(k), dtype=bool)
    missing[last] = True
    ended = np.zeros((2, len(k)), dtype=bool)
    ended[:, last] = [[own.diverged for own in found], [not own.diverged for own in found]]
    columns: dict[str, tuple[Any, str]] = {
        "episode": (np.repeat(np.arange(len(found)), lengths), ""),
        "seed": (np.repeat([own.seed for own in found], lengths), ""),
        "k": (k, ""),
        "t": (k * dt, "s"),
        **{name: (y[:, i], unit) for i, name in enumerate(measured_names(run, y.shape[1]))},
        **{f"a{i + 1}": (pa.array(a, mask=missing), "") for i, a in enumerate(actions.T)},
        "reward": (pa.array(rewards, mask=missing), ""),
        "terminated": (ended[0], ""),
        "truncated": (ended[1], ""),
    }
    arrays = {name: pa.array(values) for name, (values, _) in columns.items()}
    schema = pa.schema(
        [
            pa.field(name, arrays[name].type, metadata={"unit": columns[name][1]})
            for name in columns
        ],
        metadata={"problem": str(run.values["problem"]), "sample_time": repr(dt)},
    )
    stream = BytesIO()
    files.write_table(pa.table(arrays, schema=schema), stream)
    return stream.getvalue()


def measured_names(run: FinishedRun, n_y: int) -> list[str]:
    """Names of the measurements: u1 .. of a field u, z1 .. of a plain state, y1 .. of sensors."""
    grid = Grid.parse(run.values["grid"])
    if run.values["sensors"]:
        return [f"y{i + 1}" for i in range(n_y)]
    return [f"{part.name}{i + 1}" for part in grid.parts for i in range(part.axis.size)]


def write_minari(run: FinishedRun, name: str) -> None:
    """Make a data set of Minari, in the folder that Minari keeps them in.

    run: a run whose training can be repeated; name: its id in Minari, such as burgers/rollouts-v0.
    ValueError if Minari is not installed, there is such a data set, the name is none, or the run cannot
    be repeated.
    """
    try:
        import minari
        from gymnasium.spaces import Box
        from minari.data_collector import EpisodeBuffer
        from minari.dataset.minari_dataset import parse_dataset_id
    except ImportError as error:
        raise ParameterError(
            "a data set of Minari needs it: pip install 'pdeloop[minari]'"
        ) from error
    try:
        parse_dataset_id(name)
    except ValueError as error:
        raise ParameterError(
            f"--minari is {name}; expected a name such as burgers/rollouts-v0"
        ) from error
    if name in minari.list_local_datasets():
        raise ParameterError(
            f"there is a data set {name}; choose another name, or minari delete {name}"
        )
    buffers = []
    for i, own in enumerate(data_episodes(run)):
        ends = np.zeros((2, len(own.a)), dtype=bool)
        ends[:, -1:] = [[own.diverged], [not own.diverged]]
        buffers.append(
            EpisodeBuffer(
                id=i,
                seed=own.seed if own.seed >= 0 else None,
                observations=list(own.y),
                actions=list(own.a),
                rewards=own.rewards.tolist(),
                terminations=ends[0].tolist(),
                truncations=ends[1].tolist(),
            )
        )
    allowed, n_a = ActionSet.of(run.values), int(run.values["n_a"])
    low, high = (np.broadcast_to(b, n_a).astype(np.float64) for b in (allowed.low, allowed.high))
    about = {
        name: run.values[name] for name in ("problem", "law", "optimizer", "seed", "sample_time")
    }
    names = measured_names(run, buffers[0].observations[0].size)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # about fields that only its author knows
        minari.create_dataset_from_buffers(
            name,
            buffers,
            observation_space=Box(-np.inf, np.inf, (len(names),), np.float64),
            action_space=Box(low, high, dtype=np.float64),
            algorithm_name=str(run.values["optimizer"]),
            description=json.dumps({**about, "observations": names}),
        )
