# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The rollouts of a run as a data set of Minari and as a Parquet file, read by their own loaders."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pdeloop
import pdeloop.environments
from pde_sim_node.plants.loading import OWN_PLANTS
from pdeloop.cli import main
from pdeloop.data_sets import DataEpisode, data_episodes
from pdeloop.finished_run import FinishedRun
from tests.support.small import SMALL

LIMIT = 0.05
QUICK: dict[str, Any] = {"optimizer": "two_point", "rollouts": 7, "evaluation_fields": 2}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    out = tmp_path_factory.mktemp("runs") / "run"
    return pdeloop.train(str(SMALL), horizon=20, action_limit=LIMIT, **QUICK, out=out)


def test_an_episode_is_that_of_the_plant_with_its_seed_and_rewards(run: FinishedRun) -> None:
    """Each is carried out again by Gymnasium's environment of the same plant."""
    env = pdeloop.environments.Environment(str(SMALL), horizon=20, action_limit=LIMIT)
    found = list(data_episodes(run))
    assert len(found) >= 7 and any((np.abs(own.a) == LIMIT).any() for own in found)
    for own in found:
        y, _ = env.reset(seed=own.seed)
        assert np.array_equal(y, own.y[0]) and not own.diverged
        for k, a in enumerate(own.a):
            y, reward, _, truncated, _ = env.step(a)
            assert np.array_equal(y, own.y[k + 1])
            assert own.rewards[k] == pytest.approx(reward, rel=1e-10)
            assert truncated == (k == len(own.a) - 1)


def test_an_episode_that_diverges_ends_there() -> None:
    class Growing(pdeloop.Dynamics):
        n_z, n_a, horizon, divergence_bound = 2, 1, 12, 50.0

        def initial_state(self, rng: np.random.Generator) -> Any:
            return rng.normal(size=2)

        def step(self, z: Any, a: Any) -> Any:
            return 2.0 * z + a

    plant = Growing()
    episode = pdeloop.rollout(plant, lambda k, z: np.zeros((2, 1)), [0, 1])
    lost = episode.costs.diverged_step
    assert (lost > 0).all() and episode.stage_costs is not None and episode.seeds is not None
    for m, end in enumerate(lost):
        z = episode.states[: end + 1, m]
        np.testing.assert_allclose(episode.stage_costs[:end, m], (z[:end] ** 2).sum(axis=1))
        assert np.abs(z).max() <= 50.0 < np.abs(2.0 * z[-1]).max()
    assert episode.seeds.tolist() == [0, 1]


