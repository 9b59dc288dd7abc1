# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Optimisers with a common interface: see `loop_method.adapt.base`."""

from loop_method.adapt.base import Context as Context
from loop_method.adapt.base import Optimizer as Optimizer
from loop_method.adapt.base import Record as Record
from loop_method.adapt.base import Rollout as Rollout
from loop_method.adapt.base import RolloutResult as RolloutResult
from loop_method.adapt.base import State as State
from loop_method.adapt.base import Trajectory as Trajectory
from loop_method.adapt.model_based import ModelBased as ModelBased
from loop_method.adapt.step_optimizer import StepOptimizer as StepOptimizer
from loop_method.adapt.two_point import TwoPoint as TwoPoint
