# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The Python API: problems, their plants and explorations, identification and training."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, fields
from difflib import get_close_matches
from inspect import signature
from io import StringIO
from numbers import Integral
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TextIO

import numpy as np
from numpy.typing import ArrayLike

from controller_node import identification
from pde_sim_node.build import build_plant, complete
from pde_sim_node.dynamics import Dynamics
from pde_sim_node.equations import OWN_EQUATIONS, configured_equation
from pde_sim_node.plant import Plant
from pde_sim_node.plants.loading import OWN_PLANTS, hand_over
from pdeloop.display import Display
from pdeloop.finished_run import FinishedRun, load_run
from pdeloop.in_process import LocalPair
from pdeloop.interruption import Interruption
from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.messages.own_code import refuse_while_executed
from pdeloop.messages.parameters import table
from pdeloop.messages.problem import load_parameters
from pdeloop.messages.spec import FREE, flatten
from pdeloop.method.adapt.registry import OWN_OPTIMIZERS
from pdeloop.method.laws.base import Law
from pdeloop.method.laws.registry import OWN_LAWS
from pdeloop.method.reduce.identifiability import IdentifiabilityWarning
from pdeloop.method.reduce.reduced_model import ReducedModel
from pdeloop.method.reduce.regression import has_offset
from pdeloop.pairs import Transport
from pdeloop.problem_values import problem_values
from pdeloop.training_run import begin, carry_out, continuing
from pdeloop.training_warning import TrainingWarning
from tuner_node import narration
from tuner_node.build import build_training
from tuner_node.optimizer_parameters import training_parameters

__all__ = ["Problem", "identify", "problem", "train"]


@dataclass(frozen=True, eq=False)
class Problem:
    """A PDE with its grid, actuators, cost and horizon, and the settings of the method for it.

    Attributes
    ----------
    source : str
        Name or YAML file that it was made from; empty for a plant alone.
    given : dict
        The parameters that replace those of the file.
    values : dict
        All parameters, by the names of docs/parameters.md.
    """

    source: str
    given: Mapping[str, Any]
    values: Mapping[str, Any]

    def __repr__(self) -> str:
        given = "".join(f", {name}={value!r}" for name, value in self.given.items())
        return f"Problem({self.source!r}{given})"

    def plant(self, batch: int = 1) -> Plant:
        """A plant of M = `batch` environments, at the start of an episode with the fields 0 .. M - 1.

        `Plant.reset` begins another episode, of any M. `states` (M, n_z) are the fields, `step`
        takes actions (M, n_a), and `episode_costs` has the costs so far.

        Parameters
        ----------
        batch
            M, at least 1.

        Returns
        -------
        Plant
            With noise, limits and sensors where the problem has them.

        Raises
        ------
        ValueError
            The parameters do not fit together, or `batch` is less than 1.
        """
        _check_count("batch", batch, 1)
        plant = build_plant(self.values)
        plant.reset(np.arange(batch))
        return plant

    def explore(self, seed: int = 0) -> tuple[Array, Array]:
        """The exploratory episode that a training with this seed begins with.

        Parameters
        ----------
        seed
            Seed of the training, 0 or more.

        Returns
        -------
        states : (T + 1, state_size) array
            z_0 .. z_T as they are measured.
        actions : (T, n_a) array
            Drawn around the middle of the actuators' bounds, or 0, whatever the states.

        Raises
        ------
        ValueError
            The plant diverged, or the seed is out of range.
        """
        own = {"seed": seed, "seeds": 1, "model": ""}
        values = training_parameters(self.source, {**self.given, **own})
        training = build_training({**self.values, **values})
        batch = training.next_batch()
        assert batch is not None
        episode = LocalPair(self.values).roll_out(batch)
        if (lost := int(episode.costs.diverged_step[0])) >= 0:
            raise ValueError(
                f"the plant diverged under exploration at step {lost}; lower exploration_variance, or "
                "measurement_noise, which raises it"
            )
        return episode.states[:, 0], episode.actions[:, 0]


