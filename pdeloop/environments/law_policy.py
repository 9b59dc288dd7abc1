# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law as a linear path beside the network of a stable-baselines3 policy.

    mean action = K y + b + n(y),    n = 0 at first

where SAC and CrossQ squash: tanh(artanh(K y + b) + n(y)) in units of the action space. K and b are
learnt like the network's weights.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import nn

from pdeloop.messages.arrays import Array

LARGEST = 0.999
"""Largest magnitude of a squashed law, beyond which its tanh has hardly a gradient."""


class Beside(nn.Module):  # type: ignore[misc, unused-ignore]  # untyped where it is not installed
    """A network's last features, and behind them its input."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, y: torch.Tensor) -> torch.Tensor:
        return torch.cat([self.network(y), y], dim=1)


class Head(nn.Module):  # type: ignore[misc, unused-ignore]
    """A layer of a network's last features, and the linear path of its input."""

    def __init__(self, layer: nn.Linear, law: nn.Linear | None, squashed: bool) -> None:
        super().__init__()
        self.layer, self.law, self.squashed = layer, law, squashed

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        inner, y = features.split(
            [self.layer.in_features, features.shape[1] - self.layer.in_features], 1
        )
        if self.law is None:
            return self.layer(inner)
        path = self.law(y)
        return self.layer(inner) + (
            torch.atanh(path.clamp(-LARGEST, LARGEST)) if self.squashed else path
        )


class LawPolicy:
    """Mixed into a policy of PPO, SAC or CrossQ: with the linear path, to be saved and loaded.

    law: K (n_a, n_y), b (n_a,), the standard deviation of the exploration, and whether it is squashed.
    """

    def __init__(self, *given: Any, law: tuple[Array, Array, float, bool], **named: Any) -> None:
        super().__init__(*given, **named)
        add_path(self, *law)


def add_path(policy: Any, K: Array, b: Array, std: float, squashed: bool) -> None:
    """Change a policy's network in place; its optimiser learns the path, too."""
    owner = policy.actor if squashed else policy
    law = nn.Linear(K.shape[1], K.shape[0], device=policy.device)
    with torch.no_grad():
        law.weight.copy_(torch.as_tensor(np.asarray(K)))
        law.bias.copy_(torch.as_tensor(np.asarray(b)))
        head = owner.mu if squashed else owner.action_net
        head.weight.zero_(), head.bias.zero_()
        if squashed:
            owner.log_std.weight.zero_()
            owner.log_std.bias.fill_(float(np.log(std)))
            owner.latent_pi = Beside(owner.latent_pi)
            owner.mu, owner.log_std = Head(head, law, True), Head(owner.log_std, None, True)
        else:
            owner.log_std.fill_(float(np.log(std)))
            owner.mlp_extractor.policy_net = Beside(owner.mlp_extractor.policy_net)
            owner.action_net = Head(head, law, False)
    optimizer = owner.optimizer
    owner.optimizer = type(optimizer)(owner.parameters(), **optimizer.defaults)
