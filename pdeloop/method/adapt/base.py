# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The interface of optimisers: they ask for rollouts and are told the results.

    while not optimizer.done:
        rollouts = optimizer.ask()                # the same until tell
        row = optimizer.tell([measure(rollout) for rollout in rollouts])

An optimiser runs no rollouts and uses no clock, so the same object serves a loop over topics and a
loop in one process. Its randomness is a pure function of (seed, tells), and `state` holds
everything that `restore` needs to continue as if nothing had happened, to the last bit.
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdeloop.messages.action_set import ANY_ACTION, ActionSet
from pdeloop.messages.array_files import checked_array
from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.method.laws.base import Law
from pdeloop.method.laws.linear import Linear, Observer
from pdeloop.method.models.base import DEFAULTS, FieldModelSettings
from pdeloop.method.models.sensed import Actuators
from pdeloop.method.seeds import field_seed
from pdeloop.method.settings import Settings as _Settings

Row = dict[str, float | int | bool | str]
State = dict[str, NDArray[np.generic]]


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One episode of one environment.

    Attributes
    ----------
    states : (T, n_z) or (T + 1, n_z) array
        z_0 .. z_{T-1}, and z_T if it is known.
    actions : (T, n_a) array
        a_k, held from z_k to z_{k+1}.

    A diverged episode may be shorter, or end in values that are not finite.
    """

    states: Array
    actions: Array


@dataclass(frozen=True, eq=False)
class Rollout:
    """An episode requested by an optimiser.

    Attributes
    ----------
    policy : (size,) or (n_a, 2 n_s)
        The law's parameters theta, of the shape that the optimiser was given.
    field_seed : int
        Seed of the initial field.
    """

    policy: Array
    field_seed: int


@dataclass(frozen=True, eq=False)
class RolloutResult:
    """The outcome of a rollout.

    Attributes
    ----------
    cost : float
        Its mean stage cost; meaningless if it diverged.
    diverged : bool
        True if the plant's state left its bound.
    trajectory : Trajectory or None
        Its states and actions, for optimisers that learn from trajectories.
    """

    cost: float
    diverged: bool = False
    trajectory: Trajectory | None = None

    @property
    def usable(self) -> bool:
        """True if the cost is a finite measurement."""
        return not self.diverged and bool(np.isfinite(self.cost))


@dataclass(frozen=True, eq=False)
class Record:
    """A rollout that was measured: its theta, and its mean stage cost, infinite if it diverged.

    states (L + 1, n_z) or (L, n_z), actions (L, n_a): all of the episode, or before it ran away; stamp:
    its number among the rollouts of the optimiser; -1: from before; field_seed: -1: not known.
    """

    policy: Array
    cost: float
    states: Array
    actions: Array
    stamp: int = -1
    field_seed: int = -1

    @property
    def usable(self) -> bool:
        """True if the rollout came to its end."""
        return bool(np.isfinite(self.cost))

    @property
    def acted_from(self) -> Array:
        """The states that an action followed, (L, n_z)."""
        return self.states[: len(self.actions)]


def of_law(records: Sequence[Record], law: Array) -> list[Record]:
    """The rollouts of a law."""
    return [record for record in records if np.array_equal(record.policy, law)]


def by_law(records: Sequence[Record]) -> list[list[Record]]:
    """The rollouts of each law, the first law first."""
    found: dict[bytes, list[Record]] = {}
    for record in records:
        found.setdefault(record.policy.tobytes(), []).append(record)
    return list(found.values())


@dataclass(frozen=True, eq=False)
class Context:
    """The problem as a model-based optimiser knows it.

    Attributes
    ----------
    U : (n_z, n_s) array
        Basis of the projected state.
    target : (n_z,) array
        z_r.
    state_weight, action_weight : float
        Q = state_weight I, R = action_weight I.
    horizon : int
        T, the steps of an episode.
    exploration : Trajectory
        The exploratory trajectory that the reduced model was identified from.
    measured : sequence of Record
        Rollouts from before the optimisation: those that checked the first law, and no control.
    action_set : ActionSet
        Admissible actions, the nearest of which is applied.
    noise : float
        Standard deviation of the noise on every number of the states; 0 for none, or unknown.
    sensors : int
        n_y, point sensors, of whose last readings the states consist; 0: the states are whole.
    sensor_positions : sequence of float
        Of each as a share of a periodic domain; none: at (j + 1/2) / n_y.
    actuator_positions : sequence of float
        Centres of the actuators as shares of the domain; none: equally spaced.
    actuator_widths : sequence of float
        Width of each as a share of the domain; none: not declared.
    periodic : bool
        Whether the states are fields on one periodic axis, which models of the whole field assume.
    line : bool
        Whether they are fields on one axis, or plain vectors.
    shape : tuple of int
        Points of each axis, where they are fields on several; none: they are not.
    further : sequence of Trajectory
        Other explorations, from other initial fields.
    cost : Cost or None
        The whole cost, where the weights and the target do not say it.
    law : Law, optional
        The law whose parameters theta is, with its derivatives if it has any.
    field_models : FieldModelSettings
        How models of the whole field are fitted and one is chosen.
    """

    U: Array
    target: Array
    state_weight: float
    action_weight: float
    horizon: int
    exploration: Trajectory
    measured: Sequence[Record] = ()
    action_set: ActionSet = ANY_ACTION
    noise: float = 0.0
    sensors: int = 0
    sensor_positions: Sequence[float] = ()
    actuator_positions: Sequence[float] = ()
    actuator_widths: Sequence[float] = ()
    periodic: bool = True
    line: bool = True
    shape: tuple[int, ...] = ()
    further: Sequence[Trajectory] = ()
    cost: Cost | None = None
    law: Law | None = None
    field_models: FieldModelSettings = DEFAULTS

    @property
    def with_constants(self) -> Linear | None:
        """The law, where constants are parts of its theta; None: the affine one."""
        law = self.law
        return law if isinstance(law, Linear) and "1" in law.acts.values() else None

    @property
    def every_exploration(self) -> Sequence[Trajectory]:
        """The exploration of the reduced model first."""
        return (self.exploration, *self.further)

    @cached_property
    def of_readings(self) -> bool:
        """Whether a filter's state tells what follows and the measured one does not.

        So it is with few sensors, and where its state has the last actions, of which U is 0.
        """
        return isinstance(self.law, Observer) and (self.sensors > 0 or not self.U.any(axis=0).all())

    @cached_property
    def stage(self) -> Cost:
        """The cost, whatever says it."""
        return self.cost or self.plain(self.target)

    def plain(self, target: Array, q: float | None = None) -> Cost:
        """q |x - x_r|^2 + r |a|^2, with x_r the target, and q that of the state if not given."""
        return Cost(
            len(target),
            self.exploration.actions.shape[1],
            self.horizon,
            state_weight=self.state_weight if q is None else q,
            action_weight=self.action_weight,
            target=target,
        )

    @cached_property
    def largest(self) -> float:
        """The largest magnitude of a number of the states that were explored."""
        return max(float(np.abs(own.states).max()) for own in self.every_exploration)

    @property
    def weights(self) -> Array | None:
        """W of the state's part |W (z - z_r)|^2 of the cost; None: a multiple of the identity."""
        return None if self.cost is None else self.cost.state_weights

    def cost_of(self, record: Record) -> float:
        """Mean stage cost, of q, r and z_r, of the recorded part of a rollout."""
        error, actions = record.acted_from - self.target, record.actions
        cost = self.state_weight * np.sum(error * error)
        cost += self.action_weight * np.sum(actions * actions)
        return float(cost) / max(len(actions), 1)

    @property
    def places(self) -> Array:
        """Of the sensors, (n_y,)."""
        return np.array(self.sensor_positions or (np.arange(self.sensors) + 0.5) / self.sensors)

    def actuators(self, n_a: int) -> Actuators:
        """What is declared of the n_a actuators."""
        centres = np.array(self.actuator_positions or (np.arange(n_a) + 0.5) / n_a)
        return Actuators(centres, np.array(self.actuator_widths or np.zeros(n_a)))


