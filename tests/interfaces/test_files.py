# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Damaged, forged and misplaced files: a sentence each, no link followed, nothing unpacked blindly."""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import re
import shutil
import zipfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from loop_interfaces import array_files
from loop_interfaces.files import (
    FileError,
    open_own,
    private_folder,
    read_json,
    write_atomically,
)
from loop_interfaces.spec import ParameterError, read_document
from pde_sim_node import run_record
from pdeloop import domain, live
from pdeloop.cli import FAILED, main
from pdeloop.commands import new
from pdeloop.report.data import gather
from pdeloop.training_run import unused
from tests.support.made_once import made_once
from tests.support.small import SMALL, parameters
from tuner_node import checkpoint, training_state
from tuner_node.build import build_training
from tuner_node.run_folder import RunFolder, RunFolderError
from tuner_node.run_store import open_run

SHOWN = ("behaviour", "gains", "orders", "spectrum")
"""The figures of a problem in the report of a training by two_point."""
by_both = pytest.mark.parametrize("finished", ["two_point", "gauss_newton"], indirect=True)


@pytest.fixture(scope="module")
def finished(request, tmp_path_factory) -> Path:
    """The folder of a finished run of the small problem, by two_point or by the optimizer asked for."""
    optimizer = getattr(request, "param", "two_point")

    def make(folder: Path) -> Path:
        out = folder / "run"
        options = ["--in-process", "--optimizer", optimizer, "--rollouts", "15", "--out", str(out)]
        assert main(["train", str(SMALL), *options]) == 0
        return out

    return made_once(tmp_path_factory, f"run-by-{optimizer}", make)


@pytest.fixture
def run(finished, tmp_path) -> Path:
    """A copy of it that may be damaged."""
    return Path(shutil.copytree(finished, tmp_path / "run"))


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


@by_both
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
            sealed(good | {name: others[i]}) for i in rng.choice(len(others), 2, replace=False)
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


def test_an_archive_is_refused_before_it_is_unpacked(tmp_path, monkeypatch):
    path = tmp_path / "policy.npz"
    np.savez_compressed(path, policy=np.zeros(2**20))
    assert path.stat().st_size < 2**15
    assert array_files.read_arrays(path)["policy"].shape == (2**20,)
    monkeypatch.setattr(array_files, "MAX_ARRAY_BYTES", 2**22)
    with pytest.raises(FileError, match=r"holds 83\d+ bytes of arrays; expected at most 4194304"):
        array_files.read_arrays(path)
    # One whose header promises more than it holds.
    with zipfile.ZipFile(path, "w") as archive:
        header = io.BytesIO()
        np.lib.format.write_array_header_1_0(
            header, {"descr": "<f8", "fortran_order": False, "shape": (2**40,)}
        )
        archive.writestr("policy.npy", header.getvalue())
    with pytest.raises(FileError, match="holds no arrays"):
        array_files.read_arrays(path)


