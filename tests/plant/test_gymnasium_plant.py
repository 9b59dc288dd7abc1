# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A Gymnasium environment as a plant, against the environment itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import pdeloop
from pde_sim_node.instruments import InstrumentedPlant
from pde_sim_node.plant import Instruments, Plant
from pdeloop.cli import main
from pdeloop.messages.own_code import OwnCodeError
from tests.support.interpreter import ROOT
from tuner_node.narration import COSTLIER

NAME = f"{ROOT}/examples/plants/pendulum.py"


def test_it_is_the_environment_step_by_step_and_its_actions_saturate() -> None:
    plant = pdeloop.from_gymnasium("Pendulum-v1", horizon=5)
    assert isinstance(plant, Plant)
    env = gymnasium.make("Pendulum-v1")
    expected = [env.reset(seed=4)[0]]
    states, rewards = [plant.reset([7, 4]).copy()], 0.0
    for torque in (0.5, 9.0, -9.0, 0.0, 1.0):
        observation, reward, *_ = env.step(np.clip([torque], -2, 2).astype(np.float32))
        expected.append(observation)
        rewards += float(reward)
        states.append(plant.step(np.array([[0.0], [torque]])).copy())
    assert np.array_equal(np.array(states)[:, 1], np.array(expected, dtype=np.float64))
    assert plant.episode_costs().total[1] == -rewards


def test_with_a_target_the_cost_is_quadratic_and_does_not_depend_on_the_batch() -> None:
    def plant() -> Any:
        return pdeloop.from_gymnasium(
            "Pendulum-v1", target=[1.0, 0.0, 0.0], state_weight=2.0, action_weight=0.5, horizon=3
        )

    many, alone = plant(), plant()
    many.reset([1, 2])
    z = alone.reset([2]).copy()
    total = 0.0
    for a in (1.0, -3.0, 0.25):
        total += 2.0 * ((z[0] - [1, 0, 0]) ** 2).sum() + 0.5 * np.clip(a, -2, 2) ** 2
        many.step(np.array([[0.0], [a]]))
        z = alone.step(np.array([[a]])).copy()
        assert np.array_equal(z[0], many.states[1])
    assert alone.totals[0] == many.totals[1] == pytest.approx(total)
    assert many.definition.fingerprint == plant().definition.fingerprint
    other = pdeloop.from_gymnasium("Pendulum-v1", horizon=3)
    assert other.definition.fingerprint != many.definition.fingerprint


def test_what_cannot_be_done_with_it_is_refused() -> None:
    plant = pdeloop.from_gymnasium("Pendulum-v1", horizon=300)
    with pytest.raises(ValueError, match="its state cannot be set"):
        plant.evaluate(np.zeros((1, 3)), np.zeros((1, 1)))
    with pytest.raises(ValueError, match="starts from seeds only"):
        plant.reset(np.zeros((1, 3)))
    with pytest.raises(ValueError, match="process_noise cannot force"):
        InstrumentedPlant(plant, Instruments(process_noise=0.1))
    with pytest.raises(ValueError, match="has no derivatives"):
        pdeloop.Gradients(plant)
    with pytest.raises(ValueError, match=r"the action space must be a Box"):
        pdeloop.from_gymnasium("CartPole-v1")
    with pytest.raises(ValueError, match="target must be 3 finite numbers"):
        pdeloop.from_gymnasium("Pendulum-v1", target=[1.0])
    with pytest.raises(OwnCodeError, match=r"ends an episode after 200 steps, .* horizon is 300"):
        pdeloop.rollout(plant, lambda k, z: np.zeros((1, 1)), [0])


