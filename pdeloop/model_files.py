# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law as a co-simulation FMU, an ONNX model or a MATLAB file."""

from __future__ import annotations

import hashlib
import subprocess
import zipfile
from io import BytesIO
from pathlib import Path
from string import Template
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from pdeloop.law_form import LawForm
from pdeloop.messages.arrays import Array
from pdeloop.messages.spec import ParameterError

_TEMPLATE = Path(__file__).parent / "commands" / "template" / "fmu.c.txt"
_OPSET, _IR = 17, 9
"""Versions of ONNX that its runtimes have known since 2023."""


def fmu(law: LawForm, source: bytes) -> bytes:
    """An FMU of FMI 2.0 for co-simulation, compiled from the law in C99 by `cc`.

    Its inputs are y[1] .. y[n_y], its outputs a[1] .. a[n_a]; a step of the law is made at each
    multiple of the sample time.
    source: the law in C99, as `pdeloop export --out law.c` writes it. ValueError if there is no
    compiler, or it fails.
    """
    call = "pdeloop_law(&law->memory, law->y, law->a)"
    memory = "pdeloop_memory memory;"
    if law.kind != "observer":
        call, memory = "pdeloop_law(law->y, law->a)", ""
    start = "memcpy(law->a, pdeloop_start, sizeof law->a);" if law.action_set.rated else ""
    wrapper = Template(_TEMPLATE.read_text()).substitute(
        call=call, memory=memory, start=start, sample_time=float(law.sample_time).hex()
    )
    code = source + b"\n" + wrapper.encode()
    with TemporaryDirectory() as folder:
        path, library = Path(folder) / "law.c", Path(folder) / "law.so"
        path.write_bytes(code)
        command = ["cc", "-std=c99", "-O2", "-shared", "-fPIC", "-ffp-contract=off"]
        try:
            done = subprocess.run(
                [*command, "-o", library, path, "-lm"], capture_output=True, text=True, timeout=300
            )
        except FileNotFoundError:
            raise ParameterError(
                "an FMU is compiled by a C compiler, and there is no command cc: install one"
            ) from None
        if done.returncode:
            raise ParameterError(f"the C compiler fails: {done.stderr.strip().splitlines()[0]}")
        content = BytesIO()
        with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("modelDescription.xml", _description(law, code))
            archive.writestr("sources/law.c", code)
            archive.write(library, "binaries/linux64/law.so")
    return content.getvalue()


def _description(law: LawForm, code: bytes) -> str:
    def variable(name: str, reference: int, kind: str, start: str) -> str:
        return (
            f'<ScalarVariable name="{name}" valueReference="{reference}" causality="{kind}" '
            f'variability="discrete"{start}</ScalarVariable>'
        )

    variables = [variable(f"y[{i + 1}]", i, "input", '><Real start="0"/>') for i in range(law.n_y)]
    variables += [
        variable(f"a[{k + 1}]", law.n_y + k, "output", ' initial="calculated"><Real/>')
        for k in range(law.n_a)
    ]
    outputs = "".join(f'<Unknown index="{law.n_y + k + 1}"/>' for k in range(law.n_a))
    digest = hashlib.sha256(code).hexdigest()[:32]
    step = repr(law.sample_time)
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<fmiModelDescription fmiVersion="2.0" modelName="law" '
        f'guid="{digest}" generationTool="pdeloop"><CoSimulation modelIdentifier="law" '
        'canHandleVariableCommunicationStepSize="true" canGetAndSetFMUstate="true"/>'
        f'<DefaultExperiment startTime="0" stepSize="{step}"/><ModelVariables>{"".join(variables)}'
        f"</ModelVariables><ModelStructure><Outputs>{outputs}</Outputs><InitialUnknowns>{outputs}"
        "</InitialUnknowns></ModelStructure></fmiModelDescription>\n"
    )


