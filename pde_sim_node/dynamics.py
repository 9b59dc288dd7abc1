# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A plant of your own: z_{k+1} = f(z_k, a_k) of one state, and the numbers of its control task.

>>> import numpy as np
>>> class Chain(Dynamics):
...     n_z, n_a, horizon = 16, 2, 30
...     A = 0.9 * np.eye(16) + 0.05 * np.eye(16, k=1) + 0.05 * np.eye(16, k=-1)
...     B = np.eye(16, 2)
...
...     def initial_state(self, rng):
...         return rng.normal(size=16)
...
...     def step(self, z, a):
...         return self.A @ z + self.B @ a
>>> import pdeloop
>>> run = pdeloop.train(plant=Chain(), reduced_order=4, rollouts=12)
>>> bool(run.costs["adapted"].mean() < run.costs["none"].mean())
True
"""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from typing import Any, ClassVar

import numpy as np

from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.messages.grid import Grid

SPELT_ALIKE = 0.83
"""Similarity of names, of difflib, from which one is taken for a misspelt other one."""
MEAN_DRAWS = 100
"""Initial states whose average stands for the mean of their distribution."""


class Dynamics(ABC):
    """Base class of one environment of a plant, z_{k+1} = f(z_k, a_k).

    A derived class defines the sizes of state and action, the initial state and the step. Batches of
    environments, seeds, costs, divergence, noise, sensors and everything else of a plant are provided.
    Attributes that a class does not set have the values given here. They may also be set in
    ``__init__``, whose arguments are the plant's parameters (`physical.NAME` in a problem's file).

    The same arguments must give the same bits: take random numbers only from the given ``rng``, and
    keep no state between calls unless the class is ``stateful``. `step` has one LAPACK thread.

    Attributes
    ----------
    n_a : int
        Size of an action; required.
    n_z : int
        Size of a state; required unless ``grid`` is set.
    grid : Grid or None
        Meaning of a state's numbers; None: a plain vector.
    target : array of n_z numbers, or number
        State z_r to be tracked, or the target of the output; one row per step: the target of each step.
    horizon : int
        Steps of an episode.
    sample_time : float
        Time (s) of a step.
    state_weight, action_weight : number, diagonal or matrix
        Q and R of the stage cost (z - z_r)'Q(z - z_r) + (a - a_r)'R(a - a_r); a number q is q I.
    output : (n_y, n_z) or None
        C, with which y = C z takes the place of z in the cost.
    action_target : number or (n_a,)
        a_r.
    terminal_weight : number, diagonal or matrix
        Weight of the state after the last step.
    action_low, action_high : number or (n_a,)
        Bounds of the actions; None: there are none. An action outside is replaced by the nearest
        admissible one.
    action_rate : number or (n_a,)
        Largest change of an action from one step to the next. Before the first step it is the middle
        between two bounds, else 0 or the point nearest to it (`pdeloop.messages.action_set`).
    zero_mean : bool
        Whether the actions of a step must have mean zero.
    divergence_bound : float or None
        A new state that is not finite or exceeds this magnitude anywhere ends the rollout; None: 1000
        times the target's magnitude, if that is above 1.
    supports : (n_z, n_a) or None
        Where each actuator acts, for pictures.
    batched : bool
        Whether `step` takes M states (M, n_z) and actions (M, n_a) at once. The result for
        one must not depend on the others, to the last bit; a matrix product does not guarantee this.
    stateful : bool
        Whether the object keeps a state of its own between calls, as a simulator that cannot be set to
        any z does. `initial_state` then begins an episode, `step` continues it and gets as z what it
        returned last, and each environment has an object of its own, made with the same arguments.

    Examples
    --------
    See the module. docs/bring-your-own.md has more.
    """

    n_a: int
    n_z: int = 0
    grid: Grid | None = None
    target: Any = 0.0
    horizon: int = 100
    sample_time: float = 1.0
    state_weight: Any = 1.0
    action_weight: Any = 1.0
    output: Any = None
    action_target: Any = 0.0
    terminal_weight: Any = 0.0
    action_low: Any = -np.inf
    action_high: Any = np.inf
    action_rate: Any = np.inf
    zero_mean: bool = False
    divergence_bound: float | None = None
    supports: Array | None = None
    batched: ClassVar[bool] = False
    stateful: ClassVar[bool] = False

    def __new__(cls, *arguments: Any, **named: Any) -> Dynamics:
        """Remember the arguments, with which other processes make the plant again."""
        made = super().__new__(cls)
        if arguments or named:
            object.__setattr__(made, "_given", (arguments, named))
        return made

    @abstractmethod
    def initial_state(self, rng: np.random.Generator) -> Array:
        """Draw a state from the distribution of initial states.

        Parameters
        ----------
        rng
            Source of everything random.

        Returns
        -------
        (n_z,), or the grid's shape
        """

    @abstractmethod
    def step(self, z: Array, a: Array) -> Array:
        """The state after a sampling time in which the action is held.

        Parameters
        ----------
        z : (n_z,)
            z_k, a copy, which must not be changed.
        a : (n_a,)
            a_k.

        Returns
        -------
        (n_z,), or the grid's shape
            z_{k+1}.
        """

    def actuated(self, a: Array) -> Array:
        """The action that is applied, and counted in the cost, for a requested one.

        Parameters
        ----------
        a : (n_a,)
            An action, a copy.

        Returns
        -------
        (n_a,)
            The action passed to `step`; by default the nearest one that ``action_low``,
            ``action_high`` and ``zero_mean`` admit.
        """
        bounds = self.action_low, self.action_high, self.zero_mean
        return ActionSet(self.n_a, *bounds).project(a)

    def mean_state(self) -> Array:
        """The mean initial state, from which reports show the controllers.

        Returns
        -------
        (n_z,), or the grid's shape
            By default the average of 100 draws.
        """
        drawn = [self.initial_state(np.random.default_rng(seed)) for seed in range(MEAN_DRAWS)]
        mean: Array = np.mean(drawn, axis=0)
        return mean

    def identity(self) -> Mapping[str, Any]:
        """The arguments by which it is told from another plant of its class, for the fingerprint.

        Returns
        -------
        dict
            By name; all arguments by default.
        """
        return arguments_of(self)

    def pull_back(self, z: Array, a: Array, y: Array) -> tuple[Array, Array]:
        """The transposed derivative of `step`, for `pdeloop.Gradients`; not needed elsewhere.

        Parameters
        ----------
        z : (n_z,)
            z_k.
        a : (n_a,)
            a_k.
        y : (n_z,)
            Any vector.

        Returns
        -------
        (n_z,), (n_a,)
            (df/dz)^T y and (df/da)^T y.

        Raises
        ------
        NotImplementedError
            The class has none.
        """
        raise NotImplementedError

    def refined(self) -> Dynamics | None:
        """The same with half the internal time step, for `pdeloop check`.

        Returns
        -------
        Dynamics or None
            None where there is no step to halve.
        """
        return None


_ELSEWHERE = {
    "action_bounds": "'action_low' and 'action_high'",
    "action_limit": "'action_low' and 'action_high'",
    "bounds": "'action_low' and 'action_high'",
} | {
    name: f"the parameter of a training, {name}=… or --set {name}=…"
    for name in ("measurement_noise", "process_noise", "sensors", "exploration_variance")
}
"""Names of parameters that a class could take for attributes, and what is meant."""


def refuse_misspelt(kind: type[Dynamics]) -> None:
    """ValueError where a class sets a name close to one that it could set and does not."""
    known = {name for name in (*vars(Dynamics), *Dynamics.__annotations__) if name[0] != "_"}
    own = {name for cls in kind.__mro__ if cls not in Dynamics.__mro__ for name in vars(cls)}
    for name in sorted(name for name in own - known if name[0] != "_"):
        if name in _ELSEWHERE:
            raise ValueError(
                f"{kind.__qualname__} sets '{name}', which a plant does not have; expected "
                f"{_ELSEWHERE[name]}. An attribute of your own may begin with _"
            )
        for meant in get_close_matches(name, known - own, n=1, cutoff=SPELT_ALIKE):
            raise ValueError(
                f"{kind.__qualname__} sets '{name}', which a plant does not have; did you mean "
                f"'{meant}'? An attribute of your own may begin with _"
            )


def signature_of(maker: Callable[..., Any]) -> inspect.Signature:
    """The signature of a function or class; of a class derived from Dynamics, that of `__init__`."""
    if not (isinstance(maker, type) and issubclass(maker, Dynamics)):
        return inspect.signature(maker)
    if maker.__init__ is object.__init__:
        return inspect.Signature()
    _, *parameters = inspect.signature(maker.__init__).parameters.values()
    return inspect.Signature(parameters)


def made_again(dynamics: Dynamics) -> Dynamics:
    """Another object of its class, made with the same arguments."""
    arguments, named = getattr(dynamics, "_given", ((), {}))
    return type(dynamics)(*arguments, **named)


def arguments_of(dynamics: Dynamics) -> Mapping[str, Any]:
    """The arguments that an object was made with, by name, defaults included."""
    arguments, named = getattr(dynamics, "_given", ((), {}))
    bound = signature_of(type(dynamics)).bind(*arguments, **named)
    bound.apply_defaults()
    found: dict[str, Any] = {}
    for name, value in bound.arguments.items():
        further = bound.signature.parameters[name].kind is inspect.Parameter.VAR_KEYWORD
        found |= value if further else {name: value}
    return found
