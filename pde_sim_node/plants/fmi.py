# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""One instance of an FMU: FMI 2.0 or 3.0, co-simulation, or model exchange with FMPy's CVode.

Source: *Functional Mock-up Interface Specification*, 2.0.4 and 3.0.2, Modelica Association.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import Any
from weakref import WeakValueDictionary, finalize

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.messages.text import shown

FATAL = 4
"""fmi2Fatal and fmi3Fatal: no call may follow."""


def fmpy() -> Any:
    """The package FMPy; ValueError that says how to install it."""
    try:
        import fmpy
    except ImportError as error:
        raise ValueError("an FMU needs FMPy: pip install 'pdeloop[fmi]'") from error
    return fmpy


@lru_cache(maxsize=32)
def described(path: str, digest: str) -> Any:
    """FMPy's description of an FMU of this content; ValueError where it cannot be used."""
    try:
        description = fmpy().read_model_description(path)
    except ValueError:
        raise
    except Exception as error:  # FMPy raises this class itself
        told = " ".join(str(error).split())
        raise ValueError(f"{path} is not an FMU that FMPy can read: {told}") from error
    if not description.fmiVersion.startswith(("2.", "3.")):
        raise ValueError(f"{path} is of FMI {description.fmiVersion}; expected 2.0 or 3.0")
    if not (description.coSimulation or description.modelExchange):
        raise ValueError(f"{path} is for neither co-simulation nor model exchange")
    return description


class Archive:
    """An extracted FMU, whose folder is removed when no instance needs it any more."""

    def __init__(self, path: str) -> None:
        self.folder = mkdtemp(prefix="fmu-")
        finalize(self, rmtree, self.folder, ignore_errors=True)
        fmpy().extract(path, self.folder)
        platforms = fmpy().platform, fmpy().platform_tuple
        if not any((Path(self.folder) / "binaries" / name).is_dir() for name in platforms):
            raise ValueError(f"{path} has no binary for {fmpy().platform_tuple}")


_archives: WeakValueDictionary[str, Archive] = WeakValueDictionary()
"""By content; instances of one FMU share the folder."""


class Signals:
    """Variables of an FMU, whose numbers stand one after the other; an array has several.

    kinds: the types that they may have.
    """

    def __init__(self, variables: Sequence[Any]) -> None:
        self.names: list[str] = []
        self._parts: list[tuple[str, int, int]] = []
        for variable in variables:
            size = int(np.prod(variable.shape or (1,)))
            indexed = [f"{variable.name}[{i + 1}]" for i in range(size)] if variable.shape else []
            self.names += indexed or [variable.name]
            self._parts.append((_accessor(variable.type), variable.valueReference, size))
        self.variables = list(variables)

    def read(self, instance: Any) -> Array:
        """Their values."""
        found: list[float] = []
        for kind, reference, size in self._parts:
            get, further = getattr(instance, f"get{kind}"), {} if size == 1 else {"nValues": size}
            found += map(float, get([reference], **further))
        return np.array(found)

    def write(self, instance: Any, values: Array) -> None:
        """Set their values."""
        at = 0
        for kind, reference, size in self._parts:
            getattr(instance, f"set{kind}")([reference], values[at : at + size].tolist())
            at += size


def _accessor(kind: str) -> str:
    return "Integer" if kind == "Enumeration" else kind


