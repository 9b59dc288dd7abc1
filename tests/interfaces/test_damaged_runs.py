# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Damaged and forged files of a run: a sentence each, nothing unpacked blindly."""

from __future__ import annotations

import hashlib
import io
import json
import re
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest

from pdeloop.cli import FAILED, main
from pdeloop.report.data import gather
from tuner_node import checkpoint, training_state
from tuner_node.run_folder import RunFolder, RunFolderError

by_both = pytest.mark.parametrize("finished", ["two_point", "model_based"], indirect=True)


def contents(good: bytes) -> Iterator[bytes]:
    """A file cut off, with flipped bits, and something else altogether."""
    rng = np.random.default_rng(0)
    for size in (0, 1, 4, 30, len(good) // 2, len(good) - 40, len(good) - 1):
        yield good[:size]
    for position in rng.integers(0, len(good), 40):
        yield (
            good[:position]
            + bytes([good[position] ^ (1 << rng.integers(8))])
            + good[position + 1 :]
        )
    yield rng.bytes(2000)
    yield b"\x80\x04K\x01."  # a pickle


def arrays_like(good: np.ndarray) -> Iterator[np.ndarray]:
    """Arrays of wrong shapes, types and values."""
    yield from (good[np.newaxis], good.ravel()[:0], good.ravel()[:1], np.array(1.0), good.T)
    if good.ndim:
        yield from (good[:0], good[..., :0], np.concatenate([good, good]))
    if good.dtype.kind in "if":
        yield from (good.astype(str), good.astype(complex), good.astype("S3"), good > 0)
    if good.dtype.kind == "f":
        yield from (
            np.full_like(good, np.nan),
            np.full_like(good, np.inf),
            np.zeros(good.shape, np.int64),
            good.astype(np.float32),
            good.astype(np.longdouble),
            good.astype(">f8"),
        )
    yield np.zeros(good.shape, dtype=[("a", float)])


def packed(arrays: dict[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def refused(task: Callable[[], Any]) -> str | None:
    """The sentence with which a folder is refused, None if it is taken."""
    try:
        task()
    except RunFolderError as error:
        return str(error)
    return None


@pytest.mark.usefixtures("read_once")
def test_damaged_policies_are_refused_in_one_sentence(run):
    folder, path = RunFolder(run), run / "policy.npz"
    good = path.read_bytes()
    with np.load(path) as archive:
        arrays = dict(archive)
    for content in contents(good):
        path.write_bytes(content)
        sentence = refused(folder.policies)
        if sentence is None:  # a bit of a time stamp or of padding
            assert all(np.array_equal(folder.policies()[k], arrays[k]) for k in ("policy", "model"))
        else:
            assert sentence.startswith(f"{path} cannot be read (")
    wrong = [packed({})]
    for name in ("policy", "lqt", "model"):
        wrong.append(packed({k: v for k, v in arrays.items() if k != name}))
        wrong += [packed(arrays | {name: other}) for other in arrays_like(arrays[name])]
    for content in wrong:
        path.write_bytes(content)
        assert (refused(folder.policies) or "").startswith(f"{path} cannot be read (")


@pytest.fixture
def read_once(run, monkeypatch) -> None:
    """The parameters, which are not damaged, are not read again for each damage."""
    known = RunFolder(run).values()
    monkeypatch.setattr(RunFolder, "values", lambda _: dict(known))


@by_both
@pytest.mark.usefixtures("read_once")
def test_a_damaged_result_is_refused_in_one_sentence(run):
    folder, path = RunFolder(run), run / "result.json"
    good = json.loads(path.read_text())
    things = (
        None,
        1,
        10**400,
        -1e300,
        float("nan"),
        "text",
        [],
        {},
        [[]],
        [1, 2],
        [{"seed": 7}],
        True,
    )
    wrong = [json.dumps(thing) for thing in things] + ["{" * 50_000, "[" * 50_000, '{"a":' * 50_000]
    for name in ("costs_by_field", "history", "seed", "seeds", "rollouts", "environment"):
        wrong += [json.dumps(good | {name: thing}) for thing in things]
    row = dict(good["history"][0])
    for name in ("rollouts", "seed", "accepted"):
        wrong += [json.dumps(good | {"history": [row | {name: thing}]}) for thing in things]
    counted = good["rollouts"][0]
    wrong += [json.dumps(good | {"rollouts": [counted | {"check": thing}]}) for thing in things]
    del counted["total"]
    wrong += [json.dumps(good | {"rollouts": [counted]})]
    for name in ("none", "lqt", "adapted"):
        costs = [good["costs_by_field"] | {name: thing} for thing in things]
        wrong += [json.dumps(good | {"costs_by_field": c}) for c in costs]
    for text in wrong:
        path.write_text(text)
        sentence = refused(folder.result)
        if sentence is None:
            gather(run)  # what is taken can be reported
        else:
            assert sentence.startswith(f"{path} cannot be used (")
    path.write_bytes(b"\xff\xfe\x00")
    assert "cannot be used" in (refused(folder.result) or "")


def sealed(arrays: dict[str, np.ndarray]) -> bytes:
    """A checkpoint with a good checksum, whatever is in it."""
    body = packed(arrays)
    return checkpoint.MAGIC + hashlib.sha256(body).hexdigest().encode() + b"\n" + body


@by_both
def test_forged_checkpoints_with_a_good_checksum_are_passed_over(run, capsys):
    (run / "result.json").unlink()
    policy = (run / "policy.npz").read_bytes()
    path = run / "checkpoint"
    with path.open("rb") as file:
        file.readline()
        with np.load(io.BytesIO(file.read())) as archive:
            good = dict(archive)
    previous = checkpoint.previous(path).read_bytes()
    rng = np.random.default_rng(0)
    wrong: list[bytes] = []
    # One rollout of many: all are read alike.
    for name in {re.sub(r"\d+", "", name): name for name in good}.values():
        array = good[name]
        wrong.append(sealed({k: v for k, v in good.items() if k != name}))
        others = [a for a in arrays_like(array) if a.shape != array.shape or a.dtype != array.dtype]
        wrong += [
            sealed(good | {name: others[i]}) for i in rng.choice(len(others), 1, replace=False)
        ]
    wrong += [
        sealed(good | {"phase": np.array("sleep")}),
        sealed(good | {"history": np.array("[")}),
    ]
    wrong += [sealed(good | {"phase": np.array(phase)}) for phase in ("identify", "check", "adapt")]
    history = ('[{"seed": "x", "rollouts": null}]', f'[{{"seed": 0, "rollouts": {10**30}}}]')
    wrong += [sealed(good | {"history": np.array(text)}) for text in history]
    values = RunFolder(run).values()
    for content in wrong:
        path.write_bytes(content)
        checkpoint.previous(path).write_bytes(previous)
        training = build(values)
        found, passed_over = checkpoint.restore(path, partial(training_state.restore, training))
        assert found and len(passed_over) <= 1
        training.next_batch()
    # And by the command, which goes on from the one before, to the same policy.
    path.write_bytes(sealed(good | {"plant": np.array("x")}))
    checkpoint.previous(path).write_bytes(previous)
    capsys.readouterr()
    assert main(["train", "--resume", str(run), "--in-process"]) == 0
    assert "does not fit this training" in capsys.readouterr().out
    assert (run / "policy.npz").read_bytes() == policy


def build(values: dict[str, Any]) -> Any:
    from tuner_node.build import build_training

    return build_training(values)


def test_damaged_run_files_end_the_commands_with_one_line(run, capsys):
    (run / "result.json").write_text('{"seed": []}')
    (run / "policy.npz").write_bytes(b"PK\3\4nonsense")
    capsys.readouterr()
    commands = (["evaluate", str(run)], ["report", str(run)])
    for command in commands:
        assert main(command) == FAILED
        (line,) = capsys.readouterr().err.splitlines()
        assert "policy.npz cannot be read" in line
    (run / "result.json").unlink()
    for text in ("[]", "{}", '{"run": 1e999, "incarnation": 0, "parameters": {}}', '{"run": {}}'):
        (run / "run.json").write_text(text)
        assert main(["train", "--resume", str(run), "--in-process"]) == FAILED
        (line,) = capsys.readouterr().err.splitlines()
        assert "run.json cannot be used" in line or "has other parameters" in line
