# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A controller of a small plant, what it is sent, and what an exploration makes it answer."""

from __future__ import annotations

from functools import cache

import numpy as np

from controller_node.identification import DesignSettings
from controller_node.policy import excitation
from controller_node.responder import Responder
from pde_sim_node.build import build_plant
from pde_sim_node.plants import SpectralPlant
from pdeloop.in_process import LocalPair
from pdeloop.messages.frames import Frame
from pdeloop.messages.topics import COMPLETED
from tests.support.small import parameters, same_bits
from tuner_node.batch import Batch

RUN = 5
COSTS = np.array([[1.0, 30.0, COMPLETED]])
SETTINGS = DesignSettings(n_a=4, reduced_order=4, state_weight=1.0, action_weight=1.0)


@cache
def plant() -> SpectralPlant:
    return build_plant(parameters())


def target() -> Frame:
    return Frame(0, 0, 0, 0.0, plant().target)


def start(episode: int, *rows: tuple[float, ...], run: int = RUN) -> Frame:
    return Frame(run, episode, 0, 0.0, np.array(rows, dtype=float).reshape(-1, 4))


def models() -> np.ndarray:
    found = LocalPair(parameters()).run(Batch(np.array([(1.0, 2.0, 0.1, 0.0)]), None)).models
    assert found is not None
    return found


def explore(responder: Responder, episode: int, excitation_seed: int = 2, lose: int = -1):
    """Drive an exploratory episode; the state of step `lose` never reaches the controller."""
    responder.start(start(episode, (1, excitation_seed, 0.1, 0)))
    states = plant().reset(np.array([1]))
    for k in range(plant().horizon + 1):
        if k != lose:
            (send,) = responder.state(Frame(RUN, episode, k, 0.0, states))
            expected = excitation(excitation_seed, k, 4, 0.1)
            assert same_bits(send.frame.values[0], expected)
        if k < plant().horizon:
            states = plant().step(excitation(excitation_seed, k, 4, 0.1)[np.newaxis])
    return responder.cost(Frame(RUN, episode, plant().horizon, 1.0, COSTS))