class Optimizer(Protocol):
    """The interface of an optimiser: declarations of its class, and methods of its objects.

    A history row holds JSON numbers, booleans and strings; a cost that is not finite is left out of
    it. Every row has `rollouts` (told so far, in total) and `diverged` (how many of those told now
    did).

    Parameters
    ----------
    policy0 : (size,) array
        The initial theta, the vector of the law's parameters, whichever law it is. An optimiser
        that `needs_affine_law` is given the matrix [K_a K_b], (n_a, 2 n_s).
    seed : int
        Determines everything random.
    rollouts : int
        The budget.
    settings : Settings
        Settings of the class's own type.
    context : Context, optional
        What is known of the problem, if it needs trajectories.
    """

    name: ClassVar[str]
    """The name that selects this optimiser."""
    Settings: ClassVar[type[_Settings]] = _Settings
    """Its constants; none if it does not say otherwise."""
    needs_trajectories: ClassVar[bool] = False
    """True if results have to come with their trajectories."""
    needs_affine_law: ClassVar[bool] = False
    """True if it knows the law a = K_a s + K_b s_r, and improves those gains alone."""
    also_improves: ClassVar[tuple[str, ...]] = ()
    """Names of other laws that it improves, whose theta it is given as a vector."""
    any_cost: ClassVar[bool] = False
    """True if it can use any quadratic cost (`pdeloop.messages.cost.Cost`), if it needs trajectories;
    otherwise scalar weights and a constant target. Optimisers that need only costs can."""
    judges_first_law: ClassVar[bool] = False
    """True if it always compares the first law with no control itself."""
    in_coordinates: ClassVar[bool] = False
    """True if it can work on coordinates in an orthonormal basis of the measured states in place of
    states of more than 2,048 numbers (`pdeloop.method.adapt.trajectories`)."""
    explorations: ClassVar[int] = 1
    """Rollouts of an exploration, from as many initial fields."""
    law_with_constants: ClassVar[str] = ""
    """The law preferred where the target changes from step to step, or is 0 and not where the plant
    rests; empty: as without."""
    law_with_actions: ClassVar[str] = ""
    """The law preferred where actions act late, which remembers them; empty: as without."""
    law_of_sensors: ClassVar[str] = ""
    """The law preferred where the state is that of few sensors; empty: as without."""
    laws_of_sensors: ClassVar[Mapping[str, str]] = {}
    """By the name of a law of the whole state, the one that few sensors have in its place."""
    iteration_rollouts: ClassVar[int] = 0
    """Rollouts of an iteration, for a budget that is counted in them; 0: it counts none."""
    preferences: ClassVar[Mapping[str, Any]] = {}
    """Parameters of the training with the defaults that it was tuned for."""

    def __init__(
        self,
        policy0: ArrayLike,
        *,
        seed: int,
        rollouts: int,
        settings: Any,
        context: Context | None = None,
    ) -> None: ...

    @classmethod
    def for_context(cls, context: Context) -> "type[Optimizer]":
        """The class that is made for a problem: this one, or one derived from it."""
        return cls

    @classmethod
    def first_step(cls, settings: Any) -> int:
        """Rollouts of its first step, without which there is nothing to adapt with."""
        return 1

    @classmethod
    def settings_of(cls, values: Mapping[str, Any], given: Mapping[str, Any]) -> Any:
        """The settings of a training with these parameters; given: those of `Settings` by name."""
        return cls.Settings(**given)

    @property
    def policy(self) -> Array:
        """The current policy, in its initial shape; always finite."""

    @property
    def tells(self) -> int:
        """Number of calls of `tell`."""

    @property
    def done(self) -> bool:
        """True once no further rollouts are needed."""

    def ask(self) -> list[Rollout]:
        """The rollouts needed next.

        Returns
        -------
        list of Rollout
            The same ones on every call until `tell`; none when done.
        """

    def tell(self, results: Sequence[RolloutResult]) -> Row:
        """Take the results of the rollouts that were asked for.

        Parameters
        ----------
        results
            One for each rollout of `ask`, in the same order.

        Returns
        -------
        dict
            A row of the history.

        Raises
        ------
        ValueError
            There are more or fewer results.
        """

    def state(self) -> State:
        """Everything a checkpoint needs.

        Returns
        -------
        dict of str to array
            Arrays without objects, as `numpy.savez` stores them.
        """

    def restore(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Continue from the state of an optimiser that was made with the same arguments.

        Parameters
        ----------
        state : dict of str to array, (...)
            As `state` returned it.

        Raises
        ------
        ValueError
            An array is missing, or has another shape or type.
        """


def checked_theta(theta: ArrayLike) -> Array:
    """A finite copy of a law's parameters, of any shape, or a ValueError."""
    array = np.array(theta, dtype=np.float64, order="C")
    if not array.size:
        raise ValueError("a policy must have parameters, but it is empty.")
    if not np.isfinite(array).all():
        raise ValueError("a policy must be finite, but there is NaN or infinity in it.")
    return array


def require_positive(**values: float) -> None:
    """A ValueError that names the first value that is not positive and finite."""
    for name, value in values.items():
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name} must be positive and finite, but it is {value}.")


