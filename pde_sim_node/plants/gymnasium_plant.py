# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A Gymnasium environment with box spaces as a plant: the state is its observation."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pde_sim_node.definition import Definition, described, source_of
from pde_sim_node.plant import MEAN_FIELD
from pde_sim_node.plants.batch import BatchPlant
from pde_sim_node.plants.gymnasium_spaces import Boxes
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.messages.grid import Grid
from pdeloop.messages.long_calls import LONG_CALLS
from pdeloop.messages.own_code import OwnCodeError, called
from pdeloop.messages.text import shown

if TYPE_CHECKING:
    from gymnasium import Env

Numbers: TypeAlias = ArrayLike | Mapping[str, ArrayLike]
_OUTCOMES = ("reward", "terminated", "truncated")
_TERMINATIONS = ("success", "failure")
_SUCCESS = ("is_success", "success")
"""Names by which environments say in a step's info whether their goal is reached."""
_STEP = f"observation, {', '.join(_OUTCOMES)}, info"
"""Names of a step's results."""


def from_gymnasium(
    env: Env[Any, Any] | str,
    *,
    target: Numbers | None = None,
    state_weight: Numbers = 1.0,
    action_weight: Numbers = 1.0,
    action_rate: Numbers | None = None,
    horizon: int = 0,
    sample_time: float = 1.0,
    divergence_bound: float = 1e6,
    termination: str | None = None,
) -> GymnasiumPlant:
    """A plant from a Gymnasium environment with box spaces, also in Dict and Tuple spaces.

    Its state is the observation, the boxes one after the other, and its actions saturate at the bounds
    of the action space. With a target the stage cost is that of every plant, q |o - o_r|^2 + r |a|^2.
    Without one it is minus the reward, from which only optimisers that need costs alone can learn, such
    as two_point. The mean field is the initial state of seed 0.

    Parameters
    ----------
    env
        The environment, which is copied, or its id for `gymnasium.make`.
    target : (n_z,) or mapping, optional
        Observation to be tracked; or, of a Dict or Tuple, numbers by key ("tank.level"), and what has
        no key is not tracked.
    state_weight : number, (n_z,) or mapping
        q: of all, of each number, or by key (0 for keys that are left out).
    action_weight : number, (n_a,) or mapping
        r: the same, with 1 for keys that are left out.
    action_rate : number, (n_a,) or mapping, optional
        Largest change of each action in a step, which a space does not tell: the same, without a limit
        for keys that are left out.
    horizon
        Steps of an episode; 0: the limit in the environment's specification, or of its TimeLimit.
    sample_time
        Time (s) of a step.
    divergence_bound
        An observation beyond this magnitude has diverged.
    termination : {"success", "failure"}, optional
        What it means that the environment terminates. After a success the episode goes on to its
        horizon: with a target the environment is stepped on and every step costs, as it is to stay
        there; without one it is left, and no reward counts any more, as in Gymnasium. A failure ends
        the rollout as a divergence does. None: what `is_success` or `success` in the step's info say,
        and a success where there is neither. The first termination is said.

    Returns
    -------
    GymnasiumPlant

    Raises
    ------
    ValueError
        The spaces are not boxes, the length of an episode is unknown, or the target or `termination`
        does not fit.
    """
    import gymnasium

    try:
        made: Env[Any, Any] = gymnasium.make(env) if isinstance(env, str) else env
    except gymnasium.error.Error as error:
        raise ValueError(f"Gymnasium cannot make the environment {shown(env)}: {error}") from error
    if not isinstance(made, gymnasium.Env):
        raise ValueError(f"env must be a gymnasium.Env or the id of one, got {shown(made)}")
    limit = made.spec.max_episode_steps if made.spec is not None else None
    if limit is None and made.has_wrapper_attr("_max_episode_steps"):  # a TimeLimit by itself
        limit = made.get_wrapper_attr("_max_episode_steps")
    if termination not in (None, *_TERMINATIONS):
        raise ValueError(
            f"termination is {shown(termination)}; expected 'success' or 'failure', or None: as the "
            "environment's info says"
        )
    if not (horizon or limit):
        raise ValueError(f"{made} has no limit on the length of an episode: give horizon")
    return GymnasiumPlant(
        made,
        target=target,
        horizon=horizon or limit or 0,
        sample_time=sample_time,
        state_weight=state_weight,
        action_weight=action_weight,
        action_rate=action_rate,
        divergence_bound=divergence_bound,
        termination=termination,
    )