def onnx(law: LawForm) -> bytes:
    """An ONNX model in float64: y (n_y,) to a (n_a,).

    An observer also takes its prediction p (n_s,), a law with rate limits the action before,
    a_before (n_a,), and both whether they have `started`; an observer also gives p_next.

    ParameterError without the package onnx, for actions of mean zero and a target that moves.
    """
    try:
        from onnx import TensorProto, helper, numpy_helper
    except ImportError as error:
        raise ParameterError("an ONNX model needs onnx: pip install 'pdeloop[onnx]'") from error
    law.require_constant()
    if law.action_set.zero_mean:
        raise ParameterError(
            "actions of mean zero have no form in ONNX; export the law as C or --ros2"
        )
    rated, limits = law.action_set.rated, law.action_set.limits(law.n_a)
    constants: dict[str, Array] = {"Ut": law.arrays["U"].T, **limits}
    constants |= {name: array for name, array in law.arrays.items() if name != "U"}
    node, nodes = helper.make_node, []

    def computed(out: str, *terms: tuple[str, str], constant: str) -> None:
        """out = sum of matrix times vector, plus a constant."""
        last = constant
        for i, (matrix, vector) in enumerate(terms):
            nodes.append(node("MatMul", [matrix, vector], [f"{out}_{i}"]))
            last_of = out if i == len(terms) - 1 else f"{out}_sum{i}"
            nodes.append(node("Add", [last, f"{out}_{i}"], [last_of]))
            last = last_of

    def vector(name: str, size: int, kind: int = TensorProto.DOUBLE) -> Any:
        return helper.make_tensor_value_info(name, kind, [size] if size else [])

    n_s, bounds = law.arrays["U"].shape[1], ("low", "high")
    nodes.append(node("MatMul", ["Ut", "y"], ["s"]))
    inputs, outputs = [vector("y", law.n_y)], [vector("a", law.n_a)]
    if law.kind == "observer":
        inputs.append(vector("p", n_s))
    if rated or law.kind == "observer":
        inputs.append(vector("started", 0, TensorProto.BOOL))
    if rated:
        bounds = "least", "most"
        inputs.append(vector("a_before", law.n_a))
        nodes.append(node("Where", ["started", "a_before", "start"], ["before"]))
        for near, side, change, far in (
            ("least", "Max", "Sub", "low"),
            ("most", "Min", "Add", "high"),
        ):
            nodes.append(node(change, ["before", "rate"], [f"{near}_near"]))
            nodes.append(node(side, [f"{near}_near", far], [near]))
    if law.kind == "affine":
        computed("requested", ("K", "s"), constant="constant")
    elif law.kind == "neural":
        computed("into", ("W", "s"), constant="w")
        nodes.append(node("Tanh", ["into"], ["hidden"]))
        computed("requested", ("K", "s"), ("D", "hidden"), constant="c")
    else:
        outputs += [vector("p_next", n_s)]
        nodes.append(node("Where", ["started", "p", "s"], ["prediction"]))
        computed("requested", ("K", "prediction"), ("D", "s"), constant="b")
    nodes.append(node("Max", ["requested", bounds[0]], ["raised"]))
    nodes.append(node("Min", ["raised", bounds[1]], ["a"]))
    if law.kind == "observer":
        computed("p_next", ("F", "prediction"), ("G", "s"), ("B", "a"), constant="c")
    graph = helper.make_graph(
        nodes,
        "law",
        inputs,
        outputs,
        [numpy_helper.from_array(np.ascontiguousarray(a), n) for n, a in constants.items()],
    )
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR, doc_string=law.name
    )
    content: bytes = model.SerializeToString()
    return content


def matlab(law: LawForm) -> bytes:
    """A MATLAB file, as `load`, Simulink's State-Space block and python-control take it.

    A static law is a = P(K y + constant). An observer is x <- A x + B [y; 1], a = C x + D [y; 1] as
    long as no action is at a limit, and always a = P(C x + D [y; 1]), x <- F x + G [y; 1] + H a, with
    x_0 = Ut y_0. `low`, `high` and `zero_mean` say what P is, with rate limits also `rate`, and
    `start`, the action before the first; `Ts` is the sample time, and `spectral_radius` that of the
    closed loop on the identified model.
    """
    from scipy.io import savemat

    law.require_matrices()
    own, Ut = law.arrays, law.arrays["U"].T
    if law.kind == "affine":
        known: dict[str, Any] = {"K": own["K"] @ Ut, "constant": own["constant"][:, None]}
    else:
        feedthrough = np.column_stack([own["D"] @ Ut, own["b"]])
        predicted = np.column_stack([own["G"] @ Ut, own["c"]])
        known = {
            "A": own["F"] + own["B"] @ own["K"],
            "B": predicted + own["B"] @ feedthrough,
            "C": own["K"],
            "D": feedthrough,
            "F": own["F"],
            "G": predicted,
            "H": own["B"],
            "Ut": Ut,
        }
    content = BytesIO()
    savemat(
        content,
        known
        | {name: limit[:, None] for name, limit in law.action_set.limits(law.n_a).items()}
        | {"zero_mean": law.action_set.zero_mean}
        | {"Ts": law.sample_time, "spectral_radius": law.spectral_radius, "law": law.name},
    )
    return content.getvalue()