def require_results(results: Sequence[RolloutResult], expected: int) -> None:
    """A ValueError unless there is one result per rollout that was asked for."""
    if not expected:
        raise ValueError(
            "the optimiser is done and asked for no rollouts; check `done` before `tell`."
        )
    if len(results) != expected:
        raise ValueError(f"tell needs one result per rollout, {expected}, but got {len(results)}.")


def part_of(state: Mapping[str, NDArray[np.generic]], prefix: str) -> State:
    """The arrays with a prefix, without it."""
    names = [name for name in state if name.startswith(prefix)]
    return {name.removeprefix(prefix): state[name] for name in names}


def numbers_of(
    state: Mapping[str, NDArray[np.generic]], kinds: Mapping[str, str], *, finite: bool = True
) -> dict[str, Any]:
    """The single numbers and texts of these names in a state, by their NumPy kinds; or a ValueError."""
    return {
        name: checked_array(state, name, kind, (), finite=finite).item()
        for name, kind in kinds.items()
    }


_STREAM = 0x53544550  # "STEP"; large, as in pdeloop.method.seeds


class StepOptimizer(Optimizer):
    """Base class of optimisers whose steps all have the same number of rollouts.

    A derived class has a `name` and defines `rollouts` and `update`. The budget, the counts,
    the history and checkpoints are handled here.

    Parameters
    ----------
    policy0, seed, rollouts, settings, context
        As for `Optimizer`.

    Attributes
    ----------
    policy : array
        The law's parameters theta so far; `update` assigns the next one.
    tells : int
        Steps so far.
    settings, context
        As they were given.
    """

    step_rollouts: ClassVar[int] = 1
    """Rollouts of a step."""
    kept: ClassVar[Sequence[str]] = ()
    """Float64 arrays of a fixed shape that a checkpoint holds in addition to the policy."""

    def __init__(
        self,
        policy0: ArrayLike,
        *,
        seed: int,
        rollouts: int,
        settings: Any,
        context: Context | None = None,
    ) -> None:
        require_positive(rollouts=rollouts)
        self._policy = checked_theta(policy0)
        self._seed, self._budget, self._tells = seed, rollouts, 0
        self.settings, self.context = settings, context

    @abstractmethod
    def rollouts(self) -> list[Rollout]:
        """The rollouts of this step.

        Returns
        -------
        list of Rollout
            `step_rollouts` of them, which depend on nothing but `policy`, `generator`, `field_seed` and
            what is `kept`.
        """

    @abstractmethod
    def update(self, results: Sequence[RolloutResult]) -> Row:
        """Improve `policy` by the outcome of this step.

        Parameters
        ----------
        results
            The results of `rollouts`, in the same order; one that is not `usable` diverged.

        Returns
        -------
        dict
            What the history records of this step: JSON numbers, booleans and strings by name.
        """

    @classmethod
    def first_step(cls, settings: Any) -> int:
        return cls.step_rollouts

    @property
    def generator(self) -> np.random.Generator:
        """A random number generator for this step, in its initial state at each access."""
        return np.random.default_rng([self._seed, _STREAM, self._tells])

    @property
    def field_seed(self) -> int:
        """The seed of an initial field for this step."""
        return field_seed(self._seed, self._tells)

    @property
    def policy(self) -> Array:
        return self._policy.copy()

    @policy.setter
    def policy(self, policy: ArrayLike) -> None:
        self._policy = checked_theta(policy)

    @property
    def tells(self) -> int:
        return self._tells

    @property
    def done(self) -> bool:
        return (self._tells + 1) * self.step_rollouts > self._budget

    def ask(self) -> list[Rollout]:
        """The rollouts of this step; see `Optimizer.ask`.

        Returns
        -------
        list of Rollout

        Raises
        ------
        ValueError
            `rollouts` returned more or fewer than `step_rollouts`.
        """
        asked = [] if self.done else self.rollouts()
        if asked and isinstance(asked, Sequence) and len(asked) != self.step_rollouts:
            raise ValueError(
                f"{type(self).__name__}.rollouts returned {len(asked)}; expected step_rollouts, "
                f"which is {self.step_rollouts}"
            )
        return asked

    def tell(self, results: Sequence[RolloutResult]) -> Row:
        require_results(results, 0 if self.done else self.step_rollouts)
        row: Row = {
            "rollouts": (self._tells + 1) * self.step_rollouts,
            "diverged": sum(not result.usable for result in results),
        }
        usable = [result.cost for result in results if result.usable]
        with np.errstate(over="ignore"):
            cost = float(np.mean(usable)) if usable else np.inf
        if np.isfinite(cost):
            row["cost"] = cost
        found = self.update(results)
        if not isinstance(found, Mapping):
            kind = type(found).__name__
            raise ValueError(f"{type(self).__name__}.update returned {kind}; expected a dict")
        row |= found
        self._tells += 1
        return row

    def state(self) -> State:
        own = {name: np.array(getattr(self, name)) for name in self.kept}
        return {"policy": self.policy, "tells": np.array(self._tells), **own}

    def restore(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        policy = checked_array(state, "policy", "f", self._policy.shape).copy()
        tells = int(checked_array(state, "tells", "i", ()))
        own = {
            name: checked_array(state, name, "f", np.shape(getattr(self, name)))
            for name in self.kept
        }
        self._policy, self._tells = policy, tells
        for name, value in own.items():
            setattr(self, name, value.copy())