class Unit:
    """An instance, which `begin` brings to the start of an episode however often it is called.

    Parameters
    ----------
    path, digest : str
        File, and what tells its content from another one.
    tolerance : float
        Relative tolerance of the solver for model exchange.
    """

    def __init__(self, path: str, digest: str, tolerance: float) -> None:
        self.description = described(path, digest)
        self._archive = _archives.get(digest) or Archive(path)
        _archives[digest] = self._archive
        self._three = self.description.fmiVersion.startswith("3.")
        self._stepping = self.description.coSimulation is not None
        self.interface = self.description.coSimulation or self.description.modelExchange
        self._tolerance = tolerance
        self._fmu: Any = None
        self._solver: Any = None
        self._resets, self.time = True, 0.0
        self._free: Any = None
        self.owner: object = None

    def begin(self, start: Mapping[str, Any], inputs: Signals, values: Array) -> None:
        """Initialise at time 0 with start values by name; ValueError for one that cannot be set."""
        self._renew()
        fmu, left = self._fmu, dict(start)
        simulation = fmpy().simulation
        if not self._three:
            fmu.setupExperiment(startTime=0.0)
        left = simulation.apply_start_values(
            fmu, self.description, left, simulation.settable_in_instantiated
        )
        fmu.enterInitializationMode()
        left = simulation.apply_start_values(
            fmu, self.description, left, simulation.settable_in_initialization_mode
        )
        if left:
            raise ValueError(
                f"the FMU does not allow {shown(next(iter(left)))} to be set at the start: it is "
                "calculated; set what it is calculated from"
            )
        inputs.write(fmu, values)
        fmu.exitInitializationMode()
        self.time = 0.0
        if not self._stepping:
            self._update()
            fmu.enterContinuousTimeMode()
            self._solver = self._cvode()

    def step(self, k: int, length: float) -> bool:
        """From time k h to (k + 1) h, with the inputs as they are; False where the FMU refuses it."""
        from fmpy.fmi1 import FMICallException

        try:
            if self._stepping:
                ended = self._fmu.doStep(
                    currentCommunicationPoint=k * length, communicationStepSize=length
                )
                return not (self._three and ended[1])
            return self._integrate((k + 1) * length)
        except FMICallException as error:
            if error.status == FATAL:
                self._forget()
                raise
            self._resets = False
            return False
        except RuntimeError as error:  # of CVode
            if "CVode" not in str(error):
                raise
            return False

    def before_inputs(self) -> None:
        """Announce that inputs change, which is an event of model exchange."""
        if not self._stepping:
            self._fmu.enterEventMode()

    def after_inputs(self) -> None:
        """They have changed."""
        if not self._stepping:
            self._update()
            self._fmu.enterContinuousTimeMode()
            self._solver.reset(self.time)

    def read(self, signals: Signals) -> Array:
        """Values of signals."""
        return signals.read(self._fmu)

    def write(self, signals: Signals, values: Array) -> None:
        """Set values of signals."""
        signals.write(self._fmu, values)

    @property
    def saves(self) -> bool:
        """Whether its state can be saved and set again."""
        return bool(self.interface.canGetAndSetFMUstate)

    def saved(self, into: Any = None) -> Any:
        """The state, for `restore`; `into`: one that is not needed any more."""
        get = self._fmu.getFMUState if self._three else self._fmu.getFMUstate
        if into is not None:
            (self._fmu.freeFMUState if self._three else self._fmu.freeFMUstate)(into)
        return get()

    def restore(self, state: Any) -> None:
        """Set a saved state."""
        (self._fmu.setFMUState if self._three else self._fmu.setFMUstate)(state)

    def _renew(self) -> None:
        """A fresh instance, or the old one reset where that gives the same."""
        from fmpy.fmi1 import FMICallException

        self._solver = None
        if self._fmu is not None and self._resets:
            try:
                self._fmu.reset()
                return
            except FMICallException:
                self._resets = False
        self._forget()
        kind = "CoSimulation" if self._stepping else "ModelExchange"
        self._fmu = fmpy().instantiate_fmu(self._archive.folder, self.description, kind)
        self._free = finalize(self, self._fmu.freeInstance)

    def never_reset(self) -> None:
        """Make a new instance for each episode from now on."""
        self._resets = False

    def _forget(self) -> None:
        if self._free is not None:
            self._free()
        self._fmu = self._free = self._solver = None

    def _update(self) -> bool:
        """Update discrete states until nothing changes; False where the FMU ends the simulation."""
        update = self._fmu.updateDiscreteStates if self._three else self._fmu.newDiscreteStates
        needed = True
        while needed:
            needed, ended, _, _, self._timed, self._next_event = update()
            if ended:
                return False
        return True

    def _integrate(self, until: float) -> bool:
        """Model exchange up to this time, over time, state and step events on the way."""
        fmu = self._fmu
        while self.time < until:
            timed = self._timed and self._next_event < until
            event, _, self.time = self._solver.step(self.time, self._next_event if timed else until)
            fmu.setTime(self.time)
            if self._completes:
                own, ended = fmu.completedIntegratorStep()
                if ended:
                    return False
                event = event or own
            if event or timed:
                fmu.enterEventMode()
                if not self._update():
                    return False
                fmu.enterContinuousTimeMode()
                self._solver.reset(self.time)
        return True

    @property
    def _completes(self) -> bool:
        return bool(self.interface.needsCompletedIntegratorStep)

    def _cvode(self) -> Any:
        from fmpy.sundials import CVodeSolver

        fmu = self._fmu
        return CVodeSolver(
            nx=self.description.numberOfContinuousStates,
            nz=self.description.numberOfEventIndicators,
            get_x=fmu.getContinuousStates,
            set_x=fmu.setContinuousStates,
            get_dx=fmu.getContinuousStateDerivatives if self._three else fmu.getDerivatives,
            get_z=fmu.getEventIndicators,
            get_nominals=fmu.getNominalsOfContinuousStates,
            set_time=fmu.setTime,
            input=_Held(),
            startTime=0.0,
            relativeTolerance=self._tolerance,
            maxNumSteps=100_000,
        )


class _Held:
    """Inputs that do not change between samples, as CVode's wrapper asks for them."""

    def apply(self, time: float) -> None:
        """Nothing is to be set."""


def digest_of(path: Path) -> str:
    """The SHA-256 of a file; ValueError if it cannot be read."""
    import hashlib

    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise ValueError(f"cannot read the FMU {shown(str(path))}: {error.strerror}") from error
