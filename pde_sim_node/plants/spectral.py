# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The plant of an equation on a periodic interval: pseudo-spectral in space, and compiled."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numba
import numpy as np
from numba import types
from numba.core.errors import NumbaError
from numpy.typing import NDArray

from pde_sim_node.arguments import grid_points, internal_steps, positive, whole
from pde_sim_node.definition import Definition, sources_of
from pde_sim_node.equations import Equation, Field, LinearEquation, Spectrum
from pde_sim_node.equations.base import result_of
from pde_sim_node.plant import MEAN_FIELD, Adjoint
from pde_sim_node.plants.batch import BatchPlant
from pde_sim_node.supports import indicator_supports, placed_supports
from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.messages.grid import Grid
from pdeloop.messages.own_code import in_one_line, located
from pdeloop.solver.exact import exact_step
from pdeloop.solver.kernel import etdrk4_step
from pdeloop.solver.memory import StepSettings
from pdeloop.solver.pointwise import NotCompiledError
from pdeloop.solver.workers import ParallelStep

NUMBERS = (
    "n_z",
    "n_a",
    "sample_time",
    "integration_time",
    "horizon",
    "state_weight",
    "action_weight",
    "divergence_bound",
)
"""Parameters of a problem that are arguments of the same name."""


class SpectralPlant(BatchPlant):
    """M environments of one equation, advanced in lock-step.

    u_t = F(u, u_x, ...) + sum_j Phi_j(x) a_j(t) on the grid x_i = i L / n_x, with the action held
    over a sampling time: z_{k+1} = f(z_k, a_k), pseudo-spectral in space and ETDRK4 in time, or
    exact in time for a `LinearEquation`. The result for an environment is the same to the last bit
    whatever the number of environments, its place among them, the threads and the process.

    Parameters
    ----------
    equation
        The PDE.
    n_z
        Size of the state: the number of grid points, even, at least 8, times the number of the
        equation's components, which stand one after the other in a state.
    n_a
        Number of actuators.
    width
        Width of one actuator as a fraction of the domain, see `Equation.supports`.
    shape
        "indicator", "gaussian" with ``width`` as standard deviation, or "equation", as
        `Equation.supports` has it.
    positions
        Centres of the actuators as fractions of the domain; none: n_x // n_a points apart, or as
        `Equation.supports` has them.
    sample_time
        Sampling time, a whole multiple of ``integration_time``.
    integration_time
        Internal step of the integrator.
    horizon, state_weight, action_weight, divergence_bound
        See `pde_sim_node.plant.Plant`.
    cost
        In place of that of the weights and the equation's target; see `pdeloop.messages.cost.Cost`.
    compiled
        Whether the step is compiled now; otherwise by `load`, or with the first step.

    Attributes
    ----------
    x : (n_x,)
        Grid points; n_x = n_z / components.
    supports : (n_x, n_a)
        Phi_j(x_i), on the component ``equation.actuated``.

    Raises
    ------
    ValueError
        A parameter has no usable value; the message names it and what would be right.
    """

    supports: Array

    def __init__(
        self,
        equation: Equation,
        *,
        n_z: int,
        n_a: int,
        width: float,
        sample_time: float,
        integration_time: float,
        horizon: int,
        state_weight: float,
        action_weight: float,
        divergence_bound: float = 1e3,
        shape: str = "equation",
        positions: Sequence[float] = (),
        cost: Cost | None = None,
        compiled: bool = True,
    ) -> None:
        if whole("n_z", n_z, 8) % 2:
            raise ValueError(f"n_z must be even, got {n_z}: take {n_z + 1}")
        self.equation = equation
        self.integration_time = positive("integration_time", integration_time)
        n_x = grid_points(equation, n_z)
        self.x = equation.length * np.arange(n_x) / n_x
        self.forced = slice(equation.actuated * n_x, (equation.actuated + 1) * n_x)
        if cost is not None:
            state_weight, action_weight = cost.size
        super().__init__(
            grid=Grid.interval(equation.length, n_x, equation.components),
            n_a=n_a,
            horizon=horizon,
            sample_time=sample_time,
            state_weight=state_weight,
            action_weight=action_weight,
            divergence_bound=divergence_bound,
            target=self._checked("target", result_of(equation.target, self.x)),
            cost=cost,
        )
        self._own_cost = cost
        if cost is not None:
            self._require_fitting(cost)
            self.field_target = self.target = cost.field_target
        self.width, self.shape, self.positions = positive("width", width), shape, positions
        self.supports = actuator_supports(equation, self.x, self.n_a, width, shape, positions)
        self._step = self._make_step()
        self._bind()
        if compiled:
            self.load()

    def load(self) -> None:
        """Load the compiled step, or compile it; ValueError where the equation cannot be compiled."""
        load(self._step, self.equation)

    @property
    def parallel(self) -> ParallelStep | None:  # type: ignore[override]
        """The compiled step; None where its cost is more than compiled code counts."""
        return self._step if self.cost.plain else None

    def _require_fitting(self, cost: Cost) -> None:
        """ValueError unless the cost is one of a state, actions and episodes of these sizes."""
        for name in ("n_z", "n_a", "horizon"):
            if getattr(cost, name) != getattr(self, name):
                raise ValueError(
                    f"the cost is for {name} {getattr(cost, name)}, but this plant has {name} "
                    f"{getattr(self, name)}: make the cost for that"
                )

    def _make_step(self) -> ParallelStep:
        """The compiled step of this plant."""
        modes = np.arange(len(self.x) // 2 + 1, dtype=np.float64)
        return compiled_step(
            self.equation,
            2 * np.pi * modes / self.equation.length,
            supports=self.supports,
            target=self.field_target,
            integration_time=self.integration_time,
            steps=internal_steps(self.sample_time, self.integration_time),
            state_weight=self.state_weight,
            action_weight=self.action_weight,
            bound=self.divergence_bound,
        )

    def __getstate__(self) -> dict[str, Any]:
        """All but the compiled step, which holds addresses of this process: a copy makes its own."""
        return {name: value for name, value in vars(self).items() if name != "_step"}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        """Continue where the plant was when it was pickled or copied, to the bit."""
        vars(self).update(state)
        self._step = self._make_step()
        self._bind()

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.equation.name}: state of {self.state_size}, "
            f"{self.n_a} actuators, {self.horizon} steps of {self.sample_time:g})"
        )

    @property
    def definition(self) -> Definition:
        """Its parameters and the source of its equation; see `Definition`."""
        values = {name: getattr(self, name) for name in NUMBERS} | {"actuator_width": self.width}
        # Defaults are omitted so that fingerprints from older versions stay valid.
        if self.shape != "equation":
            values["actuator_shape"] = self.shape
        if len(self.positions):
            values["actuator_positions"] = [float(position) for position in self.positions]
        if self._own_cost is not None:
            values["cost"] = "".join(self._own_cost.packed)
        sources = sources_of(type(self.equation), Equation)
        return Definition({**values, **asdict(self.equation)}, sources)

    def adjoint(self) -> Adjoint:
        """The transpose of the step's own derivative, or of the matrices of a linear step.

        Raises
        ------
        ValueError
            The equation's nonlinearity has no derivative that can be computed.
        """
        # Compiled code that only gradients need.
        from pdeloop.solver import adjoint

        self.load()
        if not isinstance(self.equation, LinearEquation):
            return adjoint.Adjoint(self._step, self.equation.nonlinearity)
        n_z, n_a = self.n_z, self.n_a
        A_transposed, _ = self.evaluate(np.eye(n_z), np.zeros((n_z, n_a)))
        B_transposed, _ = self.evaluate(np.zeros((n_a, n_z)), np.eye(n_a))
        return adjoint.LinearAdjoint(A_transposed, B_transposed)

    def refined(self) -> "SpectralPlant | None":
        """With half the integration time; None where the step is exact."""
        if isinstance(self.equation, LinearEquation):
            return None
        given = {name: getattr(self, name) for name in (*NUMBERS, "width", "shape", "positions")}
        given["integration_time"] /= 2
        return SpectralPlant(self.equation, **given, cost=self._own_cost)

    def _allocate(self, batch: int) -> None:
        super()._allocate(batch)
        if batch:
            self._bind()

    def _bind(self) -> None:
        # The compiled step's sum is the cost only where the cost has no further terms.
        counted = self.totals if self.cost.plain else np.zeros(self.batch)
        self._step.bind(self.states, self.actions, counted, self.diverged_step)

    def _draw(self, seed: int) -> Array:
        rng = None if seed == MEAN_FIELD else np.random.default_rng(seed)
        return self._checked("initial_field", result_of(self.equation.initial_field, self.x, rng))

    def _checked(self, what: str, values: Array) -> Array:
        """A field of the equation as a state: one component after the other."""
        components, n_x = len(self.equation.components), len(self.x)
        shape = (n_x,) if components == 1 else (components, n_x)
        values = np.asarray(values, dtype=np.float64)
        if values.shape != shape or not np.isfinite(values).all():
            raise ValueError(
                f"{what} of the equation must return {' x '.join(map(str, shape))} finite numbers "
                f"for x of shape ({n_x},), got shape {values.shape}"
            )
        return values.flatten()

    def _advance(self) -> None:
        if self.cost.plain:
            self._step.step(self.step_index)
            return
        alive = np.flatnonzero(self.diverged_step < 0)
        before, totals = self.states[alive], self.totals[alive]
        self.cost.add(totals, before, self.actions[alive], self.step_index)
        self._step.step(self.step_index)
        lost = ~np.isfinite(totals)
        self.states[alive[lost]] = before[lost]
        self.diverged_step[alive[lost]] = self.step_index
        if self.step_index + 1 == self.horizon:
            self.cost.add_terminal(totals, self.states[alive])
        self.totals[alive] = totals

    def _evaluate(self, states: Array, actions: Array) -> Array:
        costs, diverged_step = np.zeros(len(states)), np.full(len(states), -1, dtype=np.int64)
        counted = costs.copy()
        if not self.cost.plain:
            self.cost.add(costs, states, actions, 0)
        self._step.bind(states, actions, counted, diverged_step)
        self._step.step(0)
        self._bind()
        return counted if self.cost.plain else costs


