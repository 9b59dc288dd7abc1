# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""An FMU as a plant: what it measures are its outputs, its actions are held inputs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import ArrayLike

from pde_sim_node.dynamics import Dynamics, arguments_of, signature_of
from pde_sim_node.plants.fmi import Signals, Unit, described, digest_of
from pdeloop.messages.arrays import Array, float_array
from pdeloop.messages.grid import Grid
from pdeloop.messages.text import shown

Start: TypeAlias = Callable[[np.random.Generator], Mapping[str, float]]
STATES = "states"
"""In place of outputs: all continuous states."""
NUMBERS = ("Real", "Float64", "Float32", "Integer", "Boolean", "Enumeration")
HORIZON = 100
"""Steps where nobody says how many."""
_resets_wholly: dict[tuple[Any, ...], bool] = {}
"""By content, sample time and start values: see `Fmu._resets_wholly`."""
_only: WeakValueDictionary[str, Unit] = WeakValueDictionary()
"""The instances that are the only ones of their process, by content."""


def from_fmu(
    path: str | Path,
    *,
    inputs: str | Sequence[str] = (),
    outputs: str | Sequence[str] = (),
    sample_time: float = 0.0,
    horizon: int = 0,
    target: ArrayLike = 0.0,
    state_weight: ArrayLike = 1.0,
    action_weight: ArrayLike = 1.0,
    action_target: ArrayLike = 0.0,
    start: Mapping[str, Any] | None = None,
    perturbed: Mapping[str, float] | None = None,
    initial: Start | None = None,
    divergence_bound: float = 1e6,
    tolerance: float = 1e-8,
) -> Fmu:
    """A plant from an FMU of FMI 2.0 or 3.0, for co-simulation or else for model exchange.

    The inputs are held over a sample. An FMU is native code of its author, which runs in this process.
    A step that it refuses, or ends, counts as divergence. Model exchange is integrated by FMPy's CVode.

    Parameters
    ----------
    path
        The file.
    inputs, outputs
        Names of variables; all inputs and all outputs if not given. outputs="states": all continuous
        states. Bounds of the inputs are those of the FMU (min, max).
    sample_time
        Time (s) of a step; 0: the step size of the FMU's default experiment.
    horizon
        Steps of an episode; 0: up to the stop time of the default experiment, otherwise 100.
    target : number or (n_z,)
        Outputs to be tracked.
    state_weight : number, (n_z,) or (n_z, n_z)
        Q.
    action_weight : number, (n_a,) or (n_a, n_a)
        R.
    action_target : number or (n_a,)
        a_r.
    start
        Start values and parameters, by name.
    perturbed
        Standard deviations of start values, by name: each episode draws from the normal distribution
        about the start value.
    initial
        In place of it, a function that draws start values by name from a generator.
    divergence_bound
        An output beyond this magnitude has diverged.
    tolerance
        Relative tolerance for model exchange.

    Returns
    -------
    Fmu

    Raises
    ------
    ValueError
        The file is not an FMU, a name is not one of its variables, or a number does not fit.

    Examples
    --------
    >>> import pdeloop
    >>> rod = pdeloop.from_fmu("rod.fmu", inputs="Q", target=20.0)  # doctest: +SKIP
    >>> run = pdeloop.train(plant=rod, rollouts=20)  # doctest: +SKIP
    """
    defaults = {p.name: p.default for p in signature_of(Fmu).parameters.values()}
    if reserved := {*defaults} & {*(start or {})}:
        raise ValueError(f"a start value cannot be given for a variable named {min(reserved)!r}")
    spread = dict(perturbed or {})
    given = {
        "inputs": _names(inputs),
        "outputs": outputs if outputs == STATES else _names(outputs),
        "sample_time": float(sample_time),
        "horizon": horizon,
        "target": _listed("target", target),
        "state_weight": _listed("state_weight", state_weight),
        "action_weight": _listed("action_weight", action_weight),
        "action_target": _listed("action_target", action_target),
        "perturbed": [*spread],
        "spread": [float(value) for value in spread.values()],
        "initial": initial,
        "divergence_bound": float(divergence_bound),
        "tolerance": float(tolerance),
    }
    own = {name: value for name, value in given.items() if value not in ([], defaults[name])}
    return Fmu(str(Path(path).absolute()), **own, **(start or {}))


