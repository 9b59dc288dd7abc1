# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Optimisers of a policy behind one interface: see `tuner_node.optimizers.base`."""

from tuner_node.optimizers.base import Context as Context
from tuner_node.optimizers.base import Optimizer as Optimizer
from tuner_node.optimizers.base import Record as Record
from tuner_node.optimizers.base import Rollout as Rollout
from tuner_node.optimizers.base import RolloutResult as RolloutResult
from tuner_node.optimizers.base import State as State
from tuner_node.optimizers.base import Trajectory as Trajectory
from tuner_node.optimizers.gauss_newton import GaussNewton as GaussNewton
from tuner_node.optimizers.two_point import TwoPoint as TwoPoint