def actuator_supports(
    equation: Equation,
    x: NDArray[np.float64],
    n_a: int,
    width: float,
    shape: str,
    positions: Sequence[float],
) -> NDArray[np.float64]:
    """Phi_j(x_i), (n_x, n_a), at the grid points x (n_x,); the arguments are those of `SpectralPlant`.

    ValueError where they do not fit each other or the equation.
    """
    if shape not in ("equation", "indicator", "gaussian"):
        raise ValueError(f"actuator_shape must be equation, indicator or gaussian, got {shape!r}")
    if len(positions) not in (0, n_a):
        raise ValueError(
            f"actuator_positions must have a centre for each of the n_a = {n_a} actuators, got "
            f"{len(positions)}"
        )
    if shape == "equation" and not len(positions):
        supports = np.array(result_of(equation.supports, x, n_a, width), np.float64)
        if supports.shape != (len(x), n_a) or not np.isfinite(supports).all():
            raise ValueError(
                f"supports of the equation must return {len(x)} x {n_a} finite numbers, got shape "
                f"{supports.shape}"
            )
        return supports
    if shape == "equation" and type(equation).supports is not Equation.supports:
        raise ValueError(
            f"{equation.name} has actuators of its own at fixed positions: give actuator_shape "
            "together with actuator_positions"
        )
    if shape == "indicator" and not len(positions):
        return indicator_supports(len(x), n_a, width)
    centres = positions if len(positions) else (np.arange(n_a) + 0.5) / n_a
    return placed_supports(len(x), centres, width, gaussian=shape == "gaussian")


