# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`VecEnvironment` of stable-baselines3: its contract, and the library itself where it is installed.

The library needs PyTorch, so that only the extra `rl` installs it. The contract of a VecEnv is tested
without, on a stand-in for its base class that does what the library's documentation says of it.
"""

from __future__ import annotations

import copy
import importlib.util
import pickle
import sys
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
import pytest

import pdeloop.environments
from tests.support.small import same_bits

INSTALLED = importlib.util.find_spec("stable_baselines3") is not None
GRID: dict[str, Any] = {"n_z": 32, "horizon": 6}
BURGERS = "pdeloop/Burgers-v0"


class VecEnv(ABC):
    """What stable_baselines3.common.vec_env.VecEnv gives its subclasses and asks of them."""

    def __init__(self, num_envs: int, observation_space: Any, action_space: Any) -> None:
        self.num_envs = num_envs
        self.observation_space, self.action_space = observation_space, action_space
        self.reset_infos: list[dict[str, Any]] = [{} for _ in range(num_envs)]
        self._seeds: list[int | None] = [None] * num_envs
        self._options: list[dict[str, Any]] = [{} for _ in range(num_envs)]
        (self.render_mode,) = set(self.get_attr("render_mode"))

    def _reset_seeds(self) -> None:
        self._seeds = [None] * self.num_envs

    def _reset_options(self) -> None:
        self._options = [{} for _ in range(self.num_envs)]

    def _get_indices(self, indices: Any) -> Any:
        if indices is None:
            return range(self.num_envs)
        return [indices] if isinstance(indices, int) else indices

    def seed(self, seed: int) -> list[int | None]:
        self._seeds = [seed + m for m in range(self.num_envs)]
        return self._seeds

    def set_options(self, options: Any) -> None:
        one = isinstance(options, dict)
        self._options = [dict(options)] * self.num_envs if one else options

    def step(self, actions: np.ndarray) -> Any:
        self.step_async(actions)
        return self.step_wait()

    @abstractmethod
    def reset(self) -> Any: ...
    @abstractmethod
    def step_async(self, actions: np.ndarray) -> None: ...
    @abstractmethod
    def step_wait(self) -> Any: ...
    @abstractmethod
    def close(self) -> None: ...
    @abstractmethod
    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]: ...
    @abstractmethod
    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None: ...
    @abstractmethod
    def env_method(self, method_name: str, *args: Any, **kwargs: Any) -> list[Any]: ...
    @abstractmethod
    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]: ...


@pytest.fixture(scope="module")
def kind() -> Iterator[Any]:
    """The class, on the library or on the stand-in."""
    name = "pdeloop.environments.stable_baselines"
    if INSTALLED:
        yield importlib.import_module(name).VecEnvironment
        return
    modules = [f"stable_baselines3{end}" for end in ("", ".common", ".common.vec_env")]
    with pytest.MonkeyPatch.context() as patch:
        for module in modules:
            patch.setitem(sys.modules, module, ModuleType(module))
        sys.modules[modules[-1]].VecEnv = VecEnv  # type: ignore[attr-defined]
        yield importlib.import_module(name).VecEnvironment
        del sys.modules[name]


def singles(count: int, seed: int, **changes: Any) -> list[gymnasium.Env[Any, Any]]:
    """Environments of their own that have begun with the seeds s, s + 1, ..."""
    made = [gymnasium.make(BURGERS, **GRID, **changes) for _ in range(count)]
    for m, env in enumerate(made):
        env.reset(seed=seed + m)
    return made


@pytest.mark.parametrize("changes", [{}, {"sensors": 4, "measurement_noise": 0.1}])
def test_a_step_is_that_of_single_environments_which_begin_again_at_once(
    kind: Any, changes: dict[str, Any]
) -> None:
    batch = kind("burgers", num_envs=3, **GRID, **changes)
    others = [gymnasium.make(BURGERS, **GRID, **changes) for _ in range(3)]
    assert batch.num_envs == 3 and batch.action_space == others[0].action_space
    assert batch.observation_space == others[0].observation_space
    assert batch.seed(5) == [5, 6, 7]
    begun = [env.reset(seed=5 + m) for m, env in enumerate(others)]
    assert same_bits(batch.reset(), np.stack([state for state, _ in begun]))
    rng = np.random.default_rng(0)
    for k in range(2 * GRID["horizon"] + 3):
        actions = rng.uniform(-0.5, 0.5, (3, 6)).astype(np.float32)
        states, rewards, dones, infos = batch.step(actions)
        assert rewards.dtype == np.float32 and dones.dtype == np.bool_
        for m, env in enumerate(others):
            state, reward, terminated, truncated, info = env.step(actions[m].astype(float))
            if truncated:
                assert same_bits(infos[m].pop("terminal_observation"), state)
                state, first = env.reset()
                assert batch.reset_infos[m].keys() == first.keys()
            assert dones[m] == truncated == ((k + 1) % GRID["horizon"] == 0) and not terminated
            assert same_bits(states[m], state) and rewards[m] == np.float32(reward)
            assert infos[m].pop("TimeLimit.truncated") is truncated
            assert infos[m].keys() == info.keys() == {"cost", "distance", "target"}
            assert infos[m]["cost"] == info["cost"] and same_bits(
                infos[m]["target"], info["target"]
            )


def test_one_that_diverges_is_terminated_and_not_truncated(kind: Any) -> None:
    batch = kind("burgers", num_envs=2, divergence_penalty=5.0, **GRID)
    batch.seed(1)
    batch.reset()
    _, rewards, dones, infos = batch.step(np.array([np.zeros(6), np.full(6, 1e6)]))
    assert dones.tolist() == [False, True] and rewards[1] == np.float32(-infos[1]["cost"] - 5.0)
    assert infos[1]["TimeLimit.truncated"] is False and "terminal_observation" in infos[1]
    assert "terminal_observation" not in infos[0]


def test_seeds_and_options_are_those_of_the_next_reset_alone(kind: Any) -> None:
    batch = kind("burgers", num_envs=2, **GRID)
    batch.seed(3)
    first = batch.reset()
    assert not same_bits(batch.reset(), first)
    batch.seed(3)
    assert same_bits(batch.reset(), first)
    field = np.sin(np.arange(32))
    batch.set_options({"field": field})
    assert same_bits(batch.reset(), np.stack([field, field]))
    assert not same_bits(batch.reset()[0], field)
    batch.set_options([{"field": field}, {}])
    with pytest.raises(ValueError, match="option 'field' is not given for every environment"):
        batch.reset()


def test_attributes_are_those_of_the_batch(kind: Any) -> None:
    batch = kind("burgers", num_envs=2, render_mode="rgb_array", **GRID)
    assert batch.get_attr("render_mode") == ["rgb_array"] * 2
    assert batch.get_attr("action_space", indices=1) == [batch.action_space]
    assert batch.get_attr("plant", indices=[0])[0].horizon == GRID["horizon"]
    with pytest.raises(AttributeError, match="no_such_thing"):
        batch.get_attr("no_such_thing")
    batch.set_attr("label", "mine")
    assert batch.get_attr("label") == ["mine", "mine"]
    with pytest.raises(AttributeError, match="'label' can only be set for all of them"):
        batch.set_attr("label", "other", indices=[1])
    with pytest.raises(AttributeError, match="'reset' cannot be called for one of them"):
        batch.env_method("reset")
    assert batch.env_is_wrapped(gymnasium.Wrapper) == [False, False]
    batch.reset()
    assert [image.shape[2] for image in batch.get_images()] == [3, 3]
    batch.close(), batch.close()


def test_a_copy_continues_with_the_same_bits(kind: Any) -> None:
    batch = kind("burgers", num_envs=2, process_noise=0.01, **GRID)
    batch.seed(3)
    batch.reset(), batch.step(np.ones((2, 6)))
    for other in (copy.deepcopy(batch), pickle.loads(pickle.dumps(batch))):
        mine = copy.deepcopy(batch)
        for _ in range(GRID["horizon"] + 1):
            ours, theirs = mine.step(np.ones((2, 6))), other.step(np.ones((2, 6)))
            assert all(np.array_equal(a, b) for a, b in zip(ours[:3], theirs[:3], strict=True))


def test_without_the_library_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    name = "pdeloop.environments.stable_baselines"
    monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    monkeypatch.setitem(sys.modules, "stable_baselines3.common.vec_env", None)
    with pytest.raises(gymnasium.error.DependencyNotInstalled, match=r"install 'pdeloop\[rl\]'"):
        importlib.import_module(name)


needs_library = pytest.mark.skipif(
    not INSTALLED, reason="stable-baselines3 is not installed: extra rl"
)


@needs_library
@pytest.mark.parametrize("problem", pdeloop.environments.shipped_problems())
@pytest.mark.filterwarnings("ignore:We recommend you to use a symmetric and normalized")
@pytest.mark.filterwarnings("ignore:Your action space has dtype float64")
def test_every_problem_passes_the_librarys_own_check(problem: str) -> None:
    from stable_baselines3.common.env_checker import check_env

    env_id = pdeloop.environments.environment_id(problem)
    check_env(gymnasium.make(env_id, n_z=64, horizon=6, render_mode="rgb_array").unwrapped)


@needs_library
def test_the_first_line_of_everybody_works_and_has_the_bits_of_the_batch() -> None:
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import SubprocVecEnv

    from pdeloop.environments.stable_baselines import VecEnvironment

    how = {"n_envs": 2, "seed": 3, "env_kwargs": GRID}
    batch = VecEnvironment("burgers", num_envs=2, render_mode="rgb_array", **GRID)
    here = make_vec_env(BURGERS, **how)
    apart = make_vec_env(f"pdeloop.environments:{BURGERS}", vec_env_cls=SubprocVecEnv, **how)
    try:
        batch.seed(3)
        first = batch.reset()
        assert same_bits(here.reset(), first) and same_bits(apart.reset(), first)
        assert np.array_equal(here.render(), batch.render())
        assert apart.render().shape == batch.render().shape
        for _ in range(2 * GRID["horizon"]):
            actions = np.array([batch.action_space.sample() for _ in range(2)])
            ours = batch.step(actions)
            for other in (here.step(actions), apart.step(actions)):
                assert same_bits(ours[0], other[0]) and np.array_equal(ours[2], other[2])
                assert np.array_equal(ours[1], other[1].astype(np.float32))
                for mine, info in zip(ours[3], other[3], strict=True):
                    assert mine.keys() == info.keys() - {"episode"}
    finally:
        apart.close()
    here.close(), here.close(), batch.close()


@needs_library
def test_its_algorithms_and_wrappers_take_the_batch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its logs and the compiler's files, of which it tells nobody, go to the test's folder."""
    monkeypatch.setenv("SB3_LOGDIR", str(tmp_path / "logs"))
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "inductor"))
    from stable_baselines3 import PPO, SAC
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.vec_env import VecFrameStack, VecMonitor, VecNormalize

    from pdeloop.environments.stable_baselines import VecEnvironment

    def batch() -> Any:
        return VecMonitor(VecEnvironment("burgers", num_envs=2, **GRID))

    agent = PPO("MlpPolicy", VecNormalize(batch()), n_steps=12, batch_size=12, device="cpu").learn(
        48
    )
    PPO("MlpPolicy", VecFrameStack(batch(), 3), n_steps=6, batch_size=12, device="cpu").learn(12)
    SAC("MlpPolicy", batch(), learning_starts=4, device="cpu").learn(12)
    _, lengths = evaluate_policy(agent, batch(), n_eval_episodes=3, return_episode_rewards=True)
    assert lengths == [GRID["horizon"]] * 3
    agent.save(tmp_path / "agent")
    assert PPO.load(tmp_path / "agent", device="cpu").action_space == agent.action_space