@pytest.mark.skipif(
    importlib.util.find_spec("pyarrow") is None, reason="pyarrow is not installed: extra logs"
)
def test_a_parquet_file_has_every_row_and_identifies_a_model(
    run: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from pyarrow import parquet

    file = tmp_path / "rollouts.parquet"
    assert main(["export", str(run.folder), "--parquet", str(file)]) == 0
    table, own = parquet.read_table(file), list(data_episodes(run))
    assert table.schema.metadata[b"sample_time"] == repr(run.values["sample_time"]).encode()
    assert table.schema.field("t").metadata[b"unit"] == b"s"
    assert table.num_rows == sum(len(each.y) for each in own)
    columns = {name: table[name].to_numpy() for name in table.column_names}
    n_y, n_a = own[0].y.shape[1], own[0].a.shape[1]
    for i, each in enumerate(own):
        rows = np.flatnonzero(columns["episode"] == i)
        assert (columns["seed"][rows] == each.seed).all()
        np.testing.assert_array_equal(
            np.stack([columns[f"u{j + 1}"][rows] for j in range(n_y)], axis=1), each.y
        )
        actions = np.stack([columns[f"a{j + 1}"][rows] for j in range(n_a)], axis=1)
        np.testing.assert_array_equal(actions[:-1], each.a)
        assert np.isnan(actions[-1]).all() and np.isnan(columns["reward"][rows[-1]])
        np.testing.assert_array_equal(columns["reward"][rows[:-1]], each.rewards)
        assert columns["truncated"][rows].tolist() == [False] * (len(rows) - 1) + [True]
    read = pdeloop.read_measurements(file, time="t", states="u*", inputs="a?")
    for (z, a), each in zip(read.trajectories, own, strict=True):
        assert np.array_equal(z, each.y) and np.array_equal(a, each.a)


@pytest.mark.skipif(
    importlib.util.find_spec("pyarrow") is None, reason="pyarrow is not installed: extra logs"
)
def test_a_plant_of_ones_own_is_named_to_repeat_its_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = tmp_path / "own.py", tmp_path / "run"
    file.write_text(
        "import pdeloop\n\n\nclass Own(pdeloop.Dynamics):\n    n_z, n_a, horizon = 2, 1, 12\n\n"
        "    def initial_state(self, rng):\n        return rng.normal(size=2)\n\n"
        "    def step(self, z, a):\n        return 0.9 * z + a\n"
    )
    monkeypatch.setenv(OWN_PLANTS.variable, "")
    pdeloop.train(plant=f"{file}:Own", rollouts=6, evaluation_fields=2, out=out)
    monkeypatch.setenv(OWN_PLANTS.variable, "")
    words = ["export", str(out), "--parquet", str(tmp_path / "rollouts.parquet")]
    assert main(words) == 1
    assert f"name it yourself: --plant {file}:Own" in capsys.readouterr().err
    assert main([*words, "--plant", f"{file}:Own"]) == 0


@pytest.mark.skipif(
    importlib.util.find_spec("minari") is None, reason="Minari is not installed: extra minari"
)
def test_minari_loads_the_episodes(
    run: FinishedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    import minari

    words = ["export", str(run.folder), "--minari", "small/rollouts-v0"]
    assert main(words) == 0
    loaded, own = minari.load_dataset("small/rollouts-v0"), list(data_episodes(run))
    assert loaded.total_episodes == len(own)
    assert loaded.total_steps == sum(len(each.a) for each in own)
    assert loaded.spec.action_space.high.tolist() == [LIMIT] * own[0].a.shape[1]
    about = json.loads(loaded.storage.metadata["description"])
    assert about["observations"][:2] == ["u1", "u2"]
    assert about["sample_time"] == run.values["sample_time"]
    for episode, each in zip(loaded.iterate_episodes(), own, strict=True):
        same(episode, each)
    seeds = [m.get("seed") for m in loaded.storage.get_episode_metadata(range(len(own)))]
    assert seeds == [each.seed for each in own]
    assert main(words) == 1
    assert "there is a data set small/rollouts-v0" in capsys.readouterr().err
    assert main([*words[:-1], "no name at all!"]) == 1
    assert "expected a name such as burgers/rollouts-v0" in capsys.readouterr().err


def same(episode: Any, own: DataEpisode) -> None:
    assert np.array_equal(episode.observations, own.y) and episode.observations.dtype == np.float64
    assert np.array_equal(episode.actions, own.a)
    assert np.array_equal(episode.rewards, own.rewards)
    assert not episode.terminations.any()
    assert episode.truncations.tolist() == [False] * (len(own.a) - 1) + [True]


@pytest.mark.parametrize(
    ("module", "words", "sentence"),
    [
        ("pyarrow", ["--parquet", "x.parquet"], "needs pyarrow: pip install 'pdeloop[logs]'"),
        ("minari", ["--minari", "small/x-v0"], "needs it: pip install 'pdeloop[minari]'"),
        ("", ["--parquet", "x.csv"], "expected a file that ends in .parquet"),
    ],
)
def test_what_is_missing_is_said(
    run: FinishedRun,
    module: str,
    words: list[str],
    sentence: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if module:
        monkeypatch.setitem(__import__("sys").modules, module, None)
    assert main(["export", str(run.folder), *words]) == 1
    assert sentence in capsys.readouterr().err and not Path(words[-1]).exists()