def compiled_step(equation: Equation, k: Field, **settings: Any) -> ParallelStep:
    """The step z_{k+1} = f(z_k, a_k) of an equation: exact in time if it is linear, else ETDRK4.

    k: wavenumbers 2 pi j / L, (n_x//2 + 1,); settings: the other fields of `StepSettings`. ValueError
    for operators of the wrong shape or that are not finite. It is compiled by `load`.
    """
    linear = isinstance(equation, LinearEquation)
    step = StepSettings(
        linear_operator=operator(equation, "linear_operator", k),
        multiplier=np.zeros(len(k)) if linear else operator(equation, "multiplier", k),
        nonlinearity=equation.nonlinearity,
        actuated=equation.actuated,
        **settings,
    )
    return exact_step(step) if linear else etdrk4_step(step)


def load(step: ParallelStep, equation: Equation) -> None:
    """Load the machine code of an equation's step; ValueError where its nonlinearity has none."""
    try:
        step.load()
    except NotCompiledError as error:
        function = equation.nonlinearity
        why = reason(function)
        if why is None:
            raise
        raise ValueError(
            f"the nonlinearity {function.__qualname__} must be a scalar function u -> g(u) "
            f"that Numba can compile for a float64: {why}"
        ) from error


def operator(equation: Equation, name: str, k: Field) -> Spectrum:
    """L(k) or m(k), the equation's method of that name; ValueError for a wrong shape or NaN."""
    values = result_of(getattr(equation, name), k)
    components = len(equation.components)
    shape = k.shape if components == 1 else (*k.shape, components, components)
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "iufc":
        got = repr(values)
    elif values.shape != shape:
        got = f"shape {values.shape}"
    elif not np.isfinite(values).all():
        got = "NaN or infinity"
    else:
        return values
    raise ValueError(
        f"{name} of the equation must return an array of {' x '.join(map(str, shape))} "
        f"finite numbers for k of shape {k.shape}, got {got}"
    )


def reason(function: Callable[[float], float]) -> str | None:
    """Why Numba cannot compile a function by itself, in one line, with the line of the source."""
    alone: Any = numba.njit(function)
    code = function.__code__
    try:
        alone.compile((types.float64,))
    except NumbaError as error:
        text = str(error).partition("\n")[2] or str(error)  # after "Failed in nopython mode ..."
        words = re.split(r"\n\s*(?:There are|File |During)", text)[0].replace(">>>", "").split()
        line = getattr(getattr(error, "loc", None), "line", code.co_firstlineno)
        return f"{code.co_filename}, line {line}: {' '.join(words)}"
    except Exception as error:  # without a place, which Python may know
        try:
            function(0.5)
        except Exception as own:
            if code.co_filename in located(own):
                return located(own)
        return f"{code.co_filename}, line {code.co_firstlineno}: {in_one_line(error)}"
    (signature,) = alone.nopython_signatures
    if signature.return_type == types.float64:
        return None
    return f"it returns {signature.return_type}, expected a float64"
