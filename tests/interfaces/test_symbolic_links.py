# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""No symbolic link is followed where a run, its report or what tells of it is written."""

from __future__ import annotations

import os

import pytest

from pde_sim_node import run_record
from pdeloop import domain
from pdeloop.cli import FAILED, main
from pdeloop.messages.files import FileError, private_folder
from pdeloop.training_run import unused

SHOWN = ("behaviour", "gains", "orders", "spectrum")
"""The figures of a problem in the report of a training by two_point."""


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
    monkeypatch.setattr(domain, "DOMAINS_FOLDER", folder)
    folder.mkdir(mode=0o777)
    for number in domain.DOMAINS:
        (folder / str(number)).symlink_to(victim)
        (folder / f"new-live-{os.getpid()}-{number}").symlink_to(victim)
    with pytest.raises(OSError, match="it is a symbolic link"), domain.own_domain():
        pass
    with domain.announced(7, tmp_path):
        assert [found.domain for found in domain.running()] == [7]
    assert victim.read_text() == "precious"
    assert folder.stat().st_mode & 0o777 == 0o700


def test_the_folder_of_the_domains_must_be_this_users_own(tmp_path, monkeypatch):
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    (tmp_path / "elsewhere").mkdir()
    link = tmp_path / "domains"
    link.symlink_to(tmp_path / "elsewhere")
    monkeypatch.setattr(domain, "DOMAINS_FOLDER", link)
    with pytest.raises(domain.DomainError, match="is not a folder of this user"):
        domain.own_domain().__enter__()
    with domain.announced(7, tmp_path):
        assert domain.running() == []
    assert list((tmp_path / "elsewhere").iterdir()) == []
    if os.getuid() == 0:
        foreign = tmp_path / "foreign"
        foreign.mkdir(mode=0o777)
        os.chown(foreign, 12345, 12345)
        with pytest.raises(FileError, match="is not a folder of this user"):
            private_folder(foreign)


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
