# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A file is read within bounds or refused in a sentence, and written whole or not at all."""

from __future__ import annotations

import errno
import hashlib
import io
import os
import zipfile
from pathlib import Path

import numpy as np
import pytest

from pdeloop.cli import FAILED, main
from pdeloop.commands import new
from pdeloop.messages import array_files
from pdeloop.messages.array_files import packed, unpacked
from pdeloop.messages.files import FileError, make_folder, open_own, read_json, write_atomically
from pdeloop.messages.spec import ParameterError, read_document
from tuner_node import checkpoint


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


def test_content_and_then_its_name_are_on_the_disk_when_a_write_returns(tmp_path, monkeypatch):
    synced, replace, calls = os.fsync, os.replace, []

    def fsync(descriptor: int) -> None:
        calls.append(("fsync", str(Path(f"/proc/self/fd/{descriptor}").readlink())))
        synced(descriptor)

    def renamed(*names: str | os.PathLike[str]) -> None:
        calls.append(("replace", *map(os.fspath, names)))
        replace(*names)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", renamed)
    write_atomically(tmp_path / "file", b"content")
    part, path = str(tmp_path / "file.part"), str(tmp_path / "file")
    assert calls == [("fsync", part), ("replace", part, path), ("fsync", str(tmp_path))]
    calls.clear()
    make_folder(tmp_path / "a" / "b")
    # A name is an entry of the folder above it.
    assert {found for _, found in calls} == {str(tmp_path), str(tmp_path / "a")}


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


def test_a_part_that_a_crash_left_is_replaced(tmp_path):
    (tmp_path / "file.part").write_bytes(b"half of the conte")
    write_atomically(tmp_path / "file", b"new ", b"content")
    assert (tmp_path / "file").read_bytes() == b"new content"
    assert not (tmp_path / "file.part").exists()


def test_arrays_come_back_from_numbers_to_the_bit() -> None:
    arrays = {
        "complex": np.array([[1.5 - 2j, 3j]]),
        "text": np.array("a model of u²"),
        "flag": np.array(True),
        "count": np.array([3, -4]),
        "large": np.array([1e300, -np.inf, 0.1, 5e-324]),
        "none": np.empty((0, 2)),
    }
    numbers = packed(arrays)
    assert ((numbers >= 0.0) & (numbers < 2.0**24)).all() and (numbers % 1.0 == 0.0).all()
    found = unpacked(np.append(numbers, np.zeros(7)))
    assert list(found) == list(arrays)
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype and found[name].shape == array.shape
        assert found[name].tobytes() == array.tobytes()
    with pytest.raises(ValueError, match="no arrays"):
        unpacked(numbers[:20])
