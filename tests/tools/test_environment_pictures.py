# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The frames of environments, and the films that Gymnasium makes of them."""

from __future__ import annotations

import copy
import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import DependencyNotInstalled
from gymnasium.wrappers import RecordVideo
from gymnasium.wrappers.vector import RecordVideo as RecordVideos

import pdeloop
from pde_sim_node.plants.loading import as_plant
from pdeloop.environments import environment_id
from pdeloop.environments.picture import Picture
from pdeloop.frames import Frames
from pdeloop.messages.grid import Axis, Grid

BURGERS = "pdeloop/Burgers-v0"
GRID: dict[str, Any] = {"n_z": 32, "horizon": 2}


@pytest.mark.parametrize("problem", ["burgers", "wave", "schrodinger"])
def test_a_frame_shows_the_field_of_a_problem(problem: str) -> None:
    """Of one component, of two, and of a complex one: the others have one of these."""
    env = gymnasium.make(environment_id(problem), render_mode="rgb_array", n_z=64)
    env.reset(seed=1)
    first = env.render()
    assert isinstance(first, np.ndarray) and first.dtype == np.uint8 and first.shape[2] == 3
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 20
    env.step(env.action_space.high)
    after = env.render()
    assert after.shape == first.shape and not np.array_equal(after, first)
    assert np.array_equal(env.render(), after)


def test_without_a_mode_nothing_is_drawn() -> None:
    env, batch = gymnasium.make(BURGERS, **GRID), gymnasium.make_vec(BURGERS, 2, **GRID)
    env.reset(seed=0), batch.reset(seed=0)
    assert env.unwrapped.render() is None and batch.render() is None


def test_a_batch_draws_each_of_its_environments() -> None:
    batch = gymnasium.make_vec(BURGERS, 2, render_mode="rgb_array", **GRID)
    batch.reset(seed=4)
    frames = batch.render()
    single = gymnasium.make(BURGERS, render_mode="rgb_array", **GRID)
    single.reset(seed=5)
    assert len(frames) == 2 and np.array_equal(frames[1], single.render())
    assert not np.array_equal(frames[0], frames[1])
    other = copy.deepcopy(batch)
    assert np.array_equal(other.render()[0], frames[0])


@pytest.mark.parametrize(
    "grid",
    [
        Grid.vector(6),
        Grid((Axis("y", 1.0, 2), Axis("x", 1.0, 3))),
        Grid.interval(1.0, 3, "uv"),
        Grid(fields={"u": (0, 4), "v": (4, 6)}),
    ],
)
def test_states_of_any_grid_are_drawn(grid: Grid) -> None:
    class Any6(pdeloop.Dynamics):
        n_a, horizon = 2, 5

        def __init__(self) -> None:
            self.grid = grid

        def initial_state(self, rng: np.random.Generator) -> np.ndarray:
            return np.arange(6.0)

        def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
            return -z

    plant = as_plant(Any6())
    plant.reset([0])
    picture = Picture()
    frame = picture.frame(plant, 0)
    assert np.array_equal(picture.frame(plant, 0), frame)
    plant.step(np.ones((1, 2)))
    assert not np.array_equal(picture.frame(plant, 0), frame)


def test_where_matplotlib_is_missing_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    env = gymnasium.make(BURGERS, render_mode="rgb_array", **GRID)
    env.reset(seed=0)
    monkeypatch.delitem(sys.modules, "pdeloop.frames", raising=False)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(DependencyNotInstalled, match=r"pip install 'pdeloop\[report\]'"):
        env.render()


@pytest.fixture
def clips(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, float]]:
    """Number of frames and frames a second of the films made; a stand-in writes them, not MoviePy."""
    made: list[tuple[int, float]] = []

    class ImageSequenceClip:
        def __init__(self, frames: list[np.ndarray], fps: float) -> None:
            assert len({frame.shape for frame in frames}) == 1
            made.append((len(frames), fps))

        def write_videofile(self, path: str, **how: Any) -> None:
            Path(path).write_bytes(b"")

    names = ("moviepy", "moviepy.video", "moviepy.video.io", "moviepy.video.io.ImageSequenceClip")
    for name in names:
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    sys.modules[names[-1]].ImageSequenceClip = ImageSequenceClip  # type: ignore[attr-defined]
    return made


def episode(env: gymnasium.Env[Any, Any]) -> None:
    env.reset(seed=0)
    while not env.step(env.action_space.sample())[3]:
        pass


def test_a_film_has_a_frame_for_each_state(clips: list[tuple[int, float]], tmp_path: Path) -> None:
    env = gymnasium.make(BURGERS, render_mode="rgb_array", **GRID)
    film = RecordVideo(env, str(tmp_path / "one"), episode_trigger=lambda _: True)
    episode(film), episode(film)
    film.close()
    assert clips == [(GRID["horizon"] + 1, env.metadata["render_fps"])] * 2
    batch = gymnasium.make_vec(BURGERS, 3, render_mode="rgb_array", **GRID)
    films = RecordVideos(batch, str(tmp_path / "many"), episode_trigger=lambda _: True)
    films.reset(seed=0)
    for _ in range(GRID["horizon"]):
        films.step(films.action_space.sample())
    films.close()
    assert len(clips) == 3


@pytest.mark.skipif(
    importlib.util.find_spec("moviepy") is None, reason="MoviePy is not installed: extra rl"
)
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_a_film_is_written(tmp_path: Path) -> None:
    env = gymnasium.make(BURGERS, render_mode="rgb_array", **GRID)
    film = RecordVideo(env, str(tmp_path / "films"), episode_trigger=lambda _: True)
    episode(film)
    film.close()
    (written,) = tmp_path.glob("films/*.mp4")
    assert written.stat().st_size > 1000 and b"ftyp" in written.read_bytes()[:32]


def test_what_is_drawn_is_not_part_of_the_episode() -> None:
    """The bits with and without a picture are the same."""
    env = gymnasium.make(BURGERS, render_mode="rgb_array", **GRID)
    plant = pdeloop.problem("burgers", **GRID).plant()
    env.reset(seed=3), plant.reset([3])
    for _ in range(GRID["horizon"]):
        env.render()
        assert np.array_equal(env.step(np.ones(6))[0], plant.step(np.ones((1, 6)))[0])


class Tracks(pdeloop.Dynamics):
    """Eight cells whose target moves, with two heaters of 0 to 2."""

    n_z, n_a, horizon, sample_time = 8, 2, 6, 1.0
    state_weight, action_weight = 1.0, 1.0
    action_low, action_high = 0.0, 2.0

    def __init__(self) -> None:
        self.target = np.outer(np.arange(7.0), np.ones(8))

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        return rng.normal(size=8)

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        return 0.5 * z + a.sum()


def test_a_picture_has_the_target_of_its_step_and_the_bounds_of_its_actuators() -> None:
    frames = Frames(as_plant(Tracks()), largest=1.0)
    field, actions = frames._canvas.figure.axes
    for step in (0, 4, 6):
        frames.draw(np.zeros((1, 8)), np.zeros((1, 2)), step)
        dashed = next(line for line in field.lines if line.get_linestyle() == "--")
        np.testing.assert_array_equal(dashed.get_ydata(), np.full(8, float(step)))
    drawn = {
        float(y) for lines in actions.collections for _, y in np.concatenate(lines.get_segments())
    }
    assert drawn == {0.0, 2.0}
