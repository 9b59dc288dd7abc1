# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The parameters of a bag that was copied, converted or begun anew are found, or asked for."""

from __future__ import annotations

import json
import shlex
import shutil
from pathlib import Path

import pytest
import zstandard

from pdeloop.bags.mcap_messages import Message
from pdeloop.bags.reader import Bag
from pdeloop.bags.verify import verify
from pdeloop.cli import main
from pdeloop.identification import identify_bag
from pdeloop.messages.parameters import PLANT
from pdeloop.messages.topics import TARGET
from recorder_node.bag import BagError
from recorder_node.recording import PARAMETERS_TOPIC
from tests.support.converted import convert
from tests.support.recorded_here import change_metadata, messages_of, write
from tests.support.verified_bag import by_episodes, verified


@pytest.mark.parametrize("beside", [(), ("parameters.json",), ("metadata.yaml",)])
def test_the_file_of_a_bag_is_verified_alone(run, tmp_path, beside):
    """Copied without what was beside it; its parameters stand in it."""
    alone = tmp_path / "alone"
    alone.mkdir()
    for name in ("bag.mcap", *beside):
        shutil.copy(run / "bag" / name, alone)
    report = verify(alone)
    assert report.good and report.notes == [], report.text()
    assert identify_bag(alone, {}).model.A.shape == (4, 4)


def without_notes(run: Path, messages: list[Message]) -> None:
    """The bag as an earlier version wrote it: its parameters are only beside it."""
    kept = run.parent / "kept.json"
    shutil.copy(run / "bag" / "parameters.json", kept)
    shutil.rmtree(run / "bag")
    write(run / "bag", [[m for m in messages if m.topic != PARAMETERS_TOPIC]])
    shutil.copy(kept, run / "bag" / "parameters.json")


def test_parameters_are_found_in_the_folder_of_the_run(run, messages, tmp_path):
    without_notes(run, messages)
    assert verify(run).good
    (run / "bag" / "parameters.json").unlink()
    assert verify(run).good
    assert verify(run / "bag").good
    shutil.copytree(run / "bag", tmp_path / "copy")
    (note, *_) = verify(tmp_path / "copy").notes
    assert "its parameters are not in the bag" in note and "parameters.yaml of the run" in note
    assert verified(tmp_path / "copy") == 1


def test_a_plant_that_told_no_parameters_is_not_to_be_looked_for_in_a_file(run, messages):
    """As of a node of its own: those of controller and tuner are there."""
    without_notes(run, messages)
    (run / "parameters.yaml").unlink()
    path = run / "bag" / "parameters.json"
    known = json.loads(path.read_text())
    plant = {spec.name for spec in PLANT}
    kept = {run: {k: v for k, v in own.items() if k not in plant} for run, own in known.items()}
    path.write_text(json.dumps(kept))
    (note, *_) = verify(run / "bag").notes
    assert "its plant gave no parameters" in note and "--parameters" not in note


@pytest.mark.parametrize("given", ["parameters.yaml", "parameters.json"])
def test_the_parameters_that_the_advice_names_are_taken(run, messages, tmp_path, given):
    without_notes(run, messages)
    bag = Path(shutil.copytree(run / "bag", tmp_path / "copy"))
    (bag / "parameters.json").unlink()
    file = run / given if given == "parameters.yaml" else run / "bag" / given
    assert main(["bag", "verify", str(bag), "--parameters", str(file)]) == 0


def test_parameters_in_a_later_bag_of_the_run_are_those_of_the_run(run, messages):
    without_notes(run, messages)
    shutil.rmtree(run / "bag")
    (run / "run.json").unlink()
    first, second = by_episodes(messages, 4)
    write(run / "bag", [[m for m in first if m.topic != PARAMETERS_TOPIC]])
    notes = [m for m in messages if m.topic == PARAMETERS_TOPIC]
    about_none = [m for m in first if m.topic == f"/{TARGET.name}" or m.topic == "/model"]
    write(run / "bag-2", [[*notes, *about_none, *second]])
    report = verify(run)
    assert report.notes == [] and "missing: run.json" in report.text()
    assert "everything that is there is the same to the bit" in report.text()


def converted(refusal: str) -> None:
    """Follow the advice in a refusal."""
    convert(*shlex.split(refusal.split("onvert it: ")[1]))


@pytest.mark.parametrize("old", [False, True])
def test_a_bag_that_was_converted_as_we_advise_is_verified(run, messages, tmp_path, old):
    if old:
        without_notes(run, messages)
    sqlite = tmp_path / "lab"
    source = ("--src", str(run / "bag"), "--dst", str(sqlite), "--dst-storage", "sqlite3")
    convert("rosbags-convert", *source)
    shutil.copy(run / "bag" / "parameters.json", sqlite)
    with pytest.raises(BagError) as refused:
        Bag(sqlite)
    converted(str(refused.value))
    report = verify(tmp_path / "lab-mcap")
    assert report.good and not report.notes, report.text()
    assert identify_bag(tmp_path / "lab-mcap", {}).model.A.shape == (4, 4)


def test_a_file_that_rosbag2_compressed_is_verified_after_what_we_advise(run, tmp_path):
    bag = run / "bag"
    content = (bag / "bag.mcap").read_bytes()
    (bag / "bag.mcap.zstd").write_bytes(zstandard.compress(content))
    (bag / "bag.mcap").unlink()
    change_metadata(
        bag,
        lambda told: told.update(
            compression_format="zstd",
            compression_mode="FILE",
            relative_file_paths=["bag.mcap.zstd"],
        ),
    )
    with pytest.raises(BagError, match="is compressed by rosbag2") as refused:
        Bag(bag)
    converted(str(refused.value))
    assert verify(run / "bag-mcap").good


def test_a_bag_that_expands_too_far_is_read_after_what_we_advise(tmp_path):
    text = bytes.fromhex("00010000") + (2**20).to_bytes(4, "little") + bytes(2**20)
    talk = [Message("/talk", "std_msgs/msg/String", when, text) for when in range(100)]
    folder = write(tmp_path / "lab", [talk])
    with pytest.raises(BagError, match="decompresses to more than 100 times") as refused:
        messages_of(folder)
    converted(str(refused.value))
    assert len(messages_of(tmp_path / "lab-mcap")) == 100
