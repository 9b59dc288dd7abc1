# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Fast charging of a cell of PyBaMM: a single-particle model with electrolyte and a lumped temperature.

Actions: the charging current in C (the nominal capacity per hour) and the heat transfer coefficient in
10 W/(m^2 K). Measured: state of charge, temperature above ambient in 10 K, voltage above 3.5 V, and by
how much temperature and voltage exceed their limits. The cost tracks a charge that rises and punishes
the last two. The solver's state is handed from step to step.
"""

from functools import lru_cache

import numpy as np
import pybamm

import pdeloop

CHEMISTRIES = ("Chen2020", "Marquis2019", "Ecker2015")
"""PyBaMM's parameter sets of a NMC 811, an LCO and an NCO cell, each with graphite."""
CURRENT, COOLING = "Current function [A]", "Total heat transfer coefficient [W.m-2.K-1]"
MEASURED = (
    "Discharge capacity [A.h]",
    "Volume-averaged cell temperature [K]",
    "Terminal voltage [V]",
)
START = 0.1
"""State of charge before the episode's first, drawn charge."""


@lru_cache
def cell(chemistry):
    """A compiled model, its capacity (Ah), upper voltage (V) and ambient temperature (K)."""
    if chemistry not in CHEMISTRIES:
        raise ValueError(f"chemistry is {chemistry!r}; expected one of {', '.join(CHEMISTRIES)}")
    values = pybamm.ParameterValues(chemistry)
    values.update({CURRENT: "[input]", COOLING: "[input]"})
    model = pybamm.lithium_ion.SPMe({"thermal": "lumped"})
    model.events = []  # limits are costs here, and after an event PyBaMM's steps stand still
    solver = pybamm.IDAKLUSolver(rtol=1e-8, atol=1e-8)
    simulation = pybamm.Simulation(model, parameter_values=values, solver=solver)
    simulation.build(initial_soc=START, inputs={CURRENT: 0.0, COOLING: 10.0})
    names = "Nominal cell capacity [A.h]", "Upper voltage cut-off [V]", "Ambient temperature [K]"
    return simulation, *(float(values[name]) for name in names)


class Cell(pdeloop.Dynamics):
    n_z, n_a, horizon, sample_time, stateful = 5, 2, 30, 60.0, True
    action_low, action_high = (0.0, 0.5), (3.0, 5.0)
    state_weight, action_weight = (100.0, 0.0, 0.0, 10.0, 100.0), (0.001, 0.001)

    def __init__(self, chemistry="Chen2020", rate=1.5, warmest=10.0):
        """Charge at this rate (C), and the limit of the temperature above ambient (K)."""
        self._cell, self._warmest = cell(chemistry), warmest
        soc = np.minimum(0.2 + rate * self.sample_time / 3600.0 * np.arange(self.horizon + 1), 0.8)
        self.target = np.stack([soc, *np.zeros((4, len(soc)))], axis=1)

    def initial_state(self, rng):
        self._state = pybamm.EmptySolution()
        return self._advance(600.0, (rng.uniform(0.3, 0.9), 1.0))

    def step(self, z, a):
        return self._advance(self.sample_time, a)

    def _advance(self, seconds, a):
        simulation, capacity, highest, ambient = self._cell
        inputs = {CURRENT: -a[0] * capacity, COOLING: 10.0 * a[1]}
        self._state = simulation.step(
            seconds, inputs=inputs, starting_solution=self._state, save=False
        )
        charge, temperature, voltage = (self._state[name].entries[-1] for name in MEASURED)
        warm = temperature - ambient
        excess = max(warm - self._warmest, 0.0) / 10.0, max(voltage - highest, 0.0)
        return np.array([START - charge / capacity, warm / 10.0, voltage - 3.5, *excess])
