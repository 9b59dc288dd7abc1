# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Control of PDEs from Python: the command line's functions on arrays (docs/python.md).

>>> import pdeloop
>>> burgers = pdeloop.problem("burgers")
>>> model = pdeloop.identify(burgers.explore(seed=0), n_s=8)
>>> gains = pdeloop.track(model, state_weight=1.0, action_weight=1.0)
>>> plant = burgers.plant()
>>> episode = pdeloop.rollout(plant, pdeloop.projected_law(plant, model.U, gains), [0, 1])
>>> episode.states.shape
(301, 2, 128)

Every name is imported when it is used first, so that `import pdeloop` costs nothing; none needs ROS
but `train(..., over_topics=True)`.
"""

import importlib

# Not from `typing`: `python -m pdeloop` is here before its working directory is off the module path.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from pde_sim_node.dynamics import Dynamics as Dynamics
    from pde_sim_node.plant import Plant as Plant
    from pde_sim_node.plants.fmu import from_fmu as from_fmu
    from pde_sim_node.plants.gymnasium_plant import from_gymnasium as from_gymnasium
    from pde_sim_node.plants.process import from_process as from_process
    from pdeloop.api import Problem as Problem
    from pdeloop.api import identify as identify
    from pdeloop.api import problem as problem
    from pdeloop.api import train as train
    from pdeloop.data_file import read_measurements as read_measurements
    from pdeloop.episode import projected_law as projected_law
    from pdeloop.episode import rollout as rollout
    from pdeloop.finished_run import FinishedRun as FinishedRun
    from pdeloop.finished_run import load_run as load_run
    from pdeloop.gradients import Gradients as Gradients
    from pdeloop.messages.grid import Axis as Axis
    from pdeloop.messages.grid import Grid as Grid
    from pdeloop.method.adapt.base import Optimizer as Optimizer
    from pdeloop.method.adapt.base import Rollout as Rollout
    from pdeloop.method.adapt.base import RolloutResult as RolloutResult
    from pdeloop.method.adapt.base import StepOptimizer as StepOptimizer
    from pdeloop.method.design.lqt import track as track
    from pdeloop.method.design.lqt import track_horizon as track_horizon
    from pdeloop.method.laws.base import Law as Law
    from pdeloop.method.reduce.identifiability import (
        IdentifiabilityWarning as IdentifiabilityWarning,
    )
    from pdeloop.method.reduce.identifiability import NotIdentifiableError as NotIdentifiableError
    from pdeloop.method.reduce.reduced_model import ReducedModel as ReducedModel
    from pdeloop.method.reduce.regression import study_orders as study_orders
    from pdeloop.method.settings import Settings as Settings
    from pdeloop.method.settings import setting as setting
    from pdeloop.plots import plot_behaviour as plot_behaviour
    from pdeloop.plots import plot_costs as plot_costs
    from pdeloop.plots import plot_episode as plot_episode
    from pdeloop.plots import plot_gains as plot_gains
    from pdeloop.plots import plot_spectrum as plot_spectrum
    from pdeloop.plots import plot_training as plot_training
    from pdeloop.training_warning import TrainingWarning as TrainingWarning

_NAMES = {
    "pdeloop.method.reduce.identifiability": ("IdentifiabilityWarning", "NotIdentifiableError"),
    "pdeloop.method.adapt": ("Optimizer", "Rollout", "RolloutResult", "StepOptimizer"),
    "pdeloop.method.design.lqt": ("track", "track_horizon"),
    "pdeloop.method.laws.base": ("Law",),
    "pdeloop.method.reduce.regression": ("study_orders",),
    "pdeloop.method.reduce.reduced_model": ("ReducedModel",),
    "pdeloop.method.settings": ("Settings", "setting"),
    "pdeloop.messages.grid": ("Axis", "Grid"),
    "pde_sim_node.dynamics": ("Dynamics",),
    "pde_sim_node.plant": ("Plant",),
    "pde_sim_node.plants.fmu": ("from_fmu",),
    "pde_sim_node.plants.gymnasium_plant": ("from_gymnasium",),
    "pde_sim_node.plants.process": ("from_process",),
    "pdeloop.api": ("Problem", "identify", "problem", "train"),
    "pdeloop.data_file": ("read_measurements",),
    "pdeloop.episode": ("projected_law", "rollout"),
    "pdeloop.finished_run": ("FinishedRun", "load_run"),
    "pdeloop.gradients": ("Gradients",),
    "pdeloop.plots": (
        "plot_behaviour",
        "plot_costs",
        "plot_episode",
        "plot_gains",
        "plot_spectrum",
        "plot_training",
    ),
    "pdeloop.training_warning": ("TrainingWarning",),
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names}
__all__ = sorted(_MODULES)


if not TYPE_CHECKING:  # a type checker knows the names above, and that there are no others

    def __getattr__(name: str) -> object:
        if name == "__version__":
            from importlib.metadata import version  # a tenth of a short command's time

            return version("pdeloop")
        if name not in _MODULES:
            raise AttributeError(f"module 'pdeloop' has no attribute {name!r}")
        return getattr(importlib.import_module(_MODULES[name]), name)

    def __dir__() -> list[str]:
        return [*__all__, "__version__"]
