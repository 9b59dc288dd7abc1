# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The plant of a user's `Dynamics`: M environments of it, in lock-step."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import numpy as np

from pde_sim_node.arguments import positive, whole
from pde_sim_node.definition import Definition, described, sources_of
from pde_sim_node.dynamics import Dynamics, refuse_misspelt
from pde_sim_node.plant import MEAN_FIELD, Adjoint, Plant
from pde_sim_node.plants.batch import BatchPlant
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array, float_array
from pdeloop.messages.cost import Cost
from pdeloop.messages.grid import Grid
from pdeloop.messages.own_code import OwnCodeError, called
from pdeloop.process.one_thread import one_thread

DIVERGED = 1e3
"""`divergence_bound` unless it is set, for each unit of the target's magnitude, if that is above 1."""
SETTABLE = ("horizon", "state_weight", "action_weight", "divergence_bound")
"""Attributes that a problem may override; weights only where they are numbers."""
WEIGHTS = ("state_weight", "action_weight")
FAR = 1e9
"""Magnitude of requested actions beyond all bounds, which tells of those of `actuated`."""


class DynamicsPlant(BatchPlant):
    """M environments of z_{k+1} = f(z_k, a_k).

    Parameters
    ----------
    dynamics
        The user's object; it is not changed.
    settings
        `SETTABLE` in place of what it has.

    Raises
    ------
    ValueError
        The class lacks something, or has something unusable; the message names it.
    """

    def __init__(self, dynamics: Dynamics, **settings: Any) -> None:
        self.dynamics, self.name = dynamics, type(dynamics).__qualname__
        if not hasattr(dynamics, "n_a"):
            raise ValueError(f"{self.name} must set n_a, the size of an action")
        for name in Dynamics.__annotations__:
            if inspect.ismethod(getattr(dynamics, name)):
                raise ValueError(
                    f"{self.name}: {name} is a method; expected its value (an attribute or property)"
                )
        refuse_misspelt(type(dynamics))
        given = {name: getattr(dynamics, name) for name in ("n_a", "sample_time", *SETTABLE)}
        given |= settings
        try:
            grid = self._checked_grid()
            cost = self._declared_cost(grid, given)
            for name, number in zip(WEIGHTS, cost.size, strict=True):
                given[name] = number
            aim = cost.field_target if cost.output is not None else cost.target
            largest = float(np.abs(aim).max())
            if given["divergence_bound"] is None:
                given["divergence_bound"] = DIVERGED * max(1.0, largest)
            super().__init__(grid=grid, target=cost.field_target, cost=cost, **given)
            if largest > self.divergence_bound:
                raise ValueError(
                    f"the target has the magnitude {largest:g}, and rollouts beyond divergence_bound, "
                    f"{self.divergence_bound:g}, count as diverged; set divergence_bound above it"
                )
            bounds = dynamics.action_low, dynamics.action_high, dynamics.zero_mean
            self.action_set = ActionSet(self.n_a, *bounds, rate=dynamics.action_rate)
        except ValueError as error:
            raise ValueError(f"{self.name}: {error}") from error
        declared = np.isfinite([self.action_set.low, self.action_set.high]).any()
        if self.actuated and not (declared or self.action_set.zero_mean):
            self.action_set = self._clipped_to() or self.action_set
        self.supports = None if dynamics.supports is None else self._checked_supports()
        self._mean: Array | None = None

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.name}: state of {self.n_z}, {self.n_a} actuators, "
            f"{self.horizon} steps of {self.sample_time:g})"
        )

    def _checked_grid(self) -> Grid:
        grid, n_z = self.dynamics.grid, whole("n_z", self.dynamics.n_z, 0)
        if grid is None:
            if not n_z:
                raise ValueError("expected n_z, the size of a state, or a grid")
            return Grid.vector(n_z)
        if n_z and n_z != grid.size:
            raise ValueError(f"n_z is {n_z}, but its grid has {grid.size} numbers")
        return grid

    def _declared_cost(self, grid: Grid, given: Mapping[str, Any]) -> Cost:
        """The cost as the class declares it; a problem may replace weights that are numbers."""
        own, weights = self.dynamics, {}
        for name in WEIGHTS:
            declared = getattr(own, name)
            weights[name] = given[name] if np.ndim(declared) == 0 else declared
            if np.ndim(weights[name]) == 0:
                if name == WEIGHTS[0] and not weights[name] and own.terminal_weight is not None:
                    raise ValueError(
                        f"{name} is 0; with a terminal_weight give it a small positive number, by "
                        "which models are judged on the way there"
                    )
                positive(name, weights[name])
        target = float_array("target", own.target)
        shape = (len(grid.components), *grid.shape)
        if own.output is None and target.shape[-len(shape) :] == shape:
            target = target.reshape(*target.shape[: -len(shape)], grid.size)
        return Cost(
            grid.size,
            whole("n_a", own.n_a, 1),
            whole("horizon", given["horizon"], 1),
            target=target,
            output=own.output,
            action_target=own.action_target,
            terminal_weight=own.terminal_weight,
            **weights,
        )

    def _checked_supports(self) -> Array:
        supports = float_array("supports", np.asarray(self.dynamics.supports))
        if supports.shape != (self.n_z, self.n_a):
            raise ValueError(
                f"{self.name}: supports must have shape {(self.n_z, self.n_a)}, got {supports.shape}"
            )
        return supports

    @property
    def definition(self) -> Definition:
        """The object's arguments, the source of its class, and a problem's overrides."""
        settings = {name: getattr(self, name) for name in SETTABLE}
        arguments = {
            f"physical.{name}": described(name, value)
            for name, value in self.dynamics.identity().items()
        }
        sources = sources_of(type(self.dynamics), Dynamics)[:-1]  # without that of Dynamics itself
        return Definition({"plant": self.name, **settings, **arguments}, sources)

    def adjoint(self) -> Adjoint:
        """The result of the object's `pull_back`; ValueError if it has none."""
        if type(self.dynamics).pull_back is Dynamics.pull_back:
            raise ValueError(
                f"{self.name} has no derivatives, which exact gradients need: it has no method "
                "pull_back(z, a, y)"
            )
        if self.action_set.rated:
            raise ValueError(
                f"{self.name} has rate limits, with which there are no exact gradients of the plant: "
                "leave action_rate out"
            )
        return _DynamicsAdjoint(self)

    def refined(self) -> Plant | None:
        """The plant of the object's `refined`."""
        finer = self.dynamics.refined()
        if finer is None:
            return None
        return DynamicsPlant(finer, **{name: getattr(self, name) for name in SETTABLE})

    def _draw(self, seed: int) -> Array:
        if seed == MEAN_FIELD:
            if self._mean is None:
                self._mean = self._state("mean_state", self._call("mean_state"))
            mean: Array = self._mean
            return mean
        drawn = self._call("initial_state", np.random.default_rng(seed))
        return self._state("initial_state", drawn)

    def _state(self, method: str, returned: Any) -> Array:
        """The return value of a method as an initial state."""
        state: Array = self._numbers(method, returned, 1)[0]
        if not np.isfinite(state).all():
            raise OwnCodeError(f"{self.name}.{method} returned NaN or infinity")
        if (largest := float(np.abs(state).max())) > self.divergence_bound:
            raise OwnCodeError(
                f"{self.name}.{method} returned a state of magnitude {largest:g}, and rollouts beyond "
                f"divergence_bound, {self.divergence_bound:g}, count as diverged; set divergence_bound "
                "above it"
            )
        return state

    def _advance(self) -> None:
        alive = np.flatnonzero(self.diverged_step < 0)
        if not alive.size:
            return
        states, totals = self.states[alive], self.totals[alive]
        self.actions[alive] = held = self.applied(self.actions[alive])
        lost = self._advanced(states, held, totals, self.step_index, alive)
        if self.step_index + 1 == self.horizon:
            self.cost.add_terminal(totals, states)
        self.states[alive], self.totals[alive] = states, totals
        self.diverged_step[alive[lost]] = self.step_index

    def _evaluate(self, states: Array, actions: Array) -> Array:
        costs = np.zeros(len(states))
        self._advanced(states, self.applied(actions), costs, 0, np.arange(len(states)))
        return costs

    @property
    def actuated(self) -> bool:
        """True if the class says itself what its actuators apply."""
        return type(self.dynamics).actuated is not Dynamics.actuated

    def applied(self, actions: Array) -> Array:
        """The actions that actuators apply for requested ones (M, n_a)."""
        if not self.actuated:
            return self.action_set.project(actions)
        taken = [float_array("it", self._call("actuated", a.copy())) for a in actions]
        held = np.stack(taken) if {a.shape for a in taken} == {(self.n_a,)} else np.zeros(0)
        if held.shape != actions.shape or not np.isfinite(held).all():
            raise OwnCodeError(f"{self.name}.actuated must return {self.n_a} finite numbers")
        return held

    def _clipped_to(self) -> ActionSet | None:
        """The bounds that `actuated` clips each action to; None if it does anything else."""
        try:
            ends = self.applied(np.full((2, self.n_a), [[-FAR], [FAR]]))
            if not (ends[0] < ends[1]).all():
                return None
            bounds = np.abs(ends) < FAR
            low, high = np.where(bounds, ends, np.copysign(np.inf, ends))
            least, most = np.where(bounds, ends, np.copysign(1.0, ends))
            rng = np.random.default_rng(0)
            tried = [least + rng.uniform(-1.0, 2.0, (32, self.n_a)) * (most - least)]
            tried += [10.0**power * rng.normal(size=(8, self.n_a)) for power in range(-6, 7)]
            asked, known = np.concatenate(tried), ActionSet(self.n_a, low, high)
            alike = np.allclose(self.applied(asked), known.project(asked), rtol=1e-12, atol=0.0)
        except OwnCodeError:  # a training says so where it matters
            return None
        return ActionSet(self.n_a, low, high, rate=self.action_set.rate) if alike else None

    def _advanced(
        self, states: Array, actions: Array, totals: Array, step: int, environments: Any
    ) -> Any:
        """Advance states in place and add their stage costs; which of them diverged."""
        new = self._next(states, actions, environments)
        self.cost.add(totals, states, actions, step)
        good = np.isfinite(totals) & (np.abs(new) <= self.divergence_bound).all(axis=1)
        states[good] = new[good]
        return ~good

    def _next(self, states: Array, actions: Array, environments: Any) -> Array:
        """The states of environments after a step, (M, n_z); they may be anything."""
        if self.dynamics.batched:
            return self._numbers("step", self._step(states, actions), len(states))
        one_by_one = zip(states, actions, strict=True)
        return np.concatenate([self._numbers("step", self._step(z, a), 1) for z, a in one_by_one])

    def _step(self, z: Array, a: Array, of: Dynamics | None = None) -> Any:
        own_z, own_a = z.copy(), a.copy()
        returned = self._call("step", own_z, own_a, of=of)
        for name, own, handed in (("z", own_z, z), ("a", own_a, a)):
            if not np.array_equal(own, handed):
                raise OwnCodeError(
                    f"{self.name}.step changes its argument {name}, which must stay as it is: work on "
                    f"a copy, {name}.copy()"
                )
        return returned

    def _call(self, method: str, *arguments: Any, of: Dynamics | None = None) -> Any:
        """Call a method of an object, with one LAPACK thread: more of them round otherwise."""
        function = getattr(of or self.dynamics, method)
        with one_thread(), np.errstate(over="ignore", invalid="ignore"):
            return called(f"{self.name}.{method}", function, *arguments)

    def _numbers(self, method: str, returned: Any, count: int) -> Array:
        """The return value of a method as (count, n_z) numbers."""
        batch = (count,) if self.dynamics.batched and method == "step" else ()
        grid = self.grid
        shapes = [(*batch, grid.size), (*batch, len(grid.components), *grid.shape)]
        if len(grid.components) == 1:
            shapes.append((*batch, *grid.shape))
        try:
            numbers = float_array("it", returned)
        except ValueError:
            got = f"{type(returned).__name__}, which is not an array of real numbers"
        else:
            if numbers.shape in shapes:
                # A copy: solvers like to return the array that they compute the next step in.
                return numbers.reshape(count, grid.size).copy()
            got = f"an array of shape {numbers.shape}"
        expected = " or ".join(str(shape) for shape in dict.fromkeys(shapes))
        raise OwnCodeError(
            f"{self.name}.{method} returned {got}; expected numbers of shape {expected}"
        )


class _DynamicsAdjoint:
    """Pulls covectors back with the object's `pull_back`."""

    def __init__(self, plant: DynamicsPlant) -> None:
        self._plant = plant

    def pull_back(self, states: Array, actions: Array, covectors: Array) -> tuple[Array, Array]:
        """See `pde_sim_node.plant.Adjoint.pull_back`."""
        plant = self._plant
        if plant.dynamics.batched:
            pulled = [plant._call("pull_back", states, actions, covectors)]
        else:
            each = zip(states, actions, covectors, strict=True)
            pulled = [plant._call("pull_back", z, a, y) for z, a, y in each]
        try:
            on_states, on_actions = (
                float_array("it", np.stack(part)) for part in zip(*pulled, strict=True)
            )
            return on_states.reshape(states.shape), on_actions.reshape(actions.shape)
        except (TypeError, ValueError) as error:
            raise OwnCodeError(
                f"{plant.name}.pull_back must return two arrays of {plant.n_z} and {plant.n_a} "
                f"numbers: {error}"
            ) from error
