# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The ramp-up of ITER's hybrid scenario in TORAX, by Gym-TORAX, as a plant.

Actions go about the open loop that Gym-TORAX brings: a part of the plasma current (MA) that is added to
its ramp, and the shares of its beam and microwave power, which it turns on after 99 of 150 s. Measured:
the fusion gain Q, safety factors, and temperatures of the core and along the radius (10 keV). Q, fusion
power over heating power, has no bound where the heating goes out: its logarithm is measured, with 0 for
Q = 0 and 1 for Q = 10. The cost tracks Q = 10, with q_min and q95 as in the environment's reward.
"""

import gymnasium
import gymtorax
import numpy as np

import pdeloop

FAILED = -1000.0
"""Reward of a step that fails."""
RADII = slice(0, 25, 4)
"""Which of the radial cells of a temperature are measured."""


class Scenario(gymnasium.Wrapper):
    """Chosen measurements in units of their size, actions about the open loop, and failures as ends."""

    def __init__(self, env):
        super().__init__(env)
        sizes = {"Q": 1, "q_min": 1, "q95": 1, "H98": 1, "T_e": 7, "T_i": 7, "current": 1}
        self.observation_space = gymnasium.spaces.Dict(
            {name: gymnasium.spaces.Box(-np.inf, np.inf, (n,)) for name, n in sizes.items()}
        )
        bounds = {"current": (-1.0, 1.5), "beam": (0.0, 1.0), "waves": (0.0, 1.0)}
        self.action_space = gymnasium.spaces.Dict(
            {name: gymnasium.spaces.Box(*ends, (1,), np.float64) for name, ends in bounds.items()}
        )

    def reset(self, **given):
        observation, info = self.env.reset(**given)
        self._open_loop = gymtorax.IterHybridAgent(self.env.action_space)
        self._last = observation
        return self._measured(observation), info

    def step(self, action):
        full = {name: np.array(a, float) for name, a in self._open_loop.act(self._last).items()}
        full["Ip"] += 1e6 * action["current"]
        full["NBI"][0] *= action["beam"][0]
        full["ECRH"][0] *= action["waves"][0]
        self._last, reward, ended, _, info = self.env.step(full)
        failed = bool(reward == FAILED)  # the end of the scenario is `terminated` as well
        return self._measured(self._last), reward, failed, ended and not failed, info

    def _measured(self, observation):
        scalars, profiles = observation["scalars"], observation["profiles"]
        return {
            "Q": logarithmic(scalars["Q_fusion"]),
            "q_min": np.minimum(scalars["q_min"], 1.0),
            "q95": np.minimum(scalars["q95"] / 3.0, 1.0),
            "H98": scalars["H98"],
            "T_e": profiles["T_e"][RADII] / 10.0,
            "T_i": profiles["T_i"][RADII] / 10.0,
            "current": profiles["Ip_profile"][-1:] / 1e7,
        }


def logarithmic(gain):
    """log(1 + Q), which is 1 for Q = 10."""
    return np.log1p(gain) / np.log(11.0)


def scenario():
    """The environment."""
    return Scenario(gymnasium.make("gymtorax/IterHybrid-v0"))


def ramp(gain=10.0):
    """The scenario, to burn at this fusion gain."""
    return pdeloop.from_gymnasium(
        scenario(),
        target={"Q": logarithmic(gain), "q_min": 1.0, "q95": 1.0},
        state_weight={"Q": 1.0, "q_min": 0.1, "q95": 0.1},
        action_weight=0.01,
        action_rate={"current": 0.1},
        horizon=150,
        termination="failure",
    )


def rewarded():
    """The cost is minus the environment's own reward."""
    return pdeloop.from_gymnasium(
        scenario(), action_rate={"current": 0.1}, horizon=150, termination="failure"
    )
