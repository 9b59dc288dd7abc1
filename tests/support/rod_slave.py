# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A heated rod of twenty segments with two heaters, of which pythonfmu makes an FMU."""

from typing import Any

from pythonfmu import DefaultExperiment, Fmi2Causality, Fmi2Slave, Fmi2Variability, Real

SEGMENTS, STEPS = 20, 10


class RodSlave(Fmi2Slave):
    def __init__(self, **given: Any) -> None:
        super().__init__(**given)
        self.default_experiment = DefaultExperiment(start_time=0.0, stop_time=4.0, step_size=0.1)
        self.T0, self.k, self.q1, self.q2 = 1.0, 4.0, 0.0, 0.0
        self.T: list[float] = []
        for name in ("q1", "q2"):
            self.register_variable(Real(name, causality=Fmi2Causality.input, start=0.0))
        for name in ("T0", "k"):
            kind = {"causality": Fmi2Causality.parameter, "variability": Fmi2Variability.fixed}
            self.register_variable(Real(name, **kind))
        for i in range(SEGMENTS):
            getter = lambda i=i: self.temperatures()[i]  # noqa: E731
            output = Real(f"T[{i + 1}]", causality=Fmi2Causality.output, getter=getter)
            self.register_variable(output)

    def temperatures(self) -> list[float]:
        return self.T or [self.T0] * SEGMENTS

    def do_step(self, t: float, h: float) -> bool:
        T = self.temperatures()
        heat = [0.5 * (self.q1 if 2 * i < SEGMENTS else self.q2) for i in range(SEGMENTS)]
        for _ in range(STEPS):
            neighbours = zip(T[:1] + T[:-1], T, T[1:] + T[-1:], heat, strict=True)
            T = [
                x + h / STEPS * (self.k * (left - 2 * x + right) - 0.1 * x + q)
                for left, x, right, q in neighbours
            ]
        self.T = T
        return True
