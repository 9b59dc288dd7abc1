# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Optimisers with a common interface: see `pdeloop.method.adapt.base`."""

from pdeloop.method.adapt.base import Context as Context
from pdeloop.method.adapt.base import Optimizer as Optimizer
from pdeloop.method.adapt.base import Record as Record
from pdeloop.method.adapt.base import Rollout as Rollout
from pdeloop.method.adapt.base import RolloutResult as RolloutResult
from pdeloop.method.adapt.base import State as State
from pdeloop.method.adapt.base import StepOptimizer as StepOptimizer
from pdeloop.method.adapt.base import Trajectory as Trajectory
from pdeloop.method.adapt.model_based import ModelBased as ModelBased
from pdeloop.method.adapt.two_point import TwoPoint as TwoPoint
