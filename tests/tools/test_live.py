# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Which loop the live page watches: the one that runs, or the one it was told."""

from __future__ import annotations

import json
from pathlib import Path

from pdeloop.domain import Live, announced, running
from pdeloop.monitor.finder import Finder
from tuner_node.run_folder import RunFolder


def test_a_loop_is_found_as_long_as_it_runs(tmp_path, monkeypatch):
    monkeypatch.setattr("pdeloop.domain.DOMAINS_FOLDER", tmp_path / "domains")
    assert running() == []
    with announced(17, tmp_path / "first"):
        (live,) = running()
        assert live.domain == 17 and live.folder == (tmp_path / "first").resolve()
        with announced(18, tmp_path / "second"):
            assert [live.domain for live in running()] == [18, 17]
        assert [live.domain for live in running()] == [17]
    assert running() == [] and list((tmp_path / "domains").iterdir()) == []


def test_what_a_killed_loop_left_behind_is_not_found_and_goes_away(tmp_path, monkeypatch):
    monkeypatch.setattr("pdeloop.domain.DOMAINS_FOLDER", tmp_path)
    left = tmp_path / "live-1-17"
    left.write_text(json.dumps({"domain": 17, "folder": "x", "started": 1, "network": False}))
    assert running() == [] and not left.exists()


def live(domain: int, folder: str, started: float) -> Live:
    return Live(domain, Path(folder).resolve(), started)


def test_the_finder_stays_with_a_training_until_it_ends_and_takes_the_newest_next():
    found = [live(1, "a", 1.0)]
    finder = Finder(None, None, lambda: found)
    assert finder.find() == live(1, "a", 1.0)
    found.insert(0, live(2, "b", 2.0))
    assert finder.find() == live(1, "a", 1.0)
    del found[1]
    assert finder.find() == live(2, "b", 2.0)
    del found[0]
    assert finder.find() == live(2, "b", 2.0)  # what it was stays on the page


def test_a_folder_in_a_given_domain_is_watched_while_a_process_works_on_it(tmp_path):
    (tmp_path / "lock").touch()
    finder = Finder(tmp_path, 9, list)
    assert finder.find() is None  # nothing runs: what is there is shown as it was left
    with RunFolder(tmp_path).locked():
        assert finder.find() == Live(9, tmp_path, 0.0)


def test_a_given_folder_or_domain_is_the_only_one():
    found = [live(2, "b", 2.0), live(1, "a", 1.0)]
    assert Finder(Path("a"), None, lambda: found).find() == live(1, "a", 1.0)
    assert Finder(Path("c"), None, lambda: found).find() is None
    assert Finder(None, 1, lambda: found).find() == live(1, "a", 1.0)
    assert Finder(None, 9, lambda: found).find() == Live(9, None, 0.0)