def problem(
    source: str | Path | None = None,
    *,
    plant: Dynamics | Plant | str | None = None,
    physical: Mapping[str, Any] | None = None,
    cost: Mapping[str, Any] | None = None,
    **parameters: Any,
) -> Problem:
    """A shipped problem, or one from a YAML file, with given parameters replaced.

    Parameters
    ----------
    source
        A name that `pdeloop problems` lists, or the path of a YAML file; burgers if neither it nor a
        plant is given.
    plant
        A plant of your own: an object of a class derived from `Dynamics`, or a name
        ('file.py:Class'), whose code is then run. Without a `source`, the class supplies everything
        else.
    physical
        The parameters of the equation, like {"viscosity": 1e-3}, or of the named plant.
    cost
        The cost for an equation, where `state_weight`, `action_weight` and the equation's own target
        do not suffice: arguments of `pdeloop.messages.cost.Cost` by name, like
        {"output": C, "target": y_r}.
    parameters
        Any parameter of docs/parameters.md by name: n_z, n_a, horizon, measurement_noise, ... Your
        own code ('file.py:Class', or the class itself) is run if it is given here as `equation`,
        `optimizer` or `law`.

    Returns
    -------
    Problem
        With all parameters checked against their ranges.

    Raises
    ------
    ValueError
        There is no such problem or parameter, or a value is out of range.

    Examples
    --------
    >>> import pdeloop
    >>> burgers = pdeloop.problem("burgers", n_z=64, horizon=100, physical={"viscosity": 1e-3})
    >>> plant = burgers.plant(batch=3)
    >>> plant.states.shape
    (3, 64)
    >>> states, actions = burgers.explore(seed=0)
    >>> states.shape, actions.shape
    ((101, 64), (100, 6))
    """
    name = "burgers" if source is None and plant is None else str(source or "")
    given = named(name, {**parameters, "physical": physical, "plant": plant, "cost": cost})
    _, values = problem_values(name, given)
    return Problem(name, given, values)


def _with_cost(source: str, given: Mapping[str, Any], cost: object) -> dict[str, Any]:
    """The parameter `cost`, completed by the plant without it."""
    if isinstance(cost, list):  # as a run has it
        return {"cost": cost}
    if not isinstance(cost, Mapping):
        raise ValueError(f"cost is {cost!r}; expected a dict like {{'terminal_weight': 2.0}}")
    if given.get("plant"):
        raise ValueError(
            "a plant of your own defines its cost in its class; leave out the cost here"
        )
    # Of the whole field, whatever is measured of it.
    plant, _ = complete(training_parameters(source, {**given, "sensors": 0}), compiled=False)
    own = {name: getattr(plant, name) for name in ("state_weight", "action_weight")}
    if "output" not in cost:
        own["target"] = plant.target
    known = [name for name in signature(Cost).parameters if name not in ("n_z", "n_a", "horizon")]
    if unknown := [name for name in cost if name not in known]:
        raise ValueError(f"a cost has no {unknown[0]!r}; it has {', '.join(known)}")
    made = Cost(plant.n_z, plant.n_a, plant.horizon, **{**own, **cost})
    return {"cost": made.packed}


def _plant_named(plant: Dynamics | Plant | str) -> dict[str, Any]:
    """The parameters of the given plant; ValueError if it is not one."""
    if isinstance(plant, str):
        return {"plant": OWN_PLANTS.allow(plant)}
    if not isinstance(plant, Dynamics | Plant):
        raise ValueError(
            f"plant is {plant!r}; expected an object of a class derived from Dynamics, or a name "
            "like 'file.py:Class'"
        )
    return hand_over(plant)


