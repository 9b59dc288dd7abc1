# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Laws as FMUs, ONNX models and MATLAB files, read back by FMPy, onnxruntime and python-control."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat

import pdeloop
from pdeloop.cli import main
from pdeloop.finished_run import FinishedRun
from pdeloop.law_form import law_form
from pdeloop.messages.action_set import NO_BOUND
from pdeloop.messages.arrays import Array
from tests.support.small import SMALL

LIMIT, RATE = 0.2, 0.15
QUICK: dict[str, Any] = {"optimizer": "two_point", "rollouts": 6, "evaluation_fields": 2}
SENSED = {"law": "observer", "sensors": 8}
RATED = {"action_bounds": [*4 * [-LIMIT], *4 * [LIMIT], 0.0, RATE, *3 * [NO_BOUND]]}
LAWS: dict[str, dict[str, Any]] = {
    "affine": {"action_limit": LIMIT},
    "observer": {"action_limit": LIMIT, **SENSED},
    "affine-rated": RATED,
    "observer-rated": {**RATED, **SENSED},
}


@pytest.fixture(scope="module", params=LAWS)
def run(request: Any, tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    out = tmp_path_factory.mktemp("runs") / request.param
    return pdeloop.train(str(SMALL), **LAWS[request.param], horizon=20, **QUICK, out=out)


def readings(run: FinishedRun) -> Array:
    n_y = len(run.models[0].U)
    scale = 3.0 if n_y > 8 else 1000.0
    return np.asarray(scale * np.random.default_rng(0).standard_normal((15, n_y)))


def answers(run: FinishedRun) -> Array:
    """The actions of the law of the loop, some of them at the limits."""
    law = run.law()
    found = np.array([law(k, y[None])[0] for k, y in enumerate(readings(run))])
    assert (np.abs(found) == LIMIT).any() and (np.abs(found) < LIMIT).any()
    moved = np.abs(np.diff(found[:, 0], prepend=0.0))
    assert (moved.max() > RATE + 0.01) == (law_form(run).action_set.rated is False)
    return found


def within(known: Any, requested: Array, before: Array | None) -> Array:
    """P, as docs/deploy.md says."""
    low, high = known["low"].ravel(), known["high"].ravel()
    if "rate" in known:
        a, rate = known["start"].ravel() if before is None else before, known["rate"].ravel()
        low, high = np.maximum(low, a - rate), np.minimum(high, a + rate)
    return np.clip(requested, low, high)


def exported(run: FinishedRun, name: str, path: Path) -> Path:
    assert main(["export", str(run.folder), f"--{name}", str(path)]) == 0
    return path


@pytest.mark.skipif(
    importlib.util.find_spec("fmpy") is None, reason="FMPy is not installed: extra fmi"
)
@pytest.mark.skipif(
    shutil.which("cc") is None, reason="needs a C compiler, the command cc (make packages)"
)
def test_the_fmu_of_a_law_is_the_law_step_by_step(run: FinishedRun, tmp_path: Path) -> None:
    import fmpy
    from fmpy.validation import validate_fmu

    path = exported(run, "fmu", tmp_path / "law.fmu")
    assert validate_fmu(str(path)) == []
    description, folder = fmpy.read_model_description(str(path)), tmp_path / "unpacked"
    fmpy.extract(str(path), str(folder))
    law = fmpy.instantiate_fmu(str(folder), description)
    n_y, sample = len(run.models[0].U), run.values["sample_time"]
    ys, expected = readings(run), answers(run)

    def steps(first: int, end: int) -> Array:
        found = []
        for k, y in enumerate(ys[first:end], first):
            law.setReal(list(range(n_y)), y.tolist())
            law.doStep(begin + k * sample, sample / 2)
            law.setReal([0], [0.0])  # between samples the action is held
            law.doStep(begin + k * sample + sample / 2, sample / 2)
            found.append(law.getReal(list(range(n_y, n_y + run.values["n_a"]))))
        return np.array(found)

    for begin in (0.0, 1000.0 * sample):  # wherever the clock of the simulation begins
        law.setupExperiment(startTime=begin)
        law.enterInitializationMode()
        law.exitInitializationMode()
        found = steps(0, 5)
        kept = law.getFMUState()
        rest = steps(5, len(ys))
        np.testing.assert_allclose([*found, *rest], expected, rtol=1e-9, atol=1e-12)
        law.setFMUState(kept)  # with the action before, as rate limits need
        assert np.array_equal(steps(5, len(ys)), rest)
        law.freeFMUState(kept)
        law.reset()
    # A longer step of the simulation has as many of the law, for the inputs that it holds.
    law.setupExperiment(startTime=0.0)
    law.enterInitializationMode()
    law.exitInitializationMode()
    law.setReal(list(range(n_y)), ys[0].tolist())
    law.doStep(0.0, 3 * sample)
    act = run.law()
    held = [act(k, ys[:1])[0] for k in range(3)]
    found = law.getReal(list(range(n_y, n_y + run.values["n_a"])))
    np.testing.assert_allclose(found, held[-1], rtol=1e-9, atol=1e-12)
    law.freeInstance()


def test_the_onnx_model_of_a_law_is_the_law(
    run: FinishedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("onnx", "onnxruntime"):
        if importlib.util.find_spec(name) is None:
            pytest.skip("onnx and onnxruntime are not installed: extra onnx")
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # where its import leaves a file
    import onnxruntime

    path = exported(run, "onnx", tmp_path / "law.onnx")
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    memory = {"p": np.zeros(run.models[0].U.shape[1]), "started": np.array(False)}
    memory["a_before"] = np.full(run.values["n_a"], 9.0)  # not used before it has started
    known = {item.name for item in session.get_inputs()}
    found = []
    for y in readings(run):
        given = {name: array for name, array in memory.items() if name in known}
        a, *after = session.run(None, {"y": y, **given})
        found.append(a)
        p = after[0] if after else memory["p"]
        memory = {"p": p, "a_before": a, "started": np.array(True)}
    np.testing.assert_allclose(found, answers(run), rtol=1e-9, atol=1e-12)


def test_the_matlab_file_of_a_law_has_its_matrices_and_its_loop(
    run: FinishedRun, tmp_path: Path, capsys: Any
) -> None:
    known = loadmat(exported(run, "matlab", tmp_path / "law.mat"))
    law, model = law_form(run), run.models[0]
    told = f"closed loop on the identified model: {law.spectral_radius:.4g}"
    assert told in capsys.readouterr().out
    ys = 1e-4 * readings(run)  # an observer's matrices are those within the bounds
    act = run.law()
    expected = np.array([act(k, y[None])[0] for k, y in enumerate(ys)])
    if law.kind == "affine":
        found, a = [], None
        for y in ys:
            a = within(known, known["K"] @ y + known["constant"].ravel(), a)
            found.append(a)
        closed = model.A + model.B @ known["K"] @ model.U
    else:
        A, B, C, D = (known[name] for name in "ABCD")
        x, found, feed = known["Ut"] @ ys[0], [], D[:, :-1] @ model.U
        for y in ys:
            u = np.append(y, 1.0)
            found.append(C @ x + D @ u)
            x = A @ x + B @ u
        y, held, a = readings(run), [], None
        x = known["Ut"] @ y[0]
        for u in np.column_stack([y, np.ones(len(y))]):
            a = within(known, C @ x + D @ u, a)
            held.append(a)
            x = known["F"] @ x + known["G"] @ u + known["H"] @ a
        np.testing.assert_allclose(held, answers(run), rtol=1e-9, atol=1e-12)
        closed = np.block([[model.A + model.B @ feed, model.B @ C], [B[:, :-1] @ model.U, A]])
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    assert np.abs(np.linalg.eigvals(closed)).max() == pytest.approx(law.spectral_radius)
    assert known["spectral_radius"].item() == law.spectral_radius
    assert known["Ts"].item() == run.values["sample_time"]


def test_python_control_reads_it(run: FinishedRun, tmp_path: Path) -> None:
    if importlib.util.find_spec("control") is None:
        pytest.skip("python-control is not installed: extra extras")
    import control

    known = loadmat(exported(run, "matlab", tmp_path / "law.mat"))
    if "A" not in known:
        system = control.ss([], [], [], known["K"], known["Ts"].item())
        assert (system.ninputs, system.noutputs) == known["K"].shape[::-1]
        return
    system = control.ss(*(known[name] for name in "ABCD"), known["Ts"].item())
    poles = np.sort_complex(system.poles())
    assert np.allclose(poles, np.sort_complex(np.linalg.eigvals(known["A"])))


def test_a_file_of_another_ending_and_a_law_without_matrices_are_refused(
    tmp_path: Path, capsys: Any
) -> None:
    out = tmp_path / "run"
    run = pdeloop.train(str(SMALL), law="feedforward", horizon=10, **QUICK, out=out)
    assert main(["export", str(run.folder), "--onnx", str(tmp_path / "law.txt")]) == 1
    assert "--onnx is" in capsys.readouterr().err
    assert main(["export", str(run.folder), "--matlab", str(tmp_path / "law.mat")]) == 1
    assert "has no such form; train with --law affine or observer" in capsys.readouterr().err
    assert not (tmp_path / "law.mat").exists()
