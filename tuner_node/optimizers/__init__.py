"""Optimisers of a policy behind one interface: see `tuner_node.optimizers.base`."""

from collections.abc import Callable

from tuner_node.optimizers.base import (
    Context,
    Measured,
    Optimizer,
    Rollout,
    RolloutResult,
    Row,
    State,
    Trajectory,
)
from tuner_node.optimizers.directions import Directions
from tuner_node.optimizers.gauss_newton import GaussNewton
from tuner_node.optimizers.two_point import TwoPoint

__all__ = [
    "NEED_TRAJECTORIES",
    "OPTIMIZERS",
    "Context",
    "Directions",
    "GaussNewton",
    "Measured",
    "Optimizer",
    "Rollout",
    "RolloutResult",
    "Row",
    "State",
    "Trajectory",
    "TwoPoint",
]

# The names that parameters and the command line use.
OPTIMIZERS: dict[str, Callable[..., Optimizer]] = {
    cls.name: cls for cls in (TwoPoint, Directions, GaussNewton)
}
NEED_TRAJECTORIES = tuple(
    cls.name for cls in (TwoPoint, Directions, GaussNewton) if cls.needs_trajectories
)
"""The optimisers whose results must carry their trajectories."""