def test_an_optimiser_that_needs_a_target_is_refused_without_one(
    tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PDELOOP_PLANTS", "")
    words = ["train", "--plant", f"{NAME}:rewarded", "--in-process"]
    assert main(words) == 1
    assert "needs a quadratic cost about a target, which this plant does not have" in (
        capsys.readouterr().err
    )
    budget = ["--rollouts", "40", "--evaluation-fields", "2", "--reduced-order", "3"]
    assert main([*words, "--optimizer", "two_point", *budget, "--out", str(tmp_path / "run")]) == 0
    done = main(["evaluate", str(tmp_path / "run"), "--plant", f"{NAME}:rewarded"])
    assert done in (0, COSTLIER)  # on other fields the law of few rollouts may cost more than none


class Misbehaving(gymnasium.Env[Any, Any]):
    """Returns what it is told to."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, reset: Any = ([0.0, 0.0], {}), step: Any = None) -> None:
        self.returned = {"reset": reset, "step": step}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return self.returned["reset"]

    def step(self, action: Any) -> Any:
        return self.returned["step"]

    def __str__(self) -> str:
        return "env"


class Uncopiable(Misbehaving):
    """Cannot be copied."""

    def __deepcopy__(self, memo: Any) -> Any:
        raise TypeError("cannot pickle a lock")


NOTHING = np.zeros(2)


@pytest.mark.parametrize(
    ("env", "said"),
    [
        (
            Misbehaving(NOTHING),
            r"reset returned a ndarray; expected the tuple \(observation, info\)",
        ),
        (Misbehaving((NOTHING, 0.0, {})), "reset returned a tuple of 3; expected"),
        (Misbehaving(({"a": 1}, {})), r"reset returned the observation .*; expected 2 numbers"),
        (Misbehaving(([[1.0], [1.0, 2.0]], {})), r"the observation .*; expected 2 numbers"),
        (Misbehaving((np.zeros(3), {})), r"observation of shape \(3,\); expected 2 numbers"),
        (Misbehaving(([np.nan, 0.0], {})), "reset returned NaN or infinity"),
        (
            Misbehaving(step=(NOTHING, 0.0, False, {})),
            r"step returned a tuple of 4; expected the tuple",
        ),
        (Misbehaving(step=None), "step returned a NoneType; expected the tuple"),
        (Misbehaving(step=(NOTHING, None, False, False, {})), "the reward None; expected a number"),
        (
            Misbehaving(step=(NOTHING, 10**400, False, False, {})),
            "the reward a number of more than 300 digits; expected",
        ),
        (
            Misbehaving(step=(NOTHING, 0, NOTHING, False, {})),
            r"the terminated .*; expected a number",
        ),
        (
            Misbehaving(step=("ab", 0.0, False, False, {})),
            "the observation 'ab'; expected 2 numbers",
        ),
        (Uncopiable(), "a deep copy of env fails: .*cannot pickle a lock"),
    ],
)
def test_an_environment_that_misbehaves_is_told_in_a_sentence(env: Any, said: str) -> None:
    plant = pdeloop.from_gymnasium(env, horizon=3)
    with pytest.raises(OwnCodeError, match=said) as error:
        pdeloop.rollout(plant, lambda k, z: np.zeros((1, 1)), [0])
    assert len(str(error.value)) < 300


def test_what_is_no_environment_is_refused() -> None:
    with pytest.raises(ValueError, match="Gymnasium cannot make the environment 'Nowhere-v1'"):
        pdeloop.from_gymnasium("Nowhere-v1")
    with pytest.raises(ValueError, match=r"must be a gymnasium\.Env"):
        pdeloop.from_gymnasium(object())  # type: ignore[arg-type]


class Goal(gymnasium.Env[Any, Any]):
    """A double integrator, done within 0.3 of rest; `told` is what it says of that."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float64)

    def __init__(self, ends: bool = True, **told: Any) -> None:
        self.ends, self.told = ends, told

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.x = self.np_random.normal(size=2)
        return self.x.copy(), {}

    def step(self, action: Any) -> Any:
        self.x = self.x + 0.1 * np.array([self.x[1], float(action[0])])
        distance = float(np.abs(self.x).max())
        info = self.told if distance < 0.3 else {}
        return self.x.copy(), -1.0, self.ends and distance < 0.3, False, info


def to_rest(k: int, z: Any) -> Any:
    """A law that brings the double integrator to rest."""
    return -(z @ np.array([[1.0], [1.7]]))


def episode(env: Any, target: Any = (0.0, 0.0), **named: Any) -> Any:
    plant = pdeloop.from_gymnasium(env, target=target, horizon=80, sample_time=0.1, **named)
    return pdeloop.rollout(plant, to_rest, [3])


@pytest.mark.parametrize(
    ("told", "named"), [({}, {}), ({"is_success": True}, {}), ({}, {"termination": "success"})]
)
def test_an_environment_that_ends_at_its_goal_has_not_diverged(
    told: Any, named: Any, capfd: Any
) -> None:
    """The law is measured to the horizon, as on the plant that has no end."""
    endless, found = episode(Goal(ends=False)), episode(Goal(**told), **named)
    assert capfd.readouterr().err.count("terminated at step") == 1
    assert found.whole and np.array_equal(found.states, endless.states)
    assert found.costs.total == endless.costs.total


@pytest.mark.parametrize(
    ("told", "named"),
    [({"success": False}, {}), ({"is_success": True}, {"termination": "failure"})],
)
def test_an_environment_that_ends_as_a_failure_ends_the_rollout(
    told: Any, named: Any, capfd: Any
) -> None:
    reached = np.flatnonzero(np.abs(episode(Goal(ends=False)).states[:, 0]).max(axis=1) < 0.3)[0]
    assert episode(Goal(**told), **named).costs.diverged_step.tolist() == [reached - 1]
    assert f"terminated at step {reached - 1}: taken for a failure" in capfd.readouterr().err


def test_without_a_target_rewards_count_up_to_the_goal_as_in_gymnasium() -> None:
    reached = np.flatnonzero(np.abs(episode(Goal(ends=False)).states[:, 0]).max(axis=1) < 0.3)[0]
    found = episode(Goal(), target=None)
    assert found.whole and found.costs.total.tolist() == [float(reached)]


def test_the_limit_of_an_episode_is_the_horizon_of_a_specification_or_of_a_wrapper() -> None:
    import pdeloop.environments

    made = gymnasium.make("pdeloop/Burgers-v0", n_z=16, horizon=7)
    assert made.spec is not None and made.spec.max_episode_steps == 7
    assert pdeloop.from_gymnasium(made).horizon == 7
    several = gymnasium.make_vec("pdeloop/Burgers-v0", 2, n_z=16, horizon=7)
    assert several.spec is not None and several.spec.max_episode_steps == 7
    shorter = gymnasium.make("pdeloop/Burgers-v0", n_z=16, horizon=7, max_episode_steps=5)
    assert pdeloop.from_gymnasium(shorter).horizon == 5
    limited = gymnasium.wrappers.TimeLimit(Goal(), 12)
    assert pdeloop.from_gymnasium(limited).horizon == 12
    with pytest.raises(ValueError, match="termination is 'won'; expected 'success' or 'failure'"):
        pdeloop.from_gymnasium(limited, termination="won")


class Tanks(gymnasium.Env[Any, Any]):
    """Two tanks: levels by name and a tuple of readings, one valve and one heater."""

    def __init__(self, mode: bool = False) -> None:
        box = gymnasium.spaces.Box
        parts: dict[str, Any] = {
            "levels": box(-9.0, 9.0, (2,), np.float64),
            "readings": gymnasium.spaces.Tuple([box(-9.0, 9.0, (1,)), box(-9.0, 9.0, (1, 1))]),
        }
        if mode:
            parts["mode"] = gymnasium.spaces.Discrete(3)
        self.observation_space = gymnasium.spaces.Dict(parts)
        self.action_space = gymnasium.spaces.Dict(
            {"heater": box(0.0, 2.0, (1,), np.float64), "valve": box(-1.0, 1.0, (1,), np.float64)}
        )

    def _observation(self) -> dict[str, Any]:
        levels = self.levels.copy()
        return {"levels": levels, "readings": (levels[:1], 2.0 * levels[1:].reshape(1, 1))}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.levels = self.np_random.standard_normal(2)
        return self._observation(), {}

    def step(self, action: Any) -> Any:
        self.levels = 0.9 * self.levels + np.array([action["valve"][0], action["heater"][0]])
        return self._observation(), -float(abs(self.levels).sum()), False, False, {}


def test_spaces_of_names_and_tuples_are_one_vector_with_targets_and_weights_by_key() -> None:
    plant = pdeloop.from_gymnasium(
        Tanks(), target={"levels": [1.0, 0.5]}, action_weight={"heater": 4.0}, horizon=5
    )
    assert (plant.n_z, plant.n_a) == (4, 2)
    assert plant.action_set.low.tolist() == [0.0, -1.0]
    z = plant.reset([3])[0].copy()
    assert z[2] == np.float32(z[0]) or z[2] == z[0]
    heater, valve = 0.5, 0.25
    plant.step(np.array([[heater, valve]]))
    assert np.allclose(plant.states[0, :2], 0.9 * z[:2] + [valve, heater], rtol=1e-15)
    expected = (z[0] - 1.0) ** 2 + (z[1] - 0.5) ** 2 + 4.0 * heater**2 + valve**2
    assert plant.totals[0] == pytest.approx(expected, rel=1e-14)
    run = pdeloop.train(plant=plant, rollouts=8, evaluation_fields=2, optimizer="two_point")
    assert run.costs["lqt"].mean() < run.costs["none"].mean()


def test_rate_limits_go_by_key() -> None:
    plant = pdeloop.from_gymnasium(
        Tanks(), target={"levels": 0.0}, action_rate={"valve": 0.25}, horizon=5
    )
    free = pdeloop.from_gymnasium(Tanks(), target={"levels": 0.0}, horizon=5)
    assert plant.action_set.rate.tolist() == [np.inf, 0.25] and not free.action_set.rated
    assert plant.definition.fingerprint != free.definition.fingerprint
    levels = plant.reset([0])[0, :2].copy()
    for valve in (0.25, 0.5, 0.75, 1.0, 1.0):
        levels = 0.9 * levels + [valve, 2.0]
        assert np.allclose(plant.step(np.array([[2.0, 9.0]]))[0, :2], levels, rtol=1e-14)
    with pytest.raises(
        ValueError, match=r"action_rate has the key 'pump'; the action has heater, "
    ):
        pdeloop.from_gymnasium(Tanks(), action_rate={"pump": 1.0}, horizon=5)
    with pytest.raises(ValueError, match="action_rate must be positive"):
        pdeloop.from_gymnasium(Tanks(), action_rate=0.0, horizon=5)


class Unknown(Tanks):
    """Its second reading is infinite."""

    def _observation(self) -> dict[str, Any]:
        return {"levels": self.levels, "readings": (self.levels[:1], np.full((1, 1), np.inf))}


def test_an_infinite_part_of_an_observation_is_named() -> None:
    plant = pdeloop.from_gymnasium(Unknown(), target={"levels": 0.0}, horizon=5)
    with pytest.raises(OwnCodeError, match=r"returned NaN or infinity in readings\.1; a wrapper"):
        plant.reset([0])


def test_parts_of_a_space_that_do_not_fit_are_named() -> None:
    with pytest.raises(ValueError, match=r"the part 'mode' of the observation space must be a Box"):
        pdeloop.from_gymnasium(Tanks(mode=True), horizon=5)
    with pytest.raises(
        ValueError, match=r"target has the key 'level'; the observation has levels, "
    ):
        pdeloop.from_gymnasium(Tanks(), target={"level": 1.0}, horizon=5)
    with pytest.raises(ValueError, match=r"target\['levels'\] must be 2 numbers, got 3"):
        pdeloop.from_gymnasium(Tanks(), target={"levels": [1.0, 2.0, 3.0]}, horizon=5)
