# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Bags of other writers, storages and versions: read, converted, or refused with advice."""

from __future__ import annotations

import json
import re
import shutil
import sqlite3
from functools import partial
from pathlib import Path

import pytest
from mcap.writer import CompressionType, Writer

from pdeloop.bags.reader import Bag
from pdeloop.bags.recorded_run import RecordedRun
from pdeloop.bags.verify import verify
from pdeloop.cli import main
from pdeloop.identification import identify_bag
from pdeloop.messages.spec import ParameterError
from recorder_node.bag import BagError
from tests.support.converted import convert
from tests.support.written_bag import written


def test_what_is_no_bag_is_a_clear_error(tmp_path):
    for path, words in ((tmp_path / "none", "no bag at"), (tmp_path, "there is no .mcap file")):
        with pytest.raises(BagError, match=words):
            Bag(path)
    run = tmp_path / "run"
    run.mkdir()
    (run / "parameters.yaml").write_text("")
    with pytest.raises(BagError, match="is a run without a bag; pdeloop train --record"):
        Bag(run)
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: [1")
    (tmp_path / "x.mcap").write_bytes(b"nonsense")
    with pytest.raises(
        BagError, match="cannot be read, as it is damaged: it is empty or not an MCAP file"
    ):
        list(Bag(tmp_path).messages())


def test_bags_of_another_storage_are_refused_with_what_converts_them(tmp_path):
    sqlite = tmp_path / "old"
    sqlite.mkdir()
    with sqlite3.connect(sqlite / "old.db3") as connection:
        connection.execute("CREATE TABLE messages (id INTEGER)")
    connection.close()
    with pytest.raises(BagError, match=r"is a sqlite3 bag; expected MCAP .*rosbags-convert --src"):
        Bag(sqlite)
    whole = tmp_path / "whole"
    whole.mkdir()
    (whole / "a.mcap.zstd").touch()
    with pytest.raises(BagError, match="is compressed by rosbag2; expected MCAP"):
        Bag(whole)
    single = written(tmp_path)
    text = (single / "metadata.yaml").read_text()
    (single / "metadata.yaml").write_text(
        text.replace("compression_mode: ''", "compression_mode: MESSAGE")
    )
    with pytest.raises(BagError, match="is compressed by rosbag2; expected MCAP"):
        Bag(single)


def test_what_rosbags_convert_makes_of_a_sqlite3_bag_is_read(tmp_path):
    """The command that the refusal names."""
    source, converted = tmp_path / "sqlite", tmp_path / "sqlite-mcap"
    files = ("--src", str(written(tmp_path)), "--dst", str(source))
    convert("rosbags-convert", *files, "--dst-storage", "sqlite3")
    with pytest.raises(BagError, match="sqlite3") as refused:
        Bag(source)
    convert(*str(refused.value).split("Convert it: ")[1].split())
    assert [e.missing for e in Bag(converted).episodes()] == [[], []]


@pytest.mark.parametrize("finished", [False, True])
def test_bags_of_other_writers_are_read(tmp_path, finished):
    """As rosbag2 writes them: topics declared within chunks; lz4, or messages outside chunks."""
    original = list(Bag(written(tmp_path)).messages())
    for number, how in enumerate(
        (
            {"compression": CompressionType.LZ4},
            {"compression": CompressionType.NONE},
            {"use_chunking": False},
        )
    ):
        folder = tmp_path / str(number)
        folder.mkdir()
        with (folder / "x.mcap").open("wb") as file:
            writer = Writer(file, chunk_size=1000, **how)
            writer.start("ros2")
            schema = writer.register_schema("a/msg/B", "ros2msg", b"float64 c")
            channels = {
                topic: writer.register_channel(topic, "cdr", schema)
                for topic in {message.topic for message in original}
            }
            for message in original:
                writer.add_message(
                    channels[message.topic], message.when, message.data, message.when
                )
            writer.finish() if finished else writer.flush()
        again = list(Bag(folder).messages())
        assert [(m.topic, m.when, m.data) for m in again] == [
            (m.topic, m.when, m.data) for m in original
        ]


@pytest.mark.parametrize("value", [None, "x", {}, [], True, -1, 10**30])
@pytest.mark.parametrize("name", ["seed", "sensor_delays", "state_weight", "evaluation_fields"])
def test_parameters_of_a_bag_that_are_none_are_refused(tmp_path, name, value):
    bag = Path(shutil.copytree(OLD, tmp_path / "bag"))
    content = json.loads((bag / "parameters.json").read_text())
    ((run, values),) = content.items()
    words = f"parameter '{name}' is .*; expected|parameters.json cannot be read: expected whole"
    (bag / "parameters.json").write_text(json.dumps({run: values | {name: value}}))
    for read in (verify, partial(identify_bag, given={})):
        with pytest.raises((ParameterError, BagError), match=words):
            read(bag)


OLD = Path(__file__).parents[1] / "data" / "bag_0_1"


def test_a_bag_of_the_version_before_is_read_verified_and_identified_from(tmp_path):
    bag = Bag(OLD)
    assert bag.finished and len(list(bag.episodes())) == 5
    report = verify(OLD)
    assert (report.incomplete, len(report.notes)) == ([], 2), report.text()
    assert "another fingerprint of the plant" in report.notes[0]
    assert (
        "the tuner's policies cannot be followed without its rollouts" in report.notes[1]
    )  # its budget had other parts
    assert report.compared["targets"] == 1
    assert report.compared["costs"] == 1 + 8 + 2 * 2 + 3
    steps, compared = 30 * report.compared["costs"], report.compared["steps"]
    if report.differences:  # another processor than the recording one's: up to the first of each
        assert 0 < compared <= steps
    else:
        assert compared == steps
    for text in report.differences:
        recorded, again = map(float, re.findall(r"re(?:corded|computed) (\S+?)(?:,|$)", text))
        assert again == pytest.approx(recorded, rel=1e-6), text
    assert identify_bag(OLD, {}).steps > 0


def test_what_was_compared_is_numbers_and_what_cannot_be_verified_is_refused(tmp_path, capsys):
    main(["bag", "verify", str(OLD), "--json"])
    assert json.loads(capsys.readouterr().out)["compared"]["costs"] == 1 + 8 + 2 * 2 + 3
    assert main(["bag", "verify", str(OLD), "--equation", "kdv"]) == 1
    assert "--equation is kdv, but that of the run is burgers" in capsys.readouterr().err
    without = Path(shutil.copytree(OLD, tmp_path / "bag"))
    (without / "parameters.json").unlink()
    assert main(["bag", "verify", str(without)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("pdeloop: nothing was recomputed")
    assert "its parameters are not in the bag" in line


def test_another_target_than_the_plants_is_a_difference(monkeypatch):
    target = Bag(OLD).target()
    assert target is not None
    monkeypatch.setattr(Bag, "target", lambda bag: target + 1.0)
    monkeypatch.setattr(RecordedRun, "finish", lambda run, claims: None)
    assert verify(OLD).differences[0].startswith("target of run 1299076055067259, entry [0, 0]")
