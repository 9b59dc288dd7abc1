# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Moving pictures of a run: what they show, and the files that they become."""

from __future__ import annotations

import base64
import stat
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pde_sim_node.build import build_plant
from pdeloop import animation
from pdeloop.animation import FRAMES_PER_SECOND, HOLD, pictures
from pdeloop.cli import FAILED, main
from pdeloop.finished_run import load_run
from pdeloop.method.seeds import Purpose, derive
from pdeloop.report import page
from pdeloop.report.data import ProblemData, behaviours
from tests.support.small import SMALL

STAND_IN = f"""#!{sys.executable}
import pathlib, sys
pathlib.Path(sys.argv[-1]).write_bytes(sys.stdin.buffer.read())
"""
"""A program that stands in for ffmpeg: its film is the pixels that it was given."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("animated") / "run"
    assert main(["train", str(SMALL), "--in-process", "--iterations", "2", "--out", str(out)]) == 0
    return out


def shown(folder: Path) -> ProblemData:
    run = load_run(folder)
    return ProblemData({"adapted": run}, [], 0, build_plant(run.values))


def test_all_controllers_begin_with_one_field_and_cost_what_the_evaluation_measured(
    run: Path,
) -> None:
    data = shown(run)
    seed = derive(int(data.first.values["evaluation_seed"]), Purpose.EVALUATION_FIELD, 2)
    found = behaviours(data, seed)
    assert [b.controller for b in found] == ["none", "lqt", "adapted"]
    for b in found:
        assert np.array_equal(b.states[0], found[0].states[0])
        assert b.cost == pytest.approx(data.costs[b.controller][0, 2], rel=1e-12)
    assert not np.array_equal(found[0].states[-1], found[2].states[-1])


def test_a_gif_has_the_pictures_and_rests_on_the_last(run: Path, tmp_path: Path) -> None:
    path = tmp_path / "small.gif"
    assert main(["animate", str(run), "--out", str(path), "--seconds", "0.25", "--field", "1"]) == 0
    drawn = pictures(shown(run), field=1, seconds=0.25)
    with Image.open(path) as film:
        assert film.n_frames == len(drawn) == round(0.25 * FRAMES_PER_SECOND)
        assert film.info["loop"] == 0
        for k, one in enumerate(drawn):
            film.seek(k)
            told = np.asarray(film.convert("RGB"))
            assert told.shape == one.shape and np.array_equal(told[0, 0], [255, 255, 255])
            # So few colours as a GIF is given are near those that were drawn.
            assert np.abs(told.astype(float) - one).mean() < 4.0
        assert film.info["duration"] == 1000 * HOLD
    assert not np.array_equal(drawn[0], drawn[-1])


def test_without_a_name_it_is_in_the_folder_of_the_run(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["animate", str(run), "--seconds", "0.2"]) == 0
    path = run / "animation.gif"
    assert str(path) in capsys.readouterr().out
    assert path.read_bytes().startswith(b"GIF89a")


def test_a_report_has_it_on_its_page_when_asked(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(animation, "FRAMES_PER_SECOND", 0.5)
    monkeypatch.setattr(page, "_of_problem", lambda problem: iter(()))  # no other figures
    assert main(["report", str(run), "--animate", "--out", str(tmp_path)]) == 0
    film = (tmp_path / "small-animation.gif").read_bytes()
    text = (tmp_path / "index.html").read_text()
    assert film.startswith(b"GIF89a") and base64.b64encode(film).decode() in text
    assert text.index('id="small-animation"') < text.index('id="costs"')


def test_ffmpeg_is_given_every_pixel(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "ffmpeg"
    program.write_text(STAND_IN)
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", str(tmp_path))
    path = tmp_path / "small.mp4"
    assert main(["animate", str(run), "--out", str(path), "--seconds", "0.2"]) == 0
    expected = pictures(shown(run), seconds=0.2)
    height, width = (size - size % 2 for size in expected[0].shape[:2])
    assert path.read_bytes() == b"".join(one[:height, :width].tobytes() for one in expected)
    program.write_text(f"#!{sys.executable}\nraise SystemExit('no such codec')\n")
    path.unlink()
    assert main(["animate", str(run), "--out", str(path), "--seconds", "0.2"]) == FAILED
    assert not path.exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--out", "film.mp4"), "film.mp4 needs ffmpeg, which is not found"),
        (("--out", "film.avi"), "expected a file that ends in .gif or .mp4"),
        (("--out", "film.gif", "--field", "999"), "field is 999; the closing evaluation had"),
        (("--out", "nowhere/film.gif", "--seconds", "0.2"), "cannot write nowhere/film.gif"),
    ],
)
def test_what_cannot_be_written_is_said_in_one_sentence(
    run: Path,
    words: tuple[str, ...],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.chdir(tmp_path)
    assert main(["animate", str(run), *words]) == FAILED
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_run_of_another_plant_is_refused(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def other(run: Any) -> str:
        return "the run had another plant"

    monkeypatch.setattr(animation, "another_loop", other)
    with pytest.raises(ValueError, match="another plant, so it cannot be animated"):
        animation.animated(load_run(run))