def test_a_checkpoint_of_any_size_is_read_but_none_that_unpacks_to_more_than_it_is(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(array_files, "MAX_ARRAY_BYTES", 100)  # of policies and models
    path, found = tmp_path / "checkpoint", []
    checkpoint.save(path, {"states": np.zeros(2**16)})
    assert checkpoint.restore(path, found.append) == (True, [])
    assert found[0]["states"].shape == (2**16,)
    bomb = io.BytesIO()
    np.savez_compressed(bomb, states=np.zeros(2**16))
    digest = hashlib.sha256(bomb.getvalue()).hexdigest().encode()
    path.write_bytes(checkpoint.MAGIC + digest + b"\n" + bomb.getvalue())
    usable, (sentence,) = checkpoint.restore(path, found.append)
    assert not usable and "bytes of arrays; expected at most" in sentence


def test_json_that_nothing_can_hold_is_refused(tmp_path):
    path = tmp_path / "result.json"
    for text in ("[" * 100_000, f'{{"a": {"9" * 5000}}}', f'{{"a": {-(2**63) - 1}}}'):
        path.write_text(text)
        with pytest.raises(FileError, match="is not JSON"):
            read_json(path)
    path.write_text(f'{{"a": {-(2**63)}}}')
    assert read_json(path) == {"a": -(2**63)}


def test_what_cannot_be_written_is_named_and_no_half_of_it_stays(tmp_path, monkeypatch):
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left") as failed:
        write_atomically(tmp_path / "file", b"content")
    assert failed.value.filename == str(tmp_path / "file")
    with pytest.raises(FileError, match=f"cannot write to {tmp_path}/my-pde: No space left"):
        new.write("my-pde", tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_terminal_does_not_obey_what_a_file_says(tmp_path, capsys):
    path = tmp_path / "study.yaml"
    path.write_text('problems: ["\\e[31mred\\a"]\n')
    assert main(["study", str(path), "--out", str(tmp_path / "out")]) == FAILED
    error = capsys.readouterr().err
    assert "\\x1b[31mred\\x07" in error and "\x1b" not in error


def test_a_pipe_in_place_of_a_file_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "study.yaml")
    with pytest.raises(ParameterError, match="not a regular file"):
        read_document(tmp_path / "study.yaml")
    os.mkfifo(tmp_path / "policy.npz")
    with pytest.raises(FileError, match="not a regular file"):
        array_files.read_arrays(tmp_path / "policy.npz")
    os.mkfifo(tmp_path / "lock")
    with pytest.raises(OSError, match="not a regular file"):
        open_own(tmp_path / "lock", 0)


@pytest.mark.parametrize("name", ["lock", "progress.jsonl", "checkpoint.part", "run.json.part"])
def test_a_link_in_a_run_folder_is_not_followed(run, tmp_path, name, capsys):
    victim = tmp_path / "victim"
    victim.write_text("precious")
    (run / "result.json").unlink()
    (run / name).unlink(missing_ok=True)
    (run / name).symlink_to(victim)
    code = main(["train", "--resume", str(run), "--in-process"])
    text = capsys.readouterr()
    assert victim.read_text() == "precious"
    if name == "lock":
        assert code == FAILED and "it is a symbolic link" in text.err
    else:
        assert code == 0
    if name == "progress.jsonl":
        assert "cannot write progress" in text.out and "it is a symbolic link" in text.out


@pytest.mark.parametrize("name", ["logs", "logs/pde_sim_node.log"])
def test_a_link_in_place_of_the_logs_is_refused_in_one_sentence(run, tmp_path, name, capsys):
    (run / "result.json").unlink()
    (tmp_path / "victims").mkdir()
    victim = tmp_path / "victims" / "pde_sim_node.log"
    victim.write_text("precious")
    (run / name).parent.mkdir(exist_ok=True)
    (run / name).symlink_to(victim if "/" in name else victim.parent)
    assert main(["train", "--resume", str(run)]) == FAILED
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"pdeloop: it is a symbolic link ({run / name})"
    assert victim.read_text() == "precious"
    assert list(victim.parent.iterdir()) == [victim]


def test_a_link_that_leads_nowhere_is_no_free_name_for_a_bag(tmp_path):
    (tmp_path / "bag").symlink_to(tmp_path / "elsewhere")
    assert unused(tmp_path / "bag") == tmp_path / "bag-2"


def test_links_in_the_folder_of_the_domains_harm_nobody(tmp_path, monkeypatch):
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    victim = tmp_path / "victim"
    victim.write_text("precious")
    folder = tmp_path / "domains"
    for module in (domain, live):
        monkeypatch.setattr(module, "DOMAINS_FOLDER", folder)
    folder.mkdir(mode=0o777)
    for number in domain.DOMAINS:
        (folder / str(number)).symlink_to(victim)
        (folder / f"new-live-{os.getpid()}-{number}").symlink_to(victim)
    with pytest.raises(OSError, match="it is a symbolic link"), domain.own_domain():
        pass
    with live.announced(7, tmp_path):
        assert [found.domain for found in live.running()] == [7]
    assert victim.read_text() == "precious"
    assert folder.stat().st_mode & 0o777 == 0o700


def test_the_folder_of_the_domains_must_be_this_users_own(tmp_path, monkeypatch):
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    (tmp_path / "elsewhere").mkdir()
    link = tmp_path / "domains"
    link.symlink_to(tmp_path / "elsewhere")
    for module in (domain, live):
        monkeypatch.setattr(module, "DOMAINS_FOLDER", link)
    with pytest.raises(domain.DomainError, match="is not a folder of this user"):
        domain.own_domain().__enter__()
    with live.announced(7, tmp_path):
        assert live.running() == []
    assert list((tmp_path / "elsewhere").iterdir()) == []
    if os.getuid() == 0:
        foreign = tmp_path / "foreign"
        foreign.mkdir(mode=0o777)
        os.chown(foreign, 12345, 12345)
        with pytest.raises(FileError, match="is not a folder of this user"):
            private_folder(foreign)


@pytest.mark.parametrize(
    "name", ["../../../escaped", "a/b", "..", ".hidden", "", "x" * 101, "a\0b"]
)
def test_a_problems_name_is_no_path(tmp_path, name, capsys):
    text = SMALL.read_text().replace("problem: small", f"problem: {json.dumps(name)}")
    (tmp_path / "small.yaml").write_text(text)
    out = tmp_path / "run"
    assert (
        main(["train", str(tmp_path / "small.yaml"), "--in-process", "--out", str(out)]) == FAILED
    )
    assert "expected at most 100 letters, digits" in capsys.readouterr().err
    assert not out.exists()


def test_a_report_stays_in_its_folder(run, capsys):
    path = run / "parameters.yaml"
    path.write_text(path.read_text().replace("problem: small", "problem: ../../../escaped"))
    for command in (["evaluate", str(run)], ["report", str(run)]):
        assert main(command) == FAILED
        assert "parameter 'problem' is '../../../escaped'" in capsys.readouterr().err


def test_a_report_follows_no_link(run, tmp_path, capsys, undrawn):
    victims = tmp_path / "victims"
    victims.mkdir()
    (run / "report").symlink_to(victims)
    assert main(["report", str(run)]) == FAILED
    told = f"cannot write the report to {run / 'report'}: it is a symbolic link"
    assert told in capsys.readouterr().err
    assert list(victims.iterdir()) == []
    (run / "report").unlink()
    (run / "report").mkdir()
    # All files of this report, so that it need not be made twice.
    figures = ("training-curves", "costs", *(f"small-{of}" for of in SHOWN))
    names = {"index.html", *(f"{figure}.{kind}" for figure in figures for kind in ("png", "svg"))}
    for name in names:
        (victims / name).write_text("precious")
        (run / "report" / name).symlink_to(victims / name)
    assert main(["report", str(run)]) == 0
    assert {path.name for path in (run / "report").iterdir()} == names
    assert all((victims / name).read_text() == "precious" for name in names)
    assert not any((run / "report" / name).is_symlink() for name in names)


def test_a_part_that_a_crash_left_is_replaced(tmp_path):
    (tmp_path / "file.part").write_bytes(b"half of the conte")
    write_atomically(tmp_path / "file", b"new ", b"content")
    assert (tmp_path / "file").read_bytes() == b"new content"
    assert not (tmp_path / "file.part").exists()


def test_every_start_of_a_tuner_has_a_number_of_its_own_and_the_folder_to_itself(tmp_path):
    """Also one that is started by hand: `pdeloop train` locks the folder itself."""
    values = parameters(out=str(tmp_path / "run"), resume=False, plant_fingerprint=77)
    for incarnation in (1, 2, 3):
        with ExitStack() as locks, ExitStack() as others:
            _, identity = open_run(values, build_training(values), locks, print)
            assert identity.incarnation == incarnation
            assert json.loads((tmp_path / "run" / "run.json").read_text())["plant"] == 77
            values["resume"] = True
            with pytest.raises(RunFolderError, match="another process is working on the run"):
                open_run(values, build_training(values), others, print)


def test_a_checkpoint_that_could_not_be_written_is_written_when_it_can(tmp_path, monkeypatch):
    values, told = parameters(out=str(tmp_path / "run"), resume=False), []
    with ExitStack() as locks:
        writer, _ = open_run(values, build_training(values), locks, told.append)
        assert writer is not None
        writer.note({"event": "phase"})
        with monkeypatch.context() as full:
            full.setattr(
                checkpoint, "write_part", lambda path, *content: os.open(path, os.O_RDONLY)
            )
            writer.keep(now=0.0, force=True)
        assert "cannot write the checkpoint" in told[-1]
        assert not (tmp_path / "run" / "checkpoint").exists()
        writer.keep(now=1e6)  # nothing has happened since
        assert (tmp_path / "run" / "checkpoint").exists()


def test_a_line_after_one_that_a_full_disk_cut_off_is_whole(tmp_path):
    path = tmp_path / "progress.jsonl"
    path.write_bytes(b'{"event": "a"}\n{"event": "cut')
    RunFolder(tmp_path).note({"event": "b"})
    assert path.read_bytes() == b'{"event": "a"}\n{"event": "cut\n{"event": "b"}\n'


def test_records_of_plants_are_removed_in_this_users_own_folder_alone(tmp_path):
    """A link of somebody else in the temporary folder may lead to files of the same names."""
    other = tmp_path / "other"
    other.mkdir(mode=0o700)
    (other / "7+pde_sim_node").write_text("theirs")
    link = tmp_path / "link"
    link.symlink_to(other)
    run_record.forget(7, link)
    assert (other / "7+pde_sim_node").exists()
    run_record.forget(7, tmp_path / "none")
    (other / "7+folder").mkdir()
    run_record.forget(7, other)
    assert not (other / "7+pde_sim_node").exists()


def test_a_folder_with_a_run_is_refused_with_what_can_be_done_with_that(finished, tmp_path, capsys):
    """A run that is complete cannot be continued: each advice is one that works."""
    words = ["train", str(SMALL), "--in-process", "--out"]
    assert main([*words, str(finished)]) == FAILED
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith(f"see its results: pdeloop report {finished}")
    RunFolder(tmp_path / "begun").create(parameters())
    assert main([*words, str(tmp_path / "begun")]) == FAILED
    (line,) = capsys.readouterr().err.splitlines()
    assert f"continue it with: pdeloop train --resume {tmp_path / 'begun'}" in line