class GymnasiumPlant(BatchPlant):
    """M copies of an environment in lock-step; see `from_gymnasium`."""

    settable = False

    def __init__(
        self,
        env: Env[Any, Any],
        *,
        target: Numbers | None,
        action_rate: Numbers | None,
        termination: str | None,
        **settings: Any,
    ) -> None:
        self._observed = Boxes("observation", env.observation_space)
        self._acted = Boxes("action", env.action_space)
        n_z, n_a, self.quadratic = self._observed.size, self._acted.size, target is not None
        given = self._observed.by_name("target", np.zeros(n_z) if target is None else target, 0.0)
        wanted = np.ravel(given)
        if wanted.shape != (n_z,) or not np.isfinite(wanted).all():
            raise ValueError(f"target must be {n_z} finite numbers, got shape {wanted.shape}")
        if isinstance(target, Mapping) and isinstance(
            weight := settings["state_weight"], int | float
        ):
            settings["state_weight"] = dict.fromkeys(target, weight)  # others are not tracked
        weights = {
            "state_weight": self._observed.by_name("state_weight", settings["state_weight"], 0.0),
            "action_weight": self._acted.by_name("action_weight", settings["action_weight"], 1.0),
        }
        cost = Cost(n_z, n_a, settings["horizon"], target=wanted, **weights)
        settings["state_weight"], settings["action_weight"] = cost.size
        self._first = env
        self._envs: list[Env[Any, Any]] = []
        self.termination, self._said = termination, False
        super().__init__(grid=Grid.vector(n_z, "o"), n_a=n_a, target=wanted, cost=cost, **settings)
        rate = np.inf if action_rate is None else action_rate
        limits = self._acted.by_name("action_rate", rate, np.inf)
        self.action_set = ActionSet(n_a, self._acted.low, self._acted.high, rate=limits)

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self._first}: state of {self.n_z}, {self.n_a} actuators, "
            f"{self.horizon} steps)"
        )

    @property
    def definition(self) -> Definition:
        """The specification, the source of the environment's class, and the settings."""
        spec, inner = self._first.spec, self._first.unwrapped
        names = ("horizon", "sample_time", "state_weight", "action_weight", "divergence_bound")
        values = {name: getattr(self, name) for name in names}
        values["target"] = self.target.tolist() if self.quadratic else None
        if not self.cost.plain:
            values["cost"] = self.cost.texts
        if self.action_set.rated:
            values["action_rate"] = self.action_set.rate.tolist()
        if self.termination is not None:
            values["termination"] = self.termination
        values["environment"] = (
            json.loads(spec.to_json()) if spec is not None else described("env", vars(inner))
        )
        return Definition(values, [source_of(type(inner))])

    def _allocate(self, batch: int) -> None:
        super()._allocate(batch)
        self._terminated = np.full(batch, -1, dtype=np.int64)
        """The step in which each environment terminated with success, or -1."""

    def reset(self, seeds: ArrayLike, noise: NDArray[np.int64] | None = None) -> Array:
        """Begin an episode; see `pde_sim_node.plant.Plant.reset`."""
        given = np.asarray(seeds)
        states = super().reset(seeds)
        self._terminated.fill(-1)
        while len(self._envs) < len(states):
            self._envs.append(called(f"a deep copy of {self._first}", copy.deepcopy, self._first))
        for m, seed in enumerate(given.tolist()):
            self._begin(self._envs[m], seed)
        return states

    def restart(self, environments: NDArray[np.intp], seeds: ArrayLike) -> Array:
        """Begin again in some; see `pde_sim_node.plant.Plant.restart`."""
        states = super().restart(environments, seeds)
        self._terminated[environments] = -1
        for m, seed in zip(environments.tolist(), np.asarray(seeds).tolist(), strict=True):
            self._begin(self._envs[m], seed)
        return states

    def _draw(self, seed: int) -> Array:
        return self._begin(self._first, seed)

    def _begin(self, env: Env[Any, Any], seed: int) -> Array:
        own = partial(env.reset, seed=0 if seed == MEAN_FIELD else seed)
        observation, _ = self._returned("reset", own, names="observation, info")
        state = self._numbers("reset", observation)
        if not np.isfinite(state).all():
            where = self._observed.infinite(state)
            raise OwnCodeError(f"{self._first}.reset returned NaN or infinity{where}")
        return state

    def _returned(
        self, method: str, function: Callable[..., Any], *given: Any, names: str
    ) -> tuple[Any, ...]:
        """A method's results: the values of these names."""
        found = called(f"{self._first}.{method}", function, *given)
        if not isinstance(found, tuple) or len(found) != len(names.split()):
            size = f" of {len(found)}" if isinstance(found, tuple) else ""
            raise OwnCodeError(
                f"{self._first}.{method} returned a {type(found).__name__}{size}; expected the tuple "
                f"({names})"
            )
        return found

    def _number(self, name: str, value: Any) -> float:
        try:
            return float(value)
        except (TypeError, ValueError, OverflowError) as error:
            raise OwnCodeError(
                f"{self._first}.step returned the {name} {shown(value)}; expected a number"
            ) from error

    def _numbers(self, method: str, observation: Any) -> Array:
        try:
            numbers = self._observed.vector(observation)  # a copy: it may be reused
        except (TypeError, ValueError, OverflowError, LookupError) as error:
            raise OwnCodeError(
                f"{self._first}.{method} returned the observation {shown(observation)}; expected "
                f"{self.n_z} numbers"
            ) from error
        if numbers.size != self.n_z:
            one = self._observed.names == [""]
            got = f"shape {np.shape(observation)}" if one else f"{numbers.size} numbers"
            raise OwnCodeError(
                f"{self._first}.{method} returned an observation of {got}; expected {self.n_z} numbers"
            )
        return numbers

    def _advance(self) -> None:
        self.action_set.project(self.actions, out=self.actions)
        for m in np.flatnonzero(self.diverged_step < 0):
            over = self._terminated[m] >= 0
            if over and not self.quadratic:
                continue
            action = self._acted.member(self.actions[m])
            try:
                observation, *rest = self._returned("step", self._envs[m].step, action, names=_STEP)
            except OwnCodeError as error:
                if not over:
                    raise
                raise OwnCodeError(
                    f"{error} (it terminated at step {self._terminated[m]}, and is stepped on: if that "
                    "is no success, give termination='failure')"
                ) from error
            reward, terminated, truncated = (
                self._number(name, value) for name, value in zip(_OUTCOMES, rest[:3], strict=True)
            )
            if truncated and self.step_index + 1 < self.horizon:
                raise OwnCodeError(
                    f"{self._first} ends an episode after {self.step_index + 1} steps, and its horizon "
                    f"is {self.horizon}: give a horizon of {self.step_index + 1} or less"
                )
            if self.quadratic:
                own = slice(m, m + 1)
                self.cost.add(
                    self.totals[own], self.states[own], self.actions[own], self.step_index
                )
            else:
                self.totals[m] -= reward
            new = self._numbers("step", observation)
            good = (np.abs(new) <= self.divergence_bound).all() and np.isfinite(self.totals[m])
            failed = bool(terminated) and not over and self._terminates(int(m), rest[3])
            if failed or not good:
                self.diverged_step[m] = self.step_index
            else:
                self.states[m] = new

    def _terminates(self, m: int, info: Any) -> bool:
        """Note that environment m terminates, and say so the first time; whether it is a failure."""
        info = info if isinstance(info, Mapping) else {}
        known = [bool(np.all(info[name])) for name in _SUCCESS if name in info]
        kind = self.termination or ("failure" if known and not any(known) else "success")
        failed = kind == "failure"
        if not failed:
            self._terminated[m] = self.step_index
        if not self._said:
            self._said = True
            source = "" if self.termination or known else ", as its info says nothing of it"
            other = "success" if failed else "failure"
            meaning = "ends the rollout as a divergence does" if failed else "ends no rollout"
            LONG_CALLS.tell(
                f"{self._first} terminated at step {self.step_index}: taken for a {kind}{source}, "
                f"which {meaning}; termination='{other}' takes it for a {other}"
            )
        return failed

    def _evaluate(self, states: Array, actions: Array) -> Array:
        raise ValueError(f"{self!r} cannot step from a given state: its state cannot be set")
