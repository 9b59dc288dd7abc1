# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A heated rod as an FMU compiled from C, of each version and interface, and its exact solution."""

from __future__ import annotations

import subprocess
import zipfile
from pathlib import Path

import numpy as np
import scipy.linalg

from pdeloop.messages.arrays import Array

SOURCE = Path(__file__).with_name("rod_fmu.c")
SEGMENTS, STEPS, SAMPLE = 20, 40, 0.1
EXPERIMENT = '<DefaultExperiment startTime="0" stopTime="3" stepSize="0.1"/>'


def rod(folder: Path, version: int, kind: str, *, reset: int = 0, options: str = "") -> Path:
    """Compile one. kind: CoSimulation or ModelExchange; reset: what fmi2Reset returns, or -1: nothing
    is reset.
    """
    binaries = "linux64" if version == 2 else "x86_64-linux"
    library, path = folder / "rod.so", folder / f"rod-{version}-{kind}-{reset}{len(options)}.fmu"
    flags = ["-shared", "-fPIC", "-O2", "-ffp-contract=off", f"-DFMI={version}", f"-DRESET={reset}"]
    subprocess.run(["cc", *flags, "-o", library, SOURCE, "-lm"], check=True)
    described = _two(kind, options) if version == 2 else _three(kind, options)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", '<?xml version="1.0"?>\n' + described)
        archive.write(library, f"binaries/{binaries}/rod.so")
    return path


def _two(kind: str, options: str) -> str:
    def real(name: str, reference: int, kinds: str, inner: str) -> str:
        return (
            f'<ScalarVariable name="{name}" valueReference="{reference}" {kinds}><Real {inner}/>'
            "</ScalarVariable>"
        )

    fixed, at = 'causality="parameter" variability="fixed"', range(SEGMENTS)
    variables = [
        real("q", 1, 'causality="input"', 'start="0" min="-50" max="2e6"'),
        real("k", 2, fixed, 'start="4"'),
        real("T0", 3, fixed, 'start="1"'),
        *(real(f"T[{i + 1}]", 4 + i, 'causality="output" initial="calculated"', "") for i in at),
        *(real(f"der(T[{i + 1}])", 24 + i, "", f'derivative="{4 + i}"') for i in at),
    ]
    outputs, rates = (
        "".join(f'<Unknown index="{first + i}"/>' for i in at) for first in (4, 4 + SEGMENTS)
    )
    return (
        f'<fmiModelDescription fmiVersion="2.0" modelName="rod" guid="rod"><{kind} '
        f'modelIdentifier="rod" {options}/>{EXPERIMENT}<ModelVariables>{"".join(variables)}'
        f"</ModelVariables><ModelStructure><Outputs>{outputs}</Outputs><Derivatives>{rates}"
        f"</Derivatives><InitialUnknowns>{outputs}{rates}</InitialUnknowns></ModelStructure>"
        "</fmiModelDescription>"
    )


def _three(kind: str, options: str) -> str:
    fixed = 'causality="parameter" variability="fixed"'
    return (
        f'<fmiModelDescription fmiVersion="3.0" modelName="rod" instantiationToken="rod"><{kind} '
        f'modelIdentifier="rod" {options}/>{EXPERIMENT}<ModelVariables>'
        '<Float64 name="time" valueReference="0" causality="independent" variability="continuous"/>'
        '<Float64 name="q" valueReference="1" causality="input" start="0"/>'
        f'<Float64 name="k" valueReference="2" {fixed} start="4"/>'
        f'<Float64 name="T0" valueReference="3" {fixed} start="1"/>'
        '<Float64 name="T" valueReference="4" causality="output"><Dimension start="20"/></Float64>'
        '<Float64 name="der(T)" valueReference="24" derivative="4"><Dimension start="20"/></Float64>'
        '</ModelVariables><ModelStructure><Output valueReference="4"/><ContinuousStateDerivative '
        'valueReference="24"/><InitialUnknown valueReference="4"/><InitialUnknown '
        'valueReference="24"/></ModelStructure></fmiModelDescription>'
    )


def rod_matrix(k: float = 4.0) -> Array:
    """A of T' = A T + 0.5 q."""
    ends = np.eye(SEGMENTS, k=1) + np.eye(SEGMENTS, k=-1) - 2 * np.eye(SEGMENTS)
    ends[0, 0] = ends[-1, -1] = -1.0
    return k * ends - 0.1 * np.eye(SEGMENTS)


def exact_step(T: Array, q: float, k: float = 4.0) -> Array:
    """The temperatures a sample later, with the input held."""
    A = rod_matrix(k)
    steady = -np.linalg.solve(A, np.full(SEGMENTS, 0.5 * q))
    return np.asarray(steady + scipy.linalg.expm(SAMPLE * A) @ (T - steady))


def euler_step(T: Array, q: float, k: float = 4.0) -> Array:
    """The same by the co-simulation's own Euler steps."""
    for _ in range(STEPS):
        T = T + SAMPLE / STEPS * (rod_matrix(k) @ T + 0.5 * q)
    return T