class Fmu(Dynamics):
    """An FMU in the loop; see `from_fmu`, whose `perturbed` is here a list of names and `spread`."""

    stateful = True

    def __init__(
        self,
        path: str,
        inputs: str | Sequence[str] = (),
        outputs: str | Sequence[str] = (),
        sample_time: float = 0.0,
        horizon: int = 0,
        target: Any = 0.0,
        state_weight: Any = 1.0,
        action_weight: Any = 1.0,
        action_target: Any = 0.0,
        perturbed: str | Sequence[str] = (),
        spread: Any = (),
        initial: Start | None = None,
        divergence_bound: float = 1e6,
        tolerance: float = 1e-8,
        **start: Any,
    ) -> None:
        self._path, self._digest, self._tolerance = path, digest_of(Path(path)), tolerance
        self._description = described(path, self._digest)
        self._known = {variable.name: variable for variable in self._description.modelVariables}
        self._inputs, self._outputs = self._actuated(inputs), self._measured(outputs)
        self.n_a = len(self._inputs.names)
        self.grid = Grid.vector(len(self._outputs.names), "y")
        self.sample_time, self.horizon = self._times(sample_time, horizon)
        self.target, self.action_target = target, action_target
        self.state_weight, self.action_weight = state_weight, action_weight
        self.divergence_bound = divergence_bound
        self.action_low, self.action_high = self._bounds()
        self._held = np.array([_number(v, 0.0) for v in self._each(self._inputs)])
        self._start = {name: self._settable(name, value) for name, value in start.items()}
        self._spread = self._perturbation(_names(perturbed), spread)
        self._initial = initial
        self._unit: Unit | None = None
        self._state: Any = None
        self._token, self._k = object(), 0

    @property
    def measured(self) -> list[str]:
        """Names of the numbers of a state."""
        return list(self._outputs.names)

    @property
    def path(self) -> str:
        """The file."""
        return self._path

    def identity(self) -> Mapping[str, Any]:
        """Its arguments, and the content of the file in place of its name."""
        return {**arguments_of(self), "path": self._digest}

    def mean_state(self) -> Array:
        """The outputs after the start values without perturbation."""
        self._begin({})
        return self._read()

    def initial_state(self, rng: np.random.Generator) -> Array:
        """The outputs after the start values that `rng` draws."""
        if self._initial is not None:
            drawn = {str(name): float(value) for name, value in self._initial(rng).items()}
            for name in drawn:
                self._settable(name, 0.0)
        else:
            normal = rng.standard_normal(len(self._spread)).tolist()
            drawn = {
                name: mean + deviation * number
                for (name, (mean, deviation)), number in zip(
                    self._spread.items(), normal, strict=True
                )
            }
        self._begin(drawn)
        return self._read()

    def step(self, z: Array, a: Array) -> Array:
        """The outputs after a sample in which a is held; NaN where the FMU refuses the step."""
        unit = self._mine()
        unit.before_inputs()
        unit.write(self._inputs, a)
        unit.after_inputs()
        good = unit.step(self._k, self.sample_time)
        self._k += 1
        return self._read() if good else np.full(len(self._outputs.names), np.nan)

    def _begin(self, drawn: Mapping[str, float]) -> None:
        self._unit = unit = self._unit or self._made()
        if not self._resets_wholly(unit):
            unit.never_reset()
        self._k, unit.owner = 0, self._token
        unit.begin({**self._start, **drawn}, self._inputs, self._held)

    def _made(self) -> Unit:
        if self._only_one:
            return _shared(self._path, self._digest, self._tolerance)
        return Unit(self._path, self._digest, self._tolerance)

    @property
    def _only_one(self) -> bool:
        made = self._description.coSimulation or self._description.modelExchange
        return bool(made.canBeInstantiatedOnlyOncePerProcess)

    def _resets_wholly(self, unit: Unit) -> bool:
        """Whether an instance that was reset gives the bits of a new one, over two steps."""
        key = self._digest, self.sample_time, *self._start.items()
        if key not in _resets_wholly:
            first, second = self._two_steps(unit), self._two_steps(unit)
            same = np.array_equal(first, second, equal_nan=True)
            _resets_wholly[key] = bool(same)
        return _resets_wholly[key]

    def _two_steps(self, unit: Unit) -> Array:
        unit.begin(self._start, self._inputs, self._held)
        found = [unit.read(self._outputs)]
        for k in range(2):
            good = unit.step(k, self.sample_time)
            found.append(unit.read(self._outputs) if good else np.full_like(found[0], np.nan))
        return np.array(found)

    def _mine(self) -> Unit:
        """The instance in this plant's state, which others may have used where there is only one."""
        unit = self._unit
        assert unit is not None, "initial_state comes before step"
        if unit.owner is not self._token:
            if self._state is None:
                raise ValueError(
                    f"{self._path} can be instantiated only once in a process, and its state cannot be "
                    "saved: take one environment at a time, --set max_batch=1"
                )
            unit.restore(self._state)
            unit.owner = self._token
        return unit

    def _read(self) -> Array:
        assert self._unit is not None
        values = self._unit.read(self._outputs)
        if self._only_one and self._unit.saves:
            self._state = self._unit.saved(self._state)
        return values

    def _variable(self, name: str, what: str) -> Any:
        if name not in self._known:
            near = get_close_matches(name, self._known, n=1)
            meant = f"; did you mean {near[0]!r}?" if near else ""
            known = ", ".join([*self._known][:8])
            raise ValueError(f"the FMU has no {what} {shown(name)}{meant or f'; it has {known}'}")
        return self._known[name]

    def _actuated(self, inputs: str | Sequence[str]) -> Signals:
        chosen = [self._variable(name, "input") for name in _names(inputs)]
        chosen = chosen or [v for v in self._known.values() if v.causality == "input"]
        for variable in chosen:
            if variable.causality != "input":
                raise ValueError(
                    f"the variable {shown(variable.name)} of the FMU is no input but of causality "
                    f"{variable.causality}"
                )
            if variable.type not in ("Real", "Float64"):
                raise ValueError(
                    f"the input {shown(variable.name)} of the FMU is of type {variable.type}; expected "
                    "Real or Float64"
                )
        if not chosen:
            raise ValueError("the FMU has no input, so that nothing can act on it")
        return Signals(chosen)

    def _measured(self, outputs: str | Sequence[str]) -> Signals:
        if outputs == STATES:
            chosen = [unknown.variable.derivative for unknown in self._description.derivatives]
        else:
            chosen = [self._variable(name, "output") for name in _names(outputs)]
            chosen = chosen or [v for v in self._known.values() if v.causality == "output"]
        for variable in chosen:
            if variable.type not in NUMBERS:
                raise ValueError(
                    f"the output {shown(variable.name)} of the FMU is of type {variable.type}; "
                    "expected a number"
                )
        if not chosen:
            raise ValueError(
                "the FMU declares no such outputs, so that nothing is measured: name variables as "
                "outputs"
            )
        return Signals(chosen)

    def _times(self, sample_time: float, horizon: int) -> tuple[float, int]:
        experiment = self._description.defaultExperiment
        step = float(getattr(experiment, "stepSize", None) or 0.0)
        sample_time = sample_time or step
        if not 0.0 < sample_time < math.inf:
            raise ValueError(
                "the FMU has no default step size: give sample_time, as fmu.sample_time=0.1"
            )
        stop = float(getattr(experiment, "stopTime", None) or 0.0)
        begin = float(getattr(experiment, "startTime", None) or 0.0)
        return sample_time, horizon or max(round((stop - begin) / sample_time), 0) or HORIZON

    def _each(self, signals: Signals) -> list[Any]:
        """The variable of each number."""
        return [
            v for v in signals.variables for _ in range(int(np.prod(v.shape or (1,), dtype=int)))
        ]

    def _bounds(self) -> tuple[Array, Array]:
        each = self._each(self._inputs)

        def declared(side: str, otherwise: float) -> Array:
            types = [getattr(v.declaredType, side, None) for v in each]
            own = [getattr(v, side) or known for v, known in zip(each, types, strict=True)]
            return np.array([otherwise if value is None else float(value) for value in own])

        return declared("min", -math.inf), declared("max", math.inf)

    def _settable(self, name: str, value: Any) -> Any:
        variable = self._variable(name, "parameter")
        if variable.variability == "constant" or variable.causality == "calculatedParameter":
            raise ValueError(f"the variable {shown(name)} of the FMU cannot be set")
        if variable.type in NUMBERS and variable.type != "Boolean":
            try:
                float(value)
            except (TypeError, ValueError):
                raise ValueError(
                    f"the start value of {shown(name)} is {shown(value)}; expected a number"
                ) from None
        return value

    def _perturbation(
        self, names: Sequence[str], spread: ArrayLike
    ) -> dict[str, tuple[float, float]]:
        """The mean and standard deviation of start values that are drawn, by name."""
        deviations = np.atleast_1d(float_array("spread", spread))
        if deviations.shape not in ((1,), (len(names),)) or not (deviations >= 0).all():
            raise ValueError(
                f"spread must be one number or {len(names)} of at least 0, one for each of perturbed, "
                f"got {spread!r}"
            )
        found = {}
        for name, deviation in zip(names, np.broadcast_to(deviations, len(names)), strict=True):
            self._settable(name, 0.0)
            mean = self._start.get(name, self._known[name].start)
            if mean is None:
                raise ValueError(
                    f"the variable {shown(name)} of the FMU has no start value about which to draw: "
                    "give one"
                )
            found[name] = float(mean), float(deviation)
        return found


def maker(path: str) -> Callable[..., Fmu]:
    """What makes a plant of the FMU in a file, with the arguments of `Fmu`."""
    return partial(Fmu, path)


def _shared(path: str, digest: str, tolerance: float) -> Unit:
    """The instance of an FMU that can have one only."""
    unit = _only.get(digest) or Unit(path, digest, tolerance)
    _only[digest] = unit
    return unit


def _names(given: str | Sequence[str]) -> list[str]:
    return [given] if isinstance(given, str) else [str(name) for name in given]


def _number(variable: Any, otherwise: float) -> float:
    try:
        return float(variable.start)
    except (TypeError, ValueError):
        return otherwise


def _listed(name: str, given: ArrayLike) -> Any:
    """A number, or numbers as a list, which a parameter file can hold."""
    numbers = float_array(name, given)
    return float(numbers) if numbers.ndim == 0 else numbers.tolist()