def named(
    source: str, parameters: Mapping[str, Any], base: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """The parameters by their names, those of `physical` among them; code that is named is allowed.

    A plant may be an object, for whose name and parameters it then stands. base: parameters besides,
    for the plant that a cost is made for.

    ValueError, with what was meant, where a parameter of the equation is given as one of the problem.
    """
    given = dict(parameters)
    physical = given.pop("physical", None) or {}
    if not isinstance(physical, Mapping):
        raise ValueError(f"physical is {physical!r}; expected a dict of names and numbers")
    for code in (OWN_EQUATIONS, OWN_OPTIMIZERS, OWN_LAWS):
        if code.word in given:
            given[code.word] = code.take(given[code.word])
    if (plant := given.pop("plant", None)) is not None:
        given |= _plant_named(plant)
    cost = given.pop("cost", None)
    given = flatten(given)
    known = [spec.name for spec in table()]
    for name, value in given.items() if plant is None else ():
        if name in known or name.startswith(FREE):
            continue
        equation = {"equation": given["equation"]} if "equation" in given else {}
        kind = configured_equation(load_parameters(source, equation)["equation"])
        own = [item.name for item in fields(kind) if item.name != "length"]
        for meant in get_close_matches(name, [*own, *known], n=1):
            if meant in own:
                raise ValueError(
                    f"{name!r} is not a parameter of the problem; did you mean the equation's own, "
                    f"physical={{{meant!r}: {value!r}}}?"
                )
    given |= {f"physical.{name}": value for name, value in physical.items()}
    return given if cost is None else given | _with_cost(source, {**(base or {}), **given}, cost)


def identify(
    *trajectories: tuple[ArrayLike, ArrayLike],
    n_s: int,
    method: str = "regression",
    p: int = 0,
    constant: bool | None = True,
) -> ReducedModel:
    """A reduced linear model s_{k+1} = A s_k + B a_k + d, s = U^T z, from trajectories of one plant.

    Parameters
    ----------
    trajectories : (states (N + 1, n_z), actions (N, n_a)) each
        As returned by `Problem.explore`; a_k is held from z_k to z_{k+1}.
    n_s
        Order of the model; 0: the one that `study_orders` suggests.
    method : {"regression", "dmdc"}
        Least squares in reduced coordinates with the inputs whole, or the truncated regression of
        Proctor, Brunton and Kutz (2016).
    p
        Rank of dmdc; 0: n_s + n_a.
    constant
        Whether "regression" has the constant term d, unless that is rounding: the zero of degrees and
        per cent is no rest of the plant. None: where it predicts each held-out part better, as in a
        training. "dmdc" has none.

    Returns
    -------
    ReducedModel
        A (n_s, n_s), B (n_s, n_a), U (n_z, n_s), d (n_s,).

    Raises
    ------
    ValueError
        Shapes that do not fit, NaN or infinity, or data that allow or determine no model of this order:
        inputs that never moved, always moved together, or always followed from the state are named.

    Warns
    -----
    IdentifiabilityWarning
        The data hardly determine the model, or hold a trajectory twice.

    Examples
    --------
    >>> import pdeloop
    >>> burgers = pdeloop.problem("burgers")
    >>> model = pdeloop.identify(burgers.explore(0), burgers.explore(1), n_s=4)
    >>> model.A.shape, model.B.shape, model.U.shape
    ((4, 4), (4, 6), (128, 4))
    """
    if not trajectories or any(not isinstance(t, tuple) or len(t) != 2 for t in trajectories):
        raise ValueError("identify needs one trajectory or more, each a tuple (states, actions)")
    _check_count("n_s", n_s, 0)
    _check_count("p", p, 0)
    if constant and method == "regression":
        constant = has_offset(trajectories)
    model = identification.identify(trajectories, method=method, n_s=n_s, p=p, constant=constant)
    for remark in identification.examined(trajectories, model, method=method, p=p).remarks:
        warnings.warn(remark, IdentifiabilityWarning, stacklevel=2)
    return model


def train(
    problem: Problem | str | None = None,
    *,
    plant: Dynamics | Plant | str | None = None,
    law: type[Law] | str | None = None,
    model: ReducedModel | str | Path | Any = None,
    out: str | Path | None = None,
    over_topics: bool = False,
    progress: TextIO | None = None,
    **parameters: Any,
) -> FinishedRun:
    """Identify, design, adapt and evaluate, as `pdeloop train` does, to the same bits.

    Parameters
    ----------
    problem
        A problem, or its name; not needed with a plant.
    plant
        A plant of your own, as for `problem`.
    law
        The control law: a class derived from `Law`, or a name; the problem's if not given.
    model
        Start from this model instead of identifying one: a `ReducedModel`, a state-space system as
        `ReducedModel.of` takes it, or a file of either `ReducedModel.save` or `pdeloop identify --out`.
    out
        Folder of the results, in the command line's layout; by default nothing is kept.
    over_topics
        Run the nodes as separate processes over ROS 2 topics instead of in this process. Their
        logs are in `out`, which must then be given.
    progress
        Stream for progress messages, like sys.stdout; by default there are none.
    parameters
        As for `problem`: seed, seeds, rollouts, optimizer, optimizer_settings={"fields": 5}, ...

    Returns
    -------
    FinishedRun
        With S seeds: `policies` and `warm` (S, n_a, 2 n_s), or (S, size) for a law other than the
        affine one, `models`, and `costs` by controller, (S, fields).

    Raises
    ------
    ValueError
        The parameters do not fit together, or the folder cannot be used.
    RuntimeError
        A node cannot be started or ends, or the training over topics is stopped.

    Warns
    -----
    TrainingWarning
        The law is no better than no control or than the first one, rollouts were left over, costs
        cannot be compared, or an exploration hardly tells inputs apart or shows dead time, and why.

    Examples
    --------
    >>> import pdeloop
    >>> run = pdeloop.train(
    ...     "burgers", n_z=64, horizon=100, optimizer="two_point", rollouts=5, evaluation_fields=2
    ... )
    >>> run.policies.shape, run.costs["adapted"].shape
    ((1, 6, 8), (1, 2))
    """
    refuse_while_executed("trains")
    if not isinstance(problem, Problem | str) and (problem is not None or plant is None):
        raise ValueError(f"problem is {problem!r}; expected a Problem or its name")
    if over_topics and out is None:
        raise ValueError("a training over topics needs a folder for its results and logs: give out")
    transport = Transport(not over_topics)
    transport.require()
    with TemporaryDirectory() as temporary:
        source, given = (
            (problem.source, problem.given) if isinstance(problem, Problem) else (problem or "", {})
        )
        parameters |= {} if plant is None else {"plant": plant}
        parameters |= {} if law is None else {"law": law}
        where = Path(temporary) / "run" if out is None else Path(out)
        given = {**given, **named(source, parameters, given)}
        if model is not None:
            given["model"] = str(model) if isinstance(model, str | Path) else model
        folder, values = begin(source, given, where.absolute(), transport)
        display = Display(values["seed"], values["seeds"], progress or StringIO())
        advice = f"continue with: {continuing(folder, values, transport)}"
        if out is None:
            advice = "give out=FOLDER, in which a training is kept that can be continued"
        try:
            kept = out is not None
            carry_out(folder, values, transport, display, lambda: None, advice, kept=kept)
        except Interruption as reason:
            raise RuntimeError(f"stopped by {reason}; {advice}") from None
        finally:
            display.close()
        run = load_run(folder)
    outcome = narration.warnings(run.result), narration.reasons(run.result)
    for text in (*display.remarks, *outcome[0], *outcome[1]):
        warnings.warn(text.strip(), TrainingWarning, stacklevel=2)
    return run


def _check_count(name: str, value: object, least: int) -> None:
    """ValueError unless the value is a whole number, of NumPy's too, and not below the least."""
    if not isinstance(value, Integral) or int(value) < least:
        raise ValueError(f"{name} is {value!r}; expected a whole number of at least {least}")
